"""in_keys and out_keys are obeyed by every module: read there, written there, nested ones too."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

import lw_torchrl as lw
from lw_torchrl._keys import as_keys
from lw_torchrl.modules import PlanAttention

PLANS = lw.load_plans("MT10")
SMALL = dict(latent_size=4, width=8, depth=1, encoder_width=8)


def state():
    generator = torch.Generator().manual_seed(0)
    ids = torch.tensor([lw.task_id(task) for task in ("push", "reach", "push")])
    return TensorDict(
        {
            "observation": torch.rand(3, 39, generator=generator),
            "task_id": ids,
            "qaf": torch.rand(3, PLANS.num_steps, generator=generator) > 0.5,
        },
        [3],
    )


def make(kind, **keys):
    torch.manual_seed(0)
    return {
        "plan": lambda: lw.PlanConditionedActor(PLANS, **SMALL, **keys),
        "description": lambda: lw.DescriptorConditionedActor("MT10", **SMALL, **keys),
        "scripted": lambda: lw.ScriptedSkillActor(PLANS, **keys),
        "expert": lambda: lw.ExpertActor("MT10", **keys),
        "attention": lambda: PlanAttention(PLANS, **keys),
    }[kind]()


KINDS = ["plan", "description", "scripted", "expert", "attention"]


@pytest.mark.parametrize("kind", KINDS)
def test_keys_are_obeyed(kind):
    plain = make(kind).eval()
    read = [("agent", "in", str(number)) for number in range(len(plain.in_keys))]
    written = [("agent", "out", str(number)) for number in range(len(plain.out_keys))]
    other = make(kind, in_keys=read, out_keys=written).eval()
    assert (other.in_keys, other.out_keys) == (read, written)
    rows = state()
    expected = plain(rows.clone())
    moved = TensorDict({there: rows[here] for here, there in zip(plain.in_keys, read, strict=True)}, [3])
    found = other(moved)
    assert set(found.keys(True, True)) == {*read, *written}
    for here, there in zip(plain.out_keys, written, strict=True):
        assert torch.equal(found[there], expected[here])


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_missing_is_named(kind):
    module = make(kind)
    rows = state()
    for key in module.in_keys:
        with pytest.raises(ValueError, match=rf"{module.in_keys[0]} and .* are needed, got .*; without {key}"):
            module(rows.exclude(key))


@pytest.mark.parametrize(
    "given", ["action", ["action"], ["a", "b", "c", "d"], ["a", "a", "b"], [1, 2, 3], [[], [], []], 3]
)
def test_what_is_no_list_of_keys_is_refused(given):
    with pytest.raises(ValueError, match="out_keys must be a list of 3, in this order: action, skill_weights, skill_l"):
        lw.PlanConditionedActor(PLANS, out_keys=given)


def test_keys_travel_with_the_policy(tmp_path):
    keys = dict(
        in_keys=["state", ("words", "task"), ("words", "qaf")], out_keys=["action", ("why", "weights"), "latent"]
    )
    actor = make("plan", **keys)
    lw.save_actor(actor, tmp_path / "policy.zip")
    loaded = lw.load_actor(tmp_path / "policy.zip")
    assert (loaded.in_keys, loaded.out_keys) == (actor.in_keys, actor.out_keys)
    queries = actor.transform()
    assert (queries.in_keys, queries.out_keys) == (
        ["state", ("words", "task")],
        [("words", "qaf"), ("words", "qaf_plan")],
    )


def test_a_json_list_is_a_nested_key():
    assert as_keys("in_keys", [["a", "b"], "c"], ("x", "y")) == [("a", "b"), "c"]


@pytest.mark.parametrize(
    "make_one",
    [
        lambda: lw.PlanConditionedActor(PLANS, out_keys=["action", "observation", "latent"]),
        lambda: lw.DescriptorConditionedActor("MT10", out_keys=["task_id"]),
        lambda: lw.ScriptedSkillActor(PLANS, out_keys=["qaf", "weights"]),
        lambda: lw.PlanConditionedQValue(PLANS, out_keys=["action"]),
        lambda: lw.QAFTransform(PLANS, out_keys=["observation"]),
        lambda: lw.QAFTransform(PLANS, in_keys=["observation", "qaf_plan"]),
        lambda: lw.RandomYaw(0.1, out_keys=["action", "observation", "a", "b"]),
    ],
)
def test_nothing_writes_over_what_it_reads(make_one):
    with pytest.raises(ValueError, match="out_keys must not be among in_keys"):
        make_one()
