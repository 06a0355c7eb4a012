"""Faults of a row do not change other rows: NaN actions, unstable simulations."""

import numpy as np
import pytest
import torch
from rows import STEPS, advance, others, row_actions, same, trajectories
from torchrl.envs import TransformedEnv

import lw_torchrl as lw
from lw_torchrl.envs import episode_seed


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
    assert not state["terminated"].any()
    assert torch.equal(state["observation"][4], before["observation"][4])
    assert state["reward"][4].item() == 0.0
    assert not state["success"][4]
    with pytest.raises(RuntimeError, match=r"rows \[4\] have ended"):
        advance(any_env, state, action)

    state = any_env.reset(state.clone().set("_reset", ~others(4)), episode=1)
    assert state["episode"].tolist() == [0, 0, 0, 1, 1, 1]
    assert not state["fault"].any()
    assert not state["done"].any()
    for step in range(4, STEPS):
        action = torch.where(others(4)[:, None], row_actions(state, step), row_actions(state, step - 4))
        state = advance(any_env, state, action)
        for row, key in enumerate(zip(state["task_id"].tolist(), state["episode"].tolist(), strict=True)):
            now = step + 1 if row != 4 else step - 3
            assert torch.equal(state["observation"][row], reference[key]["observation"][now])
            assert torch.equal(state["reward"][row], reference[key]["reward"][now - 1])
    assert state["done"].flatten().tolist() == others(4).tolist()


def test_strict_raises_an_error_and_moves_nothing(plans):
    env = lw.LanguageWorldEnv(["push", "reach"], seed=2, strict=True)
    for wrapped in (env, TransformedEnv(env, lw.QAFTransform(plans))):
        wrapped.set_seed(2)
        state = wrapped.reset()
        action = torch.ones(2, 4)
        action[1, 0] = float("nan")
        with pytest.raises(ValueError, match="action must hold numbers: row 1"):
            wrapped.step(state.clone().set("action", action))
        after = wrapped.step(state.clone().set("action", torch.ones(2, 4)))["next"]
        assert not after["fault"].any()
        wrapped.set_seed(2)
        assert same(after, wrapped.step(wrapped.reset().set("action", torch.ones(2, 4)))["next"])
    env.close()


def test_an_unstable_simulation_truncates_its_row(metaworld_env, tmp_path, monkeypatch):
    """Meta-World's own environments, with a broken state; MuJoCo leaves a log where it runs."""
    monkeypatch.chdir(tmp_path)
    env = lw.LanguageWorldEnv("push", num_envs=3, seed=0, engine="metaworld", reward="dense")
    state = env.reset()
    for step in range(3):
        state = advance(env, state, row_actions(state, step))
    expected = [advance(env, state, row_actions(state, 3))]
    expected.append(advance(env, expected[0], row_actions(state, 4)))
    env.set_seed(0)
    state = env.reset()
    for step in range(3):
        state = advance(env, state, row_actions(state, step))
    env._engine._envs[1].data.qpos[:] = np.nan
    with pytest.warns(UserWarning, match="row 1: its simulation became unstable, in task 'push', seed 0, episode 1"):
        broken = advance(env, state, row_actions(state, 3))
    rest = torch.tensor([True, False, True])
    for key in ("fault", "truncated", "done"):
        assert broken[key].flatten().tolist() == [False, True, False]
    assert torch.equal(broken["observation"][1], state["observation"][1])
    assert broken["observation"].isfinite().all()
    assert same(broken, expected[0], rest)
    again = advance(env, broken, row_actions(state, 4), _step=rest)
    assert same(again, expected[1], rest)

    fresh = env.reset(again.clone().set("_reset", ~rest), select_reset_only=True)
    own = metaworld_env("push")
    own.seed(episode_seed("push", 0, 4))
    assert np.array_equal(fresh["observation"][1].numpy(), own.reset()[0].astype(np.float32))
    after = advance(env, fresh, torch.full((3, 4), 0.5))
    assert np.array_equal(after["observation"][1].numpy(), own.step(np.full(4, 0.5, np.float32))[0].astype(np.float32))
    assert not after["fault"].any()
    env.close()
