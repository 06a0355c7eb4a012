"""in_keys and out_keys are obeyed by every module, as TorchRL's own do: also selected, or called with tensors."""

from __future__ import annotations

import copy
import inspect

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential, set_skip_existing
from torchrl.objectives.value import GAE

import lw_torchrl as lw
from lw_torchrl._keys import as_keys
from lw_torchrl.modules import DescriptorEncoder, PlanAttention, PlanEncoder, QValue, Value

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


def test_keys_travel_with_the_policy(tmp_path):
    keys = dict(
        in_keys=["state", ("words", "task"), ("words", "qaf")], out_keys=["action", ("why", "weights"), "latent"]
    )
    actor = make("plan", **keys)
    lw.save_actor(actor, tmp_path / "policy.safetensors")
    loaded = lw.load_actor(tmp_path / "policy.safetensors")
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


# --- what TorchRL does with modules --------------------------------------------------------------------------------


def plan_actor(**more):
    return lw.PlanConditionedActor(PLANS, **SMALL, **more)


networks = dict(width=8, depth=1)
MODULES = {
    "plan": plan_actor,
    "tanh_normal": lambda: plan_actor(distribution="tanh_normal"),
    "normal": lambda: lw.DescriptorConditionedActor("MT10", distribution="normal", **SMALL),
    "description": lambda: lw.DescriptorConditionedActor("MT10", **SMALL),
    "with evaluator": lambda: plan_actor(evaluator=lw.StateQueryEvaluator(PLANS, width=8)),
    "scripted": lambda: lw.ScriptedSkillActor(PLANS),
    "expert": lambda: lw.ExpertActor("MT10"),
    "ensemble": lambda: lw.modules.ActorEnsemble([plan_actor(), plan_actor()]),
    "plan encoder": lambda: PlanEncoder(PLANS),
    "description encoder": lambda: DescriptorEncoder("MT10"),
    "value": lambda: Value(PlanEncoder(PLANS), ensemble=2, **networks),
    "value of actions": lambda: QValue(PlanEncoder(PLANS), ensemble=2, **networks),
    "quantiles": lambda: QValue(PlanEncoder(PLANS), quantiles=5, **networks),
    "attention": lambda: PlanAttention(PLANS),
    "evaluator": lambda: lw.StateQueryEvaluator(PLANS, width=8),
}
each_module = pytest.mark.parametrize("name", MODULES)


def made(name):
    """A module, what it reads of some rows, and what it writes."""
    torch.manual_seed(0)
    module, rows = MODULES[name]().eval(), state()
    rows["action"] = torch.rand(3, 4)
    read = rows.select(*module.in_keys)
    return module, read, module(read.copy()).select(*module.out_keys)


def as_tuple(found):
    return found if isinstance(found, tuple) else (found,)


@each_module
def test_selected_keys_hold_what_they_held_before(name):
    module, read, written = made(name)
    names = list(module.out_keys)
    for chosen in ([names[0]], [names[-1]], names[::-1]):
        assert module.select_out_keys(*chosen) is module
        assert (module.out_keys, module.out_keys_source) == (chosen, names)
        for one in (module, copy.deepcopy(module)):
            found = one(read.copy())
            assert set(found.keys(True, True)) == {*module.in_keys, *chosen}
            assert all(torch.equal(found[key], written[key]) for key in chosen)
        by_name = as_tuple(module(**read.to_dict()))
        assert all(torch.equal(one, written[key]) for one, key in zip(by_name, chosen, strict=True))
        module.reset_out_keys()
        assert (module(read.copy()).select(*names) == written).all()


@each_module
def test_selected_by_a_sequence(name):
    module, read, written = made(name)
    found = TensorDictSequential(module, selected_out_keys=[module.out_keys[-1]])(read.copy())
    assert set(found.keys(True, True)) == {*module.in_keys, module.out_keys[-1]}
    assert torch.equal(found[module.out_keys[-1]], written[module.out_keys[-1]])


@each_module
def test_called_with_tensors(name):
    module, read, written = made(name)
    for found in (module(**read.to_dict()), module(*(read[key] for key in module.in_keys))):
        assert all(torch.equal(one, written[key]) for one, key in zip(as_tuple(found), module.out_keys, strict=True))
    with pytest.raises(TypeError, match="unexpected keyword argument 'observatoin'"):
        module(observatoin=read[module.in_keys[0]])


@each_module
def test_new_names_for_what_it_writes(name):
    module, read, written = made(name)
    names = list(module.out_keys)
    module.out_keys = [("other", key) for key in names]
    found = module(read.copy())
    assert all(torch.equal(found["other", key], written[key]) for key in names)


@each_module
def test_what_is_there_is_skipped_if_asked(name):
    module, read, written = made(name)
    there = read.copy().update(written.clone().zero_())
    with set_skip_existing(True):
        assert not any(module(there.copy())[key].any() for key in module.out_keys)
        assert torch.equal(module(read.copy())[module.out_keys[0]], written[module.out_keys[0]])
    assert torch.equal(module(there.copy())[module.out_keys[0]], written[module.out_keys[0]])


@each_module
@pytest.mark.parametrize("rows", [(0,), (2, 0)])
def test_no_rows(name, rows):
    module, read, written = made(name)
    found = module(TensorDict({key: value.new_zeros(*rows, *value.shape[1:]) for key, value in read.items()}, rows))
    for key in module.out_keys:
        assert (found[key].shape, found[key].dtype) == ((*rows, *written[key].shape[1:]), written[key].dtype)


@each_module
def test_in_double_precision_it_says_the_same(name):
    module, read, written = made(name)
    found = module.to(torch.float64)(read.copy())
    for key in module.out_keys:
        torch.testing.assert_close(found[key].to(written[key].dtype), written[key], atol=1e-4, rtol=1e-4)


def test_estimators_skip_values_that_are_there():
    value, rows = Value(PlanEncoder(PLANS), **networks), state().unsqueeze(0)
    flag = torch.zeros(1, 3, 1, dtype=torch.bool)
    rows["state_value"] = torch.ones(1, 3, 1)
    rows["next"] = rows.copy().update({"reward": torch.ones(1, 3, 1), "done": flag, "terminated": flag})
    found = GAE(gamma=0.5, lmbda=0.0, value_network=value, skip_existing=True)(rows)
    assert torch.equal(found["advantage"], torch.full((1, 3, 1), 0.5)), "1 + 0.5 - 1"


@pytest.mark.parametrize("make_one", [plan_actor, MODULES["scripted"]])
def test_new_names_are_saved_or_refused(make_one, tmp_path):
    actor = make_one()
    actor.out_keys = [("other", key) for key in actor.out_keys]
    if isinstance(actor, lw.ScriptedSkillActor):
        with pytest.raises(ValueError, match="in_keys or out_keys were changed later: pass them to its constructor"):
            lw.save_actor(actor, tmp_path / "policy.safetensors")
    else:
        lw.save_actor(actor, tmp_path / "policy.safetensors")
        assert lw.load_actor(tmp_path / "policy.safetensors").out_keys == actor.out_keys


def test_every_forward_of_ours_is_called_so():
    for make_one in MODULES.values():
        kinds = [p.kind for p in inspect.signature(make_one().forward).parameters.values()]
        assert kinds == [inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD]
