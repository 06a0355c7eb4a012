"""What a growing buffer stores of a collector's batch: the demonstrations' columns, or an error that names them."""

from __future__ import annotations

from collections.abc import Mapping

from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from lw_torchrl.data.n_steps import STEPS
from lw_torchrl.data.storage import column_name

EXECUTED = ("next", "executed_action")
MASK = ("collector", "mask")


def collected_rows(batch: TensorDictBase, columns: Mapping[NestedKey, Tensor]) -> dict[NestedKey, Tensor]:
    """The columns of a batch (n, ...), its dimensions made one.

    ``action`` is what was done, ``("next", "executed_action")``, where the batch has that; a policy's own may lie
    outside [-1, 1].

    Args:
        batch: what a collector yields, of one or more dimensions.
        columns: name to rows of the column that these are to join.

    Raises:
        ValueError: a column is missing, or of another dtype or shape; a number is NaN or infinite; an action lies
            outside [-1, 1]; the rows are of n steps already, or no steps, by ``("collector", "mask")``.
    """
    names = set(batch.keys(True, True))
    if STEPS in names:
        raise ValueError(
            f"batch holds {STEPS}, so MultiStep or MultiStepTransform was here: leave it out and give the buffer "
            "n_steps= and gamma=, which makes n steps of the demonstrations and of these rows alike"
        )
    if MASK in names and not batch.get(MASK).all():
        raise ValueError(
            "batch holds rows that are no steps: split_trajs=True fills trajectories up to one length; leave it out, "
            "or give batch[batch['collector', 'mask']]"
        )
    sources = {key: EXECUTED if key == "action" and EXECUTED in names else key for key in columns}
    if absent := [column_name(key) for key, source in sources.items() if source not in names]:
        raise ValueError(f"batch lacks the columns {', '.join(absent)}, which the demonstrations have")
    found = {}
    for key, like in columns.items():
        leaf = batch.get(sources[key])
        tail = leaf.shape[batch.ndim :]
        if leaf.dtype != like.dtype or tail != like.shape[1:]:
            raise ValueError(
                f"batch: column {column_name(sources[key])} must be {like.dtype} of shape {tuple(like.shape[1:])} a "
                f"row as in the demonstrations, got {leaf.dtype} of shape {tuple(tail)}"
            )
        if leaf.dtype.is_floating_point and not leaf.isfinite().all():
            raise ValueError(f"batch: column {column_name(sources[key])} holds NaN or an infinite number")
        found[key] = leaf.detach().reshape(-1, *tail)
    if sources.get("action") == "action" and (most := float(found["action"].abs().max())) > 1.0:
        raise ValueError(
            f"batch: action must be what was done, in [-1, 1], got one of {most:.3g}; LanguageWorldEnv gives it as "
            "('next', 'executed_action'), which is taken where it is there"
        )
    return found
