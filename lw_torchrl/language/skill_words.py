"""What a skill's words say of its motion, whatever things it names."""

from __future__ import annotations

_PUSHES = frozenset({"push", "pull", "turn", "press", "slide", "drag"})
_CLOSES = frozenset({"close", "closes", "grab", "grasp", "grip"})
_DIRECTIONS = frozenset(
    {"left", "right", "front", "behind", "beside", "away", "back", "forward", "robot", "into", "in", "out", "through"}
)


def pushes(skill: str) -> bool:
    """Whether a skill pushes or pulls: "turn the dial to the right" does, "place the gripper above the dial" not."""
    return skill.split()[0] in _PUSHES


def presses(skill: str) -> bool:
    """Whether a skill pushes straight down: "push the button down"."""
    return pushes(skill) and "down" in skill.split()


def closes(skill: str) -> bool:
    """Whether a skill closes the gripper: "close the gripper around the puck"."""
    return not _CLOSES.isdisjoint(skill.split())


def has_direction(skill: str) -> bool:
    """Whether a skill says a direction in the plane, as seen by the robot or by the thing: "to the left", "toward the
    robot", "in front of the drawer handle", "into the hole"; "toward the reach target" and "above the puck" say none.

    Example:
        >>> has_direction("push the window handle to the left"), has_direction("move the puck to the target location")
        (True, False)
    """
    return not _DIRECTIONS.isdisjoint(skill.split())
