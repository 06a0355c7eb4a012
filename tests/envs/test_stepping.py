"""LanguageWorldEnv from step to step: actions, partial resets and steps, ends of episodes, faults, fresh tensors."""

import numpy as np
import pytest
import torch
from rows import ENGINES, ROWS, STATE, STEPS, actions_of, advance, others, row_actions, same, trajectories

import lw_torchrl as lw


def begun_again(env, seed):
    """Return the trajectories of the seed's episodes, and the first state of the same episodes begun again."""
    env.set_seed(seed)
    reference = trajectories(env, STEPS)
    env.set_seed(seed)
    return reference, env.reset()


def test_partial_resets_change_only_their_rows(any_env):
    reference, state = begun_again(any_env, seed=4)
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
    reference, state = begun_again(any_env, seed=6)
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
    rollout = lw.LanguageWorldEnv("reach", **options).rollout(600, lambda td: td.set("action", torch.zeros(1, 4)))
    assert rollout.batch_size == (1, length)
    assert rollout["next", "truncated"].flatten().tolist() == [False] * (length - 1) + [True]


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


def test_a_row_with_a_nan_action_is_truncated_and_others_continue(any_env):
    reference, state = begun_again(any_env, seed=2)
    for step in range(3):
        state = advance(any_env, state, row_actions(state, step))
    before = state
    action = row_actions(state, 3)
    action[4, 2] = float("nan")
    with pytest.warns(UserWarning, match="row 4: its action is NaN, in task 'push', seed 2, episode 1, step 3"):
        state = advance(any_env, state, action)
    for key in ("fault", "truncated", "done"):
        assert state[key].flatten().tolist() == (~others(4)).tolist(), key
    assert torch.equal(state["observation"][4], before["observation"][4])
    assert not any(state[key][4] for key in ("terminated", "reward", "success"))
    with pytest.raises(RuntimeError, match=r"rows \[4\] have ended"):
        advance(any_env, state, action)

    state = any_env.reset(state.clone().set("_reset", ~others(4)), episode=1)
    assert state["episode"].tolist() == [0, 0, 0, 1, 1, 1]
    assert not (state["fault"] | state["done"]).any()
    for step in range(4, STEPS):
        action = torch.where(others(4)[:, None], row_actions(state, step), row_actions(state, step - 4))
        state = advance(any_env, state, action)
        for row, key in enumerate(zip(state["task_id"].tolist(), state["episode"].tolist(), strict=True)):
            now = step + 1 if row != 4 else step - 3
            assert torch.equal(state["observation"][row], reference[key]["observation"][now])
            assert torch.equal(state["reward"][row], reference[key]["reward"][now - 1])
    assert state["done"].flatten().tolist() == others(4).tolist()


def test_strict_raises_an_error_and_moves_nothing():
    env = lw.LanguageWorldEnv(["push", "reach"], seed=2, strict=True)
    state = env.reset()
    action = torch.tensor([[1.0] * 4, [torch.nan, 1.0, 1.0, 1.0]])
    with pytest.raises(ValueError, match="action must hold numbers: row 1"):
        env.step(state.clone().set("action", action))
    after = advance(env, state, torch.ones(2, 4))
    assert not after["fault"].any()
    env.set_seed(2)
    assert same(after, advance(env, env.reset(), torch.ones(2, 4)))


def test_an_unstable_simulation_truncates_its_row(tmp_path, monkeypatch):
    """Meta-World's own environments, with a broken state; MuJoCo leaves a log where it runs."""
    monkeypatch.chdir(tmp_path)
    env = lw.LanguageWorldEnv("push", num_envs=3, seed=0, engine="metaworld", reward="dense")
    rest = torch.tensor([True, False, True])
    state = env.reset()
    expected = [state := advance(env, state, row_actions(state, step)) for step in range(5)]
    env.set_seed(0)
    state = env.reset()
    for step in range(3):
        state = advance(env, state, row_actions(state, step))
    env._engine._envs[1].data.qpos[:] = np.nan
    with pytest.warns(UserWarning, match="row 1: its simulation became unstable, in task 'push', seed 0, episode 1"):
        broken = advance(env, state, row_actions(state, 3))
    for key in ("fault", "truncated", "done"):
        assert broken[key].flatten().tolist() == [False, True, False]
    assert torch.equal(broken["observation"][1], state["observation"][1])
    assert same(broken, expected[3], rest)
    again = advance(env, broken, row_actions(state, 4), _step=rest)
    assert same(again, expected[4], rest)

    fresh = env.reset(again.clone().set("_reset", ~rest), select_reset_only=True)
    other = lw.LanguageWorldEnv("push", seed=0, engine="metaworld", reward="dense")
    ((key, episode),) = trajectories(other, 2, other.reset(episode=4)).items()
    assert same(trajectories(env, 2, fresh)[key], episode)
