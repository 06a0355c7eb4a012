"""``lw-torchrl record``: policies, comparisons, causes of failures."""

import re

import pytest
import torch
from commands import document, fails, run
from rerun.chunk import RrdReader

import lw_torchrl as lw
from lw_torchrl.record.tabs import Tabs

SHORT = ("--max-steps", 120, "--seed", 1000)


def tabs(recording):
    return [tab.name for tab in Tabs.read(RrdReader(recording)).tabs()]


def test_an_expert_is_recorded_with_the_shipped_plan(capsys, tmp_path):
    out = tmp_path / "recordings" / "reach.rrd"
    printed = run(capsys, "record", "reach", "--episodes", 0, 2, *SHORT, "--stop-at-success", "--out", out)
    assert "reach, episode 0, expert: success at step " in printed
    assert f"lw-torchrl view {out}" in printed
    assert tabs(out) == ["overview", "reach-0", "reach-2"]
    ended = [int(step) for step in re.findall(r"success at step (\d+)", printed)]
    lengths = [row["steps"] for row in document(capsys, "info", out)["episodes"]]
    assert lengths == ended, "episodes end at the success"


@pytest.mark.parametrize("who", ["random", "wrong"])
def test_a_random_policy_is_reproducible(capsys, tmp_path, who):
    out = ("--out", tmp_path / "x.rrd")
    documents = [document(capsys, "record", "push", "--policy", who, *SHORT, *out) for _ in range(2)]
    assert documents[0] == documents[1]
    assert documents[0]["episodes"][0]["first_success"] is None


def test_two_policies_are_shown_side_by_side(capsys, tmp_path):
    policy, out = tmp_path / "mine.safetensors", tmp_path / "x.rrd"
    lw.save_actor(lw.PlanConditionedActor(lw.load_plans("MT10")), policy)
    printed = run(capsys, "record", "reach", "--policy", policy, "--compare", "scripted", *SHORT, "--out", out)
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
    printed = run(capsys, "record", "reach", "--policy", "my_parts:policy", *SHORT)
    assert "reach, episode 0, policy: success at step " in printed
    assert tabs(tmp_path / "runs" / "recordings" / "reach-policy.rrd") == ["reach-0"]
    torch.manual_seed(0)
    lw.training.save_evaluator(lw.modules.StateQueryEvaluator(lw.load_plans("MT10"), width=8), "evaluator.safetensors")
    reach = lw.Plans({"reach": lw.load_plans("MT10")["reach"]})
    lw.save_actor(lw.PlanConditionedActor(reach, decoder=lw.modules.MLPDecoder(width=8)), "mine.safetensors")
    for policy in ("scripted", "mine.safetensors"):
        for evaluator in ("evaluator.safetensors", "my_parts:never", "my_parts:Never"):
            options = ("--policy", policy, "--evaluator", evaluator, "--max-steps", 20, "--out", "x.rrd")
            assert "reach, episode 0" in run(capsys, "record", "reach", *options)
    wrong = ("record", "reach", "--policy", "scripted", "--evaluator", "my_parts:number")
    assert "--evaluator my_parts:number" in fails(capsys, *wrong)
    assert "my_parts:number" in fails(capsys, "evaluate", "my_parts:number")
    assert "must have the form my_module:name" in fails(capsys, "evaluate", "my_parts:nothing")
    assert "requires a policy with plans" in fails(capsys, "record", "reach", "--evaluator", "my_parts:never")
