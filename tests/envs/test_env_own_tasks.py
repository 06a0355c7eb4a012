"""A task that Meta-World lacks, in an engine of one's own; and the shipped engines, by name."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torchrl.envs import check_env_specs

import lw_torchrl as lw
from lw_torchrl.envs.episodes import run_episodes
from lw_torchrl.envs.seeding import action_noise, episode_seed
from lw_torchrl.suites.engine import EngineStep
from lw_torchrl.suites.metaworld import ENGINES, make_engine

STACK = lw.Task("stack-cups", "Stack the cups.", (*lw.TASKS["reach"].objects,))
OWN_ID = lw.task_id("stack-cups")


class Counting:
    """Observations count steps."""

    def __init__(self, tasks, **options) -> None:
        self.tasks, self.count, self.seeds = tasks, np.zeros(len(tasks)), {}

    def _observe(self):
        return np.repeat(self.count[:, None], 39, axis=1)

    def reset(self, rows, seeds):
        self.count[list(rows)] = 0
        self.seeds.update(zip(rows, seeds, strict=True))
        return self._observe()[list(rows)]

    def step(self, action, active):
        self.count += active
        none = np.zeros(len(self.tasks), bool)
        return EngineStep(self._observe(), none.astype(float), none, none)

    def close(self) -> None:
        pass


@pytest.mark.parametrize("tasks", [["reach", STACK], [STACK, "reach"], (t for t in (STACK, lw.TASKS["reach"]))])
def test_a_task_of_ones_own_runs_beside_others(tasks):
    env = lw.LanguageWorldEnv(tasks, num_envs=3, seed=4, max_steps=5, engine=Counting)
    assert env.tasks == ("reach", "stack-cups")
    assert env.row_tasks == ("reach", "stack-cups", "reach")
    assert env._engine.tasks == ["reach", "stack-cups", "reach"]
    check_env_specs(env)
    env.set_seed(4)
    state = env.reset()
    assert state["task_id"].tolist() == [lw.task_id("reach"), OWN_ID, lw.task_id("reach")]
    assert env._engine.seeds[1] == episode_seed(STACK, 4, 0)
    assert env._engine.seeds[0] == episode_seed("reach", 4, 0)
    assert episode_seed(lw.TASKS["reach"], 4, 0) == episode_seed("reach", 4, 0)
    env.load_state_dict(env.state_dict())
    assert env.reset()["episode"].tolist() == [2, 1, 3]
    env.close()


def test_a_task_alone():
    env = lw.LanguageWorldEnv(STACK, engine=Counting)
    assert env.tasks == ("stack-cups",)
    assert env.observation_spec["task_id"].is_in(env.reset()["task_id"])
    env.close()


def test_its_episodes_run_with_noise():
    env = lw.LanguageWorldEnv([STACK, "push"], seed=4, max_steps=5, engine=Counting)
    found = run_episodes(
        env,
        lambda td: td.set("action", torch.zeros(2, 4)),
        {"stack-cups": [3]},
        keys=["action", "episode"],
        noise=lambda _: (0.1,) * 4,
    )
    (steps,) = [one.steps for one in found]
    assert steps["episode"].tolist() == [3] * 5
    expected = torch.from_numpy(action_noise(STACK, 4, 3, 5) * np.float32(0.1))
    assert torch.equal(steps["action"], expected.clamp(-1, 1))
    env.close()


def test_ids_of_the_fifty_keep_their_spec():
    env = lw.LanguageWorldEnv(lw.TASKS["reach"], engine=Counting)
    assert env.observation_spec["task_id"].space.n == 50
    env.close()


@pytest.mark.parametrize("engine", ENGINES)
def test_the_shipped_engines_refuse_it_by_name(engine):
    own = lw.Task("push-bck", "Push it back.", (*lw.TASKS["reach"].objects,))
    with pytest.raises(ValueError, match=r"task must be one of .* got 'push-bck'; did you mean 'push-back'"):
        make_engine(engine, [own.name])


@pytest.mark.parametrize("tasks", ["stack-cups", ["stack-cups"], ["reach", "stack-cups"], [STACK]], ids=str)
def test_a_task_of_ones_own_without_an_engine_is_told_how(tasks):
    with pytest.raises(ValueError, match=r"'stack-cups'.* is a Task with an engine=, see docs/training.md"):
        lw.LanguageWorldEnv(tasks)


def test_a_name_alone_must_be_known():
    """A typo is no task of one's own."""
    with pytest.raises(ValueError, match=r"task must be one of .* got 'stack-cups'"):
        episode_seed("stack-cups", 0, 0)


def test_an_engine_by_name_or_of_ones_own():
    assert list(ENGINES) == ["vectorized", "metaworld"]
    assert make_engine(Counting, ["reach"]).tasks == ["reach"]
    with pytest.raises(ValueError, match="engine must be one of 'vectorized', 'metaworld', got 'vectorised'; did you"):
        make_engine("vectorised", ["reach"])
