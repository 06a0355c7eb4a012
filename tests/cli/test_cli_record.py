"""``lw-torchrl record``: any task under any policy, two of them side by side, and why it failed."""

import re

import pytest
import torch
from commands import fails, run
from rerun.chunk import RrdReader

import lw_torchrl as lw
from lw_torchrl.cli import options
from lw_torchrl.record.tabs import Tabs

SHORT = ("--max-steps", 120, "--seed", 1000)


def tabs(recording):
    return [tab.name for tab in Tabs.read(RrdReader(recording)).tabs()]


def test_an_expert_is_recorded_with_the_shipped_plan(capsys, tmp_path):
    out = tmp_path / "recordings" / "reach.rrd"
    printed = run(capsys, "record", "reach", "--episodes", 0, 2, *SHORT, "--stop-at-success", "--out", out)
    assert "reach, episode 0, expert: success at step " in printed
    assert "reach, episode 2, expert: " in printed
    assert f"lw-torchrl view {out}" in printed
    assert tabs(out) == ["overview", "reach-0", "reach-2"]
    pages = Tabs.read(RrdReader(out)).pages
    ended = [int(step) for step in re.findall(r"success at step (\d+)", printed)]
    assert [page.row["at"] for page in pages.values()] == ended
    chunks = [chunk for chunk in RrdReader(out).stream() if str(chunk.entity_path).endswith("/action")]
    lengths = [len(chunk) for chunk in chunks if not chunk.is_static]
    assert sorted(lengths) == sorted(ended), "nothing comes after the success"


def test_a_resumed_training_writes_a_second_recording(tmp_path):
    for value in (1.0, 2.0):
        with options.make_logger("rerun", tmp_path / "policy.safetensors") as logger:
            logger.log_scalar("train/loss", value)
    assert sorted(path.name for path in (tmp_path / "logs").iterdir()) == ["policy-2.rrd", "policy.rrd"]


@pytest.mark.parametrize("who", ["random", "wrong"])
def test_who_acts_by_chance_is_the_same_each_time(capsys, tmp_path, who):
    found = [run(capsys, "record", "push", "--policy", who, *SHORT, "--out", tmp_path / "x.rrd") for _ in range(2)]
    assert found[0] == found[1]
    assert f"push, episode 0, {who}: failed" in found[0]


def test_two_policies_side_by_side(capsys, tmp_path):
    policy, out = tmp_path / "mine.safetensors", tmp_path / "x.rrd"
    lw.save_actor(lw.PlanConditionedActor(lw.load_plans("MT10"), width=16, depth=1), policy)
    printed = run(capsys, "record", "reach", "--policy", policy, "--compare", "scripted", *SHORT, "--out", out)
    assert "reach, episode 0, mine: failed" in printed
    assert "reach, episode 0, scripted: success at step " in printed
    assert tabs(out) == ["reach · episode 0 · side by side", "reach-0-1", "reach-0-2"]


def test_a_failure_is_explained(capsys, tmp_path):
    out = tmp_path / "x.rrd"
    printed = run(
        capsys, "record", "push", "--policy", "scripted", "--attribute", "--max-steps", 45, "--seed", 1000, "--out", out
    )
    assert "push, episode 0, scripted: failed, out of time: " in printed


MINE = """
import lw_torchrl as lw
policy = lw.ScriptedSkillActor(lw.load_plans("MT10"))
number = 3
class Unmade: ...
"""


def test_a_policy_of_your_own_in_python(capsys, tmp_path, monkeypatch):
    (tmp_path / "my_policies.py").write_text(MINE)
    monkeypatch.chdir(tmp_path)
    printed = run(capsys, "record", "reach", "--policy", "my_policies:policy", *SHORT)
    assert "reach, episode 0, policy: success at step " in printed
    assert tabs(tmp_path / "runs" / "recordings" / "reach-policy.rrd") == ["reach-0"]
    told = run(capsys, "evaluate", "my_policies:policy", "--tasks", "reach", "--episodes", 1, *SHORT, "--json")
    assert '"success_once": 1.0' in told
    for wrong, message in (("my_policies:number", "must name a policy"), ("my_policies:Unmade", "the class Unmade")):
        assert message in fails(capsys, "record", "reach", "--policy", wrong)
        assert message in fails(capsys, "evaluate", wrong)


def test_conditions_answered_by_a_network(capsys, tmp_path):
    file, out = tmp_path / "evaluator.safetensors", tmp_path / "x.rrd"
    torch.manual_seed(0)
    lw.training.save_evaluator(lw.StateQueryEvaluator(lw.load_plans("MT10"), width=8), file)
    few = ("record", "reach", "--policy", "scripted", "--max-steps", 20, "--out", out)
    assert "reach, episode 0, scripted: failed" in run(capsys, *few, "--evaluator", file, "--attribute")
    assert "expert" in fails(capsys, "record", "reach", "--evaluator", file)


OWN_EVALUATORS = """
import torch
import lw_torchrl as lw


class Never(lw.QueryEvaluator):
    def logits(self, observation, task_id):
        return observation.new_full((*task_id.shape, self.plans.num_steps), -3.0)


never = Never(lw.load_plans("MT10"))
number = 3
"""


def test_conditions_answered_by_an_evaluator_of_yours(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "my_evaluators.py").write_text(OWN_EVALUATORS)
    roles = lw.PlanConditionedActor(lw.Plans({"reach": lw.load_plans("MT10")["reach"]}), roles=True, width=8)
    lw.save_actor(roles, "roles.safetensors")  # it reads exact truth, so it takes no evaluator inside
    for policy, named in (("scripted", "Never"), ("roles.safetensors", "never")):
        out = f"{named}.rrd"
        more = "--policy", policy, "--evaluator", f"my_evaluators:{named}", "--max-steps", 20, "--out", out
        assert "reach, episode 0" in run(capsys, "record", "reach", *more)
    run(
        capsys, "evaluate", "roles.safetensors", "--evaluator", "my_evaluators:Never", "--episodes", 1, "--max-steps", 5
    )
    more = "--policy", "scripted", "--evaluator", "my_evaluators:number"
    assert "must name an lw.QueryEvaluator, or a class of these, it names 3" in fails(capsys, "record", "reach", *more)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (("--policy", "my policies:x"), "must be like my_module:policy"),
        (("--policy", "scripted", "--evaluator", "nowhere.safetensors"), "evaluator: no file 'nowhere.safetensors'"),
        (("--policy", "random", "--evaluator", "x.safetensors"), "random asks no conditions"),
        (("--suite", "metawold"), "did you mean 'metaworld'"),
        (("--policy", "experts"), "did you mean 'expert'"),
        (("--compare", "nowhere.safetensors"), "'nowhere.safetensors'"),
        (("--device", "cuda:99"), "--device must be one of"),
        (("--reference", "MT10"), "--reference is for --attribute"),
        (("--out", "x.mp4"), "--out must end in '.rrd'"),
        (("--episodes", -1), "-1"),
    ],
)
def test_what_it_refuses(capsys, tmp_path, monkeypatch, more, message):
    monkeypatch.chdir(tmp_path)
    assert message in fails(capsys, "record", "reach", *more)
    assert not list(tmp_path.rglob("*.rrd"))
