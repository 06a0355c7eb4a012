"""All that the rewards of one step look at: one row of numbers for each row."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lw_torchrl.envs.engines.vectorized.rewards.parameters import (
    EPISODE,
    FACTS,
    GOAL,
    GRIP,
    TCP,
    Parameters,
)
from lw_torchrl.envs.engines.vectorized.sensors import (
    CURRENT,
    HAND,
    LEFT_TIP,
    OBJECT,
    REWARD_WIDTH,
    RIGHT_TIP,
)

Array = NDArray[np.float64]


def gather_facts(task: Parameters, sensors: Array, current: Array, goal: Array, episode: Array) -> Array:
    """(rows, FACTS) the sensors, with the observation in the place of what it is made from, and what rewards add."""
    facts = np.empty((len(sensors), FACTS))
    facts[:, :REWARD_WIDTH] = sensors
    facts[:, CURRENT] = current
    facts[:, GOAL] = goal
    facts[:, EPISODE] = episode
    facts[:, TCP] = (sensors[:, RIGHT_TIP] + sensors[:, LEFT_TIP]) / 2.0
    facts[:, GRIP] = current[:, OBJECT] + task.grip_offset
    hand = current[:, HAND.start]
    slides = np.abs(current[:, OBJECT.start] - hand) < task.slide
    np.copyto(facts[:, GRIP.start], hand, where=slides)
    return facts
