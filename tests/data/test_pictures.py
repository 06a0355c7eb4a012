"""Pictures of datasets: equal to a camera's, lossless, resumed after a kill, and errors for damaged ones."""

import shutil

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
    options = {"episodes_per_task": 2, "noise_scale": 0.1, "seed": 4, "max_steps": 12, "progress": False}
    lw.collect_demonstrations(["drawer-open", "reach"], root=root, **options)
    render(root)
    return root


@pytest.fixture
def root(made, tmp_path):
    return shutil.copytree(made, tmp_path / "demos")


def render(root, **options):
    lw.data.add_pictures(root, ("corner", "topview"), progress=False, **SIZE, **options)


def load(replay, **options):
    return lw.data.load_pictures(replay, ("corner", "topview"), **SIZE, **options)


def files(root):
    return sorted((root / "pictures").rglob("*.zip"))


def test_pictures_equal_those_of_a_camera(made):
    replay = lw.LanguageWorldExperienceReplay(made, label="executed")
    images, rows = load(replay), replay[:]
    assert images.shape == (len(replay), 24, 64, 3)
    for task in ("drawer-open", "reach"):
        steps = (rows["task_id"] == lw.task_id(task)) & (rows["episode"] == 1)
        camera = lw.transforms.CameraTransform(("corner", "topview"), **SIZE)
        env = TransformedEnv(lw.LanguageWorldEnv(task, seed=4), camera)
        state = env.reset(episode=1)
        for row in steps.nonzero().flatten().tolist():
            assert torch.equal(state["observation"][0], rows["observation"][row])
            assert torch.equal(state["pixels"][0], images[row])
            state = env.step(state.set("action", rows["action"][row : row + 1]))["next"]
        env.close()


def test_pictures_belong_to_the_rows_of_a_buffer(made):
    whole = lw.LanguageWorldExperienceReplay(made, label="executed")
    part = lw.LanguageWorldExperienceReplay([made], episodes=[{"reach": [1]}], after_success=0, label="executed")
    rows, images = part[:], load(whole)
    where = (whole[:]["task_id"] == lw.task_id("reach")) & (whole[:]["episode"] == 1)
    assert torch.equal(load(part), images[where][: len(rows)])
    part.add_column("pixels", load(part))
    assert torch.equal(part[:]["pixels"], load(part))


def test_rows_between_pictures_have_the_earlier_one(root):
    render(root, every=7)
    replay = lw.LanguageWorldExperienceReplay(root, label="executed")
    each, held = load(replay), load(replay, every=7)
    step = torch.cat([torch.arange(info.length) for info in replay.demonstrations.episodes])
    assert torch.equal(held, each[torch.arange(len(each)) - step % 7])


@pytest.mark.slow
def test_a_killed_call_is_resumed(root, monkeypatch):
    shutil.rmtree(root / "pictures")
    kept, written = pictures._write, []

    def stop(path, taken):
        if len(written) == 1:
            raise KeyboardInterrupt
        written.append(path)
        kept(path, taken)

    monkeypatch.setattr(pictures, "_write", stop)
    with pytest.raises(KeyboardInterrupt):
        render(root)
    assert files(root) == written
    with pytest.raises(ValueError, match="add_pictures"):
        load(lw.LanguageWorldExperienceReplay(root))
    monkeypatch.setattr(pictures, "_write", lambda path, taken: written.append(path) or kept(path, taken))
    render(root)
    assert len(written) == 4, "existing pictures are not rendered again"
    assert len(load(lw.LanguageWorldExperienceReplay(root))) == 48


def test_every_changed_bit_of_a_picture_is_found(root):
    replay, file = lw.LanguageWorldExperienceReplay(root), files(root)[0]
    expected, content, errors = load(replay), file.read_bytes(), []
    for at in torch.randint(len(content), (40,), generator=torch.Generator().manual_seed(0)).tolist():
        file.write_bytes(content[:at] + bytes([content[at] ^ 1 << at % 8]) + content[at + 1 :])
        try:
            assert torch.equal(load(replay), expected)  # the bit belongs to the archive's dates
        except ValueError as error:
            errors.append(str(file) in str(error))
    assert all(errors)
    assert len(errors) > 20
    with pytest.raises(ValueError, match="has no such pictures"):
        lw.data.load_pictures(replay, "corner", **SIZE)


def test_episodes_that_run_differently_are_errors(root):
    shutil.rmtree(root / "pictures")
    actions = root / "data" / "action.memmap"
    content = bytearray(actions.read_bytes())
    content[16 * 4 : 16 * 5] = torch.tensor([0.3, 0.2, 0.1, 0.0]).numpy().tobytes()
    actions.write_bytes(content)
    with pytest.raises(ValueError, match="checksum"):
        render(root)
    restate_checksums(root)
    with pytest.raises(ValueError, match="step 5"):
        render(root)
    assert not files(root)
