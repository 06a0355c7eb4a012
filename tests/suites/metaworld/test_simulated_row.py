"""The shortened first substep, which reuses the last step's mj_forward."""

import mujoco
import numpy as np

from lw_torchrl.suites.metaworld import simulated_rows
from lw_torchrl.suites.metaworld.simulated_rows import SimulatedRow
from lw_torchrl.suites.metaworld.tables import simulation_table
from lw_torchrl.suites.metaworld.vectorized_engine import VectorizedEngine

TASKS = list(simulation_table())
STATE = ("qpos", "qvel", "qacc", "qacc_warmstart", "xpos", "xquat", "site_xpos", "efc_force", "time")


def whole_substep(row: SimulatedRow) -> None:
    mujoco.mj_step(row._model, row._data)


def test_shortened_substep_has_the_bits_of_a_whole_one(monkeypatch):
    """Compare the states of all tasks after every step, with a reset in between."""
    n, rng = len(TASKS), np.random.default_rng(0)
    engine = VectorizedEngine(TASKS, num_threads=1)
    monkeypatch.setattr(simulated_rows, "find_row_kernel", lambda: None)
    plain = VectorizedEngine(TASKS, num_threads=1)
    for row in plain._rows:
        monkeypatch.setattr(row, "_substep_after_look", lambda row=row: whole_substep(row))
    for step in range(20):
        if step % 10 == 0:
            for k in (engine, plain):
                k.reset(range(n), range(step, step + n))
        action = rng.uniform(-1, 1, (n, 4)).astype(np.float32)
        action[:, 2] -= 0.5  # downwards, to make contacts
        for k in (engine, plain):
            k.step(action, np.ones(n, bool))
        for task, ours, whole in zip(TASKS, engine._rows, plain._rows, strict=True):
            for name in STATE:
                same = np.array_equal(getattr(ours._data, name), getattr(whole._data, name))
                assert same, f"step {step}, {task}: {name}"
    assert sum(row._data.ncon for row in engine._rows) > n


def test_first_step_of_an_episode_is_not_shortened(monkeypatch):
    """Positions computed in a reset may be older than its last change."""
    calls = []
    monkeypatch.setattr(simulated_rows, "find_row_kernel", lambda: None)
    engine = VectorizedEngine(["push"], num_threads=1)
    monkeypatch.setattr(engine._rows[0], "_substep_after_look", lambda: calls.append(engine._rows[0]._data.time))
    for _ in range(2):
        engine.reset([0], [0])
        engine.step(np.zeros((1, 4)), np.ones(1, bool))
    assert calls == []
    engine.step(np.zeros((1, 4)), np.ones(1, bool))
    assert len(calls) == 1
