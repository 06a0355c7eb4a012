"""The plan formats by name: the paper's nine, a style (what is said) in a container (how), and those that you add."""

from __future__ import annotations

import re
from typing import Any

from lw_torchrl._util.checks import check_choice, shown, typed
from lw_torchrl._util.registry import Registry
from lw_torchrl.language.formats.base import STYLES, Clause, PlanFormat, Reading
from lw_torchrl.language.formats.prose import md
from lw_torchrl.language.formats.python import py, py_md
from lw_torchrl.language.plans import ConditionalPlan


def _check_format(name: str, format: Any) -> PlanFormat:
    if not isinstance(name, str) or not re.fullmatch(r"[a-z][a-z0-9_]*", name):
        raise ValueError(f"a plan format must be named in lower case, like 'basic_py', got {shown(name)}")
    if not isinstance(format, PlanFormat):
        raise TypeError(f"plan format {name!r} must be a PlanFormat, got {shown(format)}")
    return format


_CONTAINERS = {"py": py, "py_md": py_md, "md": md}
PLAN_FORMATS = Registry(
    "plan format",
    "lw_torchrl.formats",
    {f"{style}_{name}": make(said) for style, said in STYLES.items() for name, make in _CONTAINERS.items()},
    _check_format,
)
"""The formats by name: the nine of the paper, and those that you add, ``PLAN_FORMATS["mine"] = PlanFormat(...)``."""


@typed
def encode_plan(plan: ConditionalPlan, format: str) -> str:
    """A plan as text, from which :func:`~lw_torchrl.decode_plan` reads an equal plan.

    Only formats that explain hold reasons, and only goal formats hold a goal other than the skill's usual one.

    Example:
        >>> plan = ConditionalPlan.from_pairs("reach", [("gripper is open", "move the gripper to the target")])
        >>> print(encode_plan(plan, "basic_md").splitlines()[2])
        - When the robot's gripper is open, the robot should move the gripper to the target.

    Source: paper section 'Conditional Plan Generation'.
    """
    return PLAN_FORMATS[check_choice("format", format, PLAN_FORMATS)].encode(plan)


__all__ = ["PLAN_FORMATS", "Clause", "PlanFormat", "Reading", "encode_plan"]
