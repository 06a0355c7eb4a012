"""What a replay buffer of demonstrations refuses, since it would go wrong without a word."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import NestedKey
from torch import Tensor
from torchrl.data.replay_buffers.samplers import SliceSampler
from torchrl.envs import Compose, MultiStepTransform

from lw_torchrl.data.behaviours import EXPERT
from lw_torchrl.data.dataset import Demonstrations
from lw_torchrl.data.rewards import REWARDS, RewardName, check_reward


def check_transform(transform: Any) -> None:
    """Raise for a transform that would do nothing to demonstrations, and say nothing."""
    if isinstance(transform, MultiStepTransform):
        raise ValueError(
            "MultiStepTransform acts on rows as they are written, and demonstrations are not: leave it out and give "
            f"n_steps={transform.n_steps}, gamma={transform.gamma}, which makes n steps of all rows"
        )
    for part in transform if isinstance(transform, Compose) else ():
        check_transform(part)


def check_prefetch(batches: int | None) -> None:
    """Raise where several threads would draw batches in an order that differs from run to run."""
    if (batches or 0) > 1:
        raise ValueError(
            f"prefetch must be None, 0 or 1, got {batches}: several threads draw the batches in an order that differs "
            "from run to run"
        )


def check_label(label: str, parts: Sequence[Demonstrations]) -> None:
    """Raise :class:`ValueError` where an expert's actions are asked for, and another one acted."""
    others = sorted({part.config.behaviour for part in parts if part.config.policy != EXPERT})
    if others and label != "executed":
        raise ValueError(
            f"label={label!r} is what the expert wanted, and {', '.join(others)} acted here: take label='executed'"
        )


def check_growing(sampler: Any, options: Mapping[str, Any]) -> None:
    """Raise for what a buffer that grows cannot do, or would do wrong without a word."""
    if options.get("prefetch"):
        raise ValueError(f"prefetch={options['prefetch']} draws batches before the newest rows come: leave it out")
    if options.get("shared"):
        raise ValueError("shared=True: a buffer that grows is of one process")
    if isinstance(sampler, SliceSampler) and not sampler._fetch_traj:
        raise ValueError(
            "sampler: a SliceSampler by end_key joins trajectories that a collector cut without an end; take "
            "traj_key=('collector', 'traj_ids')"
        )


def check_rows(reward: RewardName, terminate_on_success: bool, rows: Mapping[NestedKey, Tensor]) -> None:
    """Raise where rows have another reward, or other ends, than the demonstrations that they are to stand beside."""
    success = rows["next", "success"]
    check_reward(reward, rows["next", "reward"], success)
    if not torch.equal(rows["next", "terminated"], success & terminate_on_success):
        at = "terminated at success" if terminate_on_success else "never terminated"
        raise ValueError(
            f"batch: rows must be {at}, as the demonstrations are; give the environment and the buffer the same "
            f"terminate_on_success, here {terminate_on_success}"
        )


def admit_rows(
    reward: RewardName, terminate_on_success: bool, rows: Mapping[NestedKey, Tensor]
) -> dict[NestedKey, Tensor]:
    """A collector's rows with the demonstrations' reward; raises as :func:`check_rows`."""
    made = REWARDS[reward]
    check_rows(made.source, terminate_on_success, rows)
    return {**rows, ("next", "reward"): made.of(rows["next", "reward"], rows["next", "success"])}
