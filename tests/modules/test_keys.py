"""in_keys and out_keys of every module, as TorchRL uses them: renamed, selected, called with tensors."""

import copy

import pytest
import torch
from small_actors import ACTORS, PLANS, make_actor, make_descriptor, make_rows, rows_for
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential, set_skip_existing

import lw_torchrl as lw
from lw_torchrl import modules as m
from lw_torchrl.modules import PlanAttention, QValue, Value, descriptor_trunk, plan_trunk

KINDS = {
    "plan": make_actor,
    "description": make_descriptor,
    "scripted": lambda **keys: lw.ScriptedSkillActor(PLANS, **keys),
    "expert": lambda **keys: lw.ExpertActor("MT10", **keys),
    "attention": lambda **keys: PlanAttention(PLANS, **keys),
    "mixer": lambda **keys: m.SkillMixer(PLANS, m.SkillEncoder(3), **keys),
    "features": lambda **keys: m.ObservationFeatures(**keys),
    "focus": lambda **keys: m.FocusFeatures(PLANS, **keys),
}


def state():
    rows = make_rows(3)
    return rows.set("skill_weights", torch.rand(3, PLANS.num_steps, generator=torch.Generator().manual_seed(0)))


def make(kind, **keys):
    torch.manual_seed(0)
    return KINDS[kind](**keys).eval()


@pytest.mark.parametrize("kind", KINDS)
def test_renamed_keys_are_read_and_written(kind):
    plain, rows = make(kind), state()
    read = [("agent", "in", str(number)) for number in range(len(plain.in_keys))]
    last = plain.out_keys if kind not in ("plan", "description") else ["action"]
    written = [("agent", "out", str(number)) for number in range(len(last))]
    expected = plain(rows.clone())
    moved = TensorDict({there: rows[here] for here, there in zip(plain.in_keys, read, strict=True)}, [3])
    assigned = make(kind)
    assigned.in_keys = read
    for other, names in ((make(kind, in_keys=read, out_keys=written), written), (assigned, last)):
        assert (other.in_keys, other.out_keys[-len(last) :]) == (read, names)
        output = other(moved.clone())
        assert set(output.keys(True, True)) == {*read, *other.out_keys}
        assert all(torch.equal(output[there], expected[here]) for here, there in zip(last, names, strict=True))


SMALL = dict(width=8, depth=1)
MODULES = ACTORS | {
    "expert": lambda: lw.ExpertActor("MT10"),
    "plan trunk": lambda: plan_trunk(PLANS),
    "description trunk": lambda: descriptor_trunk("MT10"),
    "value": lambda: Value(plan_trunk(PLANS), ensemble=2, **SMALL),
    "value of actions": lambda: QValue(plan_trunk(PLANS), ensemble=2, **SMALL),
    "quantiles": lambda: QValue(plan_trunk(PLANS), quantiles=5, **SMALL),
    "attention": lambda: PlanAttention(PLANS),
    "focus features": lambda: m.FocusFeatures(PLANS),
    "answers": lambda: lw.modules.StateQueryEvaluator(PLANS, width=8),
}
each_module = pytest.mark.parametrize("name", MODULES)


def made(name):
    """Return a module, its inputs for some rows, and its outputs."""
    torch.manual_seed(0)
    module = MODULES[name]().eval()
    rows = rows_for(module, 3).update({"action": torch.rand(3, 4), "skill_weights": torch.rand(3, PLANS.num_steps)})
    rows.update({"qaf": rows.get("qaf", state()["qaf"]), "turn": torch.zeros(3, dtype=torch.int64)})
    read = rows.select(*module.in_keys)
    return module, read, module(read.copy()).select(*module.out_keys)


def as_tuple(output):
    return output if isinstance(output, tuple) else (output,)


@each_module
def test_select_out_keys(name):
    module, read, written = made(name)
    names = list(module.out_keys)
    for chosen in ([names[0]], [names[-1]], names[::-1]):
        assert module.select_out_keys(*chosen) is module
        assert (module.out_keys, module.out_keys_source) == (chosen, names)
        for one in (module, copy.deepcopy(module)):
            output = one(read.copy())
            assert set(output.keys(True, True)) == {*module.in_keys, *chosen}
            assert all(torch.equal(output[key], written[key]) for key in chosen)
        by_name = as_tuple(module(**read.to_dict()))
        assert all(torch.equal(one, written[key]) for one, key in zip(by_name, chosen, strict=True))
        module.reset_out_keys()
        assert (module(read.copy()).select(*names) == written).all()


@each_module
def test_call_with_tensors_by_position_and_by_name(name):
    module, read, written = made(name)
    for output in (module(**read.to_dict()), module(*(read[key] for key in module.in_keys))):
        assert all(torch.equal(one, written[key]) for one, key in zip(as_tuple(output), module.out_keys, strict=True))
    with pytest.raises((TypeError, RuntimeError), match="observatoin"):
        module(observatoin=read[module.in_keys[0]])


@pytest.mark.parametrize("name", [n for n in MODULES if not isinstance(MODULES[n](), TensorDictSequential)])
def test_assigned_out_keys(name):
    module, read, written = made(name)
    module.out_keys = [("other", key) for key in module.out_keys]
    output = module(read.copy())
    assert all(torch.equal(output["other", key], written[key]) for key in written.keys(True, True))


@each_module
def test_skip_existing(name):
    module, read, written = made(name)
    there = read.copy().update(written.clone().zero_())
    with set_skip_existing(True):
        assert not any(module(there.copy())[key].any() for key in module.out_keys)
        assert torch.equal(module(read.copy())[module.out_keys[0]], written[module.out_keys[0]])
    assert torch.equal(module(there.copy())[module.out_keys[0]], written[module.out_keys[0]])


@pytest.mark.parametrize("name", [name for name in MODULES if "normal" not in name])  # no distribution has no rows
@pytest.mark.parametrize("rows", [(0,), (2, 0)])
def test_call_with_no_rows(name, rows):
    module, read, written = made(name)
    output = module(TensorDict({key: value.new_zeros(*rows, *value.shape[1:]) for key, value in read.items()}, rows))
    for key in module.out_keys:
        assert (output[key].shape, output[key].dtype) == ((*rows, *written[key].shape[1:]), written[key].dtype)


@pytest.mark.parametrize("name", ["ensemble", "scripted"])
def test_renamed_out_keys_are_saved_or_refused(name, tmp_path):
    actor = MODULES[name]()
    actor.out_keys = [("other", key) for key in actor.out_keys]
    if name == "ensemble":
        with pytest.raises(ValueError, match="in_keys or out_keys were changed after construction"):
            lw.save_actor(actor, tmp_path / "policy.safetensors")
    else:
        lw.save_actor(actor, tmp_path / "policy.safetensors")
        assert lw.load_actor(tmp_path / "policy.safetensors").out_keys == actor.out_keys
