"""Where things stand in Meta-World's observation, and how many numbers it and an action have.

Positions are in metres; the gripper's opening is between 0, closed, and 1. A task with one object has zeros for the
second. The goal is where the task's target is.
Source: ``metaworld.sawyer_xyz_env.SawyerXYZEnv._get_obs``.
"""

from __future__ import annotations

OBSERVATION_SIZE = 39
ACTION_SIZE = 4

HAND = slice(0, 3)
OPENING = 3
FIRST = slice(4, 7)
FIRST_QUATERNION = slice(7, 11)
SECOND = slice(11, 14)
SECOND_QUATERNION = slice(14, 18)
BEFORE = slice(18, 36)  # all of the above, a step before
GOAL = slice(36, 39)

POSITIONS = (HAND, FIRST, SECOND, GOAL)
"""The positions of this step."""


def places(part: slice) -> tuple[int, ...]:
    """The numbers' indices.

    Example:
        >>> places(GOAL)
        (36, 37, 38)
    """
    return tuple(range(part.start, part.stop))


def a_step_before(part: slice) -> slice:
    """Where the same stands of the step before; the goal has no past.

    Example:
        >>> a_step_before(FIRST)
        slice(22, 25, None)
    """
    return slice(part.start + BEFORE.start, part.stop + BEFORE.start)
