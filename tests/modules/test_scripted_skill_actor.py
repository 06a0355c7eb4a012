"""ScriptedSkillActor: which step acts, and the plans of MT10 carried out."""

import pytest
import torch
from tensordict import TensorDict

import lw_torchrl as lw

PLANS = lw.load_plans("MT10")
PUSH = lw.task_id("push")


def acting(select, qaf, **options):
    """Return the actor's weights and actions, and those of each skill, in a random state of push for each row."""
    n = len(qaf)
    torch.manual_seed(0)
    state = TensorDict(
        {"observation": torch.rand(n, 39), "task_id": torch.full((n,), PUSH), "qaf": torch.tensor(qaf)}, [n]
    )
    actor = lw.ScriptedSkillActor({"push": PLANS["push"]}, select, **options)
    out = actor(state)
    return out["skill_weights"], out["action"], actor.program(state["observation"], state["task_id"])


TRUE = [[True, False, False, False], [False, True, True, False], [False, False, False, False], [True, True, True, True]]


def test_first_true_step_acts_or_the_last_if_none_is_true():
    weights, action, each = acting("first", TRUE)
    assert weights.argmax(-1).tolist() == [0, 1, 3, 0]
    assert weights.sum(-1).tolist() == [1.0] * 4
    assert torch.equal(action, each[torch.arange(4), weights.argmax(-1)])


def test_mix_averages_the_true_steps():
    weights, action, each = acting("mix", TRUE)
    assert weights[1].tolist() == [0.0, 0.5, 0.5, 0.0]
    assert weights[2].tolist() == [0.0, 0.0, 0.0, 1.0]
    assert torch.allclose(action[1], (each[1, 1] + each[1, 2]) / 2)


def test_random_step_is_uniform_over_true_steps_and_depends_on_the_seed():
    qaf = [[False, True, True, True]] * 3000
    weights, _, _ = acting("random", qaf, seed=3)
    counts = weights.sum(0).tolist()
    assert counts[0] == 0
    assert all(900 < count < 1100 for count in counts[1:])
    assert torch.equal(weights, acting("random", qaf, seed=3)[0])
    assert not torch.equal(weights, acting("random", qaf, seed=4)[0])


@pytest.mark.parametrize("select", ["first", "mix", "random"])
def test_soft_truth_is_true_above_a_half(select):
    soft = [[0.1, 0.9, 0.4, 0.0], [0.6, 0.9, 0.1, 0.5], [0.5, 0.4, 0.1, 0.0]]
    weights = acting(select, soft, seed=5)[0]
    assert torch.equal(weights, acting(select, [[truth > 0.5 for truth in row] for row in soft], seed=5)[0])
    assert weights[0].tolist() == [0.0, 1.0, 0.0, 0.0]
    assert weights[2].tolist() == [0.0, 0.0, 0.0, 1.0]


def test_padding_gets_no_weight():
    ids = torch.tensor([lw.task_id(task) for task in lw.MT10])
    qaf = torch.zeros(10, PLANS.num_steps, dtype=torch.bool)
    state = TensorDict(observation=torch.rand(10, 39), task_id=ids, qaf=qaf, batch_size=[10])
    weights = lw.ScriptedSkillActor(PLANS)(state)["skill_weights"]
    assert weights.argmax(-1).tolist() == [len(PLANS[task].steps) - 1 for task in lw.MT10]


def test_plans_of_mt10_succeed():
    options = {"noise_scale": 0.0, "stop_at_success": True, "progress": False}
    result = lw.evaluate(lw.ScriptedSkillActor(PLANS), tasks="MT10", episodes_per_task=5, seed=31, **options)
    assert result.mean_success >= 0.98, result.table()


def test_custom_skills_and_other_plans(tmp_path):
    path = tmp_path / "skills.toml"
    path.write_text('["stay put"]\ntarget = "robot\'s gripper"\n')
    plan = lw.ConditionalPlan.from_pairs("reach", [("the gripper is open", "stay put")])
    actor = lw.ScriptedSkillActor({"reach": plan}, skills=lw.load_skills(path))
    ids = torch.tensor([lw.task_id("reach")])
    state = TensorDict(observation=torch.rand(1, 39), task_id=ids, qaf=torch.ones(1, 1).bool(), batch_size=[1])
    assert not actor(state)["action"].any()
    assert actor.with_plans({"reach": plan}).plans == actor.plans
