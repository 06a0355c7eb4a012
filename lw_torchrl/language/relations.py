"""What the relations mean: each is one or two comparisons on d = first position - second position, in metres.

The unary predicates fit the same form with the origin as second position: "touching the table" compares the z
of an object, "open" and "closed" the gripper's opening, put in place of z.
Source: paper section 'Query Answering Function'; the thresholds are the published ones.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

import torch
from torch import Tensor

from lw_torchrl._checks import check_choice


@dataclass(frozen=True)
class Comparison:
    """One comparison: a length or a coordinate of d against a threshold.

    Attributes:
        axes: the axes of d that count, "x", "xy", "xyz", ...
        sense: how the value is compared with the threshold.
        threshold: in metres.
        length: the Euclidean length over the axes; otherwise the signed coordinate of the one axis.
        raise_z: added to dz first, in metres.
        temperature: of the soft truth, metres (or shares of the gripper's opening) to one logit.
    """

    axes: str
    sense: Literal["<", ">", "<="]
    threshold: float
    length: bool = True
    raise_z: float = 0.0
    temperature: float = 0.01

    def holds(self, d: Tensor) -> Tensor:
        """Whether the comparison holds of d: (..., 3) metres to (...) bool."""
        counted = [d[..., "xyz".index(axis)] + (self.raise_z if axis == "z" else 0.0) for axis in self.axes]
        value = torch.stack([x.square() for x in counted]).sum(0).sqrt() if self.length else counted[0]
        if self.sense == "<":
            return value < self.threshold
        return value > self.threshold if self.sense == ">" else value <= self.threshold


def _within(axes: str, radius: float, raise_z: float = 0.0) -> Comparison:
    return Comparison(axes, "<", radius, raise_z=raise_z)


def _more(axis: str, threshold: float) -> Comparison:
    return Comparison(axis, ">", threshold, length=False)


def _less(axis: str, threshold: float) -> Comparison:
    return Comparison(axis, "<", threshold, length=False)


RELATIONS = MappingProxyType(
    {
        "near": (_within("xyz", 0.04),),
        "around": (_within("xyz", 0.03, raise_z=0.02),),
        "left of": (_more("x", 0.04),),
        "right of": (_less("x", -0.04),),
        "behind": (_more("y", 0.04), _within("xz", 0.04)),
        "in front of": (_less("y", -0.04), _within("xz", 0.04)),
        "above": (_within("xy", 0.02), _more("z", 0.0)),
        "below": (_within("xy", 0.02), _less("z", 0.0)),
        "vertically aligned with": (_within("xy", 0.06),),
        "almost vertically aligned with": (_within("xy", 0.12),),
        "mostly below": (_less("z", 0.23),),
        "horizontally aligned with": (_within("yz", 0.03),),
        "forward aligned with": (_within("xz", 0.03),),
    }
)
"""The 13 relations between two objects."""

TOUCHING = "touching the table"
UNARY = MappingProxyType(
    {
        TOUCHING: (Comparison("z", "<=", 0.02, length=False),),
        "open": (Comparison("z", ">", 0.75, length=False, temperature=0.05),),
        "closed": (Comparison("z", "<=", 0.75, length=False, temperature=0.05),),
    }
)
"""The predicates of one object; "open" and "closed" are the gripper's."""

PREDICATES = MappingProxyType({**RELATIONS, **UNARY})


def relation_holds(relation: str, first: Tensor, second: Tensor) -> Tensor:
    """Whether ``relation`` holds between positions.

    Args:
        relation: one of :data:`RELATIONS`.
        first, second: (..., 3) float, metres; they broadcast.

    Returns:
        (...) bool.

    Raises:
        ValueError: the relation is unknown (with the nearest name).

    Example:
        >>> import torch
        >>> relation_holds("above", torch.tensor([0.0, 0.6, 0.2]), torch.tensor([0.0, 0.61, 0.02]))
        tensor(True)
    """
    check_choice("relation", relation, RELATIONS)
    return torch.stack([part.holds(first - second) for part in RELATIONS[relation]]).all(0)
