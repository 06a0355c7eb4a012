"""Offline experiments: mixtures of behaviours, methods, one recipe for all of them, and the tables of runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from itertools import product
from types import MappingProxyType
from typing import Any, Literal

from lw_torchrl._checks import check_choice, check_int, check_probability, check_scale
from lw_torchrl._files import read_toml
from lw_torchrl.data import BEHAVIOURS, EpisodeFilter
from lw_torchrl.data.rewards import REWARDS, RewardName
from lw_torchrl.language.tasks import MT10


@dataclass(frozen=True)
class Portion:
    """Episodes of one behaviour."""

    behaviour: str  # a name of :data:`BEHAVIOURS`
    episodes: int  # of each task


@dataclass(frozen=True)
class OfflineMethod:
    """How a policy is learned from a mixture."""

    name: str  # in folders and tables
    loss: str  # a name of :data:`lw_torchrl.paper.offline.DISTRIBUTIONS`
    keep: EpisodeFilter | None = None  # which episodes it sees; None for all
    critic: bool = False  # whether it has a critic, which may be conditioned otherwise than the actor
    version: int = 1  # raised by 1 whenever the method changes, so that earlier results are refused


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


def _method(name: str, keep: Mapping[str, Any] | None = None, **given: Any) -> OfflineMethod:
    return OfflineMethod(name, keep=None if keep is None else EpisodeFilter(**keep), **given)


def _table(tasks: str, runs: Sequence[Mapping[str, Any]]) -> OfflineTable:
    rows: dict[str, tuple[tuple[str, str, str], ...]] = {}
    for block in runs:
        own = tuple(product(block["methods"], block.get("actors", ["pcbc"]), block.get("critics", ["pcbc"])))
        rows |= {mixture: rows.get(mixture, ()) + own for mixture in block["mixtures"]}
    return OfflineTable(tasks, rows)


_TABLES = read_toml(files("lw_torchrl.paper") / "data" / "offline.toml", ValueError)
TASK_SETS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {"MT10": MT10, **{name: tuple(tasks) for name, tasks in _TABLES["task_sets"].items()}}
)
MIXTURES: Mapping[str, tuple[Portion, ...]] = MappingProxyType(
    {name: tuple(Portion(*portion) for portion in mixture.items()) for name, mixture in _TABLES["mixtures"].items()}
)
NOISE: Mapping[str, dict[str, Any]] = {one: _TABLES["noise"].get(one, _TABLES["noise"]["others"]) for one in BEHAVIOURS}
OFFLINE_METHODS: Mapping[str, OfflineMethod] = MappingProxyType(
    {name: _method(name, **given) for name, given in _TABLES["methods"].items()}
)
OFFLINE_TABLES: Mapping[str, OfflineTable] = MappingProxyType(
    {name: _table(**given) for name, given in _TABLES["tables"].items()}
)
