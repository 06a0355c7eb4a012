"""What relations mean of two positions, one by one: what the library compiles for whole batches."""

import torch

from lw_torchrl.language.relations import RELATIONS


def comparison_holds(part, d):
    """Whether a Comparison holds of d: (..., 3) metres to (...) bool."""
    counted = [d[..., "xyz".index(axis)] + (part.raise_z if axis == "z" else 0.0) for axis in part.axes]
    value = torch.stack([x.square() for x in counted]).sum(0).sqrt() if part.length else counted[0]
    if part.sense == "<":
        return value < part.threshold
    return value > part.threshold if part.sense == ">" else value <= part.threshold


def relation_holds(relation, first, second):
    """Whether a relation holds between two positions: (..., 3) float, metres, to (...) bool."""
    return torch.stack([comparison_holds(part, first - second) for part in RELATIONS[relation]]).all(0)
