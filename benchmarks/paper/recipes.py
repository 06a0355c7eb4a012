"""The experiments as frozen configurations, the paper's and the offline ones, as the tables in data/ have them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

from benchmarks.paper.actors import Parts, reads_plans
from lw_torchrl._util.checks import Count, Probability, Scale, typed_fields
from lw_torchrl._util.files import read_toml
from lw_torchrl.data import BEHAVIOURS, EpisodeFilter
from lw_torchrl.data.rewards import RewardName
from lw_torchrl.data.selection import Label
from lw_torchrl.language.tasks import MT10
from lw_torchrl.training.cloning import BehavioralCloningConfig


@dataclass(frozen=True)
class DataSetting:
    """What demonstrations an experiment may see; without targets it has one policy of all base tasks."""

    name: str  # "zero-shot", "few-shot" or "one-shot"
    base: str  # the tasks demonstrated, "MT10" or "MT50"
    episodes: int  # demonstrations of each
    targets: str | None = None  # tasks that each get a policy, from one demonstration beside the base tasks


@dataclass(frozen=True)
class Execution:
    """How experts are executed: a name for datasets, and options of :func:`~lw_torchrl.collect_demonstrations`."""

    name: str
    noise_scale: tuple[float, ...]
    noise_hold: int = 1
    redraw_failures: bool = False


@dataclass(frozen=True)
class Member:
    """One of the actors whose actions a policy averages, by the fields of :class:`Parts`."""

    parts: Mapping[str, Any] = field(default_factory=dict, hash=False)  # of every method
    plan_parts: Mapping[str, Any] = field(default_factory=dict, hash=False)  # more, of methods that read plans

    def __post_init__(self) -> None:
        for name in ("parts", "plan_parts"):  # a frozen recipe's options are read-only, too
            object.__setattr__(self, name, MappingProxyType(_tuples(getattr(self, name))))

    def of(self, method: str) -> Parts:
        """Return the parts of an actor of a method."""
        return Parts(**{**self.parts, **(self.plan_parts if reads_plans(method) else {})})


@dataclass(frozen=True)
class Preset:
    """How demonstrations are made and policies trained in a setting, the same for every method and task."""

    name: str  # "strong", ours; "one-network", "no-roles" and "evaluator", what they say; "paper", the published recipe
    base: Execution  # how the base tasks are demonstrated
    label: Label  # which of the expert's actions is imitated, as for :class:`LanguageWorldExperienceReplay`
    members: tuple[Member, ...]  # the actors of a policy, each trained by itself on the same demonstrations
    training: BehavioralCloningConfig  # of the optimizer
    demonstrated: tuple[
        Member, ...
    ] = ()  # with plans, actors of the descriptions, for the tasks that were demonstrated
    target: Execution | None = None  # how a target task is demonstrated, once, where the setting has targets
    after_success: int | None = None  # drop what comes so many steps after the first success; None keeps all
    passes: int | None = None  # train for so many passes over the rows instead of ``training.steps`` minibatches
    evaluations: int = 1  # of the policy, a 25th of the training apart, the last at its end; of one member, if several

    def __post_init__(self) -> None:
        if self.evaluations > 1 and len(self.members) > 1:
            raise ValueError(f"evaluations must be 1 of {len(self.members)} members, got {self.evaluations}")

    def evaluated_before(self, steps: int) -> list[int]:
        """The steps after which a policy is evaluated before its training ends."""
        return sorted({steps - k * steps // 25 for k in range(1, self.evaluations)} - {steps})


def _tuples(options: Mapping[str, Any]) -> dict[str, Any]:
    return {key: tuple(value) if isinstance(value, list) else value for key, value in options.items()}


def _preset(name: str, every: Mapping[str, Any], own: Mapping[str, Any]) -> Preset:
    """A preset in a setting, whose ``own`` table adds to the one of ``every`` setting."""
    given = {"name": name, **every, **own}
    given |= {key: EXECUTIONS[given[key]] for key in ("base", "target") if key in given}
    for field_name in ("members", "demonstrated"):
        given[field_name] = tuple(_MEMBERS[member] for member in given.get(field_name, ()))
    given["training"] = BehavioralCloningConfig(**{**every.get("training", {}), **own["training"]})
    return Preset(**given)


_TABLE = read_toml(Path(__file__).parent / "data" / "recipes.toml", ValueError)
SETTINGS = MappingProxyType({name: DataSetting(name, **setting) for name, setting in _TABLE["settings"].items()})
EXECUTIONS = {name: Execution(name, **_tuples(execution)) for name, execution in _TABLE["executions"].items()}
_MEMBERS = {name: Member(**member) for name, member in _TABLE["members"].items()}
PRESETS: Mapping[str, Mapping[str, Preset]] = MappingProxyType(
    {
        name: {key: _preset(name, settings["every"], own) for key, own in settings.items() if key != "every"}
        for name, settings in _TABLE["presets"].items()
    }
)
"""Preset's name, then setting's name, to :class:`Preset`."""


@dataclass(frozen=True)
class Portion:
    """Episodes of one behaviour."""

    behaviour: str  # a name of :data:`BEHAVIOURS`
    episodes: int  # of each task


@dataclass(frozen=True)
class OfflineMethod:
    """How a policy is learned from a mixture."""

    name: str  # in folders and tables
    loss: str  # a name of :data:`benchmarks.paper.offline.DISTRIBUTIONS`
    keep: EpisodeFilter | None = None  # which episodes it sees; None for all
    critic: bool = False  # whether it has a critic, which may be conditioned otherwise than the actor
    version: int = 1  # raised by 1 whenever the method changes, so that earlier results are refused


@typed_fields
@dataclass(frozen=True)
class OfflineRecipe:
    """The numbers of all methods."""

    reward: RewardName = "dense_cost"  # what values are of
    n_steps: Count = 10  # of the values' targets
    gamma: Probability = 0.99  # of these
    expectile: Probability = 0.7  # of the value
    beta: Scale = 2.0  # of the weights by advantage, as for :class:`AdvantageWeightedLoss`
    max_weight: Scale = 20.0  # of these
    distance: Literal["l1", "l2"] = "l1"  # to what is imitated; the mean of open and close would half open the gripper
    temperature: Scale = 3.0  # of IQL's actor
    alpha: Scale = 2.5  # of TD3+BC, the weight of the value beside the imitation
    alpha_l1: Scale = 1.0  # of TD3+BC and CQL with imitation by l1, the weight of values in deviations of their task
    cql_weight: Scale = 1.0  # of CQL's penalty
    steps: Count = 4000  # minibatches of every actor; of the value, ``value_steps``
    value_steps: Count = 4000
    batch_size: Count = 250  # rows of one
    width: Count = 256  # of hidden layers
    depth: Count = 3  # of actors
    critic_depth: Count = 2
    feature_noise: Scale = 0.05  # of actors while they train


@dataclass(frozen=True)
class OfflineTable:
    """Runs that are compared: the first row of a mixture with each of the others."""

    tasks: str  # a name of :data:`TASK_SETS`
    rows: Mapping[str, tuple[tuple[str, str, str], ...]]  # mixture to its rows, (method, actor, critic) each


def _table(tasks: str, runs: Sequence[Mapping[str, Any]]) -> OfflineTable:
    rows: dict[str, tuple[tuple[str, str, str], ...]] = {}
    for block in runs:
        own = tuple(product(block["methods"], block.get("actors", ["pcbc"]), block.get("critics", ["pcbc"])))
        rows |= {mixture: rows.get(mixture, ()) + own for mixture in block["mixtures"]}
    return OfflineTable(tasks, rows)


_TABLES = read_toml(Path(__file__).parent / "data" / "offline.toml", ValueError)
TASK_SETS = MappingProxyType({"MT10": MT10} | {name: tuple(tasks) for name, tasks in _TABLES["task_sets"].items()})
MIXTURES: Mapping[str, tuple[Portion, ...]] = MappingProxyType(
    {name: tuple(Portion(*portion) for portion in mixture.items()) for name, mixture in _TABLES["mixtures"].items()}
)
NOISE: Mapping[str, dict[str, Any]] = {one: _TABLES["noise"].get(one, _TABLES["noise"]["others"]) for one in BEHAVIOURS}
OFFLINE_METHODS: Mapping[str, OfflineMethod] = MappingProxyType(
    {
        name: OfflineMethod(name, **given | ({"keep": EpisodeFilter(**given["keep"])} if "keep" in given else {}))
        for name, given in _TABLES["methods"].items()
    }
)
OFFLINE_TABLES = MappingProxyType({name: _table(**given) for name, given in _TABLES["tables"].items()})
