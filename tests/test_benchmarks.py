"""The benchmarks run, write the tables of benchmarks/results/performance.md, and survive a benchmark that fails."""

import json
from pathlib import Path
from types import SimpleNamespace

import pytest
from commands import python_process

import lw_torchrl as lw
from benchmarks import __main__ as cli
from benchmarks import ablations, faults, truth
from benchmarks.finding_points import PADS, find_points
from benchmarks.report import Skipped, under

ROOT = Path(__file__).parent.parent

FIELDS = {"name", "ours", "unit", "rival", "theirs", "ratio", "spread", "target", "met", "note"}


@pytest.mark.slow
def test_quick_run_writes_a_table_and_json(tmp_path):
    def run(*options):
        done = python_process("-m", "benchmarks", *options, "--out", tmp_path, cwd=ROOT, OMP_NUM_THREADS="1")
        assert done.returncode == 0, done.stderr
        return done.stdout

    printed = run("samplers", "queries", "overhead", "--quick")
    report = json.loads((tmp_path / "results.json").read_text("utf-8"))
    assert report["format_version"] == 1
    assert report["quick"] is True
    assert report["machine"]["cores"] >= 1
    assert list(report["benchmarks"]) == ["samplers", "queries", "overhead"]
    for result in report["benchmarks"].values():
        assert result["status"] == "done", result["message"]
        assert result["rows"]
        for row in result["rows"]:
            assert set(row) == FIELDS
            assert row["ours"] > 0
            assert row["met"] is None  # a quick run does not compare with targets
            assert row["ratio"] > 0
            assert row["spread"][0] <= row["ratio"] <= row["spread"][1]
    table = (tmp_path / "table.md").read_text("utf-8")
    assert "ReplayBufferEnsemble" in table
    assert "ReplayBufferEnsemble" in printed
    assert run("--markdown") == table


def test_failing_benchmark_is_reported_and_the_others_continue(tmp_path, monkeypatch, capsys):
    def fail(settings):
        raise RuntimeError("no luck")

    def skip(settings):
        raise Skipped("no such thing here")

    rows = [under("a wait", 2.0, "s", 60)]
    monkeypatch.setattr(cli, "BENCHMARKS", {"bad": fail, "absent": skip, "good": lambda settings: rows})
    assert cli.main(["--out", str(tmp_path)]) == 1
    results = json.loads((tmp_path / "results.json").read_text("utf-8"))["benchmarks"]
    assert [result["status"] for result in results.values()] == ["failed", "skipped", "done"]
    assert results["bad"]["message"] == "RuntimeError: no luck"
    assert results["good"]["rows"][0]["met"] is True
    assert cli.main(["goood", "--out", str(tmp_path)]) == 2
    assert "no benchmark goood" in capsys.readouterr().err


@pytest.mark.slow
def test_scaling_prints_each_row_and_continues_after_an_error(tmp_path, monkeypatch, capfd):
    monkeypatch.setenv("OUT", str(tmp_path / "out"))
    (tmp_path / "out").mkdir()
    (tmp_path / "done").touch()  # the demonstrations are missing
    assert cli.main(["scaling", "--quick", "--folder", str(tmp_path), "--rows", "cloning", "machine"]) == 1
    report = json.loads((tmp_path / "out" / "scaling.json").read_text("utf-8"))
    assert [row["row"] for row in report["rows"]] == ["cloning", "machine"]
    assert report["rows"][0]["error"] == "exit status 1"
    assert '"row": "machine"' in capfd.readouterr().out


@pytest.mark.parametrize("setting", ["few-shot", "zero-shot"])
@pytest.mark.slow
def test_ablations_write_a_table_of_their_runs(setting, monkeypatch, tmp_path, capsys):
    runs = []

    def run(unit, plans, out):
        runs.append((unit.preset.name, unit.preset.training.steps, unit.seed))
        rates = {"reach": 1.0, "push": 0.5 + 0.25 * unit.seed}
        return SimpleNamespace(success_once=rates, mean_success=sum(rates.values()) / 2)

    monkeypatch.setattr(ablations, "execute_run", run)
    ablations.main(ablations.Arguments(setting, seeds=(0, 2), steps=3, out=tmp_path))
    assert len(runs) == 2 * len(ablations.ABLATIONS[setting])
    assert runs[:2] == [("strong-3-steps", 3, 0), ("strong-3-steps", 3, 2)]
    table = (tmp_path / setting / "ablations-3-steps.md").read_text("utf-8")
    assert [line.split("|")[1].strip() for line in table.splitlines()[2:]] == list(ablations.ABLATIONS[setting])
    assert "0.750, 1.000" in table
    assert table in capsys.readouterr().out


def test_truth_writes_a_table_and_a_figure_and_resumes(tmp_path, monkeypatch, capsys):
    plans = lw.Plans({task: lw.load_plans("MT10")[task] for task in ("push", "reach")})
    file = tmp_path / "untrained.safetensors"
    lw.save_actor(lw.PlanConditionedActor(plans), file)
    args = truth.Arguments(
        policy=(file,), tasks=("push", "reach"), every=(1, 4), flip=(0.0, 0.5), episodes=1, max_steps=10, out=tmp_path,
    )  # fmt: skip
    truth.main(args)
    table = (tmp_path / "table.md").read_text("utf-8")
    head, _, *rows = table.partition("\n\n")[0].splitlines()
    assert [cell.strip() for cell in head.split("|")[1:4]] == ["answers", "PlanConditionedActor", "scripted skills"]
    assert [row.split("|")[1].strip() for row in rows] == ["exact", "every 4 steps", "50% flipped"]
    assert (tmp_path / "truth.png").stat().st_size > 10_000
    assert table in capsys.readouterr().out
    monkeypatch.setattr(truth.lw, "evaluate", None)  # results are read, not computed again
    truth.main(args)
    assert (tmp_path / "table.md").read_text("utf-8") == table


@pytest.mark.slow
def test_planted_faults_are_counted_and_read_again(tmp_path, monkeypatch, capsys):
    options = {"tasks": ("drawer-open",), "faults": ("missing step",), "policies": ("scripted",), "episodes": 1}
    args = faults.Arguments(**options, out=tmp_path)
    faults.main(args)
    assert "plan, scripted: named right 3 of 3, 1.000" in capsys.readouterr().out
    monkeypatch.setattr(faults, "failures_of", None)
    faults.main(args)
    assert "plan, scripted: named right 3 of 3, 1.000" in capsys.readouterr().out


def test_points_are_where_fingers_fit_or_a_hand_pushes():
    tasks = find_points(["push", "plate-slide-side", "dial-turn"], episodes=1)
    points = {name: {point.name: point.offset for point in task.objects if point.ours} for name, task in tasks.items()}
    assert points["push"]["puck grip"] == pytest.approx((0.0, 0.0, PADS - 0.015), abs=2e-3)
    assert points["plate-slide-side"]["plate side"][0] == pytest.approx(0.05 + 0.015, abs=5e-3)
    assert not points["dial-turn"]
