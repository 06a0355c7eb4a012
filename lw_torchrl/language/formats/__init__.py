"""How plans are written: the nine formats of the paper, by name, and what else one adds to the table.

A style (what is said) in a container (how): ``basic_py`` to ``goal_md``. docs/planners.md shows them.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from lw_torchrl._checks import check_choice, checked
from lw_torchrl.language.formats.md import md
from lw_torchrl.language.formats.plan_format import STYLES, PlanFormat
from lw_torchrl.language.formats.py import py
from lw_torchrl.language.formats.py_md import py_md
from lw_torchrl.language.plans import ConditionalPlan

PLAN_FORMATS: Mapping[str, PlanFormat] = MappingProxyType(
    {
        f"{name}_{container}": make(style)
        for name, style in STYLES.items()
        for container, make in {"py": py, "py_md": py_md, "md": md}.items()
    }
)
"""The formats by name."""


@checked
def encode_plan(plan: ConditionalPlan, format: str) -> str:
    """A plan as text.

    :func:`~lw_torchrl.decode_plan` reads an equal plan from it: its conditions and skills, and in the goal formats its
    goals. Reasons are written where a format explains; a goal that is not its skill's usual one has no place in the
    basic and chain formats.

    Args:
        plan: the plan.
        format: a name in :data:`PLAN_FORMATS`.

    Raises:
        TypeError: ``plan`` is no ConditionalPlan.
        ValueError: an unknown format.

    Example:
        >>> from lw_torchrl.language.plan_files import load_plans
        >>> print(encode_plan(load_plans("MT10")["window-open"], "basic_md").splitlines()[2])
        - When the robot's gripper is not almost vertically aligned with the window handle, the robot should place the \
gripper above the window handle.

    Source: paper section 'Conditional Plan Generation'.
    """
    if not isinstance(plan, ConditionalPlan):
        raise TypeError(f"plan must be a ConditionalPlan, got {type(plan).__name__}")
    return PLAN_FORMATS[check_choice("format", format, PLAN_FORMATS)].encode(plan)
