"""Where bodies are, as engines tell it: what Meta-World's own state holds, and the caller's to keep."""

from __future__ import annotations

import numpy as np

from lw_torchrl.suites.metaworld import MetaWorldEngine
from lw_torchrl.suites.metaworld.vectorized_engine import VectorizedEngine


def test_poses_are_metaworlds():
    tasks = ["door-open", "door-close"]  # of one XML file, whose bodies each reset moves
    engines = [VectorizedEngine(tasks, num_threads=1), MetaWorldEngine(tasks)]
    action = np.full((2, 4), 0.3, np.float32)
    for engine in engines:
        engine.reset([0, 1], [3, 4])
        first = engine.poses(0)
        kept = first.position.copy()
        for _ in range(3):
            engine.step(action, np.ones(2, bool))
        np.testing.assert_array_equal(first.position, kept)
        assert not np.array_equal(engine.poses(0).position, kept)
        engine.reset([1], [5])
    for row in (0, 1):
        ours, theirs = (engine.poses(row) for engine in engines)
        np.testing.assert_array_equal(ours.position, theirs.position)
        np.testing.assert_array_equal(ours.quaternion, theirs.quaternion)
    ours, theirs = (engine.model(0) for engine in engines)
    assert ours.path == theirs.path
    assert ours.model.nbody == theirs.model.nbody
    for engine in engines:
        engine.close()
