"""metadata.json and config.json of any shape: a DatasetError, or a dataset that holds together; nothing is run."""

from __future__ import annotations

import json
import resource
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mutations import mutated

from lw_torchrl.data import CollectConfig, DatasetError, collect_demonstrations, missing_episodes
from lw_torchrl.data.dataset import parse_config, read_metadata, read_partial
from lw_torchrl.data.memory_map import load_rows

OPTIONS = dict(episodes_per_task=2, max_steps=4, noise_scale=(0.0, 0.3), progress=False)


def collect(root):
    return collect_demonstrations(["push", "reach"], root=root, **OPTIONS)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return collect(tmp_path_factory.mktemp("made") / "demos")


@pytest.fixture(scope="module")
def stated(made):
    return json.loads((made.root / "metadata.json").read_text())


@pytest.fixture(scope="module")
def root(made, tmp_path_factory):
    """The rows with metadata to be changed."""
    folder = tmp_path_factory.mktemp("changed") / "demos"
    folder.mkdir()
    (folder / "data").symlink_to(made.root / "data")
    return folder


@pytest.fixture
def little_memory():
    """Half a gigabyte more than there is: a huge allocation fails."""
    before = resource.getrlimit(resource.RLIMIT_AS)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + 2**29, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_AS, before)


def check_description(found):
    """What users of a description take for granted."""
    assert len(found.episodes) == len(found.config.tasks) * found.config.episodes_per_task
    assert found.num_steps == sum(episode.length for episode in found.episodes) <= 2**63 * len(found.episodes)
    assert set(found.success_rate) == set(found.config.tasks) == set(found.task_ids) == set(found.attempts)
    assert CollectConfig(**vars(found.config)) == found.config
    json.dumps(found.config.to_json())


@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_metadata_of_other_shapes_are_refused_or_hold_together(root, made, stated, data):
    changed = data.draw(mutated(stated))
    (root / "metadata.json").write_text(json.dumps(changed))
    try:
        found = read_metadata(root)
        check_description(found)
        rows = load_rows(found)
    except DatasetError:
        return
    assert len(rows) == found.num_steps == made.num_steps


@settings(max_examples=75, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_a_configuration_of_another_shape_is_refused_or_holds_together(tmp_path, made, data):
    path = tmp_path / "config.json"
    path.write_text(json.dumps(data.draw(mutated(made.config.to_json()))))
    try:
        found = read_partial(path, parse_config)
    except DatasetError:
        return
    assert found.to_json() == json.loads(path.read_text())
    assert CollectConfig(**vars(found)) == found


def edited(*path, value):
    def change(found):
        for name in path[:-1]:
            found = found[name]
        found[path[-1]] = value

    return change


BAD = {
    "columns of other lengths": lambda m: m["episodes"]["episode"].append(2),
    "all columns longer": lambda m: [column.append(column[-1]) for column in m["episodes"].values()],
    "no episodes": lambda m: m["episodes"].update({key: [] for key in m["episodes"]}),
    "negative lengths": edited("episodes", "length", value=[4, 4, -4, 12]),
    "no length": edited("episodes", "length", value=[4, 4, 0, 8]),
    "huge lengths": edited("episodes", "length", value=[2**62, 2**62, 2**62, 2**62]),
    "a length beyond max_steps": edited("episodes", "length", value=[4, 4, 4, 5]),
    "starts that overlap": edited("episodes", "start", value=[0, 0, 8, 12]),
    "booleans for numbers": edited("episodes", "start", value=[False, 4, 8, 12]),
    "a number for a boolean": edited("episodes", "success", value=[0, 0, 0, 0]),
    "texts for numbers": edited("episodes", "length", value=["4"] * 4),
    "floats for numbers": edited("episodes", "length", value=[4.0] * 4),
    "an episode twice": edited("episodes", "episode", value=[0, 0, 0, 1]),
    "episodes out of order": edited("episodes", "episode", value=[1, 0, 0, 1]),
    "a negative episode": edited("episodes", "episode", value=[-1, 1, 0, 1]),
    "an unknown task": edited("episodes", "task", value=["push", "push", "raech", "raech"]),
    "tasks that are none": edited("episodes", "task", value=[["push"], None, 1, {}]),
    "a first success without success": edited("episodes", "first_success", value=[3, None, None, None]),
    "a success that has none": edited("episodes", "success", value=[True, False, False, False]),
    "a success past the end": lambda m: m["episodes"].update(
        first_success=[5, None, None, None], success=[True, False, False, False]
    ),
    "a checksum too large": edited("episodes", "checksum", value=[2**32, 0, 0, 0]),
    "unknown tasks": edited("config", "tasks", value=["push", "raech"]),
    "tasks out of order": edited("config", "tasks", value=["reach", "push"]),
    "a million tasks": edited("config", "tasks", value=["reach"] * 1_000_000),
    "a set for tasks": edited("config", "tasks", value="MT10"),
    "more episodes than listed": edited("config", "episodes_per_task", value=2**62),
    "an integer of 400 digits": edited("config", "episodes_per_task", value=10**400),
    "a seed of 400 digits": edited("config", "seed", value=10**400),
    "a negative number of steps": edited("config", "max_steps", value=-1),
    "a noise of 400 digits": edited("config", "noise_scale", value=[10**400]),
    "no noise": edited("config", "noise_scale", value=[]),
    "noise that is one number": edited("config", "noise_scale", value=0.1),
    "noise that is a text": edited("config", "noise_scale", value="0.1"),
    "negative noise": edited("config", "gripper_noise_factor", value=-0.2),
    "a number for redrawing": edited("config", "redraw_failures", value=1),
    "a boolean for a number": edited("config", "noise_hold", value=True),
    "attempts of others": edited("attempts", value={"push": 2}),
    "fewer attempts than episodes": edited("attempts", "push", value=1),
    "versions that are none": edited("versions", value=["torch"]),
    "a version that is none": edited("versions", "torch", value=2.13),
    "numbers of other tasks": edited("task_ids", value={"push": 1}),
    "two tasks of one number": lambda m: m["task_ids"].update(push=3, reach=3),
    "a negative number of a task": edited("task_ids", "push", value=-1),
    "a boolean for a task's number": edited("task_ids", "push", value=True),
    "a number of a task past 64 bits": edited("task_ids", "push", value=2**63),
    "a list for the configuration": edited("config", value=[]),
    "nested 900 deep": edited("config", "noise_scale", value=json.loads("[" * 900 + "]" * 900)),
    "a version that is a float": edited("version", value=2.0),
    "a format that is an object": edited("format", value={"a": ["b"] * 10_000}),
}


@pytest.mark.parametrize("name", BAD)
def test_metadata_that_cannot_be_are_refused(root, stated, name, little_memory):
    changed = json.loads(json.dumps(stated))
    BAD[name](changed)
    (root / "metadata.json").write_text(json.dumps(changed))
    with pytest.raises(DatasetError, match=r"metadata\.json' is (damaged|of format)") as caught:
        read_metadata(root)
    assert len(str(caught.value)) < 2_000


TEXTS = {
    "nested": '{"config": ' + "[" * 100_000 + "]" * 100_000 + "}",
    "an integer of 5000 digits": '{"format": ' + "1" * 5_000 + "}",
    "NaN": '{"format": NaN}',
    "twice": '{"format": "lw_torchrl.demonstrations", "format": "lw_torchrl.demonstrations"}',
}


@pytest.mark.parametrize("name", TEXTS)
def test_text_that_is_no_json_is_refused_wherever_it_is_read(root, tmp_path, name, little_memory):
    (root / "metadata.json").write_text(TEXTS[name])
    with pytest.raises(DatasetError, match="is damaged"):
        read_metadata(root)
    (tmp_path / ".partial").mkdir()
    (tmp_path / ".partial" / "config.json").write_text(TEXTS[name])
    with pytest.raises(DatasetError, match=r"config\.json' is damaged .*; delete '.*' to start again"):
        collect(tmp_path)


def test_a_half_made_dataset_of_a_strange_configuration_runs_nothing(tmp_path, made, monkeypatch):
    monkeypatch.setattr(missing_episodes, "LanguageWorldEnv", None)
    (tmp_path / ".partial").mkdir()
    for change in (dict(tasks="reach"), dict(max_steps=10**400), dict(seed=None), dict(noise_scale=[[0.1]])):
        (tmp_path / ".partial" / "config.json").write_text(json.dumps(made.config.to_json() | change))
        with pytest.raises(DatasetError, match="is damaged"):
            collect(tmp_path)


@pytest.mark.parametrize(("name", "given"), [("seed", 2**63), ("seed", -(10**400)), ("max_steps", 10**400)])
def test_what_could_not_be_read_back_is_not_collected(tmp_path, name, given):
    with pytest.raises(ValueError, match=f"{name} must be"):
        collect_demonstrations("reach", root=tmp_path / "demos", **{**OPTIONS, name: given})
    assert not (tmp_path / "demos").exists()
