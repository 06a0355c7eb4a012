"""LanguageWorldEnv from step to step: partial resets and steps, the end of an episode, fresh tensors."""

import numpy as np
import pytest
import torch
from rows import ENGINES, ROWS, STATE, STEPS, actions_of, advance, others, row_actions, same, trajectories

import lw_torchrl as lw


def test_partial_resets_change_only_their_rows(any_env):
    any_env.set_seed(4)
    reference = trajectories(any_env, STEPS)
    any_env.set_seed(4)
    state = any_env.reset()
    for step in range(5):
        state = advance(any_env, state, row_actions(state, step))
    before = state.select(*STATE).clone()
    mask = ~others(1, 4)
    state = any_env.reset(state.clone().set("_reset", mask), select_reset_only=True)
    assert same(before, state, ~mask)
    assert state["episode"].tolist() == [0, 2, 0, 1, 3, 1]
    for step in range(5, STEPS):
        state = advance(any_env, state, row_actions(state, step).where(~mask[:, None], row_actions(state, step - 5)))
        for row, key in enumerate(zip(state["task_id"].tolist(), state["episode"].tolist(), strict=True)):
            if not mask[row]:
                assert torch.equal(state["observation"][row], reference[key]["observation"][step + 1])
    assert state["done"].flatten().tolist() == (~mask).tolist(), "rows that were reset count their own steps"


@pytest.mark.parametrize("shape", [(ROWS,), (ROWS, 1)], ids=str)
def test_rows_outside_a_step_mask_do_not_move(any_env, shape):
    """Rows that pause, even with NaN actions, run as rows that do not."""
    any_env.set_seed(6)
    reference = trajectories(any_env, STEPS)
    any_env.set_seed(6)
    state = any_env.reset()
    keys = list(zip(state["task_id"].tolist(), state["episode"].tolist(), strict=True))
    clock = np.zeros(ROWS, dtype=int)
    rng = np.random.default_rng(1)
    rested = 0
    for _ in range(40):
        mask = torch.from_numpy((rng.random(ROWS) < 0.5) & (clock < STEPS))
        action = torch.full((ROWS, 4), float("nan"))
        for row in torch.nonzero(mask).flatten().tolist():
            action[row] = actions_of(*keys[row], STEPS)[clock[row]]
        before = state.clone()
        state = advance(any_env, state, action, _step=mask.reshape(shape))
        clock += mask.numpy()
        assert same(before.select(*STATE), state.select(*STATE), ~mask)
        assert not mask.any() or not state["reward"][~mask].any()
        rested += int((~mask).sum()) * bool(mask.any())
        for row, key in enumerate(keys):
            assert torch.equal(state["observation"][row], reference[key]["observation"][clock[row]])
            if mask[row]:
                assert torch.equal(state["reward"][row], reference[key]["reward"][clock[row] - 1])
    assert not state["fault"].any()
    assert clock.tolist() == [STEPS] * ROWS
    assert rested > 50


@pytest.mark.parametrize(("options", "length"), [({}, 500), ({"max_steps": 510, "engine": "metaworld"}, 510)], ids=str)
def test_the_length_of_an_episode(options, length):
    """Meta-World's own limit of 500 steps does not apply to max_steps=510."""
    env = lw.LanguageWorldEnv("reach", **options)
    rollout = env.rollout(600, lambda td: td.set("action", torch.zeros(1, 4)))
    assert rollout.batch_size == (1, length)
    assert rollout["next", "truncated"].flatten().tolist() == [False] * (length - 1) + [True]
    env.close()


def test_a_row_that_has_ended_must_be_reset(any_env):
    any_env.set_seed(0)
    state = any_env.rollout(STEPS)[:, -1]["next"]
    with pytest.raises(RuntimeError, match=r"rows \[0, 1, 2, 3, 4\]"):
        advance(any_env, state, torch.zeros(ROWS, 4))
    mask = ~others(2)
    state = any_env.reset(state.clone().set("_reset", mask))
    with pytest.raises(RuntimeError, match=r"rows \[0, 1, 3, 4, 5\]"):
        advance(any_env, state, torch.zeros(ROWS, 4))
    after = advance(any_env, state, torch.ones(ROWS, 4), _step=mask)
    assert after["done"].flatten().tolist() == others(2).tolist()
    assert not torch.equal(after["observation"][2], state["observation"][2])


@pytest.mark.parametrize("engine", ENGINES)
def test_a_closed_environment_must_be_reset_and_continues_with_the_next_episodes(engine):
    env, other = (lw.LanguageWorldEnv(["push", "reach"], engine=engine, max_steps=4) for _ in range(2))
    still = lambda td: td.set("action", torch.zeros(2, 4))  # noqa: E731
    state = env.reset()
    other.reset()
    assert not env.is_closed
    for _ in range(2):
        env.close()
        assert env.is_closed
    with pytest.raises(RuntimeError, match=r"rows \[0, 1\]"):
        env.step(still(state))
    reopened, expected = (each.rollout(4, still, break_when_any_done=False) for each in (env, other))
    assert not env.is_closed
    assert (reopened == expected).all()
    assert reopened["episode"][:, 0].tolist() == [1, 1]
    env.close()
    other.close()


def test_rollouts_continue_after_the_end_of_episodes(any_env):
    any_env.set_seed(8)
    rollout = any_env.rollout(2 * STEPS + 5, break_when_any_done=False)
    rank = torch.tensor([0, 0, 0, 1, 1, 1])
    assert torch.equal(rollout["episode"], torch.arange(2 * STEPS + 5) // STEPS * 2 + rank[:, None])
    assert torch.equal(rollout["episode"], rollout["next", "episode"])
    assert (rollout["task_id"] == rollout["task_id"][:, :1]).all()
    ended = rollout["next", "done"].squeeze(-1)
    assert ended.nonzero()[:, 1].unique().tolist() == [STEPS - 1, 2 * STEPS - 1]
    inside = ~ended[:, :-1]
    assert torch.equal(rollout["observation"][:, 1:][inside], rollout["next", "observation"][:, :-1][inside])
    any_env.set_seed(8)
    for episode in range(3):
        assert torch.equal(any_env.reset()["observation"], rollout["observation"][:, episode * STEPS])


def test_later_steps_do_not_change_earlier_states(any_env):
    any_env.set_seed(0)
    states = [any_env.reset()]
    copies = [states[0].clone()]
    for step in range(6):
        last, mask = states[-1], ~others(1, 4)
        again = any_env.reset(last.clone().set("_reset", mask)) if step == 3 else None
        states.append(advance(any_env, last, row_actions(last, step)) if again is None else again)
        copies.append(states[-1].clone())
    assert all((state == copy).all() for state, copy in zip(states, copies, strict=True))
    memory = [state[key].untyped_storage().data_ptr() for state in states for key in ("observation", "success", "done")]
    assert len(set(memory)) == len(memory)


def test_writes_to_a_state_do_not_change_the_environment(env):
    env.set_seed(0)
    state = env.rand_step(env.reset())["next"]
    kept = state.select(*STATE).clone()
    for key in (*STATE, "done", "truncated", "terminated"):
        state[key].fill_(1)
    assert same(kept, advance(env, kept, torch.zeros(ROWS, 4), _step=torch.zeros(ROWS, dtype=torch.bool)))
