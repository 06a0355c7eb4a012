"""Actions: LanguageWorldEnv executes them clipped, does not change them, and raises errors for wrong ones."""

import pytest
import torch
from rows import ROWS, advance, others, same


@pytest.mark.parametrize(
    "layout",
    [
        torch.clone,
        lambda values: values.t().clone().t(),
        lambda values: torch.cat([values, values], 1)[:, ::2],
        lambda values: values.clone().requires_grad_(),
        lambda values: values.clone().requires_grad_() * 1.0,
        lambda values: values[:1].clone().expand(ROWS, 4),
    ],
    ids=["contiguous", "transposed", "strided", "grad", "not a leaf", "expanded"],
)
def test_an_action_out_of_range_is_executed_clipped_and_does_not_change(any_env, layout):
    wild = torch.linspace(-4, 4, 24).reshape(ROWS, 4)
    wild[0, 0], wild[5, 3] = -torch.inf, torch.inf
    action = layout(wild)
    wild = action.detach().clone()
    any_env.set_seed(1)
    expected = advance(any_env, any_env.reset(), wild.clamp(-1, 1))
    any_env.set_seed(1)
    state = any_env.step(any_env.reset().set("action", action))
    assert torch.equal(state["action"], wild)
    assert torch.equal(action, wild)
    assert torch.equal(state["next", "executed_action"], wild.clamp(-1, 1))
    assert not state["next", "executed_action"].requires_grad
    assert same(expected, state["next"])


def test_executed_action_is_zero_after_reset_at_rest_and_for_nan(env):
    env.set_seed(1)
    state = env.reset()
    assert not state["executed_action"].any()
    action = torch.full((ROWS, 4), 0.5)
    action[1, 2] = float("nan")
    with pytest.warns(UserWarning, match="row 1: its action is NaN"):
        state = advance(env, state, action, _step=others(0))
    moved = others(0, 1)
    assert torch.equal(state["executed_action"], action.where(moved[:, None], torch.zeros(())))
    assert not env.reset(state.clone().set("_reset", ~moved))["executed_action"][~moved].any()


@pytest.mark.parametrize(
    "action",
    [None, *map(torch.zeros, [(ROWS, 5), (ROWS, 3), (ROWS,), (ROWS, 1, 4)])]
    + [torch.zeros(ROWS, 4, dtype=dtype) for dtype in (torch.float64, torch.int64, torch.bfloat16)],
    ids=lambda a: "none" if a is None else f"{tuple(a.shape)}-{a.dtype}",
)
def test_a_wrong_action_is_an_error_and_moves_nothing(any_env, action):
    any_env.set_seed(1)
    state = any_env.reset()
    with pytest.raises(ValueError, match=r"action must be float32 of shape \(6, 4\)"):
        any_env.step(state.clone() if action is None else state.clone().set("action", action))
    after = advance(any_env, state, torch.ones(ROWS, 4))
    any_env.set_seed(1)
    assert same(after, advance(any_env, any_env.reset(), torch.ones(ROWS, 4)))
