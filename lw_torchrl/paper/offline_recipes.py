"""How policies are learned offline: the methods, and one recipe for all of them, all mixtures and all tasks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

from lw_torchrl._checks import check_choice, check_int, check_probability, check_scale
from lw_torchrl.data.rewards import REWARDS, RewardName
from lw_torchrl.data.selection import EpisodeFilter


@dataclass(frozen=True)
class OfflineMethod:
    """What is made of a mixture.

    Attributes:
        name: in folders and tables.
        loss: a name of :data:`lw_torchrl.paper.offline_training.LOSSES`.
        keep: which episodes it sees; None for all.
        critic: whether it has a critic, which may see something else than the actor.
        version: 1 more whenever it is changed, so that what it gave before is refused.
    """

    name: str
    loss: str
    keep: EpisodeFilter | None = None
    critic: bool = False
    version: int = 1


OFFLINE_METHODS: Mapping[str, OfflineMethod] = MappingProxyType(
    {
        method.name: method
        for method in (
            OfflineMethod("advantage", "advantage", critic=True),
            OfflineMethod("filtered-bc", "bc", EpisodeFilter(success=True, else_best=0.2)),
            OfflineMethod("best-bc", "bc", EpisodeFilter(best=0.2)),
            OfflineMethod("bc", "bc"),
            OfflineMethod("iql", "iql", critic=True),
            OfflineMethod("td3-bc", "td3-bc", critic=True),
            OfflineMethod("cql", "cql", critic=True),
        )
    }
)
"""By name: imitation weighted by the advantages of a value learned before; behavioral cloning of the successes (of a
task without any, of what the next one takes), of the fifth of each task's episodes with the highest return, and of all;
and TorchRL's IQL, TD3+BC and CQL."""


@dataclass(frozen=True)
class OfflineRecipe:
    """The numbers of all methods.

    Attributes:
        reward: what values are of.
        n_steps, gamma: of their targets.
        expectile: of the value.
        beta, max_weight: of the weights by advantage, as for :class:`AdvantageWeightedLoss`.
        distance: to the action that is imitated, weighted or not. The median of what was done in a state ("l1") commits
            itself where their mean would half open the gripper.
        temperature: of IQL's actor.
        alpha: of TD3+BC, the weight of the value beside the imitation.
        cql_weight: of CQL's penalty.
        steps: minibatches of every actor; of the value, ``value_steps``.
        batch_size: rows of one.
        width, depth: hidden layers of actors; of critics, ``critic_depth``.
        feature_noise: of actors while they train.
    """

    reward: RewardName = "dense_cost"
    n_steps: int = 10
    gamma: float = 0.99
    expectile: float = 0.7
    beta: float = 2.0
    max_weight: float = 20.0
    distance: Literal["l1", "l2"] = "l1"
    temperature: float = 3.0
    alpha: float = 2.5
    cql_weight: float = 1.0
    steps: int = 4000
    value_steps: int = 4000
    batch_size: int = 250
    width: int = 256
    depth: int = 3
    critic_depth: int = 2
    feature_noise: float = 0.05

    def __post_init__(self) -> None:
        check_choice("reward", self.reward, REWARDS)
        check_choice("distance", self.distance, ("l1", "l2"))
        for name in ("expectile", "gamma"):
            check_probability(name, getattr(self, name))
        for name in ("beta", "max_weight", "temperature", "alpha", "cql_weight", "feature_noise"):
            check_scale(name, getattr(self, name))
        for name in ("n_steps", "steps", "value_steps", "batch_size", "width", "depth", "critic_depth"):
            check_int(name, getattr(self, name), minimum=1)
