"""Truth of other plans than the actor's, of the same number of steps, is refused wherever both meet."""

import pytest
import torch
from tensordict import TensorDict

import lw_torchrl as lw
from lw_torchrl.language.relations import RELATIONS, Comparison
from lw_torchrl.modules import ActorEnsemble, FocusFeatures, PlanAttention

STEPS = [
    ("the gripper is not above the puck", "place the gripper above the puck"),
    ("the gripper is above the puck", "lower the gripper around the puck"),
]
REFUSED = "qaf was computed with plans.* push"


def plans_of(pairs, *more):
    return lw.Plans([lw.ConditionalPlan.from_pairs("push", pairs), *more])


PLANS = plans_of(STEPS)
OTHERS = {
    "steps in another order": plans_of(STEPS[::-1]),
    "another condition": plans_of([(f"{STEPS[0][0]} and the gripper is open", STEPS[0][1]), STEPS[1]]),
    "another skill": plans_of([STEPS[0], (STEPS[1][0], "close the gripper around the puck")]),
}
ACTORS = {
    "actor": lambda plans, **keys: lw.PlanConditionedActor(plans, **keys),
    "focus": lambda plans, **keys: lw.PlanConditionedActor(plans, features=FocusFeatures(plans), **keys),
    "scripted": lw.ScriptedSkillActor,
    "ensemble": lambda plans, **keys: ActorEnsemble([lw.PlanConditionedActor(plans, **keys)] * 2),
    "attention": lambda plans: PlanAttention(plans),
}


def state(plans, rows=3):
    data = TensorDict(observation=torch.zeros(rows, 39), task_id=torch.full((rows,), lw.task_id("push")))
    return lw.QAFTransform(plans)(data.auto_batch_size_())


@pytest.mark.parametrize("other", OTHERS)
@pytest.mark.parametrize("make", ACTORS)
def test_actor_refuses_truth_of_other_plans(make, other):
    actor = ACTORS[make](PLANS)
    with pytest.raises(ValueError, match=REFUSED):
        actor(state(OTHERS[other]))
    assert actor(state(OTHERS[other]).exclude("qaf_plan"))["skill_weights"].shape == (3, 2)
    assert actor(state(plans_of(STEPS)))["skill_weights"].shape == (3, 2), "equal plans, not the same object"


def test_each_row_carries_the_number_of_its_plan():
    reach = lw.ConditionalPlan.from_pairs("reach", [("the gripper is open", "close the gripper")] * 2)
    both = plans_of(STEPS, reach)
    mixed = TensorDict(
        observation=torch.zeros(4, 39), task_id=torch.tensor([lw.task_id(t) for t in ("push", "reach")] * 2)
    )
    mixed = lw.QAFTransform(both)(mixed.auto_batch_size_())
    assert mixed["qaf_plan"].tolist() == [both.numbers["push"], both.numbers["reach"]] * 2
    assert mixed["qaf_plan"][0] == state(PLANS)["qaf_plan"][0], "whatever stands beside it"
    lw.PlanConditionedActor(both)(mixed)
    other = lw.ConditionalPlan.from_pairs("reach", [("the gripper is closed", "close the gripper")] * 2)
    with pytest.raises(ValueError, match="for reach; pass"):
        lw.PlanConditionedActor(plans_of(STEPS, other))(mixed)


def test_refusal_after_a_relation_was_redefined(monkeypatch):
    before = lw.PlanConditionedActor(PLANS)
    monkeypatch.setitem(RELATIONS, "above", (Comparison("z", ">", 0.3),))
    with pytest.raises(ValueError, match=REFUSED):
        before(state(PLANS))
    lw.PlanConditionedActor(PLANS)(state(PLANS))


def test_vmap_over_rows_skips_the_check_and_over_weights_keeps_it():
    actor, data = lw.PlanConditionedActor(PLANS).eval(), state(OTHERS["another skill"])
    assert torch.vmap(lambda row: actor(row)["action"])(data.exclude("action")).shape == (3, 4)
    params = TensorDict.from_module(actor).expand(2).clone()

    def act(params):
        with params.to_module(actor):
            return actor(data.copy())["action"]

    with pytest.raises(ValueError, match=REFUSED):  # over weights the numbers can be read
        torch.vmap(act)(params)


def test_compiled_actor_refuses_at_run_time():
    actor = lw.PlanConditionedActor(PLANS).eval()
    act = torch.compile(lambda data: actor(data)["action"], backend="eager")
    assert act(state(PLANS)).shape == (3, 4)
    with pytest.raises(RuntimeError, match="qaf was computed with plans"):
        act(state(OTHERS["another skill"]))
    wrong = state(PLANS)
    wrong["observation"][1, 2] = torch.nan
    with pytest.raises(RuntimeError, match="finite numbers"):
        act(wrong)
