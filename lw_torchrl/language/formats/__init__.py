"""How plans are written: a module for each format, and the table of them by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

from lw_torchrl.language.formats import chain_py
from lw_torchrl.language.plans import ConditionalPlan


@dataclass(frozen=True)
class PlanFormat:
    """A way to write a plan.

    Attributes:
        encode: a plan to its text.
        decode: ``(text, task=None, source="plan", tasks=TASKS)`` to the plan, as
            :func:`~lw_torchrl.language.formats.chain_py.parse_plan`; a text that is none is a ``PlanError``.
    """

    encode: Callable[[ConditionalPlan], str]
    decode: Callable[..., ConditionalPlan]


PLAN_FORMATS: Mapping[str, PlanFormat] = MappingProxyType(
    {"chain_py": PlanFormat(chain_py.format_plan, chain_py.parse_plan)}
)
"""The formats by name."""
