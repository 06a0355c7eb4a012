"""Meta-World's own environments: an engine that steps the environments in a loop, and resets with shared models."""

from __future__ import annotations

import copy
import threading
from collections.abc import Callable, Iterable, Sequence
from functools import cache
from typing import Any, Literal

import mujoco
import numpy as np
from gymnasium.utils import seeding
from numpy.typing import NDArray

from lw_torchrl._util.checks import Count, typed
from lw_torchrl._util.rendering import naming_absent_renderer
from lw_torchrl.language.layout import METAWORLD
from lw_torchrl.language.tasks import check_task
from lw_torchrl.suites.cameras import SeenRows
from lw_torchrl.suites.engine import EngineStep, RowModel

UNSTABLE = slice(int(mujoco.mjtWarning.mjWARN_BADQPOS), int(mujoco.mjtWarning.mjWARN_BADQACC) + 1)
"""MuJoCo's three warnings about an unstable simulation: bad positions, velocities and accelerations."""


def import_metaworld() -> Any:
    """Import Meta-World; raise an ImportError that names the rendering library if it is missing."""
    with naming_absent_renderer():
        import metaworld
        import metaworld.policies
    return metaworld


def make_metaworld_env(task: str, *, max_steps: int = 500) -> Any:
    """Return Meta-World's environment for a task, with an observable goal and a new initial state at every reset. Seed
    the environment with ``env.seed(seed)``: Meta-World ignores ``reset(seed=...)``."""
    import_metaworld()
    from metaworld.env_dict import ALL_V3_ENVIRONMENTS_GOAL_OBSERVABLE

    env = ALL_V3_ENVIRONMENTS_GOAL_OBSERVABLE[f"{check_task(task)}-v3-goal-observable"](seed=0)
    env._freeze_rand_vec = False
    env.seeded_rand_vec = True
    env.max_path_length = max_steps
    return env


class MetaWorldEngine(SeenRows):
    """An engine that runs Meta-World's own environments in a loop: slow, but the vectorized engine's reference."""

    @typed
    def __init__(
        self, tasks: Sequence[str], *, reward: Literal["sparse", "dense"] = "sparse", num_threads: Count | None = None
    ) -> None:
        self._dense = reward == "dense"
        # LanguageWorldEnv truncates episodes, so Meta-World must not.
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
            # MuJoCo silently restarts an unstable simulation and only counts a warning, which a reset clears.
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


COMPARED_VERSIONS = {"metaworld": "3.1.1", "mujoco": "3.3.0"}
"""The versions of Meta-World and MuJoCo against which the vectorized engine was verified bit for bit."""

Places = tuple[NDArray[np.float64], NDArray[np.float64]]


class SharedModel:
    """A compiled model that many rows use in turn. Meta-World's resets change the positions of bodies and sites in the
    model itself, so each row stores its own positions. A row loads its positions before it uses the model, unless it
    was the last row to load positions (the ``holder``)."""

    def __init__(self, path: str, model: Any, compiled: Places | None = None) -> None:
        self.path, self.model = path, model
        self.places: Places = (model.body_pos, model.site_pos)
        self.compiled: Places = compiled or (model.body_pos.copy(), model.site_pos.copy())
        self.holder: object = None

    def load(self, holder: object, places: Places) -> None:
        self.holder = holder
        self.places[0][...], self.places[1][...] = places

    def restore(self) -> None:
        self.load(None, self.compiled)


# Reentrant, because Python may garbage-collect an engine, which calls return_models, inside borrow_model.
_lock = threading.RLock()
_compiled: dict[str, SharedModel] = {}
_idle: dict[str, SharedModel] = {}


def borrow_model(path: str) -> SharedModel:
    """Return a compiled model of an XML file for use by one engine; each process compiles a file only once."""
    with _lock:
        if (idle := _idle.pop(path, None)) is not None:
            return idle
        if (known := _compiled.get(path)) is None:
            _compiled[path] = SharedModel(path, mujoco.MjModel.from_xml_path(path))
            return _compiled[path]
        # The known model may be in use: copy it, then reset the copy to the compiled positions.
        twin = SharedModel(path, copy.copy(known.model), known.compiled)
        twin.restore()
        return twin


def return_models(models: Iterable[SharedModel]) -> None:
    """Return borrowed models to the pool; for each XML file, one idle model is kept for the next engine."""
    with _lock:
        for model in models:
            model.restore()
            _compiled[model.path] = _idle.setdefault(model.path, model)


WARNED_ALREADY = 1000
"""The initial value of MuJoCo's warning counts. MuJoCo prints a warning, and logs it to MUJOCO_LOG.TXT, only if
its count is zero, so this value silences all warnings; any other count means that a warning occurred."""


class TaskProgram:
    """A mixin that separates a Meta-World environment from its simulator state. One environment is built for each
    model and task. Every episode runs on a shallow copy (:meth:`on`), which shares everything except the state."""

    model: Any
    data: Any
    frame_skip: int
    hand_init_pos: NDArray[np.float64]
    tcp_center: NDArray[np.float64]
    reset_model: Callable[[], NDArray[np.float64]]
    get_body_com: Callable[[str], NDArray[np.float64]]

    _moves_hand = True

    def __init__(self, model: Any) -> None:
        self.model = model
        super().__init__()
        # Make the goal observable, and let each reset draw a new initial state and goal from the seed.
        self._partially_observable = False
        self.__dict__.pop("sawyer_observation_space", None)
        self._set_task_called = True
        self._freeze_rand_vec = False
        self.seeded_rand_vec = True
        self.mujoco_renderer = None
        self.data = None

    def _initialize_simulation(self) -> tuple[Any, Any]:
        return self.model, mujoco.MjData(self.model)

    def on(self, data: Any) -> TaskProgram:
        """Return a shallow copy of this program that uses the simulator state ``data``."""
        program = object.__new__(type(self))
        program.__dict__.update(self.__dict__)
        program.data = data
        # In Meta-World, these two are views of the state, so they follow the fingers.
        program.init_left_pad = program.get_body_com("leftpad")  # type: ignore[attr-defined]
        program.init_right_pad = program.get_body_com("rightpad")  # type: ignore[attr-defined]
        return program

    def start_episode(self, seed: int) -> NDArray[np.float64]:
        """Reset as Meta-World's ``env.seed(seed); env.reset()`` does, and return the first observation.

        Meta-World resets twice. The first reset affects the second only through the random draws and the positions of
        bodies and sites. These do not depend on the hand, so here the first reset does not move the hand.
        """
        self.np_random, _ = seeding.np_random(seed)
        for self._moves_hand in (False, True):
            mujoco.mj_resetData(self.model, self.data)
            self.data.warning.number[:] = WARNED_ALREADY
            if not self._moves_hand:
                mujoco.mj_forward(self.model, self.data)
            observation = self.reset_model()
        observation[18:36] = observation[:18]
        return observation

    def _reset_hand(self, steps: int = 50) -> None:
        if self._moves_hand:
            self.data.mocap_pos[:] = self.hand_init_pos
            self.data.mocap_quat[:] = (1.0, 0.0, 1.0, 0.0)
            self.data.ctrl[:] = (-1.0, 1.0)
            mujoco.mj_step(self.model, self.data, nstep=steps * self.frame_skip)
        self.init_tcp = self.tcp_center


def _task_class(task: str) -> Any:
    import_metaworld()
    from metaworld.env_dict import ALL_V3_ENVIRONMENTS

    return ALL_V3_ENVIRONMENTS[f"{task}-v3"]


@cache
def program_class(task: str) -> Any:
    base = _task_class(task)
    return type(f"{base.__name__}Program", (TaskProgram, base), {})


def model_path(task: str) -> str:
    """Return the path of a task's XML file; the 50 tasks share 36 files."""
    return object.__new__(_task_class(task)).model_name
