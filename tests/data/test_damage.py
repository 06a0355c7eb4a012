"""A damaged dataset: read through when it is collected again, and made what it was; loading refuses it."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from lw_torchrl.data import DatasetError, LanguageWorldExperienceReplay, collect_demonstrations, missing_episodes
from lw_torchrl.data import collect as collect_module
from lw_torchrl.data.dataset import read_metadata
from lw_torchrl.data.memory_map import COLUMNS, load_rows, whole_episodes

STEPS, EPISODES = 12, 3
OPTIONS = dict(episodes_per_task=EPISODES, seed=3, noise_scale=(0.0, 0.3), max_steps=STEPS, progress=False)
ALL = [(task, k) for task in ("push", "reach") for k in range(EPISODES)]


def collect(root, **changed):
    return collect_demonstrations(["push", "reach"], root=root, **{**OPTIONS, **changed})


def tree(root):
    return {str(path.relative_to(root)): path.read_bytes() for path in sorted(root.rglob("*")) if path.is_file()}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return collect(tmp_path_factory.mktemp("made") / "demos")


@pytest.fixture
def root(made, tmp_path):
    """A copy, to be damaged."""
    return shutil.copytree(made.root, tmp_path / "demos")


@pytest.fixture
def run_again(monkeypatch):
    """The episodes that are simulated."""
    ran, real = [], missing_episodes.run_episodes

    def run(env, policy, episodes, **options):
        ran.extend((task, number) for task, numbers in episodes.items() for number in numbers)
        return real(env, policy, episodes, **options)

    monkeypatch.setattr(missing_episodes, "run_episodes", run)
    return ran


def flip(path, at, number=3):
    content = bytearray(path.read_bytes())
    content[at : at + number] = bytes(byte ^ 0xFF for byte in content[at : at + number])
    path.write_bytes(content)


def edit(path, change):
    found = json.loads(path.read_text())
    change(found)
    path.write_text(json.dumps(found))


def cut(path, number):
    path.write_bytes(path.read_bytes()[:-number])


def more(path):
    path.write_bytes(path.read_bytes() + b"12345678")


# What is done to a dataset, and the episodes that are lost by it.
DAMAGE = {
    "a truncated column": (lambda r: cut(r / "data/next/observation.memmap", 8), ALL[5:]),
    "a column that lacks half": (lambda r: cut(r / "data/action.memmap", 3 * STEPS * 16), ALL[3:]),
    "a column that is too long": (lambda r: more(r / "data/task_id.memmap"), []),
    "flipped bytes in one episode": (lambda r: flip(r / "data/observation.memmap", 2 * STEPS * 156 + 500), ALL[2:3]),
    "flipped bytes across two": (lambda r: flip(r / "data/action.memmap", 4 * STEPS * 16 - 1), ALL[3:5]),
    "a flag that is 2": (lambda r: flip(r / "data/next/done.memmap", STEPS + 2, 1), ALL[1:2]),
    "a column of zeros": (
        lambda r: (r / "data/episode.memmap").write_bytes(bytes(6 * STEPS * 8)),
        [episode for episode in ALL if episode[1]],  # of the others, zeros are right
    ),
    "a missing column": (lambda r: (r / "data/unclipped_action.memmap").unlink(), ALL),
    "an empty column": (lambda r: (r / "data/unclipped_action.memmap").write_bytes(b""), ALL),
    "a missing meta.json": (lambda r: (r / "data/meta.json").unlink(), []),
    "a missing meta.json below": (lambda r: (r / "data/next/meta.json").unlink(), []),
    "half a meta.json": (lambda r: cut(r / "data/meta.json", 40), []),
    "another dtype in meta.json": (
        lambda r: edit(r / "data/meta.json", lambda m: m["action"].update(dtype="torch.int32")),
        [],
    ),
    "another shape in meta.json": (lambda r: edit(r / "data/next/meta.json", lambda m: m.update(shape=[7])), []),
    "a nested tensor in meta.json": (
        lambda r: edit(r / "data/meta.json", lambda m: m["observation"].update(is_nested=True)),
        [],
    ),
    "no rows at all": (lambda r: shutil.rmtree(r / "data"), ALL),
    "half a metadata.json": (lambda r: cut(r / "metadata.json", 300), ALL),
    "an empty metadata.json": (lambda r: (r / "metadata.json").write_bytes(b""), ALL),
    "a metadata.json of zeros": (lambda r: (r / "metadata.json").write_bytes(bytes(4096)), ALL),
    "a first success that was none": (
        lambda r: edit(
            r / "metadata.json",
            lambda m: (m["episodes"]["first_success"].__setitem__(1, 9), m["episodes"]["success"].__setitem__(1, True)),
        ),
        ALL[1:2],
    ),
    "other numbers of the tasks": (
        lambda r: edit(r / "metadata.json", lambda m: m["task_ids"].update(reach=3)),
        ALL[3:],
    ),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_collected_again_it_is_what_it_was_and_whole_episodes_are_not_run_again(root, made, run_again, name):
    damage, lost = DAMAGE[name]
    before = tree(root)
    damage(root)
    assert tree(root) != before
    with pytest.warns(UserWarning, match=f"demos' is damaged; {len(ALL) - len(lost)} of 6 episodes are kept"):
        found = collect(root)
    assert run_again == lost
    assert tree(root) == tree(made.root) == before
    assert found.episodes == made.episodes
    assert collect(root) == found


@pytest.mark.parametrize("name", DAMAGE)
def test_a_dataset_whose_files_are_not_as_they_should_be_is_not_loaded(root, name):
    DAMAGE[name][0](root)
    before = tree(root)
    with pytest.raises(DatasetError, match="the same collect_demonstrations"):
        LanguageWorldExperienceReplay(root)
    assert tree(root) == before


@pytest.mark.parametrize("size", [0, 1, -1, -8])
def test_a_column_of_another_size_never_loads_as_zeros(root, size):
    for *parents, name in COLUMNS:
        path = root.joinpath("data", *parents, f"{name}.memmap")
        content = path.read_bytes()
        changed = content[:size] if size <= 0 else content + b"1"
        path.write_bytes(changed)
        with pytest.raises(DatasetError, match=rf"{name}.memmap has {len(changed)} bytes, not {len(content)}"):
            load_rows(read_metadata(root))
        assert path.read_bytes() == changed, "mapping it would lengthen it"
        path.write_bytes(content)


def test_a_damaged_redrawn_dataset_draws_the_same_episodes_again(tmp_path):
    options = dict(episodes_per_task=3, max_steps=50, noise_scale=0.4, redraw_failures=True, progress=False)
    made = collect_demonstrations("reach", root=tmp_path / "demos", **options)
    assert made.attempts["reach"] > 3, "the test wants a failure"
    before = tree(made.root)
    flip(made.root / "data" / "action.memmap", 50 * 16)
    with pytest.warns(UserWarning, match="2 of 3 episodes are kept"):
        assert collect_demonstrations("reach", root=tmp_path / "demos", **options) == made
    assert tree(made.root) == before


@pytest.mark.parametrize("stop", range(8))  # 5 episodes put back, 1 run, the rows, the metadata
def test_mending_can_be_interrupted_anywhere(root, made, monkeypatch, stop):
    flip(root / "data/observation.memmap", 2 * STEPS * 156)
    left = [stop]

    def counting(module, name):
        real = getattr(module, name)

        def call(*args, **options):
            if not left[0]:
                raise KeyboardInterrupt
            left[0] -= 1
            return real(*args, **options)

        monkeypatch.setattr(module, name, call)

    counting(collect_module.EpisodeFiles, "put")
    counting(collect_module, "write_metadata")
    counting(collect_module, "write_rows")
    with pytest.warns(UserWarning, match="5 of 6 episodes are kept"), pytest.raises(KeyboardInterrupt):
        collect(root)
    monkeypatch.undo()
    with pytest.MonkeyPatch.context() as quiet:
        quiet.setattr(collect_module.warnings, "warn", lambda *_, **__: None)
        collect(root)
    assert tree(root) == tree(made.root)


def test_a_damaged_dataset_of_another_configuration_is_left_alone(root):
    flip(root / "data/observation.memmap", 0)
    before = tree(root)
    with pytest.raises(DatasetError, match=r"seed \(3, now 4\)"):
        collect(root, seed=4)
    assert tree(root) == before


@pytest.mark.parametrize(
    "content", [b"", b"{", b"[]", b"{}", b'{"format": "minari"}', b'{"format": "x", "version": 2}']
)
def test_other_peoples_metadata_and_data_are_left_alone(tmp_path, content):
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "observation.memmap").write_bytes(b"theirs")
    (tmp_path / "data" / "main_data.hdf5").write_bytes(b"years of work")
    (tmp_path / "metadata.json").write_bytes(content)
    before = tree(tmp_path)
    with pytest.raises(DatasetError):
        collect(tmp_path)
    assert tree(tmp_path) == before


@pytest.mark.parametrize("where", ["other.pickle", "next/other.pickle", "note/meta.json", "notes.txt"])
def test_what_is_no_part_of_a_dataset_is_refused_and_left_alone(root, where):
    (root / "data" / where).parent.mkdir(exist_ok=True)
    (root / "data" / where).write_bytes(b"cos\nsystem\n(S'false'\ntR.")
    before = tree(root)
    for read in (LanguageWorldExperienceReplay, collect):
        with pytest.raises(DatasetError, match="is no part of a dataset; move it elsewhere"):
            read(root)
    assert tree(root) == before


def test_hidden_files_do_no_harm(root, made):
    (root / "data" / ".DS_Store").write_bytes(b"a Mac was here")
    assert (load_rows(read_metadata(root)) == load_rows(made)).all()


def test_the_checksums_are_of_the_rows(made):
    assert whole_episodes(made, progress=False) == list(made.episodes)
    assert len({episode.checksum for episode in made.episodes}) == len(made.episodes)


def test_tensordict_reads_the_rows_too_and_would_have_written_the_same(made, tmp_path):
    theirs = TensorDict.load_memmap(made.root / "data", allow_pickle=False)
    assert (theirs == load_rows(made)).all()
    assert theirs.batch_size == (len(ALL) * STEPS,)
    theirs.clone().memmap(tmp_path / "data")
    ours = tree(made.root / "data")
    for name, content in tree(tmp_path / "data").items():
        same = json.loads if name.endswith("meta.json") else bytes
        assert same(content) == same(ours[name])
    assert ours.keys() == tree(tmp_path / "data").keys()


def test_what_was_numbered_otherwise_is_mended_with_todays_numbers(root, made):
    stored = {"push": 50, "reach": 51}
    edit(root / "metadata.json", lambda found: found.update(task_ids=stored))
    for name in ("task_id", "next/task_id"):
        np.repeat([50, 51], EPISODES * STEPS).tofile(root / "data" / f"{name}.memmap")
    with pytest.warns(UserWarning, match="0 of 6 episodes are kept"):  # their checksums are of other numbers
        collect(root)
    assert tree(root) == tree(made.root)


def test_half_made_episodes_of_other_numbers_get_todays(tmp_path, made, monkeypatch):
    real, left = collect_module.EpisodeFiles.put, [3]

    def put(self, task, episode, steps):
        if not left[0]:
            raise KeyboardInterrupt
        left[0] -= 1
        steps["task_id"], steps["next", "task_id"] = torch.full((STEPS,), 51), torch.full((STEPS,), 51)
        real(self, task, episode, steps)

    monkeypatch.setattr(collect_module.EpisodeFiles, "put", put)
    with pytest.raises(KeyboardInterrupt):
        collect(tmp_path / "demos", num_envs=2)
    monkeypatch.undo()
    collect(tmp_path / "demos")
    assert tree(tmp_path / "demos") == tree(made.root)


@pytest.mark.parametrize("name", ["data", ".partial"])
def test_a_link_in_the_place_of_a_folder_that_is_to_be_written_is_refused_before_anything_is_gone(
    root, made, tmp_path, name
):
    elsewhere = tmp_path / "elsewhere"
    if name == "data":
        (root / name).rename(elsewhere)
    else:
        elsewhere.mkdir()
    (root / name).symlink_to(elsewhere)
    assert len(LanguageWorldExperienceReplay(root)) == made.num_steps
    flip(root / "data" / "action.memmap", 20)
    before = tree(root), tree(elsewhere)
    with pytest.raises(DatasetError, match=rf"root: .*{name}' must be a folder .*, it is a link"):
        collect(root)
    assert (tree(root), tree(elsewhere)) == before


@pytest.mark.parametrize(
    ("column", "label"), [("action", "executed"), ("expert_action", "expert"), ("unclipped_action", "unclipped")]
)
def test_an_action_that_is_no_number_is_not_loaded(root, column, label):
    path = root / "data" / f"{column}.memmap"
    values = np.fromfile(path, "f4")
    values[17] = np.nan
    values.tofile(path)
    with pytest.raises(DatasetError, match=f"no finite number, for label='{label}'"):
        LanguageWorldExperienceReplay(root, label=label, check=False)
    values[17:19] = 3e38  # whose sum overflows
    values.tofile(path)
    assert len(LanguageWorldExperienceReplay(root, label=label, check=False)) == len(values) // 4
