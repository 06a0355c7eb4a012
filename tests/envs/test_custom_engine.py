"""Custom engines and tasks, and the shipped engines by name."""

import numpy as np
import pytest
import torch
from rows import FEW, advance
from tensordict import TensorDict
from torchrl.envs import check_env_specs

import lw_torchrl as lw
from lw_torchrl.envs.episodes import run_episodes
from lw_torchrl.envs.rows import action_noise, episode_seed
from lw_torchrl.suites.engine import EngineStep
from lw_torchrl.suites.metaworld import ENGINES, make_engine

STACK = lw.Task("stack-cups", "Stack the cups.", (*lw.TASKS["reach"].objects,))
STACK_ID = lw.task_id("stack-cups")


class FakeEngine:
    """A custom engine: observations count steps in thirds, and the rows ``faults`` break at the second step."""

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
    def make(tasks, **engine_options):
        return FakeEngine(tasks, faults=(1,), **engine_options)

    env = lw.LanguageWorldEnv(FEW, seed=4, max_steps=5, engine=make, **options)
    return env, env._engine


def test_a_custom_engine_gets_rows_seeds_and_actions():
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


def test_rows_with_nan_do_not_reach_the_engine():
    env, engine = with_fake()
    state = env.reset()
    action = torch.zeros(3, 4)
    action[0, 3] = float("nan")
    with pytest.warns(UserWarning, match="row 0"):
        advance(env, state, action)
    assert engine.steps[-1][1].tolist() == [False, True, True]
    env.close()


@pytest.mark.parametrize("tasks", [["reach", STACK], [STACK, "reach"], (t for t in (STACK, lw.TASKS["reach"]))])
def test_a_custom_task_runs_with_others(tasks):
    env = lw.LanguageWorldEnv(tasks, num_envs=3, seed=4, max_steps=5, engine=FakeEngine)
    assert env.tasks == ("reach", "stack-cups")
    assert env.row_tasks == ("reach", "stack-cups", "reach")
    assert env._engine.tasks == ["reach", "stack-cups", "reach"]
    check_env_specs(env)
    env.set_seed(4)
    state = env.reset()
    assert state["task_id"].tolist() == [lw.task_id("reach"), STACK_ID, lw.task_id("reach")]
    seeds = [episode_seed("reach", 4, 0), episode_seed(STACK, 4, 0), episode_seed("reach", 4, 1)]
    assert env._engine.resets[-1] == ([0, 1, 2], seeds)
    assert episode_seed(lw.TASKS["reach"], 4, 0) == episode_seed("reach", 4, 0)
    env.load_state_dict(env.state_dict())
    assert env.reset()["episode"].tolist() == [2, 1, 3]
    env.close()


def test_episodes_of_a_custom_task_have_noise():
    env = lw.LanguageWorldEnv([STACK, "push"], seed=4, max_steps=5, engine=FakeEngine)
    episodes = run_episodes(
        env,
        lambda td: td.set("action", torch.zeros(2, 4)),
        {"stack-cups": [3]},
        keys=["action", "episode"],
        noise=lambda _: (0.1,) * 4,
    )
    (steps,) = [episode.steps for episode in episodes]
    assert steps["episode"].tolist() == [3] * 5
    expected = torch.from_numpy(action_noise(STACK, 4, 3, 5) * np.float32(0.1))
    assert torch.equal(steps["action"], expected.clamp(-1, 1))
    env.close()


def test_the_spec_of_metaworlds_tasks_has_fifty_ids():
    env = lw.LanguageWorldEnv(lw.TASKS["reach"], engine=FakeEngine)
    assert env.observation_spec["task_id"].space.n == 50
    env.close()


def test_engines_are_made_by_name_or_function():
    assert list(ENGINES) == ["vectorized", "metaworld"]
    assert make_engine(FakeEngine, ["reach"]).tasks == ["reach"]
    with pytest.raises(ValueError, match=r"engine .* did you mean 'vectorized'"):
        make_engine("vectorised", ["reach"])
