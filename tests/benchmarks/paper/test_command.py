"""python -m benchmarks.paper: runs one by one or in processes, then a summary beside the published results."""

import json
from dataclasses import replace
from functools import partial

import pytest

import lw_torchrl as lw
from benchmarks.paper import recipes, runs, schedule
from benchmarks.paper.__main__ import main
from benchmarks.paper.recipes import OFFLINE_TABLES, PRESETS, DataSetting, Member
from benchmarks.paper.schedule import run_command, run_commands


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
def test_best_of_several_evaluations_is_reported(capsys, tmp_path, tiny):
    out = run(capsys, *arguments(tmp_path, "--preset", "paper", "--passes", 50, methods=["dc"]))
    assert "| dc, best of the last 3 evaluations " in out
    folder = tmp_path / "few-shot" / "paper"
    means = json.loads((folder / "summary.json").read_text())["published_means"]
    best = [json.loads((folder / f"dc/seed{seed}/results.json").read_text())["config"]["best"] for seed in (0, 1)]
    expected = sum(sum(one["rates"].values()) for one in best) / 100
    assert means["dc, best of the last 3 evaluations"] == pytest.approx(expected)


def test_other_plans_have_their_own_folder(capsys, tmp_path, tiny):
    folder = tmp_path / "compare/best/llama3.1/chain_py"  # as benchmarks.plan_comparison writes it
    lw.save_plans({"push": lw.load_plans("MT10")["push"]}, folder)
    given = arguments(tmp_path, "--plans", "MT50", folder, "--list", methods=["pcbc"], seeds=[0])
    assert run(capsys, *given).split()[1:] == ["few-shot/strong-MT50+llama3.1-chain_py/pcbc/seed0"]
    with pytest.raises(ValueError, match="plans have no plan for assembly, "):
        main([str(one) for one in arguments(tmp_path, "--plans", folder, "--list")])


def test_wrong_choices_raise(tmp_path):
    for given, message in {
        ("one-shot", "--preset", "one-network"): "--preset one-network is only for few-shot, got one-shot",
        ("few-shot", "--passes", "3"): "--passes requires --preset paper",
        ("few-shot", "--run", "few-shot/strong/pbc/seed0"): "did you mean 'few-shot/strong/pcbc/seed0'",
        ("offline", "quick", "--mixtures", "B"): "leave no run of the table quick",
    }.items():
        with pytest.raises(ValueError, match=message):
            main([*given, "--out", str(tmp_path / "out")])
    assert not (tmp_path / "out").exists()


def test_every_row_of_every_offline_table_is_listed(capsys, tmp_path):
    names = run(capsys, "offline", "all", "--list", "--out", tmp_path).split()
    assert len({*names}) == len(names)
    for name, table in OFFLINE_TABLES.items():
        for mixture in table.rows:
            assert (f"{table.tasks}/{mixture}/advantage-plan/seed2" in names) == (name != "quick")
    names = run(capsys, "offline", "methods", "--list", "--mixtures", "C", "--methods", "bc", "--out", tmp_path).split()
    assert names[-3:] == [f"five/C/bc-plan/seed{seed}" for seed in range(3)]


@pytest.mark.slow
def test_command_runs_in_a_process():
    assert "few-shot/strong/dc/seed0" in run_command(["few-shot", "--list"])
    with pytest.raises(RuntimeError, match=r"benchmarks.paper few-shot --run nonsense failed:\n(.*\n)*.*--run must be"):
        run_command(["few-shot", "--run", "nonsense"])


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
