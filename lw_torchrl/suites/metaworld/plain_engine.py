"""The plain engine: Meta-World's own environments, one per row, stepped in a loop."""

from collections.abc import Sequence
from typing import Any, Literal

import mujoco
import numpy as np
from numpy.typing import NDArray

from lw_torchrl._util.checks import Count, typed
from lw_torchrl._util.rendering import naming_absent_renderer
from lw_torchrl.language.layout import METAWORLD
from lw_torchrl.language.tasks import check_task
from lw_torchrl.suites.cameras import SeenRows
from lw_torchrl.suites.engine import EngineStep, RowModel

UNSTABLE = slice(int(mujoco.mjtWarning.mjWARN_BADQPOS), int(mujoco.mjtWarning.mjWARN_BADQACC) + 1)
"""MuJoCo's three warnings about an unstable simulation: bad positions, velocities or accelerations."""


def import_metaworld() -> Any:
    """Import Meta-World; an error names a missing rendering library."""
    with naming_absent_renderer():
        import metaworld
        import metaworld.policies
    return metaworld


def make_metaworld_env(task: str, *, max_steps: int = 500) -> Any:
    """Return Meta-World's own environment of a task, with an observable goal and a new initial state at every reset.
    Seed it with ``env.seed(seed)``: Meta-World ignores ``reset(seed=...)``."""
    import_metaworld()
    from metaworld.env_dict import ALL_V3_ENVIRONMENTS_GOAL_OBSERVABLE

    check_task(task)
    env = ALL_V3_ENVIRONMENTS_GOAL_OBSERVABLE[f"{task}-v3-goal-observable"](seed=0)
    env._freeze_rand_vec = False
    env.seeded_rand_vec = True
    env.max_path_length = max_steps
    return env


class MetaWorldEngine(SeenRows):
    """An engine that runs Meta-World's own environments in a loop, in one thread: slow; the others' oracle."""

    @typed
    def __init__(
        self, tasks: Sequence[str], *, reward: Literal["sparse", "dense"] = "sparse", num_threads: Count | None = None
    ) -> None:
        self._dense = reward == "dense"
        # LanguageWorldEnv counts the steps; Meta-World's own limit must not come first.
        self._envs = [make_metaworld_env(task, max_steps=2**31 - 1) for task in tasks]
        self._last = np.zeros((len(self._envs), METAWORLD.size))

    def reset(self, rows: Sequence[int], seeds: Sequence[int]) -> NDArray[np.float64]:
        for row, seed in zip(rows, seeds, strict=True):
            env = self._envs[row]
            env.seed(seed)
            env._did_see_sim_exception = False
            self._last[row] = env.reset()[0]
        return self._last[list(rows)]

    def step(self, action: NDArray[np.float32], active: NDArray[np.bool_]) -> EngineStep:
        n = len(self._envs)
        reward, success, fault = np.zeros(n), np.zeros(n, bool), np.zeros(n, bool)
        for row in np.flatnonzero(active):
            env = self._envs[row]
            observation, dense, _, _, info = env.step(action[row])
            # MuJoCo restarts an unstable simulation silently and only counts a warning, which a reset clears.
            warned = env.data.warning.number[UNSTABLE].any()
            if warned or env._did_see_sim_exception or not np.isfinite(observation).all():
                fault[row] = True
                continue
            self._last[row] = observation
            success[row] = bool(info["success"])
            reward[row] = dense if self._dense else success[row]
        return EngineStep(self._last.copy(), reward, success, fault)

    def _seen(self, row: int) -> tuple[RowModel, Any]:
        env = self._envs[row]
        return RowModel(str(env.model_name), env.model), env.data

    def close(self) -> None:
        super().close()
        for env in self._envs:
            env.close()
        self._envs = []
