"""Offline experiments as runs of work: the advantages of a mixture's rows, and policies learned from it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from lw_torchrl._checks import check_choice
from lw_torchrl.language.plans import Plans
from lw_torchrl.modules.policy import METHODS
from lw_torchrl.paper.mixtures import MIXTURES, NOISE, TASK_SETS, BehaviourData
from lw_torchrl.paper.offline_recipes import OFFLINE_METHODS, OfflineMethod, OfflineRecipe
from lw_torchrl.paper.runs import own_tasks, plain


@dataclass(frozen=True)
class Learned:
    """What an experiment learns of a mixture.

    Attributes:
        tasks: a name of :data:`TASK_SETS`.
        mixture: a name of :data:`MIXTURES`.
        seed: of the data, the initial weights and the minibatches.
        recipe: the numbers.
        max_steps: of an episode.
    """

    tasks: str
    mixture: str
    seed: int
    recipe: OfflineRecipe = field(default_factory=OfflineRecipe)
    max_steps: int = 500

    def __post_init__(self) -> None:
        check_choice("tasks", self.tasks, TASK_SETS)
        check_choice("mixture", self.mixture, MIXTURES)
        if not 0 <= self.seed < 100:
            raise ValueError(f"seed must be from 0 to 99, got {self.seed}")

    @property
    def group(self) -> Path:
        """The folder of all that is learned of the same mixture in the same tasks."""
        return Path(self.tasks) / self.mixture

    @property
    def datasets(self) -> tuple[BehaviourData, ...]:
        """What it learns from."""
        portions = MIXTURES[self.mixture]
        return tuple(BehaviourData(self.tasks, portion, self.seed, self.max_steps) for portion in portions)

    def own_plans(self, plans: Plans) -> Plans:
        """The plans of its tasks."""
        return Plans([plans[task] for task in TASK_SETS[self.tasks]])

    def describe(self, plans: Plans) -> dict[str, Any]:
        """Everything that it hangs on, as JSON."""
        data = [asdict(dataset.portion) | NOISE[dataset.portion.behaviour] for dataset in self.datasets]
        own = self.own_plans(plans)
        return plain(asdict(self) | {"plans": own.fingerprint, "data": data} | own_tasks(own))


@dataclass(frozen=True)
class Advantages(Learned):
    """The advantage of each row of a mixture, by a value that is learned of it.

    Attributes:
        critic: what the value is conditioned on, a name of :data:`METHODS`.
    """

    critic: str = "pcbc"

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choice("critic", self.critic, METHODS)

    @property
    def folder(self) -> Path:
        """Where its files go, below the experiments' folder."""
        return self.group / "advantages" / SEEN_BY[self.critic] / f"seed{self.seed}"


@dataclass(frozen=True)
class OfflineRun(Learned):
    """A policy learned of a mixture, and its evaluation: what a scheduler runs.

    Attributes:
        method: a name of :data:`OFFLINE_METHODS`.
        actor: what the policy is conditioned on, a name of :data:`METHODS`.
        critic: what its critic is conditioned on, where it has one.
        episodes: evaluated for each task.
    """

    method: str = "advantage"
    actor: str = "pcbc"
    critic: str = "pcbc"
    episodes: int = 20

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choice("method", self.method, OFFLINE_METHODS)
        for name in ("actor", "critic"):
            check_choice(name, getattr(self, name), METHODS)

    @property
    def how(self) -> OfflineMethod:
        """Its method."""
        return OFFLINE_METHODS[self.method]

    @property
    def label(self) -> str:
        """Its method and what its networks are conditioned on: its name in tables."""
        if not self.how.critic or self.critic == self.actor:
            return f"{self.method}, {SEEN_BY[self.actor]}"
        return f"{self.method}, {SEEN_BY[self.actor]}, critic {SEEN_BY[self.critic]}"

    @property
    def folder(self) -> Path:
        """Where its files go, below the experiments' folder."""
        return self.group / self.label.replace(", ", "-").replace(" ", "-") / f"seed{self.seed}"

    @property
    def advantages(self) -> Advantages | None:
        """What it weighs rows by, if it does."""
        if self.how.loss != "advantage":
            return None
        return Advantages(self.tasks, self.mixture, self.seed, self.recipe, self.max_steps, self.critic)

    def describe(self, plans: Plans) -> dict[str, Any]:
        without = {"episodes"} if self.how.critic else {"episodes", "critic"}
        described = {key: value for key, value in super().describe(plans).items() if key not in without}
        return described | {"how": plain(asdict(self.how))}


SEEN_BY: Mapping[str, str] = {"pcbc": "plan", "dc": "description", "one-hot": "one-hot"}
"""The names of ways to condition in tables and folders."""
