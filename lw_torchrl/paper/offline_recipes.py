"""Offline experiments: mixtures of behaviours, methods, one recipe for all of them, and the tables of runs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Literal

from lw_torchrl._checks import check_choice, check_int, check_probability, check_scale
from lw_torchrl.data import BEHAVIOURS, EpisodeFilter
from lw_torchrl.data.rewards import REWARDS, RewardName
from lw_torchrl.language.tasks import MT10

TASK_SETS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "five": ("door-open", "drawer-open", "peg-insert-side", "pick-place", "push"),
        "MT10": MT10,
        "two": ("door-open", "drawer-open"),
    }
)
"""By name: five tasks of MT10, without those that chance solves; MT10; and two, to try an experiment."""


@dataclass(frozen=True)
class Portion:
    """Episodes of one behaviour."""

    behaviour: str  # a name of :data:`BEHAVIOURS`
    episodes: int  # of each task


_WRONG, _RANDOM = Portion("wrong", 20), Portion("random", 10)
MIXTURES: Mapping[str, tuple[Portion, ...]] = MappingProxyType(
    {
        "B": (Portion("spoilt-30", 20), Portion("spoilt-60", 20), _WRONG, _RANDOM),
        "W": (Portion("spoilt-30", 20), _WRONG, _RANDOM),
        "C": (Portion("expert", 5), _WRONG, _RANDOM),
    }
)
"""What a policy learns from, by name: B, plans spoilt a little and much, wrong skills, chance, no expert; W, B without
the plans spoilt a little; C, the hard case: five expert demonstrations among wrong skills and chance."""

_LED_ASTRAY: dict[str, Any] = {"noise_scale": 0.3, "noise_hold": 10, "gripper_noise_factor": 0.5}
NOISE: Mapping[str, dict[str, Any]] = dict.fromkeys(BEHAVIOURS, _LED_ASTRAY) | {
    "expert": {"noise_scale": 0.0},
    "random": {"noise_scale": 0.1, "noise_hold": 10, "gripper_noise_factor": 1.0},
}
"""How each behaviour is executed: the expert without noise, chance with a little, scripts with much."""


@dataclass(frozen=True)
class OfflineMethod:
    """How a policy is learned from a mixture."""

    name: str  # in folders and tables
    loss: str  # a name of :data:`lw_torchrl.paper.offline.DISTRIBUTIONS`
    keep: EpisodeFilter | None = None  # which episodes it sees; None for all
    critic: bool = False  # whether it has a critic, which may be conditioned otherwise than the actor
    version: int = 1  # raised by 1 whenever the method changes, so that earlier results are refused


_ALL_METHODS = (
    OfflineMethod("advantage", "advantage", critic=True),
    OfflineMethod("filtered-bc", "bc", EpisodeFilter(success=True, else_best=0.2)),
    OfflineMethod("best-bc", "bc", EpisodeFilter(best=0.2)),
    OfflineMethod("bc", "bc"),
    *(OfflineMethod(name, name, critic=True) for name in ("iql", "td3-bc", "cql")),
)
OFFLINE_METHODS: Mapping[str, OfflineMethod] = MappingProxyType({method.name: method for method in _ALL_METHODS})
"""By name: imitation weighted by the advantages of a value that was learned before; behavioral cloning of the successes
(of a task without any, as the next method), of the fifth of each task's episodes with the highest return, and of all
episodes; and TorchRL's IQL, TD3+BC and CQL."""


@dataclass(frozen=True)
class OfflineRecipe:
    """The numbers of all methods."""

    reward: RewardName = "dense_cost"  # what values are of
    n_steps: int = 10  # of the values' targets
    gamma: float = 0.99  # of these
    expectile: float = 0.7  # of the value
    beta: float = 2.0  # of the weights by advantage, as for :class:`AdvantageWeightedLoss`
    max_weight: float = 20.0  # of these
    distance: Literal["l1", "l2"] = "l1"  # to what is imitated; the mean of open and close would half open the gripper
    temperature: float = 3.0  # of IQL's actor
    alpha: float = 2.5  # of TD3+BC, the weight of the value beside the imitation
    cql_weight: float = 1.0  # of CQL's penalty
    steps: int = 4000  # minibatches of every actor; of the value, ``value_steps``
    value_steps: int = 4000
    batch_size: int = 250  # rows of one
    width: int = 256  # of hidden layers
    depth: int = 3  # of actors
    critic_depth: int = 2
    feature_noise: float = 0.05  # of actors while they train

    def __post_init__(self) -> None:
        check_choice("reward", self.reward, REWARDS)
        check_choice("distance", self.distance, ("l1", "l2"))
        for name in ("expectile", "gamma"):
            check_probability(name, getattr(self, name))
        for name in ("beta", "max_weight", "temperature", "alpha", "cql_weight", "feature_noise"):
            check_scale(name, getattr(self, name))
        for name in ("n_steps", "steps", "value_steps", "batch_size", "width", "depth", "critic_depth"):
            check_int(name, getattr(self, name), minimum=1)


@dataclass(frozen=True)
class OfflineTable:
    """Runs that are compared: the first row of a mixture with each of the others."""

    tasks: str  # a name of :data:`TASK_SETS`
    rows: Mapping[str, tuple[tuple[str, str, str], ...]]  # mixture to its rows, (method, actor, critic) each


_PLAN = "pcbc", "pcbc"
_CONDITIONS = ("pcbc", "dc", "one-hot")
_METHODS = tuple((name, *_PLAN) for name in OFFLINE_METHODS)
_SHORT = tuple((name, *_PLAN) for name in ("advantage", "filtered-bc", "best-bc", "bc"))
_CONDITIONING = (
    *(("advantage", actor, critic) for actor in _CONDITIONS for critic in _CONDITIONS),
    *(("filtered-bc", actor, "pcbc") for actor in _CONDITIONS),
)
OFFLINE_TABLES: Mapping[str, OfflineTable] = MappingProxyType(
    {
        "methods": OfflineTable("five", {"B": _METHODS, "W": _METHODS, "C": _SHORT}),
        "conditioning": OfflineTable("five", {"B": _CONDITIONING, "W": _CONDITIONING}),
        "mt10": OfflineTable("MT10", {"B": _SHORT[:2]}),
        "quick": OfflineTable("two", {"W": _SHORT[:2]}),
    }
)
"""By name: seven methods on plans; what actors and critics are conditioned on; all of MT10; two tasks, to try it."""
