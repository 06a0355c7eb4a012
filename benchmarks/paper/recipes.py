"""The configurations of the paper's and the offline experiments, read from the tables in data/."""

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
    """The demonstrations that a setting provides. Without targets, one policy learns all base tasks."""

    name: str  # "zero-shot", "few-shot" or "one-shot"
    base: str  # the demonstrated tasks, "MT10" or "MT50"
    episodes: int  # demonstrations of each base task
    targets: str | None = None  # tasks with one demonstration and one policy each, trained together with the base tasks


@dataclass(frozen=True)
class Execution:
    """A way to run experts: a name for datasets, and options of :func:`~lw_torchrl.collect_demonstrations`."""

    name: str
    noise_scale: tuple[float, ...]
    noise_hold: int = 1
    redraw_failures: bool = False


@dataclass(frozen=True)
class Member:
    """One of the actors whose actions a policy averages, described by fields of :class:`Parts`."""

    parts: Mapping[str, Any] = field(default_factory=dict, hash=False)  # fields for every method
    plan_parts: Mapping[str, Any] = field(default_factory=dict, hash=False)  # additional fields for methods with plans

    def __post_init__(self) -> None:
        for name in ("parts", "plan_parts"):  # a frozen recipe's options are read-only, too
            object.__setattr__(self, name, MappingProxyType(_tuples(getattr(self, name))))

    def of(self, method: str) -> Parts:
        """Return the parts of an actor of a method."""
        return Parts(**{**self.parts, **(self.plan_parts if reads_plans(method) else {})})


@dataclass(frozen=True)
class Preset:
    """A recipe for demonstrations and training in a setting, the same for every method and task."""

    name: str  # "strong" (ours), "paper" (as published), or the ablations "one-network", "no-roles" and "evaluator"
    base: Execution  # how experts demonstrate the base tasks
    label: Label  # the action to imitate, as for :class:`LanguageWorldExperienceReplay`
    members: tuple[Member, ...]  # the actors of a policy, trained separately on the same demonstrations
    training: BehavioralCloningConfig  # hyperparameters of the training
    demonstrated: tuple[
        Member, ...
    ] = ()  # for methods with plans: description-conditioned actors for demonstrated tasks
    target: Execution | None = None  # how an expert demonstrates a target task once, if the setting has targets
    after_success: int | None = None  # drop rows more than N steps after the first success; None keeps all rows
    passes: int | None = None  # number of passes over the rows, instead of ``training.steps`` minibatches
    evaluations: int = 1  # number of evaluations, a 25th of the training apart, the last at the end

    def __post_init__(self) -> None:
        if self.evaluations > 1 and len(self.members) > 1:
            raise ValueError(f"evaluations must be 1 with {len(self.members)} members, got {self.evaluations}")

    def evaluated_before(self, steps: int) -> list[int]:
        """Return the steps after which to evaluate a policy before its training ends."""
        return sorted({steps - k * steps // 25 for k in range(1, self.evaluations)} - {steps})


def _tuples(options: Mapping[str, Any]) -> dict[str, Any]:
    return {key: tuple(value) if isinstance(value, list) else value for key, value in options.items()}


def _preset(name: str, every: Mapping[str, Any], own: Mapping[str, Any]) -> Preset:
    """Return a preset for a setting, whose ``own`` table extends the table for ``every`` setting."""
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
"""The presets by name, then by the setting's name."""


@dataclass(frozen=True)
class Portion:
    """A portion of a mixture: a number of episodes of one behaviour."""

    behaviour: str  # a name of :data:`BEHAVIOURS`
    episodes: int  # number of episodes per task


@dataclass(frozen=True)
class OfflineMethod:
    """A method to learn a policy from a mixture."""

    name: str  # the method's name in folders and tables
    loss: str  # a name of :data:`benchmarks.paper.offline.DISTRIBUTIONS`
    keep: EpisodeFilter | None = None  # the episodes to learn from; None for all
    critic: bool = False  # whether there is a critic, whose conditioning may differ from the actor's
    version: int = 1  # increased by 1 whenever the method changes, so that earlier results are rejected


@typed_fields
@dataclass(frozen=True)
class OfflineRecipe:
    """The hyperparameters of all methods."""

    reward: RewardName = "dense_cost"  # reward for learning values
    n_steps: Count = 10  # number of time steps in value targets
    gamma: Probability = 0.99  # discount factor of value targets
    expectile: Probability = 0.7  # expectile of the value
    beta: Scale = 2.0  # inverse temperature of the advantage weights, see :class:`AdvantageWeightedLoss`
    max_weight: Scale = 20.0  # maximum advantage weight
    distance: Literal["l1", "l2"] = "l1"  # imitation distance; l2 averages open and close to a half-open gripper
    temperature: Scale = 3.0  # inverse temperature of IQL's actor
    alpha: Scale = 2.5  # weight of the value in TD3+BC
    alpha_l1: Scale = 1.0  # weight of standardized values in TD3+BC and CQL with l1 imitation
    cql_weight: Scale = 1.0  # weight of CQL's penalty
    steps: Count = 4000  # minibatches for each actor; ``value_steps`` is for the value
    value_steps: Count = 4000
    batch_size: Count = 250  # rows per minibatch
    width: Count = 256  # units per hidden layer
    depth: Count = 3  # hidden layers of actors
    critic_depth: Count = 2
    feature_noise: Scale = 0.05  # feature noise of actors during training


@dataclass(frozen=True)
class OfflineTable:
    """A table of runs, in which the first row of a mixture is compared with each of the others."""

    tasks: str  # a name of :data:`TASK_SETS`
    rows: Mapping[str, tuple[tuple[str, str, str], ...]]  # the rows (method, actor, critic) of each mixture


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
