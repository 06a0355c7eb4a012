"""Layouts: Meta-World's against its own environment, and what a layout must be."""

import pickle

import numpy as np
import pytest

from lw_torchrl.language.layout import METAWORLD, Layout, Slot, places

HAND, FIRST, SECOND, GOAL = METAWORLD.positions


def test_the_parts_are_where_meta_world_puts_them(metaworld_env):
    env = metaworld_env("stick-pull")  # has two objects
    env.seed(0)
    env.reset()
    before = None
    turned = [slice(thing.quaternion, thing.quaternion + 4) for thing in METAWORLD.things]
    for _ in range(3):
        state = env.step(np.array([0.3, 0.2, -0.1, 1.0]))[0]
        np.testing.assert_allclose(state[HAND], env.get_endeff_pos(), atol=1e-12)
        np.testing.assert_array_equal(state[GOAL], env._target_pos)
        objects = env._get_pos_objects()
        np.testing.assert_allclose(np.concatenate([state[FIRST], state[SECOND]]), objects, atol=1e-12)
        turns = np.concatenate([state[part] for part in turned])
        np.testing.assert_allclose(turns, env._get_quat_objects(), atol=1e-12)
        assert 0 <= state[METAWORLD.opening] <= 1
        if before is not None:
            np.testing.assert_array_equal(state[METAWORLD.a_step_before(slice(0, 18))], before)
        before = state[:18]
    assert state.shape == (METAWORLD.size,)
    assert env.action_space.shape == (METAWORLD.action_size,)


def test_the_parts_cover_every_number_once():
    # As they were written out before there was one layout.
    assert [part.start for part in METAWORLD.all_positions] == [0, 4, 11, 36, 18, 22, 29]
    numbers = [sorted(number for part in parts for number in places(part)) for parts in METAWORLD.parts]
    assert numbers == [[*range(4, 11), *range(22, 29)], [*range(11, 18), *range(29, 36)], [36, 37, 38]]


def test_a_layout_survives_json_and_pickle():
    own = Layout("mine", 12, hand=0, opening=3, things=(Slot(4),), goal=8, thresholds={"near": 0.05})
    for again in (Layout.from_json(own.to_json()), pickle.loads(pickle.dumps(own))):
        assert (again, hash(again)) == (own, hash(own))
    assert own != METAWORLD
    with pytest.raises(ValueError, match="has no numbers of the step before"):
        own.a_step_before(slice(0, 3))
