"""Pictures of datasets: what a camera would have seen, lossless, resumed, and refused where they are not right."""

from __future__ import annotations

import shutil
import zipfile

import pytest
import torch
from collecting import restate_checksums
from pictures import why_no_pictures
from torchrl.envs import TransformedEnv

import lw_torchrl as lw
from lw_torchrl.data import pictures

SIZE = {"height": 24, "width": 32}


@pytest.fixture(scope="module", autouse=True)
def _needs_open_gl():
    if missing := why_no_pictures():
        pytest.skip(missing)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    root = tmp_path_factory.mktemp("pictures") / "demos"
    lw.collect_demonstrations(
        ["drawer-open", "reach"], episodes_per_task=2, root=root, noise_scale=0.1, seed=4, max_steps=12, progress=False
    )
    lw.data.add_pictures(root, ("corner", "topview"), every=1, progress=False, **SIZE)
    return root


@pytest.fixture
def root(made, tmp_path):
    return shutil.copytree(made, tmp_path / "demos")


def load(replay, **options):
    return lw.data.load_pictures(replay, ("corner", "topview"), **SIZE, **options)


def files(root):
    return sorted((root / "pictures").rglob("*.zip"))


def test_they_are_what_a_camera_saw(made):
    replay = lw.LanguageWorldExperienceReplay(made, label="executed")
    found, rows = load(replay), replay[:]
    assert found.shape == (len(replay), 24, 64, 3)
    for task in ("drawer-open", "reach"):
        own = (rows["task_id"] == lw.task_id(task)) & (rows["episode"] == 1)
        camera = lw.transforms.CameraTransform(("corner", "topview"), **SIZE)
        env = TransformedEnv(lw.LanguageWorldEnv(task, seed=4), camera)
        state = env.reset(episode=1)
        for row in own.nonzero().flatten().tolist():
            assert torch.equal(state["observation"][0], rows["observation"][row])
            assert torch.equal(state["pixels"][0], found[row])
            state = env.step(state.set("action", rows["action"][row : row + 1]))["next"]
        env.close()


def test_they_follow_the_rows_that_a_buffer_shows(made):
    whole = lw.LanguageWorldExperienceReplay(made, label="executed")
    some = lw.LanguageWorldExperienceReplay([made], episodes=[{"reach": [1]}], after_success=0, label="executed")
    rows, every = some[:], load(whole)
    where = (whole[:]["task_id"] == lw.task_id("reach")) & (whole[:]["episode"] == 1)
    assert torch.equal(load(some), every[where][: len(rows)])
    some.add_column("pixels", load(some))
    assert torch.equal(some[:]["pixels"], load(some))


def test_pictures_every_few_steps_are_held(made, tmp_path):
    root = shutil.copytree(made, tmp_path / "demos")
    lw.data.add_pictures(root, ("corner", "topview"), every=7, progress=False, **SIZE)
    replay = lw.LanguageWorldExperienceReplay(root, label="executed")
    each, held = load(replay), load(replay, every=7)
    step = torch.cat([torch.arange(one.length) for one in replay.demonstrations.episodes])
    assert torch.equal(held, each[torch.arange(len(each)) - step % 7])
    assert sum(len(zipfile.ZipFile(file).namelist()) for file in files(root)[:1]) in (2, 12)


def test_a_killed_call_leaves_whole_files(root, monkeypatch):
    shutil.rmtree(root / "pictures")
    kept, written = pictures._write, []

    def stop(path, taken):
        if len(written) == 1:
            raise KeyboardInterrupt
        written.append(path)
        kept(path, taken)

    monkeypatch.setattr(pictures, "_write", stop)
    with pytest.raises(KeyboardInterrupt):
        lw.data.add_pictures(root, ("corner", "topview"), progress=False, **SIZE)
    assert files(root) == written
    with pytest.raises(ValueError, match=r"has no such pictures of .*lw\.data\.add_pictures"):
        load(lw.LanguageWorldExperienceReplay(root))
    monkeypatch.setattr(pictures, "_write", lambda path, taken: written.append(path) or kept(path, taken))
    lw.data.add_pictures(root, ("corner", "topview"), progress=False, **SIZE)
    assert len(written) == 4, "existing pictures are not rendered again"
    assert len(load(lw.LanguageWorldExperienceReplay(root))) == 48


def test_no_bit_of_a_picture_changes_unnoticed(root):
    replay, file = lw.LanguageWorldExperienceReplay(root), files(root)[0]
    expected, content, refused = load(replay), file.read_bytes(), []
    for at in torch.randint(len(content), (40,), generator=torch.Generator().manual_seed(0)).tolist():
        file.write_bytes(content[:at] + bytes([content[at] ^ 1 << at % 8]) + content[at + 1 :])
        try:
            assert torch.equal(load(replay), expected)  # what the archive says of dates
        except ValueError as error:
            refused.append(str(file) in str(error))
    assert all(refused)
    assert len(refused) > 20
    with pytest.raises(ValueError, match="has no such pictures of drawer-open, episode 0"):
        lw.data.load_pictures(replay, "corner", **SIZE)


def test_episodes_that_go_otherwise_are_refused(root):
    shutil.rmtree(root / "pictures")
    actions = root / "data" / "action.memmap"
    content = bytearray(actions.read_bytes())
    content[16 * 4 : 16 * 5] = torch.tensor([0.3, 0.2, 0.1, 0.0]).numpy().tobytes()
    actions.write_bytes(content)
    with pytest.raises(ValueError, match="episode 0 of 'drawer-open' differs from its checksum"):
        lw.data.add_pictures(root, "corner", progress=False, **SIZE)
    restate_checksums(root)
    with pytest.raises(ValueError, match="differ from step 5 on when they are run again"):
        lw.data.add_pictures(root, "corner", progress=False, **SIZE)
    assert not files(root)
