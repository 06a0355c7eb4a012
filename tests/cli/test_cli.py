"""The command line: what it prints and writes, one line for an error, and a demo that survives kills."""

from __future__ import annotations

import json
import re
import signal
import time
from dataclasses import replace
from functools import partial
from importlib.metadata import entry_points
from pathlib import Path

import pytest
from commands import fails, run

import lw_torchrl as lw
import lw_torchrl.cli.main as cli
from lw_torchrl.cli.demo import QUICK
from lw_torchrl.cli.main import main
from lw_torchrl.cli.output import BROKEN_PIPE
from lw_torchrl.cli.parsing import arguments

COMMANDS = (
    "demo",
    "collect",
    "data",
    "train",
    "train-evaluator",
    "evaluate",
    "card",
    "record",
    "view",
    "query",
    "scripted",
    "tasks",
    "queries",
    "skills",
    "plans",
    "plan",
    "check",
)


# ---- help


def test_it_is_installed_as_a_command():
    (script,) = entry_points(group="console_scripts", name="lw-torchrl")
    assert script.load() is main


def test_help_names_every_command(capsys):
    with pytest.raises(SystemExit) as caught:
        main(["--help"])
    assert caught.value.code == 0
    printed = capsys.readouterr().out
    assert tuple(cli.COMMANDS) == COMMANDS
    assert all(re.search(rf"\b{command}\b", printed) for command in COMMANDS)


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_explains_itself(capsys, command):
    with pytest.raises(SystemExit) as caught:
        main([command, "--help"])
    assert caught.value.code == 0
    printed = " ".join(re.sub(r"[^ -~]", " ", capsys.readouterr().out).split())
    first = cli.COMMANDS[command].__doc__.strip().splitlines()[0]
    assert " ".join(first.split()[:5]) in printed
    options = [p.name for p in arguments(cli.COMMANDS[command]).values() if p.kind is not p.POSITIONAL_ONLY]
    assert all(f"--{name.replace('_', '-')}" in printed for name in options)


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["dance"], "there is no command 'dance'; did you mean "),
        (["query"], "TASK must be given; `lw-torchrl query --help` says what there is"),
        (["collect", "reach"], "--out must be given; "),
        (["collect", "reach", "--out"], "--out must be given a value"),
        (["train", "x", "--out", "y", "--features", "z"], "--features must be one of 'raw', 'differences', "),
    ],
)
def test_a_wrong_command_line_is_refused_with_code_2(capsys, monkeypatch, args, message):
    assert message in fails(capsys, *args)
    monkeypatch.setenv("COLUMNS", "20")
    assert message in fails(capsys, *args)


def test_the_statuses_are_stated_in_the_help(capsys):
    with pytest.raises(SystemExit):
        main(["--help"])
    printed = " ".join(capsys.readouterr().out.split())
    text = (Path(__file__).parents[2] / "docs" / "cli.md").read_text("utf-8")
    statuses = re.findall(r"^\| (\d+) \|", text, re.MULTILINE)
    assert statuses == ["0", "1", "2", str(130), str(BROKEN_PIPE)]
    assert [found for found in re.findall(r"(?:Exit status: |; )(\d+), ", printed)] == statuses


def test_ctrl_c_says_that_it_carries_on(capsys, monkeypatch):
    def interrupted() -> None:
        raise KeyboardInterrupt

    monkeypatch.setitem(cli.COMMANDS, "demo", interrupted)
    with pytest.raises(SystemExit) as caught:
        main(["demo"])
    assert caught.value.code == 130
    assert "carries on" in capsys.readouterr().err


# ---- query


def state_after(task, step, seed=0):
    env = lw.LanguageWorldEnv(task, seed=seed)
    state = env.reset()
    expert = lw.ExpertActor(task)
    for _ in range(step):
        state = env.step(expert(state))["next"]
    env.close()
    return state


@pytest.mark.parametrize(("step", "seed"), [(0, 0), (40, 0), (60, 3)])
@pytest.mark.parametrize(
    "texts",
    [
        ("Is the gripper open?", "Is the gripper not open?"),
        ("the gripper is near the puck", "the gripper is not near the puck and above the target location"),
    ],
)
def test_query_answers_yes_or_no(capsys, step, seed, texts):
    state = state_after("pick-place", step, seed)
    for asked in texts:
        parsed = lw.parse_query(asked, "pick-place")
        truth = lw.QueryProgram({"pick-place": [parsed]})(state["observation"], state["task_id"]).item()
        printed = run(capsys, "query", "pick-place", asked, "--step", step, "--seed", seed)
        assert printed.splitlines()[-1] == f"{'yes' if truth else 'no'}: {parsed}"
    hand = tuple(f"{number:.3f}" for number in state["observation"][0, :3].tolist())
    assert re.search(r"the robot's gripper +at +(\S+) +(\S+) +(\S+) m", printed).groups() == hand


def test_both_answers_occur(capsys):
    answers = {
        run(capsys, "query", "pick-place", f"the gripper is {word}").splitlines()[-1].split(":")[0]
        for word in ("open", "closed")
    }
    assert answers == {"yes", "no"}


def test_without_a_text_all_queries_that_hold_are_listed(capsys):
    printed = run(capsys, "query", "reach", "--step", 30)
    listed = printed.split("\n\n")[1].strip().splitlines()
    queries = [lw.parse_query(text, "reach") for text in lw.supported_queries("reach")]
    state = state_after("reach", 30)
    truths = lw.QueryProgram({"reach": queries})(state["observation"], state["task_id"])[0].tolist()
    assert listed == [str(query) for query, truth in zip(queries, truths, strict=True) if truth]
    assert 0 < len(listed) < len(queries)


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["query", "raech"], "reach"),
        (["query", "reach", "is the gripper purple"], "purple"),
        (["query", "reach", "the gripper is near the teapot"], "teapot"),
        (["query", "reach", "--step", "501"], "error: --step must be at most 500, got 501"),
        (["query", "reach", "--step", "-1"], "error: --step must be at least 0, got -1"),
        (["query", "reach", "--episode", "-1"], "error: --episode must be at least 0, got -1"),
        (["collect", "raech", "--out", "OUT"], "did you mean 'reach'"),
        (["collect", "--out", "OUT"], "error: TASKS must name at least one task"),
        (["collect", "reach", "--out", "OUT", "--episodes", "0"], "error: --episodes must be at least 1, got 0"),
        (["collect", "reach", "--out", "OUT", "--noise", "-1"], "error: --noise must be finite and at least 0"),
        (["collect", "reach", "--out", "OUT", "--num-envs", "0"], "error: --num-envs must be at least 1, got 0"),
        (["collect", "raech", "push", "--out", "OUT"], "error: TASKS must be one of"),
        (["check", "NOWHERE"], "error: FILE: there is no 'NOWHERE'"),
        (["train", "NOWHERE", "--out", "OUT"], "DATA: no dataset folder 'NOWHERE'; make one with `lw-torchrl collect`"),
        (["evaluate", "NOWHERE"], "error: CHECKPOINT: no file"),
        (["evaluate", "expert", "--tasks", "raech"], "did you mean 'reach'"),
        (["evaluate", "expert", "--tasks", "reach", "--episodes", "0"], "error: --episodes must be at least 1"),
        (["view", "NOWHERE"], "NOWHERE"),
        (["train", "NOWHERE", "--out", "OUT", "--learning-rate", "-1"], "error: --learning-rate must be finite"),
        (["scripted", "reach", "--episodes", "0", "--out", "OUT"], "error: --episodes must be at least 1"),
    ],
)
def test_an_error_is_one_line_and_code_2(capsys, tmp_path, monkeypatch, args, message):
    monkeypatch.chdir(tmp_path)
    assert message in fails(capsys, *args)
    assert not (tmp_path / "OUT").exists() or not (tmp_path / "OUT" / "metadata.json").exists()


# ---- collect, train, evaluate


@pytest.fixture(scope="module")
def demos(tmp_path_factory):
    root = tmp_path_factory.mktemp("cli") / "demos"
    main(["collect", "push", "reach", "--out", str(root), "--episodes", "1", "--noise", "0", "0.1"])
    return root


TINY = ("--steps", "30", "--batch-size", "20", "--width", "16", "--depth", "1")


@pytest.fixture(scope="module")
def checkpoint(demos, tmp_path_factory):
    path = tmp_path_factory.mktemp("cli") / "policy.safetensors"
    main(["train", str(demos), "--out", str(path), *TINY])
    return path


def test_collect_writes_what_it_was_told(capsys, demos):
    made = lw.LanguageWorldExperienceReplay(demos).demonstrations
    assert made.config.tasks == ("push", "reach")
    assert (made.config.episodes_per_task, made.config.seed, made.config.noise_scale) == (1, 0, (0.0, 0.1))
    printed = run(capsys, "collect", "push", "reach", "--out", demos, "--episodes", 1, "--noise", 0, 0.1)
    assert f"1000 steps in {demos}" in printed
    error = fails(capsys, "collect", "push", "--out", demos, "--episodes", 1)
    assert "another configuration" in error
    assert "tasks (['push', 'reach'], now ['push'])" in error


def test_train_writes_a_policy_and_carries_on(capsys, demos, checkpoint):
    actor = lw.load_actor(checkpoint)
    assert isinstance(actor, lw.PlanConditionedActor)
    assert (actor.config["width"], actor.config["depth"]) == (16, 1)
    content = checkpoint.read_bytes()
    assert f"trained to step 30: {checkpoint}" in run(capsys, "train", demos, "--out", checkpoint, *TINY)
    assert checkpoint.read_bytes() == content
    assert "another architecture" in fails(capsys, "train", demos, "--out", checkpoint, *TINY[:-2], "--depth", 2)
    assert "another configuration" in fails(capsys, "train", demos, "--out", checkpoint, *TINY, "--seed", 1)
    assert checkpoint.read_bytes() == content


def test_train_wants_a_plan_for_every_task(capsys, tmp_path, demos):
    lw.save_plans({"push": lw.load_plans("MT10")["push"]}, tmp_path / "plans")
    error = fails(capsys, "train", demos, "--out", tmp_path / "p.safetensors", "--plans", tmp_path / "plans", *TINY)
    assert "plans lack reach" in error
    assert not (tmp_path / "p.safetensors").exists()


def test_evaluate_writes_result_figure_and_recording(capsys, checkpoint, tmp_path):
    out = tmp_path / "runs"
    args = ("evaluate", checkpoint, "--tasks", "push", "reach", "--episodes", 1, "--seed", 7)
    printed = run(capsys, *args, "--out", out)
    assert {path.name for path in out.iterdir()} == {"results.json", "success.png", "rollout.rrd"}
    result = lw.EvaluationResult.load(out / "results.json")
    assert (result.config["seed"], result.config["episodes_per_task"], result.config["noise_scale"]) == (7, 1, 0.1)
    assert result.config["tasks"] == ["push", "reach"]
    assert result.table() in printed
    assert (out / "success.png").read_bytes().startswith(b"\x89PNG")
    assert (out / "rollout.rrd").stat().st_size > 1000
    actor = lw.load_actor(checkpoint)
    again = lw.evaluate(actor, tasks=["push", "reach"], episodes_per_task=1, seed=7, progress=False, num_envs=2)
    assert again.episodes == result.episodes


def test_evaluate_says_why_episodes_failed(capsys, checkpoint, tmp_path, monkeypatch):
    monkeypatch.setattr(lw, "evaluate", partial(lw.evaluate, max_steps=5))
    args = ("evaluate", checkpoint, "--tasks", "push", "--episodes", 1, "--attribute", "--reference", "MT10")
    printed = run(capsys, *args, "--out", tmp_path)
    assert (tmp_path / "failures.png").is_file()
    result = lw.EvaluationResult.load(tmp_path / "results.json")
    assert [failure.cause for failure in result.failures] == ["undecided"], "in 10 steps nobody pushes"
    assert result.failure_table() in printed
    for wrong in (("evaluate", checkpoint, "--reference", "MT10"), ("evaluate", "expert", "--attribute")):
        assert wrong[2] in fails(capsys, *wrong)


def test_evaluate_runs_the_tasks_of_the_training(capsys, demos, checkpoint, tmp_path, monkeypatch):
    monkeypatch.setattr(lw, "evaluate", partial(lw.evaluate, max_steps=5))
    said = "that it was trained on, of 10 that it knows; --tasks names others"
    printed = run(capsys, "evaluate", checkpoint, "--episodes", 1)
    assert [line.split()[0] for line in printed.splitlines()[2:]] == ["push", "reach", "mean"]
    assert printed.startswith(f"on the 2 tasks {said}\n")
    run(capsys, "train", demos, "--out", tmp_path / "one.safetensors", "--tasks", "push", *TINY)
    printed = run(capsys, "evaluate", tmp_path / "one.safetensors", "--episodes", 1)
    assert [line.split()[0] for line in printed.splitlines()[2:]] == ["push", "mean"]
    assert printed.startswith(f"on the 1 task {said}\n")
    lw.save_actor(lw.load_actor(checkpoint), tmp_path / "plain.safetensors")  # which says nothing of data
    assert run(capsys, "evaluate", tmp_path / "plain.safetensors", "--episodes", 1).count("\n") == 12
    assert run(capsys, "evaluate", checkpoint, "--plans", "MT10", "--episodes", 1).count("\n") == 12


def test_train_names_a_task_that_the_dataset_lacks(capsys, demos, tmp_path):
    error = fails(capsys, "train", demos, "--out", tmp_path / "p.safetensors", "--tasks", "reach", "door-open")
    assert "error: --tasks must be one of 'push', 'reach', got 'door-open'" in error


def test_evaluating_on_the_demonstrations_seed_is_refused(capsys, checkpoint, tmp_path):
    error = fails(capsys, "evaluate", checkpoint, "--seed", 0, "--out", tmp_path / "runs")
    assert "error: --seed must differ from the demonstrations' seed, 0" in error
    assert not (tmp_path / "runs").exists()


def test_evaluate_refuses_what_does_not_fit(capsys, checkpoint, demos, tmp_path):
    assert "plans lack sweep-into" in fails(capsys, "evaluate", checkpoint, "--tasks", "sweep-into")
    assert "damaged or not a .safetensors file" in fails(capsys, "evaluate", demos / "metadata.json")


def test_the_experts_can_be_evaluated(capsys):
    args = ("--tasks", "reach", "--episodes", 2, "--stop-at-success")
    printed = run(capsys, "evaluate", "expert", *args)
    assert printed.splitlines()[1].split()[:3] == ["reach", "1.00", "-"]


def test_the_baseline_trains_and_is_evaluated(capsys, demos, tmp_path, monkeypatch):
    monkeypatch.setattr(lw, "evaluate", partial(lw.evaluate, max_steps=60))
    path = tmp_path / "baseline.safetensors"
    run(capsys, "train", demos, "--out", path, "--method", "dc", *TINY)
    assert isinstance(lw.load_actor(path), lw.DescriptorConditionedActor)
    printed = run(capsys, "evaluate", path, "--episodes", 1, "--stop-at-success", "--out", tmp_path / "runs")
    assert [line.split()[0] for line in printed.splitlines()[1:4]] == ["push", "reach", "mean"]
    assert (tmp_path / "runs" / "results.json").is_file()


# ---- demo


def kill_when(forks, ready, timeout=120):
    deadline = time.monotonic() + timeout
    while not ready():
        assert forks.running(0.02), forks.end()
        assert time.monotonic() < deadline
    forks.send(signal.SIGKILL)
    assert forks.end().status == -signal.SIGKILL


@pytest.mark.slow
def test_the_quick_demo_killed_twice_ends_and_then_does_nothing_twice(forks, tmp_path):
    config, out = replace(QUICK, training_steps=200, episodes_per_task=2), tmp_path / "demo"
    shorter = f"""
from dataclasses import replace
from lw_torchrl.cli import demo
demo.QUICK = replace(demo.QUICK, training_steps={config.training_steps}, episodes_per_task={config.episodes_per_task})
"""
    demonstrations = out / "demonstrations"
    demo = ("demo", "--quick", "--out", out)
    forks.start(*demo, before=shorter)
    kill_when(forks, lambda: len(list(demonstrations.glob(".partial/*.npz"))) >= 2)
    assert not (demonstrations / "metadata.json").exists()
    forks.start(*demo, before=shorter)
    kill_when(forks, (out / "checkpoint.safetensors").exists)
    assert not (out / "results.json").exists()

    forks.start(*demo, before=shorter)
    status, printed, errors = forks.end()
    assert status == 0, errors
    assert {path.name for path in out.iterdir() if path.name[0] != "."} == {
        "config.json",
        "demonstrations",
        "checkpoint.safetensors",
        "results.json",
        "success.png",
        "rollout.rrd",
    }
    assert json.loads((out / "config.json").read_text()) == json.loads(json.dumps(vars(config)))
    result = lw.EvaluationResult.load(out / "results.json")
    assert result.config["tasks"] == list(config.tasks)
    assert result.config["episodes_per_task"] == config.episodes_per_task
    assert result.config["noise_scale"] == 0.1
    assert result.config["seed"] != config.demonstration_seed
    assert result.table() in printed
    assert (out / "success.png").read_bytes()[-8:-4] == b"IEND"
    assert (out / "rollout.rrd").read_bytes().startswith(b"RRF")
    actor = lw.load_actor(out / "checkpoint.safetensors")
    plans = lw.load_plans("MT10")
    assert actor.plans == plans
    for task in config.tasks:
        (line,) = [line for line in printed.splitlines() if line.strip().startswith(f"{task}: ")]
        assert any(f"{step.skill} (" in line for step in plans[task].steps)
    assert f"lw-torchrl view {out / 'rollout.rrd'}" in printed

    kept = [
        "checkpoint.safetensors",
        "results.json",
        "config.json",
        "demonstrations/metadata.json",
        "demonstrations/data/action.memmap",
    ]
    before = {name: (out / name).stat().st_mtime_ns for name in kept}
    forks.start(*demo, before=shorter)
    status, again, errors = forks.end()
    assert status == 0, errors
    assert {name: (out / name).stat().st_mtime_ns for name in kept} == before
    assert again == printed


def test_a_demo_of_another_configuration_is_not_overwritten(capsys, tmp_path):
    (tmp_path / "config.json").write_text(json.dumps({**vars(QUICK), "training_steps": 7}))
    before = (tmp_path / "config.json").read_bytes()
    with pytest.raises(SystemExit) as caught:
        main(["demo", "--quick", "--out", str(tmp_path)])
    assert caught.value.code == 2
    assert "holds a demo with another configuration" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["config.json"]
    assert (tmp_path / "config.json").read_bytes() == before


def test_a_damaged_demo_configuration_is_named(capsys, tmp_path):
    (tmp_path / "config.json").write_text("{")
    assert "config.json" in fails(capsys, "demo", "--quick", "--out", tmp_path)
