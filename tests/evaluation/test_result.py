"""EvaluationResult: the statistics by hand, and a file that is whole or refused."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from hashlib import sha256

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mutations import mutated

import lw_torchrl
from lw_torchrl._util.reproducibility import package_versions
from lw_torchrl.evaluation import EpisodeResult, EvaluationResult

CONFIG = {
    "tasks": ["push", "reach", "sweep"],
    "episodes_per_task": 3,
    "seed": 1,
    "noise_scale": 0.1,
    "stop_at_success": False,
    "reward": "sparse",
    "max_steps": 500,
}


def make_result():
    episodes = [
        EpisodeResult("push", 0, True, 10, False, 4.0, torch.zeros(500, 4)),
        EpisodeResult("push", 1, True, 21, True, 480.0),
        EpisodeResult("push", 2, False, None, False, 0.0),
        EpisodeResult("reach", 0, True, 1, True, 500.0),
        EpisodeResult("reach", 1, True, 2, True, 499.0),
        EpisodeResult("reach", 2, True, 6, True, 495.0),
        *(EpisodeResult("sweep", k, False, None, False, 0.0) for k in range(3)),
    ]
    return EvaluationResult(CONFIG, tuple(episodes))


def stopped():
    """An evaluation that stopped at success."""
    episodes = [EpisodeResult("reach", 0, True, 9, None, None), EpisodeResult("reach", 1, False, None, None, None)]
    config = {**CONFIG, "tasks": ["reach"], "episodes_per_task": 2, "stop_at_success": True}
    return EvaluationResult(config, tuple(episodes))


def test_the_statistics_by_hand():
    result = make_result()
    assert result.success_once == {"push": pytest.approx(2 / 3), "reach": 1.0, "sweep": 0.0}
    assert result.success_at_end == {"push": pytest.approx(1 / 3), "reach": 1.0, "sweep": 0.0}
    assert result.first_success == {"push": 15.5, "reach": 3.0, "sweep": None}
    assert result.mean_return == {"push": pytest.approx(484 / 3), "reach": 498.0, "sweep": 0.0}
    assert result.mean_success == pytest.approx(5 / 9)


def test_what_a_stopped_episode_does_not_know_is_none():
    result = stopped()
    assert result.success_once == {"reach": 0.5}
    assert result.first_success == {"reach": 9.0}
    assert result.success_at_end == result.mean_return == {"reach": None}


@pytest.mark.parametrize("make", [make_result, stopped])
def test_it_reads_back(tmp_path, make):
    result = make()
    result.save(tmp_path / "runs" / "results.json")
    found = EvaluationResult.load(tmp_path / "runs" / "results.json")
    assert found == result
    assert found.success_once == result.success_once
    assert found.first_success == result.first_success
    found.save(tmp_path / "again.json")
    assert (tmp_path / "again.json").read_bytes() == (tmp_path / "runs" / "results.json").read_bytes()


def test_the_file_can_be_read_by_anyone(tmp_path):
    make_result().save(tmp_path / "results.json")
    found = json.loads((tmp_path / "results.json").read_text())
    assert found["config"] == CONFIG
    assert found["success_once"]["reach"] == 1.0
    assert found["first_success"]["sweep"] is None
    assert found["mean_success_once"] == pytest.approx(5 / 9)
    assert len(found["episodes"]) == 9
    assert found["episodes"][0] == {
        "task": "push",
        "episode": 0,
        "success": True,
        "first_success": 10,
        "success_at_end": False,
        "episode_return": 4.0,
    }


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"path: no result file .*nowhere.json"):
        EvaluationResult.load(tmp_path / "nowhere.json")


def change(**entries):
    return lambda found: found.update(entries)


def edit(number, **entries):
    return lambda found: found["episodes"][number].update(entries)


def configure(**entries):
    return lambda found: found["config"].update(entries)


DAMAGE = {
    "a success that is 5": edit(0, success=5),
    "a success that is 1": edit(0, success=1),
    "an episode twice": edit(1, episode=0),
    "an episode more than once in full": lambda found: found["episodes"].append(found["episodes"][0]),
    "a missing episode": lambda found: found["episodes"].pop(),
    "an empty list of episodes": change(episodes=[]),
    "no tasks and no episodes": lambda found: (found["config"].update(tasks=[]), found.update(episodes=[])),
    "an episode that is negative": edit(0, episode=-1),
    "an episode that is true": edit(1, episode=True),
    "an episode of another task": edit(0, task="drawer-open"),
    "a task that is none": edit(0, task=["push"]),
    "a first success of 0": edit(0, first_success=0),
    "a first success past the end": edit(0, first_success=501),
    "a first success without success": edit(2, first_success=7),
    "a success without its first": edit(0, first_success=None),
    "a first success that is a float": edit(0, first_success=10.0),
    "a success at the end alone": edit(2, success_at_end=True),
    "a success at the end that is a text": edit(0, success_at_end="yes"),
    "a return that is a text": edit(0, episode_return="4.0"),
    "a return of 400 digits": edit(0, episode_return=10**400),
    "a return that is nan": edit(0, episode_return=float("nan")),
    "a task twice in config": lambda found: found["config"]["tasks"].append("push"),
    "tasks that are a text": configure(tasks="push"),
    "tasks that are numbers": configure(tasks=[1, 2]),
    "tasks of success_once that are others": lambda found: found["success_once"].pop("push"),
    "a number of episodes that is another": configure(episodes_per_task=4),
    "a number of episodes that is true": configure(episodes_per_task=True),
    "a seed that is a text": configure(seed="1"),
    "a noise that is negative": configure(noise_scale=-0.1),
    "a number of steps that is null": configure(max_steps=None),
    "a stop that is a number": configure(stop_at_success=0),
    "no seed": lambda found: found["config"].pop("seed"),
    "an origin that is a text": change(origin="mine"),
    "a version that is a list": change(version=[[1]]),
    "another format": change(format="minari"),
    "another version": change(version=2),
    "no configuration": lambda found: found.pop("config"),
    "an unknown entry": lambda found: found["episodes"][0].update(colour="red"),
    "a missing entry": lambda found: found["episodes"][0].pop("success"),
    "episodes of another kind": change(episodes=[1, 2]),
    "a configuration of another kind": change(config=[]),
    "a task without episodes": lambda found: found["config"]["tasks"].append("drawer-open"),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_a_wrong_file_is_refused_and_left_alone(tmp_path, name):
    path = tmp_path / "results.json"
    make_result().save(path)
    found = json.loads(path.read_text())
    DAMAGE[name](found)
    path.write_text(json.dumps(found))
    before = path.read_bytes()
    with pytest.raises(ValueError, match=r"results.json' is not a result of lw_torchrl.evaluation version 1"):
        EvaluationResult.load(path)
    assert path.read_bytes() == before


@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_a_file_of_another_shape_is_refused_or_holds_together(tmp_path, data):
    path = tmp_path / "results.json"
    stopped().save(path)
    path.write_text(json.dumps(data.draw(mutated(json.loads(path.read_text())))))
    try:
        found = EvaluationResult.load(path)
    except ValueError:
        return
    assert 0 <= found.mean_success <= 1
    found.table()
    found.save(path)
    assert EvaluationResult.load(path) == found


def test_our_version_is_that_of_the_code_that_runs(monkeypatch):
    # An old editable install reports the version that it was installed with.
    monkeypatch.setattr("lw_torchrl._util.reproducibility.version", lambda name: "0.0.1")
    found = package_versions()
    assert found["lw_torchrl"] == lw_torchrl.__version__
    assert found["torch"] == "0.0.1"


def test_it_says_where_it_came_from(tmp_path):
    checkpoint = tmp_path / "policy.safetensors"
    checkpoint.write_bytes(b"weights")
    before = datetime.now(UTC).replace(microsecond=0)
    make_result().save(tmp_path / "results.json", checkpoint=checkpoint, plans="0123abcd")
    found = EvaluationResult.load(tmp_path / "results.json")
    assert before <= datetime.fromisoformat(found.origin["date"]) <= datetime.now(UTC)
    assert found.origin["versions"] == package_versions()
    assert found.origin["checkpoint"] == {"path": str(checkpoint), "sha256": sha256(b"weights").hexdigest()}
    assert found.origin["plans"] == "0123abcd"
    assert found == make_result(), "where it came from is no part of what was measured"
    make_result().save(tmp_path / "plain.json")
    assert EvaluationResult.load(tmp_path / "plain.json").origin.keys() == {"date", "versions"}
    content = json.loads((tmp_path / "plain.json").read_text())
    (tmp_path / "old.json").write_text(json.dumps({key: content[key] for key in content if key != "origin"}))
    assert EvaluationResult.load(tmp_path / "old.json").origin == {}
    with pytest.raises(FileNotFoundError, match="nowhere"):
        make_result().save(tmp_path / "other.json", checkpoint=tmp_path / "nowhere.safetensors")
    assert not (tmp_path / "other.json").exists()


NESTED = b'{"format": ' + b"[" * 100_000 + b"]" * 100_000 + b"}"
TWICE = b'{"format": "lw_torchrl.evaluation", "format": "lw_torchrl.evaluation"}'
CONTENTS = {"empty": b"", "cut": b'{"format": "lw_torchrl.eval', "list": b"[]", "bytes": b"\xff\xfe\x00"}
CONTENTS |= {"nested": NESTED, "twice": TWICE, "digits": b"1" * 5_000}


@pytest.mark.parametrize("name", CONTENTS)
def test_a_file_that_is_not_a_result_is_refused(tmp_path, name):
    (tmp_path / "results.json").write_bytes(CONTENTS[name])
    with pytest.raises(ValueError, match="is not a result of"):
        EvaluationResult.load(tmp_path / "results.json")


def test_numbers_that_are_none_are_not_written(tmp_path):
    episode = EpisodeResult("reach", 0, True, 1, True, float("nan"))
    result = EvaluationResult({**CONFIG, "tasks": ["reach"]}, (episode,))
    with pytest.raises(ValueError, match="JSON"):
        result.save(tmp_path / "results.json")
    assert not list(tmp_path.iterdir())


def test_the_table_shows_every_task():
    lines = make_result().table().splitlines()
    assert len(lines) == 5
    assert lines[1].split() == ["push", "0.67", "0.33", "16"]
    assert lines[3].split() == ["sweep", "0.00", "0.00", "-"]
    assert lines[4].split() == ["mean", "0.56", "0.44", "-"]
    assert stopped().table().splitlines()[1].split() == ["reach", "0.50", "-", "9"]
