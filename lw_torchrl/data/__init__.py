"""Demonstrations: collect datasets, read datasets as a replay buffer, and sample rows in exact proportions."""

import lw_torchrl._util.keys  # noqa: F401
from lw_torchrl.data.collect import collect_demonstrations
from lw_torchrl.data.collection_policy import BEHAVIOURS, Behaviour
from lw_torchrl.data.dataset import CollectConfig, DatasetError, Demonstrations
from lw_torchrl.data.exchange import ExchangeError, export_dataset, import_dataset
from lw_torchrl.data.loading import ROLLOUT, load_demonstrations
from lw_torchrl.data.pictures import add_pictures, load_pictures
from lw_torchrl.data.replay import DatasetStorage, LanguageWorldExperienceReplay
from lw_torchrl.data.rewards import REWARDS, n_step_returns
from lw_torchrl.data.samplers import CoLearningSampler, TaskBalancedSampler
from lw_torchrl.data.selection import EpisodeFilter, JoinedDemonstrations

__all__ = [
    "BEHAVIOURS", "REWARDS", "ROLLOUT", "Behaviour", "CoLearningSampler", "CollectConfig", "DatasetError",
    "DatasetStorage", "Demonstrations", "EpisodeFilter", "ExchangeError", "JoinedDemonstrations",
    "LanguageWorldExperienceReplay", "TaskBalancedSampler", "add_pictures", "collect_demonstrations", "export_dataset",
    "import_dataset", "load_demonstrations", "load_pictures", "n_step_returns",
]  # fmt: skip
