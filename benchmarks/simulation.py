"""Benchmarks of the engine, compared with the physics alone and with Meta-World's own step."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from copy import copy
from time import perf_counter
from typing import Any

import mujoco
import numpy as np
from metaworld.policies import ENV_POLICY_MAP

import lw_torchrl as lw
from benchmarks.report import Row, Settings, bars, compare, times_as_long
from lw_torchrl.suites.metaworld.environments import make_metaworld_env
from lw_torchrl.suites.metaworld.vectorized_engine import VectorizedEngine

CHUNK = 25  # number of steps of a contender before the next contender's turn
SUBSTEPS = 5
MOCAP_QUATERNION = (1.0, 0.0, 1.0, 0.0)  # Meta-World sets this orientation at every step


class _Physics:
    """Copies of the MuJoCo states of Meta-World environments, on the same models, stepped by MuJoCo alone."""

    def __init__(self, envs: list[Any], *, look: bool) -> None:
        self._look = look
        self.pairs = [(env.model, copy(env.data)) for env in envs]

    def play(self, mocap: np.ndarray, control: np.ndarray) -> float:
        """Return the seconds of physics for mocap positions (T, N, 3) and controls (T, N, 2), without setting these."""
        seconds = 0.0
        for positions, controls in zip(mocap, control, strict=True):
            for (_, data), position, values in zip(self.pairs, positions, controls, strict=True):
                data.mocap_pos[0] = position
                data.mocap_quat[0] = MOCAP_QUATERNION
                data.ctrl[:] = values
            start = perf_counter()
            if self._look:
                for model, data in self.pairs:
                    mujoco.mj_step(model, data, SUBSTEPS)
                    mujoco.mj_forward(model, data)
            else:
                for model, data in self.pairs:
                    mujoco.mj_step(model, data, SUBSTEPS)
            seconds += perf_counter() - start
        return seconds


def steps(settings: Settings) -> list[Row]:
    """Step all 50 tasks with expert actions in one thread, in turns of 25 steps; check that all states are equal."""
    tasks = lw.MT50[:3] if settings.quick else lw.MT50
    n, seeds = len(tasks), list(range(len(tasks)))
    experts = [ENV_POLICY_MAP[f"{task}-v3"]() for task in tasks]
    originals = [make_metaworld_env(task) for task in tasks]
    observations = []
    for env, seed in zip(originals, seeds, strict=True):
        env.seed(seed)
        observations.append(env.reset()[0])
    floor, bare = (_Physics(originals, look=look) for look in (True, False))
    engines = {reward: VectorizedEngine(tasks, num_threads=1, reward=reward) for reward in ("sparse", "dense")}
    for engine in engines.values():
        engine.reset(range(n), seeds)
    active = np.ones(n, dtype=bool)
    found: dict[str, list[float]] = {name: [] for name in ("metaworld", "floor", "bare", "sparse", "dense")}
    for number in bars(range(settings.pick(500, 50) // CHUNK), "steps"):
        actions = np.empty((CHUNK, n, 4), dtype=np.float32)
        mocap, control = np.empty((CHUNK, n, 3)), np.empty((CHUNK, n, 2))
        seconds = 0.0
        for step in range(CHUNK):
            with warnings.catch_warnings():
                warnings.filterwarnings("ignore", message="Constant\\(s\\) may be too high")
                wanted = [expert.get_action(seen) for expert, seen in zip(experts, observations, strict=True)]
            actions[step] = np.clip(np.stack(wanted), -1, 1)
            start = perf_counter()
            observations = [env.step(action)[0] for env, action in zip(originals, actions[step], strict=True)]
            seconds += perf_counter() - start
            for row, env in enumerate(originals):
                mocap[step, row], control[step, row] = env.data.mocap_pos[0], env.data.ctrl
        found["metaworld"].append(seconds)

        def play_engine(reward: str, actions: np.ndarray = actions, expected: list = observations) -> None:
            engine = engines[reward]
            start = perf_counter()
            for action in actions:
                result = engine.step(action, active)
            found[reward].append(perf_counter() - start)
            if not np.array_equal(result.observation, np.stack(expected)):
                raise RuntimeError(f"the {reward} engine and Meta-World disagree")

        def play_physics(name: str, mocap: np.ndarray = mocap, control: np.ndarray = control) -> None:
            found[name].append({"floor": floor, "bare": bare}[name].play(mocap, control))

        turns: list[Callable[[], None]] = [
            lambda: play_engine("sparse"),
            lambda: play_physics("floor"),
            lambda: play_engine("dense"),
            lambda: play_physics("bare"),
        ]
        for turn in turns if number % 2 else reversed(turns):
            turn()
        twins = zip(originals, floor.pairs, strict=True)
        if not all(np.array_equal(env.data.qpos, data.qpos) for env, (_, data) in twins):
            raise RuntimeError("the exact floor and Meta-World disagree")
    for engine in engines.values():
        engine.close()

    scale = 1e6 / CHUNK / n

    def line(ours: str, rival: str, theirs: str, at_least: float | None = None, note: str = "") -> Row:
        name = "environment step, " + ours + " reward"
        return compare(name, found[ours], rival, found[theirs], unit="µs", scale=scale, at_least=at_least, note=note)

    return [
        line("sparse", "mj_step ×5 alone", "bare", note="without mj_forward the states drift from Meta-World's"),
        line("sparse", "mj_step ×5, mj_forward", "floor", 0.90, note="the physics that gives Meta-World's numbers"),
        line("sparse", "Meta-World's env.step", "metaworld", 2.0),
        line("dense", "Meta-World's env.step", "metaworld", 1.5),
        times_as_long(
            "environment step, dense reward",
            found["dense"],
            "with the sparse reward",
            found["sparse"],
            unit="µs",
            scale=scale,
            at_most=1.15,
        ),
    ]
