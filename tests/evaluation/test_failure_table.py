"""Failures in a result: the table, the figure, and a file that is whole or refused."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from lw_torchrl.evaluation import EpisodeResult, EvaluationResult, Failure, plot_failures
from lw_torchrl.evaluation.diagnose.failure import ActiveStep, Difference, WrongAnswers

CONFIG = {
    "tasks": ["push", "reach"],
    "episodes_per_task": 2,
    "seed": 1,
    "noise_scale": 0.1,
    "stop_at_success": False,
    "reward": "sparse",
    "max_steps": 500,
}
WRONG = WrongAnswers(2, "the gripper is open", 40, 500, 31)
FAILURES = (
    Failure("push", 1, 0, "query", "skill", 2, 31, WRONG, replaced="query + skill", succeeds_at=90,
            evidence={"wrong": 0.4}, counterfactuals={"query": False, "query + skill": True}, shares={"nothing": 0.0}),
    Failure("push", 1, 1, "undecided", None, None, 499, ActiveStep(0, "push", 9, 100), suspect="skill"),
    Failure("reach", 1, 1, "skill", None, 0, 0, ActiveStep(0, "reach", 100, 100, 0.1), counterfactuals={"skill": True}),
)  # fmt: skip


def make_result(failures=FAILURES):
    episodes = [
        EpisodeResult("push", 0, False, None, False, 0.0),
        EpisodeResult("push", 1, False, None, False, 0.0),
        EpisodeResult("reach", 0, True, 4, True, 496.0),
        EpisodeResult("reach", 1, False, None, False, 0.0),
    ]
    return EvaluationResult(CONFIG, tuple(episodes), failures=failures)


@pytest.mark.parametrize("finding", [WRONG, Difference("actions", 3, size=0.5)])
def test_failures_read_back(tmp_path, finding):
    result = make_result((replace(FAILURES[0], finding=finding), *FAILURES[1:]))
    result.save(tmp_path / "results.json")
    found = EvaluationResult.load(tmp_path / "results.json")
    assert found == result
    found.save(tmp_path / "again.json")
    assert (tmp_path / "again.json").read_bytes() == (tmp_path / "results.json").read_bytes()


WRONG_FINDINGS = {"step": -1, "condition": 3, "states": None, "of": 0, "first": 1.5, "more": 1}


@pytest.mark.parametrize("name", WRONG_FINDINGS)
def test_a_damaged_finding_is_refused(tmp_path, name):
    make_result().save(tmp_path / "results.json")
    found = json.loads((tmp_path / "results.json").read_text())
    found["failures"][0]["finding"][name] = WRONG_FINDINGS[name]
    (tmp_path / "results.json").write_text(json.dumps(found))
    with pytest.raises(ValueError, match=r"failures\[0\].finding"):
        EvaluationResult.load(tmp_path / "results.json")


def test_a_result_without_failures_says_nothing_of_them(tmp_path):
    make_result(None).save(tmp_path / "results.json")
    assert "failures" not in json.loads((tmp_path / "results.json").read_text())
    assert EvaluationResult.load(tmp_path / "results.json").failures is None
    for ask in (EvaluationResult.failure_table, plot_failures):
        with pytest.raises(ValueError, match=r"evaluate\(\.\.\., attribute=True\)"):
            ask(make_result(None))


def test_the_table_counts():
    assert make_result().failure_table().splitlines() == [
        "task       failed  query  skill  undecided",
        "push       2 of 2      1      0          1",
        "reach      1 of 2      0      1          0",
        "all        3 of 4      1      1          1",
    ]


def test_the_figure_has_a_bar_for_each_task_that_failed(tmp_path):
    axes = plot_failures(make_result(), tmp_path / "failures.png", title="a policy").axes[0]
    assert [label.get_text() for label in axes.get_yticklabels()] == ["reach", "push"]
    widths = [[bar.get_width() for bar in bars] for bars in axes.containers]
    assert widths == [[0, 1], [1, 0], [0, 1]], "query, skill, undecided"
    assert axes.get_title() == "a policy\n3 of 4 episodes failed"
    assert plot_failures(replace(make_result(), failures=())).axes[0].get_title() == "0 of 4 episodes failed"
    assert (tmp_path / "failures.png").stat().st_size > 1000
    with pytest.raises(ValueError, match="path must end in"):
        plot_failures(make_result(), tmp_path / "failures.txt")


DAMAGE = {
    "task": ["sweep", 3, None],
    "seed": [2, True, 1.0],
    "episode": [-1, 0.0, 7],
    "cause": ["luck", None, []],
    "also": ["query", "undecided", 1],
    "step": [-1, 1.5, True],
    "at": [-1, 500, None],
    "finding": [3, "he fell", {}, {"kind": "Luck"}, {"kind": "WrongAnswers"}],
    "suspect": ["luck", 3],
    "replaced": ["luck", 3],
    "rival": ["luck", True],
    "succeeds_at": [0, "1"],
    "scripted_step": [-1, 0.5],
    "evidence": [[], {"x": "1"}, {"x": 1e301}, {"x": True}],
    "counterfactuals": [[], {"luck": True}, {"query": 1}, {"": True}],
    "shares": [[], {"x": "1"}, {"x": True}],
}


@pytest.mark.parametrize("name", DAMAGE)
def test_a_damaged_failure_is_refused(tmp_path, name):
    make_result().save(tmp_path / "results.json")
    for value in DAMAGE[name]:
        found = json.loads((tmp_path / "results.json").read_text())
        found["failures"][0][name] = value
        (tmp_path / "damaged.json").write_text(json.dumps(found))
        with pytest.raises(ValueError, match="failures"):
            EvaluationResult.load(tmp_path / "damaged.json")


@pytest.mark.parametrize("failures", [{}, [3], [{}], FAILURES[:2], (*FAILURES, FAILURES[0])])
def test_failures_that_are_not_one_for_each_failed_episode_are_refused(tmp_path, failures):
    if isinstance(failures, tuple):
        make_result(failures).save(tmp_path / "results.json")
    else:
        make_result(()).save(tmp_path / "results.json")
        found = json.loads((tmp_path / "results.json").read_text())
        (tmp_path / "results.json").write_text(json.dumps({**found, "failures": failures}))
    with pytest.raises(ValueError, match="failures"):
        EvaluationResult.load(tmp_path / "results.json")


def test_a_second_cause_of_what_is_undecided_is_refused(tmp_path):
    other = (FAILURES[0], replace(FAILURES[1], also="skill"), FAILURES[2])
    make_result(other).save(tmp_path / "results.json")
    with pytest.raises(ValueError, match="also must be null or another cause"):
        EvaluationResult.load(tmp_path / "results.json")
