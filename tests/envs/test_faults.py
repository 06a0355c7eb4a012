"""Faults of a row do not change other rows: NaN actions, unstable simulations."""

import numpy as np
import pytest
import torch
from rows import STEPS, advance, others, row_actions, same, trajectories

import lw_torchrl as lw


def test_a_row_with_a_nan_action_is_truncated_and_others_continue(any_env):
    any_env.set_seed(2)
    reference = trajectories(any_env, STEPS)
    any_env.set_seed(2)
    state = any_env.reset()
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
    env.close()


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
    env.close()
