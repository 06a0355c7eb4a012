"""python -m benchmarks.paper: runs one by one or in processes, then a summary beside the published results."""

import json
from dataclasses import replace
from functools import partial

import pytest

import lw_torchrl as lw
from benchmarks.paper import recipes, runs, schedule
from benchmarks.paper.__main__ import main
from benchmarks.paper.recipes import PRESETS, DataSetting, Member
from benchmarks.paper.schedule import run_commands


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
    assert names == [
        *(f"demonstrations/reachx1-astray-seed{seed}" for seed in (0, 1)),
        *(f"few-shot/strong/{method}/seed{seed}" for method in ("pcbc", "dc") for seed in (0, 1)),
    ]
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
    assert [*summary["methods"]] == ["pcbc", "dc"]
    assert [*summary["methods"]["dc"]["tasks"]] == [*lw.MT50]
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
    given = ["scripted", "--seeds", "0", "1", "--episodes", "1", "--jobs", "2", "--out", str(tmp_path)]
    assert "| scripted |" in run(capsys, *given)
    assert sorted(commands) == [[*given, "--run", f"scripted/seed{seed}"] for seed in (0, 1)]
