"""Plan formats: the paper's nine (three styles in three containers), and custom formats."""

from __future__ import annotations

import re
from typing import Any

from lw_torchrl._util.checks import check_choice, check_value, shown, typed
from lw_torchrl._util.registry import Registry
from lw_torchrl.language.formats.base import STYLES, Clause, PlanFormat, Reading
from lw_torchrl.language.formats.prose import md
from lw_torchrl.language.formats.python import py, py_md
from lw_torchrl.language.plans import ConditionalPlan


def _check_format(name: str, format: Any) -> PlanFormat:
    if not isinstance(name, str) or not re.fullmatch(r"[a-z][a-z0-9_]*", name):  # also the name of a folder
        raise ValueError(f"name of a plan format must be lower case like 'basic_py', got {shown(name)}")
    return check_value(f"plan format {name!r}", format, PlanFormat)


_CONTAINERS = {"py": py, "py_md": py_md, "md": md}
PLAN_FORMATS = Registry(
    "plan format",
    "lw_torchrl.formats",
    {f"{name}_{container}": make(style) for name, style in STYLES.items() for container, make in _CONTAINERS.items()},
    _check_format,
)
"""The plan formats by name. Add a custom format with ``PLAN_FORMATS["mine"] = PlanFormat(...)``."""


@typed
def encode_plan(plan: ConditionalPlan, format: str) -> str:
    """Convert a plan to text in a format; :func:`~lw_torchrl.decode_plan` converts the text back to an equal plan.

    Only the chain and goal formats contain reasons. Only the goal formats contain goals other than the skills' usual
    goals.

    Example:
        >>> plan = ConditionalPlan.from_pairs("reach", [("gripper is open", "move the gripper to the target")])
        >>> print(encode_plan(plan, "basic_md").splitlines()[2])
        - When the robot's gripper is open, the robot should move the gripper to the target.

    Source: paper section 'Conditional Plan Generation'.
    """
    return PLAN_FORMATS[check_choice("format", format, PLAN_FORMATS)].encode(plan)


__all__ = ["PLAN_FORMATS", "Clause", "PlanFormat", "Reading", "encode_plan"]
