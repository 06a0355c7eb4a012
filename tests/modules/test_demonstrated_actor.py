"""DemonstratedActor: one policy for the tasks that were demonstrated, one with plans for all others."""

import pytest
import torch
from tensordict import TensorDict

import lw_torchrl as lw
from lw_torchrl.modules import ActorEnsemble, DemonstratedActor, TransferredActor
from lw_torchrl.suites import load_suite

PLANS = lw.load_plans("MT50")
SEEN = ("push", "reach")
SMALL = {"width": 8, "depth": 1}


def make(**options):
    torch.manual_seed(0)
    others = lw.PlanConditionedActor(PLANS, roles=True, features="none", **SMALL, **options)
    return DemonstratedActor(lw.DescriptorConditionedActor(SEEN, **SMALL), others).eval()


def make_state(actor, tasks=("push", "hammer", "reach", "soccer", "push")):
    ids = torch.tensor([lw.task_id(task) for task in tasks])
    state = TensorDict(observation=torch.rand(len(tasks), 39), task_id=ids).auto_batch_size_()
    return actor.transform()(state)


def test_each_row_is_its_policy_s():
    actor = make()
    state = make_state(actor)
    found = actor(state.clone())
    seen = torch.tensor([True, False, True, False, True])
    plain = actor.demonstrated(state[seen].clone())["action"]
    others = actor.others(state.clone())
    torch.testing.assert_close(found["action"][seen], plain)
    assert torch.equal(found["action"][~seen], others["action"][~seen])
    assert torch.equal(found["skill_weights"], others["skill_weights"])
    assert set(found.keys()) == {*state.keys(), *actor.out_keys}
    assert torch.equal(found["task_id"], state["task_id"])
    assert (actor.plans, actor.tasks) == (actor.others.plans, tuple(PLANS))


def test_only_one_kind_of_rows():
    actor = make()
    for tasks, part in ((("push", "reach"), actor.demonstrated), (("hammer", "soccer"), actor.others)):
        state = make_state(actor, tasks)
        torch.testing.assert_close(actor(state.clone())["action"], part(state.clone())["action"])


def test_keys_of_ones_own():
    keys = ["observation", ("agent", "task")]
    plain = lw.DescriptorConditionedActor(SEEN, in_keys=keys, **SMALL)
    others = lw.PlanConditionedActor(PLANS, roles=True, features="none", in_keys=[*keys, "qaf"], **SMALL)
    actor = DemonstratedActor(plain, others).eval()
    assert actor.in_keys == [*keys, "qaf"]
    state = make_state(make())
    state["agent", "task"] = state.pop("task_id")
    assert torch.equal(actor(state.clone())["action"][1], others(state.clone())["action"][1])
    with pytest.raises(ValueError, match=r"agent.*needed"):
        actor(state.exclude(("agent", "task")))


def test_each_policy_acts_once_a_step():
    actor, calls = make(), []
    actor.others.register_forward_hook(lambda *_: calls.append("others"))
    actor.demonstrated.register_forward_hook(lambda *_: calls.append("demonstrated"))
    actor(make_state(actor))
    assert sorted(calls) == ["demonstrated", "others"]


def test_saved_and_loaded_it_does_the_same(tmp_path):
    plain = ActorEnsemble([lw.DescriptorConditionedActor(SEEN, **SMALL) for _ in range(2)])
    others = ActorEnsemble([lw.PlanConditionedActor(PLANS, roles=True, features="none", **SMALL) for _ in range(2)])
    actor = DemonstratedActor(plain, others).eval()
    lw.save_actor(actor, tmp_path / "policy.safetensors")
    loaded, state = lw.load_actor(tmp_path / "policy.safetensors"), make_state(actor)
    assert isinstance(loaded, DemonstratedActor)
    assert not loaded.training
    assert torch.equal(loaded(state.clone())["action"], actor(state.clone())["action"])
    assert loaded.describe() == actor.describe()


def test_with_plans_gives_others_to_the_one_with_plans():
    actor = make()
    steps = [("the gripper is open", "grab the puck"), ("the gripper is closed", "bring the puck to the goal")]
    mine = lw.ConditionalPlan.from_pairs("push", steps)
    other = actor.with_plans(lw.Plans([mine, PLANS["hammer"]]))
    assert not other.training
    assert other.tasks == ("hammer", "push")
    assert other.demonstrated is actor.demonstrated
    assert other.others.head is actor.others.head
    state = make_state(other, ("push", "hammer"))
    assert torch.equal(other(state.clone())["action"][1], other.others(state.clone())["action"][1])
    torch.testing.assert_close(other(state.clone())["action"][:1], actor.demonstrated(state[:1].clone())["action"])


def test_in_another_suite_no_task_was_demonstrated():
    fetch = load_suite("fetch").plans
    other = make().with_plans(fetch)
    assert type(other) is lw.PlanConditionedActor
    moved = TransferredActor(make(), fetch)
    assert moved.tasks == tuple(fetch)


def test_it_is_evaluated_and_takes_statistics():
    actor = make()
    observation = torch.randn(50, 39)
    actor.fit_normalization(observation)
    assert actor.demonstrated.encoder.features.mean.any()
    actor.fit_contacts(observation, torch.full((50,), lw.task_id("push")))
    assert actor.others.encoder.roles.demonstrated.sum() == 1
    result = lw.evaluate(actor, tasks=["push", "hammer"], episodes_per_task=1, seed=1_000, max_steps=3, progress=False)
    assert result.mean_success == 0.0


def test_what_does_not_belong_together_is_refused():
    plain, others = lw.DescriptorConditionedActor(SEEN, **SMALL), lw.PlanConditionedActor(PLANS, **SMALL)
    for wrong in ((others, others), (plain, plain), (others, plain)):
        with pytest.raises(ValueError, match="demonstrated must be a policy without plans, and others one with plans"):
            DemonstratedActor(*wrong)
    fetch = lw.PlanConditionedActor(load_suite("fetch").plans, **SMALL)
    with pytest.raises(ValueError, match="must be of one layout, got 'metaworld' and 'fetch'"):
        DemonstratedActor(plain, fetch)
