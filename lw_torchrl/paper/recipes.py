"""The paper's experiments as frozen configurations: what data each may see, and how presets make and use it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.resources import files
from types import MappingProxyType
from typing import Any

from lw_torchrl._files import read_toml
from lw_torchrl.data.selection import Label
from lw_torchrl.training.behavioral_cloning import BehavioralCloningConfig


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
    """One of the actors whose actions a policy averages."""

    actor: Mapping[str, Any] = field(hash=False)  # its options
    plan_actor: Mapping[str, Any] = field(default_factory=dict, hash=False)  # more, of those that read plans
    yaw: float = 0.0  # scale of :class:`RandomYaw` on its demonstrations, in radians
    any_yaw: bool = False  # with plans, turn rows by any angle if their steps in force say no direction

    def __post_init__(self) -> None:
        for name in ("actor", "plan_actor"):  # a frozen recipe's options are read-only, too
            object.__setattr__(self, name, MappingProxyType(_tuples(getattr(self, name))))


@dataclass(frozen=True)
class Preset:
    """How demonstrations are made and policies trained in a setting, the same for every method and task."""

    name: str  # "strong", ours; "paper", the published recipe; "evaluator", ours with a query evaluator inside
    base: Execution  # how the base tasks are demonstrated
    label: Label  # which of the expert's actions is imitated, as for :class:`LanguageWorldExperienceReplay`
    members: tuple[Member, ...]  # the actors of a policy, each trained by itself on the same demonstrations
    training: BehavioralCloningConfig  # of the optimizer
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
    given["members"] = tuple(_MEMBERS[member] for member in given["members"])
    given["training"] = BehavioralCloningConfig(**{**every.get("training", {}), **own["training"]})
    return Preset(**given)


_TABLE = read_toml(files("lw_torchrl.paper") / "data" / "recipes.toml", ValueError)
SETTINGS: Mapping[str, DataSetting] = MappingProxyType(
    {name: DataSetting(name, **setting) for name, setting in _TABLE["settings"].items()}
)
EXECUTIONS = {name: Execution(name, **_tuples(execution)) for name, execution in _TABLE["executions"].items()}
TARGET = EXECUTIONS["target"]
_MEMBERS = {name: Member(**member) for name, member in _TABLE["members"].items()}
PRESETS: Mapping[str, Mapping[str, Preset]] = MappingProxyType(
    {
        name: {key: _preset(name, settings["every"], own) for key, own in settings.items() if key != "every"}
        for name, settings in _TABLE["presets"].items()
    }
)
"""Preset's name, then setting's name, to :class:`Preset`."""
