"""Demonstrations: collecting them, reading them as a replay buffer, sampling them in exact proportions."""

from lw_torchrl.data.collect import collect_demonstrations
from lw_torchrl.data.dataset import CollectConfig, DatasetError, Demonstrations
from lw_torchrl.data.replay import LanguageWorldExperienceReplay
from lw_torchrl.data.samplers import TaskBalancedSampler

__all__ = [
    "CollectConfig",
    "DatasetError",
    "Demonstrations",
    "LanguageWorldExperienceReplay",
    "TaskBalancedSampler",
    "collect_demonstrations",
]
