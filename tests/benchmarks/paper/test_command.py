"""python -m benchmarks.paper: runs one by one or in processes, and summaries beside the published results."""

import json
from dataclasses import replace
from functools import partial

import pytest

import lw_torchrl as lw
from benchmarks.figures import plot_sorted_tasks
from benchmarks.paper import recipes, runs, schedule
from benchmarks.paper.__main__ import main
from benchmarks.paper.comparison import MethodComparison
from benchmarks.paper.imitation import ImitationRun
from benchmarks.paper.published import published, published_curves
from benchmarks.paper.recipes import PRESETS, DataSetting, Member
from benchmarks.paper.schedule import run_commands
from benchmarks.statistics import summarize_rates


@pytest.fixture
def tiny(monkeypatch):
    """Experiments with one demonstration and twenty training steps."""
    training = lw.BehavioralCloningConfig(steps=20, batch_size=20)
    small = replace(PRESETS["strong"]["few-shot"], members=(Member({"width": 16, "depth": 1}),), training=training)
    paper = replace(small, name="paper", passes=500, evaluations=3)
    monkeypatch.setattr(recipes, "PRESETS", {"strong": {"few-shot": small}, "paper": {"few-shot": paper}})
    monkeypatch.setattr(recipes, "SETTINGS", {"few-shot": DataSetting("few-shot", "reach", 1)})
    monkeypatch.setattr(runs, "evaluate", partial(lw.evaluate, max_steps=60))


def run(capsys, *arguments):
    main([str(argument) for argument in arguments])
    return capsys.readouterr().out


def arguments(out, *more, methods=("pcbc", "dc"), seeds=(0, 1)):
    return ("few-shot", "--seeds", *seeds, "--methods", *methods, "--episodes", 1, "--out", out, *more)


@pytest.mark.slow
def test_command_runs_and_summarizes(capsys, tmp_path, tiny):
    names = run(capsys, *arguments(tmp_path, "--list")).split()
    places = "demonstrations/reachx1-astray-", "few-shot/strong/pcbc/", "few-shot/strong/dc/"
    assert names == [f"{place}seed{seed}" for place in places for seed in (0, 1)]
    assert not any(tmp_path.iterdir())
    run(capsys, *arguments(tmp_path, "--run", names[1]))
    assert (tmp_path / names[1] / "metadata.json").is_file()
    assert "few-shot/strong/dc/seed1: mean success 0." in run(capsys, *arguments(tmp_path, "--run", names[-1]))
    assert not (tmp_path / "few-shot" / "strong" / "pcbc").exists()
    first = (tmp_path / names[-1] / "results.json").read_text()

    out = run(capsys, *arguments(tmp_path))
    assert "[4/4] few-shot/strong/dc/seed1" in out
    assert "| PCBC published, last" in out
    assert "pcbc - dc: " in out
    folder = tmp_path / "few-shot" / "strong"
    summary = json.loads((folder / "summary.json").read_text())
    assert ([*summary["methods"]], [*summary["methods"]["dc"]["tasks"]]) == (["pcbc", "dc"], [*lw.MT50])
    assert summary["published_means"]["PCBC published, last"] == pytest.approx(0.393, abs=1e-3)
    assert (folder / "tasks.png").read_bytes().startswith(b"\x89PNG")
    assert (folder / "dc" / "seed1" / "results.json").read_text() == first


@pytest.mark.slow
@pytest.mark.parametrize("launcher", ["local", "ray"])
@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::FutureWarning", "ignore::DeprecationWarning")
def test_all_commands_run_before_an_error_is_raised(launcher):
    if launcher == "ray":
        pytest.importorskip("ray")
    outputs = {}

    def run_all():
        for index, printed in run_commands([["--help"], ["nonsense"], ["few-shot", "--help"]], launcher, 2):
            outputs[index] = printed

    with pytest.raises(RuntimeError, match="nonsense failed"):
        run_all()
    assert outputs.keys() == {0, 2}
    assert "usage: python -m benchmarks.paper" in outputs[0]


def test_with_jobs_each_run_is_a_command(capsys, tmp_path, monkeypatch):
    """Datasets come first; a process gets the command line with --run added."""
    commands = []

    def pretend(arguments):
        commands.append(arguments)
        if (name := arguments[-1]).startswith("scripted"):
            main(arguments)
        return name

    monkeypatch.setattr(schedule, "run_command", pretend)
    monkeypatch.setattr(runs, "evaluate", partial(lw.evaluate, max_steps=20))
    monkeypatch.setattr(ImitationRun, "scope", ("push", "reach"))
    given = ["scripted", "--seeds", "0", "1", "--episodes", "1", "--jobs", "2", "--out", str(tmp_path)]
    assert "| scripted |" in run(capsys, *given)
    assert sorted(commands) == [[*given, "--run", f"scripted/seed{seed}"] for seed in (0, 1)]


A = summarize_rates({"push": [0.9, 0.7], "assembly": [0.5, 0.3]})
B = summarize_rates({"assembly": [0.4, 0.4], "push": [0.2, 0.2]})
PUBLISHED = {"published, last": {"push": 0.8, "assembly": 0.1, "reach": 1.0}}
MEANS = {
    ("zero-shot", "PCBC"): (0.258, 0.4035),
    ("zero-shot", "DC"): (0.28875, 0.381),
    ("few-shot", "PCBC"): (0.39325, 0.631),
    ("few-shot", "DC"): (0.3395, 0.43675),
    ("one-shot", "PCBC"): (0.54575, 0.68),
    ("one-shot", "DC"): (0.539, 0.539),
}


def test_tables():
    comparison = MethodComparison({"a": A, "b": B}, PUBLISHED)
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in comparison.per_task().splitlines()]
    assert rows[0] == ["task", "a", "b", "published, last"]
    assert rows[2:] == [["push", "0.80 (0.70-0.90)", "0.20", "0.80"], ["assembly", "0.40 (0.30-0.50)", "0.40", "0.10"]]
    lines = comparison.headline().splitlines()
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[:5]]
    assert rows[0] == ["method", "mean", "IQM", "tasks >= 0.8, of 2", "seeds", "mean of the 1 outside MT10"]
    assert rows[2][3:] == ["1", "0.700, 0.500", "0.400"]
    assert rows[4] == ["published, last", "0.450", "", "1", "", "0.100"]
    assert lines[-1].startswith("a - b: 0.300 [")


@pytest.mark.parametrize(("setting", "method"), MEANS)
def test_published_rates_have_the_published_means(setting, method):
    last, best = (published(setting, method, which) for which in ("last", "best"))
    assert tuple(last) == tuple(best) == lw.MT50
    assert all(last[task] <= best[task] for task in lw.MT50)
    means = sum(last.values()) / 50, sum(best.values()) / 50
    assert means == pytest.approx(MEANS[setting, method], abs=1e-9)
    curves = published_curves(setting, method)
    assert curves == {f"{method} published, best of the last 10 evaluations": best, f"{method} published, last": last}


def test_tasks_are_sorted_by_the_first_method(tmp_path):
    pcbc = {"push": [0.5, 0.75], "reach": [1.0, 0.9], "sweep": [0.0, 0.33]}
    dc = {"push": [0.25], "reach": [0.5], "sweep": [0.75]}
    [axes] = plot_sorted_tasks({"PCBC": pcbc, "DC": dc}, tmp_path / "figure.png", title="few-shot").axes
    assert [label.get_text() for label in axes.get_yticklabels()] == ["sweep", "push", "reach"]
    drawn = {line.get_label(): list(line.get_xdata()) for line in axes.lines}
    assert drawn["PCBC: mean 0.58 (2 seeds, line: min–max)"] == pytest.approx([0.165, 0.625, 0.95])
    assert drawn["DC: mean 0.50 (1 seed)"] == pytest.approx([0.75, 0.25, 0.5])
    assert all(line.get_linestyle() == "None" for line in axes.lines)  # tasks have no order to join
    assert (axes.get_title(), [item.name for item in tmp_path.iterdir()]) == ("few-shot", ["figure.png"])
