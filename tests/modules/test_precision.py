"""Half and double precision, and gradients of single rows, for every kind of actor and critic."""

from __future__ import annotations

import pytest
import torch
from small_actors import ACTORS, PLANS, make_actor, make_descriptor, make_rows, rows_for, small_decoder
from torch.func import functional_call, grad, vmap

import lw_torchrl as lw

MODULES = ACTORS | {
    "value": lambda: lw.PlanConditionedValue(PLANS, ensemble=2, width=8, depth=1),
    "value of actions": lambda: lw.PlanConditionedQValue(PLANS, width=8, depth=1),
}


@pytest.mark.parametrize("rows_too", [True, False], ids=["rows too", "float32 rows"])
@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float64])
@pytest.mark.parametrize("name", [name for name in MODULES if name != "scripted"])
def test_other_precisions_give_nearly_the_same_output(name, dtype, rows_too):
    module = MODULES[name]().eval()
    rows = rows_for(module, 6).set("action", torch.rand(6, 4))
    key = "action" if "action" in module.out_keys else module.out_keys[-1]
    expected = module(rows.copy())[key]
    cast = rows.copy()
    if rows_too:
        cast["observation"] = cast["observation"].to(dtype)
    output = module.to(dtype)(cast)[key]
    assert output.dtype == dtype
    if key == "action" and name == "decided":
        output, expected = output[:, :3], expected[:, :3]
    limit = 0.1 if dtype == torch.bfloat16 else 1e-4
    torch.testing.assert_close(output.float(), expected, atol=limit, rtol=limit)


@pytest.mark.parametrize("make", [make_actor, make_descriptor])
def test_gradients_of_single_rows_sum_to_the_batch_gradient(make):
    actor = make(decoder=small_decoder(), **{"plans" if make is make_actor else "tasks": PLANS})
    rows = make_rows(5)
    params = {name: weight.detach() for name, weight in actor.named_parameters()}
    tensors = {key: rows[key] for key in actor.in_keys}

    def loss(params, tensors):
        return functional_call(actor, params, (), tensors)[-1].square().sum()

    each = vmap(grad(loss), (None, 0))(params, tensors)
    actor(rows.copy())["action"].square().sum().backward()
    for name, weight in actor.named_parameters():
        assert each[name].shape == (5, *weight.shape)
        torch.testing.assert_close(each[name].sum(0), weight.grad, atol=1e-5, rtol=1e-4)
