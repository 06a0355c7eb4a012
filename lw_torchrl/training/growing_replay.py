"""What the buffer of a training in an environment must be."""

from __future__ import annotations

from typing import Any

from lw_torchrl.data.co_learning_sampler import GROWN, CoLearningSampler
from lw_torchrl.data.growing import GrowingStorage
from lw_torchrl.data.replay import LanguageWorldExperienceReplay
from lw_torchrl.modules.policy import Policy
from lw_torchrl.training.minibatches import check_replay
from lw_torchrl.training.online_config import OnlineConfig


def check_growing_replay(actor: Policy, replay: Any, config: OnlineConfig) -> None:
    """Raise :class:`ValueError` unless a buffer grows, and is what rows of the environment can stand beside."""
    if not isinstance(replay, LanguageWorldExperienceReplay) or not isinstance(replay.storage, GrowingStorage):
        raise ValueError("replay must be a LanguageWorldExperienceReplay that grows: give it grow=, a number of rows")
    sampler = replay.sampler
    if not isinstance(sampler, CoLearningSampler) or sampler.target != GROWN:
        raise ValueError(
            "replay's sampler must be CoLearningSampler('grown'), which draws demonstrations and rows that came 1:1"
        )
    if not replay.terminate_on_success:
        raise ValueError("replay must end at success, as the environment does: give it terminate_on_success=True")
    if replay.storage.n_steps > 1 and replay.storage.gamma != config.gamma:
        raise ValueError(f"gamma must be the replay buffer's, {replay.storage.gamma}, got {config.gamma}")
    check_replay(actor, replay, config.batch_size)
