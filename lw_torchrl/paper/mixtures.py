"""What data offline experiments see: mixtures of behaviours, as named, frozen settings, and the datasets they share."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

from lw_torchrl._files import held
from lw_torchrl.data.behaviours import BEHAVIOURS
from lw_torchrl.data.collect import collect_demonstrations
from lw_torchrl.language.tasks import MT10

TASK_SETS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "five": ("door-open", "drawer-open", "peg-insert-side", "pick-place", "push"),
        "MT10": MT10,
        "two": ("door-open", "drawer-open"),
    }
)
"""By name: five tasks of MT10, without those that chance solves; MT10 whole; and two, to see an experiment run."""

_SEEDS = 100  # of a behaviour's datasets: each begins its episodes elsewhere


@dataclass(frozen=True)
class Portion:
    """Episodes of one behaviour.

    Attributes:
        behaviour: a name of :data:`BEHAVIOURS`.
        episodes: of each task.
    """

    behaviour: str
    episodes: int


_WRONG, _RANDOM = Portion("wrong", 20), Portion("random", 10)
MIXTURES: Mapping[str, tuple[Portion, ...]] = MappingProxyType(
    {
        "B": (Portion("spoilt-30", 20), Portion("spoilt-60", 20), _WRONG, _RANDOM),
        "W": (Portion("spoilt-30", 20), _WRONG, _RANDOM),
        "C": (Portion("expert", 5), _WRONG, _RANDOM),
    }
)
"""What a policy learns from together, by name: B, plans spoilt a little and much, wrong skills, chance, and no expert;
W, the same without what is spoilt a little; C, five clean demonstrations of the expert among wrong skills and chance,
the hard case."""


@dataclass(frozen=True)
class BehaviourData:
    """The episodes of a portion in some tasks: a dataset, which mixtures share.

    Attributes:
        tasks: a name of :data:`TASK_SETS`.
        portion: whose, and how many.
        seed: of the experiment, from 0 to 99; other behaviours begin elsewhere.
        max_steps: of an episode.
    """

    tasks: str
    portion: Portion
    seed: int
    max_steps: int = 500

    @property
    def folder(self) -> Path:
        """Where it goes, below the experiments' folder."""
        return Path("data") / self.tasks / f"{self.portion.behaviour}-x{self.portion.episodes}-seed{self.seed}"

    def make(self, out: Path, progress: bool) -> None:
        """Collect it, or what is left; of several processes one does, and the others wait."""
        root = out / self.folder
        with held(root, "out", wait=True):
            collect_demonstrations(
                TASK_SETS[self.tasks],
                episodes_per_task=self.portion.episodes,
                root=root,
                policy=self.portion.behaviour,
                seed=_SEEDS * list(BEHAVIOURS).index(self.portion.behaviour) + self.seed,
                max_steps=self.max_steps,
                progress=progress,
                **NOISE[self.portion.behaviour],
            )


_LED_ASTRAY: dict[str, Any] = {"noise_scale": 0.3, "noise_hold": 10, "gripper_noise_factor": 0.5}
NOISE: Mapping[str, dict[str, Any]] = dict.fromkeys(BEHAVIOURS, _LED_ASTRAY) | {
    "expert": {"noise_scale": 0.0},
    "random": {"noise_scale": 0.1, "noise_hold": 10, "gripper_noise_factor": 1.0},
}
"""How each behaviour is executed: the expert as it is, chance with a little noise, scripts led astray."""
