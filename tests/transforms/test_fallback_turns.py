"""FallbackTurns: a turn ends when nothing moves, or after its maximum length; rows are independent."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.envs import Compose, TransformedEnv
from torchrl.envs.utils import check_env_specs

import lw_torchrl as lw
from lw_torchrl.modules.policy import transform_of
from lw_torchrl.transforms import FallbackTurns


def turns_of(ways, rows=None, **options):
    """Return the turn after each step of observations (T, B, 39); the first is a reset's."""
    transform = FallbackTurns(**{"release": options["patience"], **options})
    start = TensorDict(observation=ways[0], batch_size=[ways.shape[1]])
    result = [transform._reset(TensorDict(batch_size=start.batch_size), start)["turn"]]
    for number, now in enumerate(ways[1:]):
        before = TensorDict(batch_size=start.batch_size)
        if rows is not None:
            before["_step"] = rows[number]
        result.append(transform._step(before, TensorDict(observation=now, batch_size=start.batch_size))["turn"])
    return torch.stack(result)


TURNS = {
    "no motion": (lambda ways: None, {"patience": 3}, [0, 0, 0, 1, 1, 1, 2, 2]),
    "hand: 2 cm in two steps": (lambda ways: ways[:, 0, 0].copy_(0.011 * torch.arange(8)), {"patience": 3}, [0] * 8),
    "object": (lambda ways: ways[:, 0, 4].copy_(0.011 * torch.arange(8)), {"patience": 3}, [0] * 8),
    "1.7 cm": (lambda ways: ways[1::2, 0, :3].fill_(0.01), {"patience": 3}, [0, 0, 0, 1, 1, 1, 2, 2]),
    "longest": (lambda ways: ways[::2, 0, 0].fill_(0.3), {"patience": 3, "longest": 3}, [0, 0, 0, 1, 1, 1, 2, 2]),
    "release": (lambda ways: ways[5::2, 0, :3].fill_(0.3), {"patience": 2, "release": 4}, [0, 0, 1, 1, 1, 1, 2, 2]),
    "goal": (lambda ways: ways[:, 0, 36].copy_(torch.arange(8)), {"patience": 3}, [0, 0, 0, 1, 1, 1, 2, 2]),
}


@pytest.mark.parametrize("name", TURNS)
def test_turn_ends_without_motion_or_after_its_maximum_length(name):
    move, options, expected = TURNS[name]
    ways = torch.zeros(8, 1, 39)
    move(ways)
    assert turns_of(ways, **{"longest": 99, **options}).flatten().tolist() == expected


@given(st.integers(0, 2**32 - 1), st.integers(1, 5), st.integers(1, 9))
def test_rows_are_independent(seed, patience, longest):
    generator = torch.Generator().manual_seed(seed)
    ways = torch.rand(15, 3, 39, generator=generator) * torch.tensor([0.001, 0.02, 0.2]).unsqueeze(-1)
    together = turns_of(ways, patience=patience, longest=longest)
    alone = [turns_of(ways[:, row : row + 1], patience=patience, longest=longest) for row in range(3)]
    assert torch.equal(together, torch.cat(alone, 1))


def test_masked_row_does_not_wait():
    rows = torch.tensor([[True, False]] * 6)
    assert turns_of(torch.zeros(7, 2, 39), rows, patience=3, longest=99)[-1].tolist() == [2, 0]


def test_reset_rows_start_with_turn_0():
    transform, state = FallbackTurns(patience=1), TensorDict(observation=torch.zeros(2, 39), batch_size=[2])
    transform._reset(TensorDict(batch_size=[2]), state.clone())
    assert transform._step(TensorDict(batch_size=[2]), state.clone())["turn"].tolist() == [1, 1]
    begun = TensorDict(_reset=torch.tensor([True, False]), batch_size=[2])
    assert transform._reset(begun, state.clone())["turn"].tolist() == [0, 1]


def test_buffer_rows_keep_their_turn():
    rows = TensorDict(observation=torch.zeros(2, 39), turn=torch.tensor([0, 3]), batch_size=[2])
    assert FallbackTurns()(rows.clone())["turn"].tolist() == [0, 3]
    assert FallbackTurns()(rows.exclude("turn"))["turn"].tolist() == [0, 0]


def test_policy_with_fallback_steps_on_rows_and_in_an_environment():
    plans = lw.canonical_plans(lw.load_plans("MT10"), fallback=True)
    actor = lw.PlanConditionedActor(plans)
    assert "turn" in actor.in_keys
    rows = TensorDict(observation=torch.rand(4, 39), task_id=torch.full((4,), lw.task_id("push")), batch_size=[4])
    assert actor(transform_of(actor)(rows))["action"].shape == (4, 4)
    assert rows["turn"].tolist() == [0] * 4
    turns = lw.QAFTransform(plans), FallbackTurns(patience=3, release=3)
    env = TransformedEnv(lw.LanguageWorldEnv("push", max_steps=12), Compose(*turns))
    check_env_specs(env)
    still = lambda td: actor(td).set("action", torch.zeros(1, 4))  # noqa: E731
    rollout = env.rollout(12, still)
    fallback = torch.tensor([step.role.fallback for step in plans["push"].steps])
    weights = rollout["skill_weights"][0, :, : len(fallback)] @ fallback.float()
    assert rollout["turn"].max() >= 2
    torch.testing.assert_close(weights, (rollout["turn"][0] % 3 > 0).float())
    env.close()
