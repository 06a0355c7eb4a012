"""EvaluationResult: statistics, tables, failures, figures, and a file that is whole or refused."""

import json
import struct
import sys
import tomllib
from dataclasses import replace
from datetime import UTC, datetime
from functools import reduce
from hashlib import sha256
from operator import getitem
from pathlib import Path

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import lw_torchrl
from lw_torchrl._util.reproducibility import package_versions
from lw_torchrl.evaluation import EpisodeResult, EvaluationResult, Failure, plot_failures, plot_success
from lw_torchrl.evaluation.diagnose.failure import Finding
from lw_torchrl.evaluation.result import wilson_interval

CONFIG = {"tasks": ["push", "reach", "sweep"], "episodes_per_task": 3, "seed": 1, "noise_scale": 0.1}
CONFIG |= {"stop_at_success": False, "reward": "sparse", "max_steps": 500}


def make_result():
    push = [(10, False, 4.0, torch.zeros(500, 4)), (21, True, 480.0), (None, False, 0.0)]
    reach = [(1, True, 500.0), (2, True, 499.0), (6, True, 495.0)]
    return EvaluationResult(CONFIG, episodes({"push": push, "reach": reach, "sweep": 3 * [(None, False, 0.0)]}))


def episodes(outcomes):
    """Return episodes from the first success, the success at the end and the return of each, by task."""
    numbered = [(task, k, *outcome) for task, listed in outcomes.items() for k, outcome in enumerate(listed)]
    return tuple(EpisodeResult(task, k, first is not None, first, *rest) for task, k, first, *rest in numbered)


def stopped():
    """A result of an evaluation with stop_at_success=True."""
    config = {**CONFIG, "tasks": ["reach"], "episodes_per_task": 2, "stop_at_success": True}
    return EvaluationResult(config, episodes({"reach": [(9, None, None), (None, None, None)]}))


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
    failed = (None, False, 0.0)
    config = {**CONFIG, "tasks": ["push", "reach"], "episodes_per_task": 2}
    outcomes = {"push": [failed, failed], "reach": [(4, True, 496.0), failed]}
    return EvaluationResult(config, episodes(outcomes), failures=failures)


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
    assert (len(lines), lines[1].split()) == (5, ["push", "0.67", "0.33", "16"])
    assert (lines[3].split(), lines[4].split()) == (["sweep", "0.00", "0.00", "-"], ["mean", "0.56", "0.44", "-"])
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


@given(st.integers(1, 1000), st.data())
def test_the_interval_contains_the_rate_and_is_symmetric(trials, data):
    successes = data.draw(st.integers(0, trials))
    low, high = wilson_interval(successes, trials)
    assert 0 <= low <= successes / trials + 1e-12
    assert successes / trials - 1e-12 <= high <= 1
    assert high - low > 0
    assert (1 - high, 1 - low) == pytest.approx(wilson_interval(trials - successes, trials), abs=1e-9)


@pytest.mark.parametrize(
    ("successes", "trials", "expected"),
    [(8, 10, (0.4902, 0.9433)), (0, 20, (0.0, 0.1611)), (50, 100, (0.4038, 0.5962))],
)
def test_the_interval_equals_published_values(successes, trials, expected):
    assert wilson_interval(successes, trials) == pytest.approx(expected, abs=2e-4)


def test_figures_are_written_as_png_and_pdf(tmp_path):
    path = tmp_path / "runs" / "success.png"
    plot_success(make_result(), path, title="a title")
    content = path.read_bytes()
    assert (content[:8], content[-8:-4]) == (b"\x89PNG\r\n\x1a\n", b"IEND")
    width, height = struct.unpack(">II", content[16:24])
    assert min(width / 4, height) > 150
    plot_success(make_result(), tmp_path / "success.pdf")
    assert (tmp_path / "success.pdf").read_bytes().startswith(b"%PDF")


def test_the_bars_are_the_rates_best_on_top():
    axes = plot_success(make_result()).axes[0]
    assert [bar.get_width() for bar in axes.patches] == pytest.approx([0.0, 2 / 3, 1.0])
    assert [label.get_text() for label in axes.get_yticklabels()] == ["sweep", "push", "reach"]
    assert "0.556" in axes.get_title()
    assert "of 3;" in axes.get_xlabel()


def test_no_window_is_opened_and_no_backend_chosen(monkeypatch):
    monkeypatch.delitem(sys.modules, "matplotlib.pyplot", raising=False)
    plot_success(make_result())
    assert "matplotlib.pyplot" not in sys.modules


DIFFERENCE = replace(FAILURES[0], finding=Finding("other actions", {"at": 3, "size": 0.5}))
RESULTS = [make_result(), stopped(), attributed(), attributed((DIFFERENCE, *FAILURES[1:]))]


@pytest.mark.parametrize("result", RESULTS)
def test_a_saved_result_reads_back(tmp_path, result):
    first, second = tmp_path / "runs" / "results.json", tmp_path / "again.json"
    result.save(first)
    loaded = EvaluationResult.load(first)
    assert (loaded, loaded.success_once, loaded.first_success) == (result, result.success_once, result.first_success)
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


DAMAGE = tomllib.loads(Path(__file__).with_name("damaged_results.toml").read_text("utf-8"))


def damaged_file(path, result, changes):
    """Save a result in which entries have other values, as JSON, or are removed."""
    result.save(path)
    content = json.loads(path.read_text())
    for place, value in changes.items():
        *parents, key = [int(name) if name.isdigit() else name for name in place.split()]
        node = reduce(getitem, parents, content)
        if isinstance(node, list):
            node[key : key + 1] = [json.loads(value)] if value else []
        elif value:
            node[key] = json.loads(value)
        else:
            node.pop(key, None)
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
    path = damaged_file(tmp_path / "results.json", attributed(()), {"failures": json.dumps(content)})
    with pytest.raises(ValueError, match=r"[Ff]ailure"):
        EvaluationResult.load(path)


@pytest.mark.parametrize("finding", [{"kind": "odd", "values": {}}, {"kind": "active step", "values": {"step": 0}}, 3])
def test_a_finding_without_its_values_is_refused(tmp_path, finding):
    change = {"failures 1 finding": json.dumps(finding)}
    with pytest.raises(ValueError, match=r"[Ff]inding|kind"):
        EvaluationResult.load(damaged_file(tmp_path / "results.json", attributed(), change))


ODD = [0, 1, -1, 2, 0.5, -0.0, 1e300, 2**31, 2**63, -(2**63), 10**400, None, True, False, "", "5", "reach", "raech"]
ODD += ["x" * 5000, [], [[[[[[]]]]]], [1, 2, 3], ["reach"], ["reach", "reach"], [None], [True], {}, {"a": {"b": {}}}]


def places_in(value, path=""):
    """Return the names of all entries inside a JSON value, as :func:`damaged_file` reads them."""
    inside = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [place for key, part in inside for place in (f"{path}{key}", *places_in(part, f"{path}{key} "))]


@pytest.fixture(scope="module")
def places(tmp_path_factory):
    path = damaged_file(tmp_path_factory.mktemp("places") / "results.json", stopped(), {})
    return [*places_in(json.loads(path.read_text())), "episodes 2", "episodes 0 more"]


@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_a_mutated_file_is_refused_or_consistent(tmp_path, places, data):
    path = tmp_path / "results.json"
    changed = data.draw(st.lists(st.sampled_from(places), min_size=1, max_size=3, unique=True))
    # Change inner entries first, because an outer one may replace or remove them.
    changed.sort(key=lambda place: -place.count(" "))
    damaged_file(path, stopped(), {place: data.draw(st.sampled_from(["", *map(json.dumps, ODD)])) for place in changed})
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
    assert (versions["lw_torchrl"], versions["torch"]) == (lw_torchrl.__version__, "0.0.1")


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
    damaged_file(tmp_path / "old.json", make_result(), {"origin": ""})
    assert EvaluationResult.load(tmp_path / "old.json").origin == {}
    with pytest.raises(FileNotFoundError, match="nowhere"):
        make_result().save(tmp_path / "other.json", checkpoint=tmp_path / "nowhere.safetensors")
    assert not (tmp_path / "other.json").exists()
