"""Load spatial relations and object states from data/relations.toml.

Each relation or state is a set of comparisons on d = first position - second position, in metres.
"""

import re
from collections import ChainMap
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from importlib.resources import files
from typing import Any, Literal

from lw_torchrl._util.checks import Finite, Positive, shown, typed_fields
from lw_torchrl._util.files import read_toml
from lw_torchrl._util.registry import ReadOnlyDict, Registry
from lw_torchrl.language.connectives import CONNECTIVES
from lw_torchrl.language.layout import Layout


@typed_fields
@dataclass(frozen=True)
class Comparison:
    """A threshold on the length, or on one coordinate, of the vector d = first position - second position."""

    axes: Literal["x", "y", "z", "xy", "xz", "yz", "xyz"]  # the axes of d to compare
    sense: Literal["<", ">", "<="]
    threshold: Finite  # metres, or a fraction of an opening
    length: bool = True  # compare the Euclidean length over the axes; False: one signed coordinate
    raise_z: Finite = 0.0  # metres added to dz before the comparison
    temperature: Positive = 0.01  # metres (or fraction of an opening) per logit of the soft truth

    def __post_init__(self) -> None:
        if not self.length and len(self.axes) != 1:
            raise ValueError(f"axes must be one axis if length=False, got {self.axes!r}")


_TABLE = read_toml(files("lw_torchrl.language") / "data" / "relations.toml", ValueError)


def _predicates(kind: str) -> dict[str, tuple[Comparison, ...]]:
    return {name: tuple(Comparison(**part) for part in parts) for name, parts in _TABLE[kind].items()}


TOUCHING = "touching the table"
PREDICATES = ChainMap[str, tuple[Comparison, ...]]()
"""All predicates of clauses: object states, other unary predicates, and relations."""


def _check_predicate(name: str, parts: Any, others: Iterable[str]) -> tuple[Comparison, ...]:
    """Check a predicate's comparisons and return them; raise a ValueError if a query cannot contain the name."""
    if not isinstance(name, str) or not re.fullmatch(r"[a-z][a-z'-]*( [a-z'-]+)*", name):
        raise ValueError(f"name of a predicate must be lower-case words like 'left of', got {shown(name)}")
    is_beginning = name.split()[0] in ("is", "isn't", "not")
    if name in others or is_beginning or not {*name.split()}.isdisjoint((*CONNECTIVES, "the", "a", "an")):
        raise ValueError(f"name {name!r} is taken, or contains a word that is reserved in queries, such as 'and'")
    if not isinstance(parts, (tuple, list)) or not parts or not all(isinstance(part, Comparison) for part in parts):
        raise ValueError(f"{name!r} must be a tuple of at least one Comparison, got {shown(parts)}")
    return tuple(parts)


def _check_state(name: str, parts: Any) -> tuple[Comparison, ...]:
    _check_predicate(name, parts, {*_OF_POSITION, *PREDICATES.maps[-1]})
    if any((part.axes, part.length) != ("z", False) for part in parts):
        raise ValueError(f"state {name!r} must compare the opening, Comparison('z', ..., length=False), got {parts}")
    return tuple(parts)


_OF_POSITION: Mapping[str, tuple[Comparison, ...]] = ReadOnlyDict(_predicates("unary"))
STATES = Registry("state", "lw_torchrl.states", _predicates("states"), _check_state)
"""The states of an opening, from 0 (closed) to 1 (open); their comparisons use the opening as z.

The shipped states are "open", "closed" and "wide open"; fingers around a wide object are neither closed nor wide open.
Add a state with ``STATES["on"] = STATES["open"]``.
"""
UNARY = ChainMap[str, tuple[Comparison, ...]](STATES, _OF_POSITION)  # type: ignore[arg-type]
"""Predicates of a single object: "touching the table" (based on the object's z) and the states of its opening."""
_check_relation = partial(_check_predicate, others=UNARY)
RELATIONS = Registry("relation", "lw_torchrl.relations", _predicates("relations"), _check_relation)
"""The relations between two objects: the paper's 13 relations, and those that you add (see docs/custom-networks.md).

Source: paper section 'Query Answering Function', with the published thresholds.
"""
PUBLISHED: tuple[str, ...] = tuple(_TABLE["published"])
"""The names of the paper's 13 relations."""
PREDICATES.maps = [STATES, _OF_POSITION, RELATIONS]  # type: ignore[list-item]


def comparisons(predicate: str, layout: Layout) -> tuple[Comparison, ...]:
    """Return the comparisons of a predicate, with the threshold of ``layout`` if it sets one for the predicate."""
    table = next((table for table in PREDICATES.maps if predicate in table), PREDICATES)  # a failed lookup is slow
    parts = table[predicate]
    if (threshold := layout.thresholds.get(predicate)) is None:
        return parts
    if len(parts) != 1:
        raise ValueError(f"thresholds of layout {layout.name!r}: {predicate!r} needs one comparison, got {len(parts)}")
    return (replace(parts[0], threshold=threshold),)
