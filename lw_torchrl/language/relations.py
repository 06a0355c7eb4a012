"""What the relations mean: comparisons of d = first position - second position, in metres."""

from __future__ import annotations

import re
from collections import ChainMap, UserDict
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Literal

from lw_torchrl._checks import check_choice, shown
from lw_torchrl.language.named_objects import is_number

if TYPE_CHECKING:
    from torch import Tensor


@dataclass(frozen=True)
class Comparison:
    """One comparison: a length or a coordinate of d against a threshold.

    Attributes:
        axes: the axes of d that count, "x", "xy", "xyz", ...
        sense: how the value is compared with the threshold.
        threshold: in metres.
        length: the Euclidean length over the axes; otherwise the signed coordinate of the one axis.
        raise_z: added to dz first, in metres.
        temperature: of the soft truth, metres (or shares of the gripper's opening) to one logit, above 0.
    """

    axes: str
    sense: Literal["<", ">", "<="]
    threshold: float
    length: bool = True
    raise_z: float = 0.0
    temperature: float = 0.01

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

    def holds(self, d: Tensor) -> Tensor:
        """Whether the comparison holds of d: (..., 3) metres to (...) bool."""
        import torch

        counted = [d[..., "xyz".index(axis)] + (self.raise_z if axis == "z" else 0.0) for axis in self.axes]
        value = torch.stack([x.square() for x in counted]).sum(0).sqrt() if self.length else counted[0]
        if self.sense == "<":
            return value < self.threshold
        return value > self.threshold if self.sense == ">" else value <= self.threshold


def _within(axes: str, radius: float, raise_z: float = 0.0) -> Comparison:
    return Comparison(axes, "<", radius, raise_z=raise_z)


def _along(axis: str, sense: Literal["<", ">", "<="], threshold: float, temperature: float = 0.01) -> Comparison:
    return Comparison(axis, sense, threshold, length=False, temperature=temperature)


TOUCHING = "touching the table"
UNARY = MappingProxyType(
    {
        TOUCHING: (_along("z", "<=", 0.02),),
        "open": (_along("z", ">", 0.75, temperature=0.05),),
        "closed": (_along("z", "<=", 0.75, temperature=0.05),),
    }
)
"""The predicates of one object, with the origin as second position: "touching the table" compares the object's z,
"open" and "closed" the gripper's opening in place of z."""


class Relations(UserDict[str, tuple[Comparison, ...]]):
    """Relations by name, to which others may be added; a name that a query cannot hold is a ValueError."""

    def __setitem__(self, name: str, parts: tuple[Comparison, ...]) -> None:
        words = name.split() if isinstance(name, str) else []
        if not words or name != " ".join(words) or not re.fullmatch(r"[a-z][a-z '-]*", name):
            raise ValueError(f"a relation must be named by lower-case words, like 'left of', got {shown(name)}")
        if name in UNARY or words[0] in ("is", "isn't", "not") or {"and", "the", "a", "an"} & set(words):
            raise ValueError(f"a relation may not be named {name!r}, which has a meaning of its own in a query")
        if isinstance(parts, Comparison) or not parts or not all(isinstance(part, Comparison) for part in parts):
            raise ValueError(f"relation {name!r} must be a tuple of Comparison, at least one, got {shown(parts)}")
        super().__setitem__(name, tuple(parts))


RELATIONS = Relations(
    {
        "near": (_within("xyz", 0.04),),
        "around": (_within("xyz", 0.03, raise_z=0.02),),
        "left of": (_along("x", ">", 0.04),),
        "right of": (_along("x", "<", -0.04),),
        "behind": (_along("y", ">", 0.04), _within("xz", 0.04)),
        "in front of": (_along("y", "<", -0.04), _within("xz", 0.04)),
        "above": (_within("xy", 0.02), _along("z", ">", 0.0)),
        "below": (_within("xy", 0.02), _along("z", "<", 0.0)),
        "vertically aligned with": (_within("xy", 0.06),),
        "almost vertically aligned with": (_within("xy", 0.12),),
        "mostly below": (_along("z", "<", 0.23),),
        "horizontally aligned with": (_within("yz", 0.03),),
        "forward aligned with": (_within("xz", 0.03),),
    }
)
"""The relations between two objects: the 13 published ones, and those that you add (docs/queries.md shows how).

Source: paper section 'Query Answering Function'; the thresholds are the published ones.
"""
PUBLISHED = (
    "near", "around", "left of", "right of", "behind", "in front of", "above", "below", "vertically aligned with",
    "almost vertically aligned with", "mostly below", "horizontally aligned with", "forward aligned with",
)  # fmt: skip
"""The names of the paper's 13, whatever else :data:`RELATIONS` holds."""

PREDICATES = ChainMap[str, tuple[Comparison, ...]](UNARY, RELATIONS)  # type: ignore[arg-type]
"""All that a clause can say: the relations, also those that are added, then the predicates of one object."""


def relation_holds(relation: str, first: Tensor, second: Tensor) -> Tensor:
    """Whether one of :data:`RELATIONS` holds between two positions: (..., 3) float, metres, to (...) bool.

    Example:
        >>> import torch
        >>> relation_holds("above", torch.tensor([0.0, 0.6, 0.2]), torch.tensor([0.0, 0.61, 0.02]))
        tensor(True)
    """
    import torch

    check_choice("relation", relation, RELATIONS)
    return torch.stack([part.holds(first - second) for part in RELATIONS[relation]]).all(0)
