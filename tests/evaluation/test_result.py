"""EvaluationResult: statistics, tables, failures, and a file that is whole or refused."""

import json
from dataclasses import replace
from datetime import UTC, datetime
from hashlib import sha256

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mutations import mutated

import lw_torchrl
from lw_torchrl._util.reproducibility import package_versions
from lw_torchrl.evaluation import EpisodeResult, EvaluationResult, Failure, plot_failures
from lw_torchrl.evaluation.diagnose.failure import Finding

CONFIG = {"tasks": ["push", "reach", "sweep"], "episodes_per_task": 3, "seed": 1, "noise_scale": 0.1}
CONFIG |= {"stop_at_success": False, "reward": "sparse", "max_steps": 500}


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
    """A result of an evaluation with stop_at_success=True."""
    episodes = [EpisodeResult("reach", 0, True, 9, None, None), EpisodeResult("reach", 1, False, None, None, None)]
    config = {**CONFIG, "tasks": ["reach"], "episodes_per_task": 2, "stop_at_success": True}
    return EvaluationResult(config, tuple(episodes))


WRONG = Finding("wrong answers", {"step": 2, "condition": "the gripper is open", "states": 40, "of": 500, "first": 31})
ACTIVE = Finding("active step", {"step": 0, "skill": "push", "states": 9, "of": 100})
DISTANT = Finding("distant step", {"step": 0, "skill": "reach", "states": 100, "of": 100, "distance_cm": 10.0})
FAILURES = (
    Failure("push", 1, 0, "query", "skill", 2, 31, WRONG, replaced="query + skill", succeeds_at=90,
            evidence={"wrong": 0.4}, counterfactuals={"query": False, "query + skill": True}, shares={"nothing": 0.0}),
    Failure("push", 1, 1, "undecided", None, None, 499, ACTIVE),
    Failure("reach", 1, 1, "skill", None, 0, 0, DISTANT, counterfactuals={"skill": True}),
)  # fmt: skip


def attributed(failures=FAILURES):
    """A result with the causes of its failures."""
    episodes = [
        EpisodeResult("push", 0, False, None, False, 0.0),
        EpisodeResult("push", 1, False, None, False, 0.0),
        EpisodeResult("reach", 0, True, 4, True, 496.0),
        EpisodeResult("reach", 1, False, None, False, 0.0),
    ]
    config = {**CONFIG, "tasks": ["push", "reach"], "episodes_per_task": 2}
    return EvaluationResult(config, tuple(episodes), failures=failures)


# ---- statistics, tables and figures


def test_the_statistics_equal_those_by_hand():
    result = make_result()
    assert result.success_once == {"push": pytest.approx(2 / 3), "reach": 1.0, "sweep": 0.0}
    assert result.success_at_end == {"push": pytest.approx(1 / 3), "reach": 1.0, "sweep": 0.0}
    assert result.first_success == {"push": 15.5, "reach": 3.0, "sweep": None}
    assert result.mean_return == {"push": pytest.approx(484 / 3), "reach": 498.0, "sweep": 0.0}
    assert result.mean_success == pytest.approx(5 / 9)


def test_statistics_that_a_stopped_episode_lacks_are_none():
    result = stopped()
    assert (result.success_once, result.first_success) == ({"reach": 0.5}, {"reach": 9.0})
    assert result.success_at_end == result.mean_return == {"reach": None}


def test_the_table_shows_every_task():
    lines = make_result().table().splitlines()
    assert len(lines) == 5
    assert lines[1].split() == ["push", "0.67", "0.33", "16"]
    assert lines[3].split() == ["sweep", "0.00", "0.00", "-"]
    assert lines[4].split() == ["mean", "0.56", "0.44", "-"]
    assert stopped().table().splitlines()[1].split() == ["reach", "0.50", "-", "9"]


def test_the_failure_table_counts_causes():
    assert attributed().failure_table().splitlines() == [
        "task       failed  query  skill  undecided",
        "push       2 of 2      1      0          1",
        "reach      1 of 2      0      1          0",
        "all        3 of 4      1      1          1",
    ]


def test_the_failure_figure_has_a_bar_for_each_task_that_failed(tmp_path):
    axes = plot_failures(attributed(), tmp_path / "failures.png", title="a policy").axes[0]
    assert [label.get_text() for label in axes.get_yticklabels()] == ["reach", "push"]
    widths = [[bar.get_width() for bar in bars] for bars in axes.containers]
    assert widths == [[0, 1], [1, 0], [0, 1]], "query, skill, undecided"
    assert axes.get_title() == "a policy\n3 of 4 episodes failed"
    assert plot_failures(attributed(())).axes[0].get_title() == "0 of 4 episodes failed"
    assert (tmp_path / "failures.png").stat().st_size > 1000
    with pytest.raises(ValueError, match="path"):
        plot_failures(attributed(), tmp_path / "failures.txt")


# ---- files


DIFFERENCE = replace(FAILURES[0], finding=Finding("other actions", {"at": 3, "size": 0.5}))
RESULTS = [make_result(), stopped(), attributed(), attributed((DIFFERENCE, *FAILURES[1:]))]


@pytest.mark.parametrize("result", RESULTS)
def test_a_saved_result_reads_back(tmp_path, result):
    first, second = tmp_path / "runs" / "results.json", tmp_path / "again.json"
    result.save(first)
    loaded = EvaluationResult.load(first)
    assert loaded == result
    assert (loaded.success_once, loaded.first_success) == (result.success_once, result.first_success)
    loaded.save(second)
    assert first.read_bytes() == second.read_bytes()


def test_the_file_is_plain_json(tmp_path):
    make_result().save(tmp_path / "results.json")
    content = json.loads((tmp_path / "results.json").read_text())
    assert content["config"] == CONFIG
    assert (content["success_once"]["reach"], content["first_success"]["sweep"]) == (1.0, None)
    assert content["mean_success_once"] == pytest.approx(5 / 9)
    assert "failures" not in content
    assert len(content["episodes"]) == 9
    outcome = {"success": True, "first_success": 10, "success_at_end": False, "episode_return": 4.0}
    assert content["episodes"][0] == {"task": "push", "episode": 0, **outcome}


def change(**entries):
    return lambda content: content.update(entries)


def edit(number, **entries):
    return lambda content: content["episodes"][number].update(entries)


def configure(**entries):
    return lambda content: content["config"].update(entries)


DAMAGE = {
    "success is 5": edit(0, success=5),
    "success is 1": edit(0, success=1),
    "an episode twice": edit(1, episode=0),
    "a whole episode twice": lambda content: content["episodes"].append(content["episodes"][0]),
    "a missing episode": lambda content: content["episodes"].pop(),
    "no episodes": change(episodes=[]),
    "no tasks and no episodes": lambda content: (content["config"].update(tasks=[]), content.update(episodes=[])),
    "a negative episode": edit(0, episode=-1),
    "episode is true": edit(1, episode=True),
    "an episode of another task": edit(0, task="drawer-open"),
    "task is a list": edit(0, task=["push"]),
    "first success is 0": edit(0, first_success=0),
    "a first success after the end": edit(0, first_success=501),
    "a first success without success": edit(2, first_success=7),
    "a success without its first": edit(0, first_success=None),
    "first success is a float": edit(0, first_success=10.0),
    "a success only at the end": edit(2, success_at_end=True),
    "success at the end is a string": edit(0, success_at_end="yes"),
    "return is a string": edit(0, episode_return="4.0"),
    "a return of 400 digits": edit(0, episode_return=10**400),
    "return is nan": edit(0, episode_return=float("nan")),
    "a task twice in config": lambda content: content["config"]["tasks"].append("push"),
    "tasks is a string": configure(tasks="push"),
    "tasks are numbers": configure(tasks=[1, 2]),
    "other tasks in success_once": lambda content: content["success_once"].pop("push"),
    "another number of episodes": configure(episodes_per_task=4),
    "number of episodes is true": configure(episodes_per_task=True),
    "seed is a string": configure(seed="1"),
    "negative noise": configure(noise_scale=-0.1),
    "max_steps is null": configure(max_steps=None),
    "stop_at_success is a number": configure(stop_at_success=0),
    "no seed": lambda content: content["config"].pop("seed"),
    "origin is a string": change(origin="mine"),
    "version is a list": change(version=[[1]]),
    "another format": change(format="minari"),
    "another version": change(version=2),
    "no config": lambda content: content.pop("config"),
    "an unknown entry": lambda content: content["episodes"][0].update(colour="red"),
    "a missing entry": lambda content: content["episodes"][0].pop("success"),
    "episodes are numbers": change(episodes=[1, 2]),
    "config is a list": change(config=[]),
    "a task without episodes": lambda content: content["config"]["tasks"].append("drawer-open"),
}


def damaged_file(path, result, damage):
    result.save(path)
    content = json.loads(path.read_text())
    damage(content)
    path.write_text(json.dumps(content))
    return path


@pytest.mark.parametrize("name", DAMAGE)
def test_a_damaged_file_is_refused_and_left_unchanged(tmp_path, name):
    path = damaged_file(tmp_path / "results.json", make_result(), DAMAGE[name])
    before = path.read_bytes()
    with pytest.raises(ValueError, match=r"results.json' is not a result of lw_torchrl.evaluation version 1"):
        EvaluationResult.load(path)
    assert path.read_bytes() == before


@pytest.mark.parametrize("failures", [{}, [3], [{}], FAILURES[:2], (*FAILURES, FAILURES[0])])
def test_there_must_be_one_failure_for_each_failed_episode(tmp_path, failures):
    content = [each.to_json() for each in failures] if isinstance(failures, tuple) else failures
    path = damaged_file(tmp_path / "results.json", attributed(()), change(failures=content))
    with pytest.raises(ValueError, match=r"[Ff]ailure"):
        EvaluationResult.load(path)


@pytest.mark.parametrize(
    "finding", [{"kind": "other", "values": {}}, {"kind": "active step", "values": {"step": 0}}, 3]
)
def test_a_finding_without_its_values_is_refused(tmp_path, finding):
    change_finding = lambda content: content["failures"][1].update(finding=finding)  # noqa: E731
    with pytest.raises(ValueError, match=r"[Ff]inding|kind"):
        EvaluationResult.load(damaged_file(tmp_path / "results.json", attributed(), change_finding))


@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_a_mutated_file_is_refused_or_consistent(tmp_path, data):
    path = tmp_path / "results.json"
    stopped().save(path)
    path.write_text(json.dumps(data.draw(mutated(json.loads(path.read_text())))))
    try:
        result = EvaluationResult.load(path)
    except ValueError:
        return
    assert 0 <= result.mean_success <= 1
    result.table()
    result.save(path)
    assert EvaluationResult.load(path) == result


NESTED = b'{"format": ' + b"[" * 100_000 + b"]" * 100_000 + b"}"
TWICE = b'{"format": "lw_torchrl.evaluation", "format": "lw_torchrl.evaluation"}'
CONTENTS = {"empty": b"", "cut": b'{"format": "lw_torchrl.eval', "list": b"[]", "bytes": b"\xff\xfe\x00"}
CONTENTS |= {"nested": NESTED, "twice": TWICE, "digits": b"1" * 5_000}


@pytest.mark.parametrize("name", CONTENTS)
def test_a_file_that_is_not_a_result_is_refused(tmp_path, name):
    (tmp_path / "results.json").write_bytes(CONTENTS[name])
    with pytest.raises(ValueError, match="is not a result of"):
        EvaluationResult.load(tmp_path / "results.json")


def test_the_recorded_version_is_that_of_the_running_code(monkeypatch):
    # An old editable install reports the version that it was installed with.
    monkeypatch.setattr("lw_torchrl._util.reproducibility.version", lambda name: "0.0.1")
    versions = package_versions()
    assert versions["lw_torchrl"] == lw_torchrl.__version__
    assert versions["torch"] == "0.0.1"


def test_the_file_records_its_origin(tmp_path):
    checkpoint = tmp_path / "policy.safetensors"
    checkpoint.write_bytes(b"weights")
    before = datetime.now(UTC).replace(microsecond=0)
    make_result().save(tmp_path / "results.json", checkpoint=checkpoint, plans="0123abcd")
    loaded = EvaluationResult.load(tmp_path / "results.json")
    assert before <= datetime.fromisoformat(loaded.origin["date"]) <= datetime.now(UTC)
    assert loaded.origin["versions"] == package_versions()
    assert loaded.origin["checkpoint"] == {"path": str(checkpoint), "sha256": sha256(b"weights").hexdigest()}
    assert loaded.origin["plans"] == "0123abcd"
    assert loaded == make_result(), "the origin is not compared"
    damaged_file(tmp_path / "old.json", make_result(), lambda content: content.pop("origin"))
    assert EvaluationResult.load(tmp_path / "old.json").origin == {}
    with pytest.raises(FileNotFoundError, match="nowhere"):
        make_result().save(tmp_path / "other.json", checkpoint=tmp_path / "nowhere.safetensors")
    assert not (tmp_path / "other.json").exists()
