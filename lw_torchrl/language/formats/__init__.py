"""The plan formats by name: the paper's nine, three styles in three containers, and those that you add."""

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
    if not isinstance(name, str) or not re.fullmatch(r"[a-z][a-z0-9_]*", name):  # it is a folder's name too
        raise ValueError(f"a plan format must be named in lower case, like 'basic_py', got {shown(name)}")
    return check_value(f"plan format {name!r}", format, PlanFormat)


_CONTAINERS = {"py": py, "py_md": py_md, "md": md}
PLAN_FORMATS = Registry(
    "plan format",
    "lw_torchrl.formats",
    {f"{name}_{container}": make(style) for name, style in STYLES.items() for container, make in _CONTAINERS.items()},
    _check_format,
)
"""The formats by name: the nine of the paper, and those that you add, ``PLAN_FORMATS["mine"] = PlanFormat(...)``."""


@typed
def encode_plan(plan: ConditionalPlan, format: str) -> str:
    """Write a plan as text, from which :func:`~lw_torchrl.decode_plan` reads an equal plan.

    Reasons are written only in the chain and goal formats. A goal that is not the skill's usual one is written only in
    goal formats.

    Example:
        >>> plan = ConditionalPlan.from_pairs("reach", [("gripper is open", "move the gripper to the target")])
        >>> print(encode_plan(plan, "basic_md").splitlines()[2])
        - When the robot's gripper is open, the robot should move the gripper to the target.

    Source: paper section 'Conditional Plan Generation'.
    """
    return PLAN_FORMATS[check_choice("format", format, PLAN_FORMATS)].encode(plan)


__all__ = ["PLAN_FORMATS", "Clause", "PlanFormat", "Reading", "encode_plan"]
