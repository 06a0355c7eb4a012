"""The layout of the observation, against Meta-World's own environment."""

import numpy as np

from lw_torchrl.envs import engine
from lw_torchrl.language import observation as layout
from lw_torchrl.modules.augmentation import _PLACES
from lw_torchrl.transforms.random_yaw import _STARTS


def test_the_parts_are_where_meta_world_puts_them(metaworld_env):
    env = metaworld_env("stick-pull")  # has two objects
    env.seed(0)
    env.reset()
    before = None
    for _ in range(3):
        state = env.step(np.array([0.3, 0.2, -0.1, 1.0]))[0]
        np.testing.assert_allclose(state[layout.HAND], env.get_endeff_pos(), atol=1e-12)
        np.testing.assert_array_equal(state[layout.GOAL], env._target_pos)
        objects = env._get_pos_objects()
        np.testing.assert_allclose(np.concatenate([state[layout.FIRST], state[layout.SECOND]]), objects, atol=1e-12)
        turns = np.concatenate([state[layout.FIRST_QUATERNION], state[layout.SECOND_QUATERNION]])
        np.testing.assert_allclose(turns, env._get_quat_objects(), atol=1e-12)
        assert 0 <= state[layout.OPENING] <= 1
        if before is not None:
            np.testing.assert_array_equal(state[layout.BEFORE], before)
        before = state[: layout.BEFORE.start]
    assert state.shape == (layout.OBSERVATION_SIZE,)
    assert env.action_space.shape == (layout.ACTION_SIZE,)


def test_the_parts_cover_every_number_once():
    parts = [layout.HAND, slice(layout.OPENING, layout.OPENING + 1), layout.FIRST, layout.FIRST_QUATERNION]
    parts += [layout.SECOND, layout.SECOND_QUATERNION, layout.BEFORE, layout.GOAL]
    assert [k for part in parts for k in layout.places(part)] == list(range(layout.OBSERVATION_SIZE))
    assert layout.a_step_before(layout.SECOND_QUATERNION) == slice(32, 36)


def test_whoever_needs_the_layout_reads_it_here():
    assert engine.OBSERVATION_SIZE is layout.OBSERVATION_SIZE
    assert engine.ACTION_SIZE is layout.ACTION_SIZE
    # As they were written out before there was one layout.
    assert _STARTS == (0, 4, 11, 36, 18, 22, 29)
    assert ({*range(4, 11), *range(22, 29)}, {*range(11, 18), *range(29, 36)}, {36, 37, 38}) == _PLACES
