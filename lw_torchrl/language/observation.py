"""Where things stand in Meta-World's observation (metres, source: ``SawyerXYZEnv._get_obs``), and its size."""

from __future__ import annotations

OBSERVATION_SIZE = 39
ACTION_SIZE = 4

HAND = slice(0, 3)
OPENING = 3  # of the gripper, from 0, closed, to 1
FIRST = slice(4, 7)
FIRST_QUATERNION = slice(7, 11)
SECOND = slice(11, 14)  # zeros in a task with one object
SECOND_QUATERNION = slice(14, 18)
BEFORE = slice(18, 36)  # all of the above, a step before
GOAL = slice(36, 39)  # where the task's target is

POSITIONS = (HAND, FIRST, SECOND, GOAL)
"""The positions of this step."""


def places(part: slice) -> tuple[int, ...]:
    """The numbers' indices: (36, 37, 38) for the goal."""
    return tuple(range(part.start, part.stop))


def a_step_before(part: slice) -> slice:
    """Where the same stands of the step before; the goal has no past."""
    return slice(part.start + BEFORE.start, part.stop + BEFORE.start)
