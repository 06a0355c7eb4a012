"""``lw-torchrl train``, ``evaluate``, ``info``, ``demo`` and ``record``: their output, files, and resuming."""

import json
import re
import signal
import time
from dataclasses import replace
from functools import partial
from unittest.mock import patch

import pytest
import torch
from commands import document, fails, run
from rerun.chunk import RrdReader

import lw_torchrl as lw
from lw_torchrl.cli.demo import QUICK
from lw_torchrl.cli.evaluate import episodes_to_record
from lw_torchrl.cli.main import main
from lw_torchrl.record.tabs import Tabs

TINY = ("--steps", "30", "--batch-size", "20", "--width", "16", "--depth", "1")
SHORT = ("--episodes", 1, "--max-steps", 5)
LONG = ("--max-steps", 120, "--seed", 1000)


@pytest.fixture(scope="module")
def demos(tmp_path_factory):
    root = tmp_path_factory.mktemp("cli") / "demos"
    with patch.object(lw, "collect_demonstrations", partial(lw.collect_demonstrations, max_steps=60)):
        main(["collect", "push", "reach", "--out", str(root), "--episodes", "1", "--noise", "0", "0.1"])
    return root


@pytest.fixture(scope="module")
def policy(demos, tmp_path_factory):
    path = tmp_path_factory.mktemp("cli") / "policy.safetensors"
    main(["train", str(demos), "--out", str(path), *TINY])
    return path


def files_in(folder):
    return {path.name for path in folder.iterdir() if path.name[0] != "."}


def test_train_writes_a_policy_and_resumes(capsys, demos, policy):
    actor = lw.load_actor(policy)
    assert isinstance(actor, lw.PlanConditionedActor)
    decoder = actor.decoder.network.config
    assert (decoder["width"], decoder["depth"]) == (16, 1)
    content = policy.read_bytes()
    assert f"trained to step 30: {policy}" in run(capsys, "train", demos, "--out", policy, *TINY)
    assert document(capsys, "train", demos, "--out", policy, *TINY)["loss"] is None
    fails(capsys, "train", demos, "--out", policy, *TINY[:-2], "--depth", 2)
    fails(capsys, "train", demos, "--out", policy, *TINY, "--seed", 1)
    assert policy.read_bytes() == content


def test_train_requires_a_plan_and_demonstrations_of_every_task(capsys, tmp_path, demos):
    lw.save_plans({"push": lw.load_plans("MT10")["push"]}, tmp_path / "plans")
    out = ("--out", tmp_path / "p.safetensors")
    assert "plans have no plan for reach" in fails(capsys, "train", demos, *out, "--plans", tmp_path / "plans", *TINY)
    assert "door-open" in fails(capsys, "train", demos, *out, "--tasks", "reach", "door-open")
    assert not out[1].exists()


def test_train_logs_and_fine_tunes(capsys, tmp_path, demos, policy):
    out = tmp_path / "tuned.safetensors"
    options = ("--begin", policy, "--tasks", "push", "--steps", 2, "--batch-size", 8, "--logger", "csv")
    run(capsys, "train", demos, "--out", out, *options)
    assert lw.modules.describe(lw.load_actor(out)) == lw.modules.describe(lw.load_actor(policy))
    assert list((tmp_path / "logs").rglob("*.csv"))
    assert "must differ from --begin" in fails(capsys, "train", demos, "--out", policy, "--begin", policy)
    assert "--begin fixes the network" in fails(capsys, "train", demos, "--out", out, "--begin", policy, "--width", 8)


def test_the_baseline_is_trained_and_evaluated(capsys, demos, tmp_path):
    path = tmp_path / "baseline.safetensors"
    run(capsys, "train", demos, "--out", path, "--method", "dc", *TINY)
    assert isinstance(lw.load_actor(path), lw.modules.DescriptorConditionedActor)
    assert [row["task"] for row in document(capsys, "evaluate", path, *SHORT)["tasks"]] == ["push", "reach"]
    assert "attribute" in fails(capsys, "evaluate", path, "--attribute", *SHORT)


def test_evaluate_writes_result_figure_and_recording(capsys, policy, tmp_path):
    out = tmp_path / "runs"
    args = ("evaluate", policy, "--tasks", "push", "reach", "--episodes", 1, "--seed", 7, "--max-steps", 20)
    printed = run(capsys, *args, "--attribute", "--reference", "MT10", "--out", out)
    assert files_in(out) == {"results.json", "success.png", "failures.png", "rollout.rrd"}
    result = lw.EvaluationResult.load(out / "results.json")
    assert (result.config["seed"], result.config["episodes_per_task"], result.config["noise_scale"]) == (7, 1, 0.1)
    assert result.table() in printed
    assert result.failure_table() in printed
    origin = json.loads((out / "results.json").read_text())["origin"]
    assert origin["checkpoint"]["path"] == str(policy)
    actor = lw.load_actor(policy)
    again = lw.evaluate(actor, tasks=["push", "reach"], episodes_per_task=1, seed=7, max_steps=20, progress=False)
    assert again.episodes == result.episodes
    assert f"written to {out}; rollout.rrd shows the failed episodes push 0, reach 0" in printed
    recorded = document(capsys, "info", out / "rollout.rrd")["episodes"]
    assert [row["episode"] for row in recorded] == ["push-0", "reach-0"]


def test_evaluate_records_the_first_failures_of_the_worst_tasks():
    def recorded(**successes):
        numbered = [(task, *each) for task, won in successes.items() for each in enumerate(won)]
        make = lw.evaluation.EpisodeResult
        episodes = [make(task, number, won, 1 if won else None, won, float(won)) for task, number, won in numbered]
        return episodes_to_record(lw.EvaluationResult({"tasks": [*successes]}, tuple(episodes)))

    outcomes = dict(a=[True, False], b=[True, True], c=[False, False], d=[True, False], e=[False, False])
    assert recorded(**outcomes) == [("c", 0), ("e", 0), ("a", 1)]
    assert recorded(a=[True, True], b=[True, False]) == [("b", 1)]
    assert recorded(a=[True], b=[True], c=[True], d=[True]) == [("a", 0), ("b", 0), ("c", 0)]


def test_evaluate_runs_the_demonstrated_tasks_by_default(capsys, policy, tmp_path):
    printed = run(capsys, "evaluate", policy, *SHORT)
    assert printed.startswith("evaluating 2 tasks of the policy's 10; use --tasks to choose others\n")
    assert [line.split()[0] for line in printed.splitlines()[2:]] == ["push", "reach", "mean"]
    shown = document(capsys, "evaluate", policy, "--plans", "MT10", *SHORT, "--attribute")
    assert len(shown["tasks"]) == len(shown["failures"]) == 10
    assert shown["config"]["max_steps"] == 5
    assert "plans have no plan for sweep-into" in fails(capsys, "evaluate", policy, "--tasks", "sweep-into")
    assert "--seed 0" in fails(capsys, "evaluate", policy, "--seed", 0)


def test_experts_and_scripted_plans_are_evaluated(capsys, tmp_path):
    shown = document(capsys, "evaluate", "expert", "--tasks", "reach", "--episodes", 2, "--stop-at-success")
    assert shown["mean_success"] == 1.0
    out = tmp_path / "scripted"
    args = ("scripted", "--tasks", "reach", "push", "--episodes", 2, "--noise", 0, "--max-steps", 120, "--out", out)
    printed = run(capsys, "evaluate", *args)
    assert "push: success 1.00\n    true " in printed
    assert "close the gripper around the puck" in printed
    assert lw.EvaluationResult.load(out / "results.json").success_once == {"push": 1.0, "reach": 1.0}
    use = json.loads((out / "plan_use.json").read_text())
    assert len(use["push"]["chosen"]) == len(lw.load_plans("MT10")["push"].steps)
    (reach,) = document(capsys, "evaluate", "scripted", "--tasks", "reach", *SHORT)["tasks"]
    assert [*reach["steps"][0]] == ["skill", "true", "chosen", "stuck"]
    assert document(capsys, "evaluate", "wrong", "--tasks", "push", *SHORT)["mean_success"] == 0.0


def test_info_describes_policies_and_datasets(capsys, demos, policy):
    assert "below 0.8" in document(capsys, "info", "few-shot-mt50")["card"]
    assert "tasks: push, reach" in run(capsys, "info", policy)
    assert "behaviour  noisy" in run(capsys, "info", demos)


def kill_when(forks, ready, timeout=120):
    deadline = time.monotonic() + timeout
    while not ready():
        assert forks.running(0.02), forks.end()
        assert time.monotonic() < deadline
    forks.send(signal.SIGKILL)
    assert forks.end().status == -signal.SIGKILL


@pytest.mark.slow
def test_the_quick_demo_resumes_after_kills_and_repeats_nothing(forks, tmp_path):
    config, out = replace(QUICK, training_steps=200, episodes_per_task=2), tmp_path / "demo"
    shorter = f"""
from dataclasses import replace
from lw_torchrl.cli import demo
demo.QUICK = replace(demo.QUICK, training_steps={config.training_steps}, episodes_per_task={config.episodes_per_task})
"""
    demonstrations = out / "demonstrations"

    def start():
        forks.start("demo", "--quick", "--out", out, before=shorter)

    def finish():
        start()
        status, printed, errors = forks.end()
        assert status == 0, errors
        return printed

    start()
    kill_when(forks, lambda: len(list(demonstrations.glob(".partial/*.npz"))) >= 2)
    assert not (demonstrations / "metadata.json").exists()
    start()
    kill_when(forks, (out / "checkpoint.safetensors").exists)
    assert not (out / "results.json").exists()
    printed = finish()
    policies = {"checkpoint.safetensors", "checkpoint.training.safetensors"}
    assert files_in(out) == {"config.json", "demonstrations", "results.json", "success.png", "rollout.rrd"} | policies
    assert json.loads((out / "config.json").read_text()) == json.loads(json.dumps(vars(config)))
    result = lw.EvaluationResult.load(out / "results.json")
    assert result.config["tasks"] == list(config.tasks)
    assert result.config["seed"] != config.demonstration_seed
    assert result.table() in printed
    assert f"lw-torchrl view {out / 'rollout.rrd'}" in printed
    policy = (out / "checkpoint.safetensors").read_bytes()
    kept = ["results.json", "config.json", "demonstrations/metadata.json", "demonstrations/data/action.memmap"]
    before = {name: (out / name).stat().st_mtime_ns for name in kept}
    assert finish() == printed
    assert {name: (out / name).stat().st_mtime_ns for name in kept} == before
    assert (out / "checkpoint.safetensors").read_bytes() == policy


def test_a_demo_of_another_configuration_is_not_overwritten(capsys, tmp_path):
    (tmp_path / "config.json").write_text(json.dumps({**vars(QUICK), "training_steps": 7}))
    before = (tmp_path / "config.json").read_bytes()
    assert "different configuration" in fails(capsys, "demo", "--quick", "--out", tmp_path)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == {"config.json": before}


def test_two_processes_cannot_write_one_demo(capsys, tmp_path, holding):
    holding(tmp_path / "demo", folder=True)
    assert "another process is writing to" in fails(capsys, "demo", "--quick", "--out", tmp_path / "demo")
    assert [path.name for path in (tmp_path / "demo").iterdir()] == [".lock"]


def tabs(recording):
    return [tab.name for tab in Tabs.read(RrdReader(recording)).tabs()]


def test_an_expert_is_recorded_with_the_shipped_plan(capsys, tmp_path):
    out = tmp_path / "recordings" / "reach.rrd"
    printed = run(capsys, "record", "reach", "--episodes", 0, 2, *LONG, "--stop-at-success", "--out", out)
    assert "reach, episode 0, expert: success at step " in printed
    assert f"lw-torchrl view {out}" in printed
    assert tabs(out) == ["overview", "reach-0", "reach-2"]
    ended = [int(step) for step in re.findall(r"success at step (\d+)", printed)]
    lengths = [row["steps"] for row in document(capsys, "info", out)["episodes"]]
    assert lengths == ended, "episodes end at the success"


@pytest.mark.parametrize("who", ["random", "wrong"])
def test_a_random_policy_is_reproducible(capsys, tmp_path, who):
    out = ("--out", tmp_path / "x.rrd")
    documents = [document(capsys, "record", "push", "--policy", who, "--max-steps", 40, *out) for _ in range(2)]
    assert documents[0] == documents[1]
    assert documents[0]["episodes"][0]["first_success"] is None


def test_two_policies_are_shown_side_by_side(capsys, tmp_path):
    policy, out = tmp_path / "mine.safetensors", tmp_path / "x.rrd"
    lw.save_actor(lw.PlanConditionedActor(lw.load_plans("MT10")), policy)
    printed = run(capsys, "record", "reach", "--policy", policy, "--compare", "scripted", *LONG, "--out", out)
    assert "reach, episode 0, mine: failed" in printed
    assert "reach, episode 0, scripted: success at step " in printed
    assert tabs(out) == ["reach · episode 0 · side by side", "reach-0-1", "reach-0-2"]


def test_the_cause_of_a_failure_is_printed(capsys, tmp_path):
    options = ("--policy", "scripted", "--attribute", "--max-steps", 45, "--seed", 1000, "--out", tmp_path / "x.rrd")
    assert "push, episode 0, scripted: failed, out of time: " in run(capsys, "record", "push", *options)


OWN = """
import torch
import lw_torchrl as lw
class Never(lw.QueryEvaluator):
    def logits(self, observation, task_id):
        return observation.new_full((*task_id.shape, self.plans.num_steps), -3.0)
policy = lw.ScriptedSkillActor(lw.load_plans("MT10"))
never = Never(lw.load_plans("MT10"))
number = 3
"""


def test_custom_policies_and_evaluators_are_recorded(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my_parts.py").write_text(OWN)
    printed = run(capsys, "record", "reach", "--policy", "my_parts:policy", *LONG)
    assert "reach, episode 0, policy: success at step " in printed
    assert tabs(tmp_path / "runs" / "recordings" / "reach-policy.rrd") == ["reach-0"]
    torch.manual_seed(0)
    lw.training.save_evaluator(lw.modules.StateQueryEvaluator(lw.load_plans("MT10"), width=8), "evaluator.safetensors")
    reach = lw.Plans({"reach": lw.load_plans("MT10")["reach"]})
    lw.save_actor(lw.PlanConditionedActor(reach, decoder=lw.modules.MLPDecoder(width=8)), "mine.safetensors")
    for policy in ("scripted", "mine.safetensors"):
        for evaluator in ("evaluator.safetensors", "my_parts:never", "my_parts:Never"):
            options = ("--policy", policy, "--evaluator", evaluator, "--max-steps", 5, "--out", "x.rrd")
            assert "reach, episode 0" in run(capsys, "record", "reach", *options)
    wrong = ("record", "reach", "--policy", "scripted", "--evaluator", "my_parts:number")
    assert "--evaluator my_parts:number" in fails(capsys, *wrong)
    assert "my_parts:number" in fails(capsys, "evaluate", "my_parts:number")
    assert "must have the form my_module:name" in fails(capsys, "evaluate", "my_parts:nothing")
    assert "requires a policy with plans" in fails(capsys, "record", "reach", "--evaluator", "my_parts:never")
