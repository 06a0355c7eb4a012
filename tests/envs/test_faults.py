"""What goes wrong in a row stays in that row: NaN actions, unstable simulations, engines of one's own."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import torch
from rows import FEW, ROWS, STEPS, advance, others, row_actions, same, trajectories
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import TransformedEnv, check_env_specs

import lw_torchrl as lw
from lw_torchrl.envs import episode_seed
from lw_torchrl.suites.engine import EngineStep


def test_a_row_with_a_nan_action_is_truncated_and_the_others_go_on(any_env):
    any_env.set_seed(2)
    reference = trajectories(any_env, STEPS)
    any_env.set_seed(2)
    state = any_env.reset()
    for step in range(3):
        state = advance(any_env, state, row_actions(state, step))
    before = state
    action = row_actions(state, 3)
    action[4, 2] = float("nan")
    with pytest.warns(UserWarning, match="row 4: its action is NaN, in task 'push', seed 2, episode 1, step 3;"):
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


def test_rollouts_go_on_over_nan_rows(any_env):
    any_env.set_seed(2)
    step = iter(range(100))

    def policy(tensordict: TensorDictBase) -> TensorDictBase:
        action = torch.zeros(ROWS, 4)
        if next(step) == 2:
            action[1:3] = float("nan")
        return tensordict.set("action", action)

    with pytest.warns(UserWarning, match=r"row 1: its action is NaN.* \(2 rows\)"):
        rollout = any_env.rollout(8, policy, break_when_any_done=False)
    ended = torch.zeros(ROWS, 8, dtype=torch.bool)
    ended[1:3, 2] = True
    assert torch.equal(rollout["next", "fault"].squeeze(-1), ended)
    assert torch.equal(rollout["next", "done"].squeeze(-1), ended)
    assert rollout["episode"][:, 2:4].tolist() == [[0, 0], [0, 2], [0, 2], [1, 1], [1, 1], [1, 1]]


def test_strict_raises_and_moves_nothing(plans):
    env = lw.LanguageWorldEnv(["push", "reach"], seed=2, strict=True)
    for wrapped in (env, TransformedEnv(env, lw.QAFTransform(plans))):
        wrapped.set_seed(2)
        state = wrapped.reset()
        action = torch.ones(2, 4)
        action[1, 0] = float("nan")
        with pytest.raises(ValueError, match=r"action must hold numbers: row 1: .*'reach', seed 2, episode 0, step 0"):
            wrapped.step(state.clone().set("action", action))
        after = wrapped.step(state.clone().set("action", torch.ones(2, 4)))["next"]
        assert not after["fault"].any()
        wrapped.set_seed(2)
        assert same(after, wrapped.step(wrapped.reset().set("action", torch.ones(2, 4)))["next"])
    env.close()


def test_an_unstable_simulation_is_a_fault_of_its_row(metaworld_env, tmp_path, monkeypatch):
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


class FakeEngine:
    """An engine of one's own: observations count steps in thirds, and ``faults`` break at the second step."""

    def __init__(self, tasks: list[str], *, faults: tuple[int, ...] = (), **options: object) -> None:
        self.tasks, self.options, self.faults = tasks, options, faults
        self.count = np.zeros(len(tasks))
        self.resets: list[tuple[list[int], list[int]]] = []
        self.steps: list[tuple[np.ndarray, np.ndarray]] = []
        self.closed = 0

    def _observe(self) -> np.ndarray:
        return np.repeat(self.count[:, None] / 3 + np.arange(len(self.tasks))[:, None], 39, axis=1)

    def reset(self, rows, seeds) -> np.ndarray:
        self.resets.append((list(rows), list(seeds)))
        self.count[list(rows)] = 0
        return self._observe()[list(rows)]

    def step(self, action, active) -> EngineStep:
        self.steps.append((action.copy(), active.copy()))
        fault = active & np.isin(np.arange(len(self.tasks)), self.faults) & (self.count == 1)
        self.count += active & ~fault
        return EngineStep(self._observe(), np.where(fault, 0.0, action[:, 0] / 3), active & ~fault, fault)

    def close(self) -> None:
        self.closed += 1


def with_fake(**options) -> tuple[lw.LanguageWorldEnv, FakeEngine]:
    env = lw.LanguageWorldEnv(
        FEW, seed=4, max_steps=5, engine=lambda tasks, **given: FakeEngine(tasks, faults=(1,), **given), **options
    )
    return env, env._engine


def test_a_step_that_returns_something_else_is_named(monkeypatch):
    env, engine = with_fake()
    state = env.reset()
    monkeypatch.setattr(engine, "step", lambda action, active: tuple(FakeEngine.step(engine, action, active)))
    with pytest.raises(ValueError, match=r"^engine: the step of FakeEngine must return an EngineStep, got tuple$"):
        advance(env, state, torch.zeros(3, 4))
    env.close()


def test_an_engine_of_ones_own():
    env, engine = with_fake(reward="dense", num_threads=2)
    assert engine.tasks == FEW
    assert engine.options == {"reward": "dense", "num_threads": 2}
    state = env.reset()
    assert engine.resets == [([0, 1, 2], [episode_seed(task, 4, 0) for task in FEW])]
    assert state["observation"].dtype == torch.float32
    action = torch.full((3, 4), 0.1)
    action[2] = 7.0
    state = advance(env, state, action, _step=torch.tensor([True, False, True]))
    sent, active = engine.steps[0]
    assert sent.dtype == np.float32
    assert sent[[0, 2], 0].tolist() == [np.float32(0.1), 1.0]
    assert active.tolist() == [True, False, True]
    assert state["observation"][:, 0].tolist() == [np.float32(1 / 3), 1.0, np.float32(2 + 1 / 3)]
    expected = np.array([np.float32(0.1) / np.float32(3), 0.0, 1 / 3], np.float32)
    assert np.allclose(state["reward"].flatten().numpy(), expected, rtol=1e-6)
    assert state["reward"].dtype == torch.float32
    assert state["success"].flatten().tolist() == [True, False, True]
    env.reset(TensorDict({"_reset": torch.tensor([False, False, True])}, [3]))
    assert engine.resets[1] == ([2], [episode_seed("reach", 4, 1)])
    env.close()
    assert engine.closed == 1
    env.close(raise_if_closed=False)
    assert engine.closed == 1


def test_a_fault_that_an_engine_reports_truncates_just_that_row():
    env, engine = with_fake()
    check_env_specs_quietly(env)
    env.set_seed(4)
    state = advance(env, env.reset(), torch.zeros(3, 4))
    before = state["observation"][1].clone()
    with pytest.warns(UserWarning, match="row 1: its simulation became unstable, in task 'push', seed 4, .*step 1;"):
        state = advance(env, state, torch.zeros(3, 4))
    assert state["fault"].flatten().tolist() == [False, True, False]
    assert state["truncated"].flatten().tolist() == [False, True, False]
    assert state["success"].flatten().tolist() == [True, False, True]
    assert torch.equal(state["observation"][1], before)
    assert state["observation"][0, 0].item() == np.float32(2 / 3)
    with pytest.raises(RuntimeError, match=r"rows \[1\]"):
        advance(env, state, torch.zeros(3, 4))
    state = env.reset(state.clone().set("_reset", torch.tensor([False, True, False])))
    state = advance(env, state, torch.zeros(3, 4))
    assert not state["fault"].any()
    assert not state["done"].any()
    assert state["observation"][0, 0].item() == 1.0
    env.close()
    assert engine.closed == 1


def check_env_specs_quietly(env) -> None:
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="row 1: its simulation became unstable")
        check_env_specs(env, break_when_any_done="both")


def test_strict_is_about_actions_not_about_faults():
    env, _ = with_fake(strict=True)
    state = advance(env, env.reset(), torch.zeros(3, 4))
    with pytest.warns(UserWarning, match="row 1: its simulation became unstable"):
        state = advance(env, state, torch.zeros(3, 4))
    assert state["fault"].flatten().tolist() == [False, True, False]
    env.close()


def test_rows_with_nan_do_not_reach_the_engine():
    env, engine = with_fake()
    state = env.reset()
    action = torch.zeros(3, 4)
    action[0, 3] = float("nan")
    with pytest.warns(UserWarning, match="row 0"):
        advance(env, state, action)
    assert engine.steps[-1][1].tolist() == [False, True, True]
    env.close()
