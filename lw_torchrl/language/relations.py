"""What the relations mean: comparisons of d = first position - second position, in metres, of data/relations.toml."""

import re
from collections import ChainMap
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from importlib.resources import files
from types import MappingProxyType
from typing import Any, Literal

from lw_torchrl._util.checks import check_choice, shown
from lw_torchrl._util.files import read_toml
from lw_torchrl._util.registry import Registry
from lw_torchrl.language.layout import Layout
from lw_torchrl.language.objects import is_number


@dataclass(frozen=True)
class Comparison:
    """One comparison: a length or a coordinate of d against a threshold."""

    axes: str  # the axes of d that count, "x", "xy", "xyz", ...
    sense: Literal["<", ">", "<="]
    threshold: float  # metres
    length: bool = True  # compare the Euclidean length over the axes, not the signed coordinate of the one axis
    raise_z: float = 0.0  # metres, added to dz first
    temperature: float = 0.01  # of the soft truth: metres (or shares of an opening) to one logit, above 0

    def __post_init__(self) -> None:
        if not self.axes or self.axes != "".join(axis for axis in "xyz" if axis in self.axes):
            raise ValueError(f"axes must be some of 'xyz' in that order, got {shown(self.axes)}")
        if not self.length and len(self.axes) != 1:
            raise ValueError(f"axes must be one axis where length=False, got {self.axes!r}")
        check_choice("sense", self.sense, ("<", ">", "<="))
        for name in ("threshold", "raise_z", "temperature"):
            if not is_number(getattr(self, name)):
                raise ValueError(f"{name} must be a number, got {shown(getattr(self, name))}")
        if self.temperature <= 0:
            raise ValueError(f"temperature must be above 0, got {self.temperature}")


_TABLE = read_toml(files("lw_torchrl.language") / "data" / "relations.toml", ValueError)


def _predicates(kind: str) -> dict[str, tuple[Comparison, ...]]:
    return {name: tuple(Comparison(**part) for part in parts) for name, parts in _TABLE[kind].items()}


TOUCHING = "touching the table"
PREDICATES = ChainMap[str, tuple[Comparison, ...]]()
"""All that a clause can say: the relations, also those that are added, then the predicates of one object."""


def _check_predicate(name: str, parts: Any, others: Iterable[str]) -> tuple[Comparison, ...]:
    """Return the comparisons of a predicate; :class:`ValueError` for a name that a query cannot contain."""
    if not isinstance(name, str) or not re.fullmatch(r"[a-z][a-z'-]*( [a-z'-]+)*", name):
        raise ValueError(f"a relation must be named by lower-case words, like 'left of', got {shown(name)}")
    words = name.split()
    reserved = [name] * (name in others) + [word for word in words[:1] if word in ("is", "isn't", "not")]
    if reserved := reserved + [word for word in words if word in ("and", "the", "a", "an")]:
        raise ValueError(f"a relation may not be named {name!r}: {reserved[0]!r} has its own meaning in a query")
    if isinstance(parts, Comparison) or not parts or not all(isinstance(part, Comparison) for part in parts):
        raise ValueError(f"relation {name!r} must be a tuple of Comparison, at least one, got {shown(parts)}")
    return tuple(parts)


def _check_relation(name: str, parts: Any) -> tuple[Comparison, ...]:
    return _check_predicate(name, parts, UNARY)


def _check_state(name: str, parts: Any) -> tuple[Comparison, ...]:
    for part in _check_predicate(name, parts, {*_OF_POSITION, *PREDICATES.maps[-1]}):
        if (part.axes, part.length) != ("z", False):
            needed = "compare the opening, Comparison('z', ..., length=False)"
            raise ValueError(f"state {name!r} must {needed}, got {shown(part)}")
    return tuple(parts)


_OF_POSITION: Mapping[str, tuple[Comparison, ...]] = MappingProxyType(_predicates("unary"))
STATES = Registry("state", "lw_torchrl.states", _predicates("states"), _check_state)
"""What is said of an opening, a number from 0, closed, to 1, open: "open", "closed", and what you add,
``STATES["on"] = STATES["open"]``. It stands in place of z."""
UNARY = ChainMap[str, tuple[Comparison, ...]](STATES, _OF_POSITION)  # type: ignore[arg-type]
"""The predicates of one object: "touching the table" compares its z with the table's, :data:`STATES` its opening."""
RELATIONS = Registry("relation", "lw_torchrl.relations", _predicates("relations"), _check_relation)
"""The relations between two objects: the 13 published ones, and those that you add (docs/queries.md shows how).

Source: paper section 'Query Answering Function'; the thresholds are the published ones.
"""
PUBLISHED: tuple[str, ...] = tuple(_TABLE["published"])
"""The names of the paper's 13, whatever else :data:`RELATIONS` holds."""
PREDICATES.maps = [STATES, _OF_POSITION, RELATIONS]  # type: ignore[list-item]


def comparisons(predicate: str, layout: Layout) -> tuple[Comparison, ...]:
    """What a predicate compares in a suite, whose layout may have a threshold of its own."""
    parts = PREDICATES[predicate]
    if (threshold := layout.thresholds.get(predicate)) is None:
        return parts
    if len(parts) != 1:
        raise ValueError(f"thresholds of layout {layout.name!r}: {predicate!r} has {len(parts)} comparisons, not one")
    return (replace(parts[0], threshold=threshold),)
