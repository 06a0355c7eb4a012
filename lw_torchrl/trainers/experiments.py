"""The paper's experiments: what data a setting has, how a preset trains, and the units of work that they make."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import torch

from lw_torchrl._checks import check_choice
from lw_torchrl.data import LanguageWorldExperienceReplay, TaskBalancedSampler, collect_demonstrations
from lw_torchrl.envs import QAFTransform
from lw_torchrl.evaluation import EvaluationResult, evaluate
from lw_torchrl.language.plans import Plans
from lw_torchrl.language.tasks import MT50, resolve_tasks
from lw_torchrl.modules import DescriptorConditionedActor, PlanConditionedActor, ScriptedSkillActor
from lw_torchrl.trainers.behavioral_cloning import BehavioralCloningConfig, BehavioralCloningTrainer

METHODS = ("pcbc", "dc", "one-hot", "scripted")
EVALUATION_SEED = 10_000
"""Training seeds count from 0; the evaluation of training seed k has seed 10000 + k."""


@dataclass(frozen=True)
class DataSetting:
    """What demonstrations an experiment may see.

    Attributes:
        name: "zero-shot", "few-shot".
        base: the tasks demonstrated, "MT10" or "MT50".
        episodes: demonstrations of each.
    """

    name: str
    base: str
    episodes: int


SETTINGS: Mapping[str, DataSetting] = MappingProxyType(
    {setting.name: setting for setting in (DataSetting("zero-shot", "MT10", 100), DataSetting("few-shot", "MT50", 10))}
)
"""Source: paper, the table of data configurations."""


@dataclass(frozen=True)
class Preset:
    """How demonstrations are made and policies trained, the same for every method, task and setting.

    Attributes:
        name: "strong", ours; "paper", the published recipe.
        noise_scale: execution noise of the demonstrations, gone through in turn.
        noise_hold: steps for which each draw is kept.
        redraw_failures: keep successful demonstrations only.
        after_success: drop what comes so many steps after the first success; None keeps all.
        passes: train for so many passes over the rows instead of ``training.steps`` minibatches.
        actor: options of the actors.
        training: of the optimizer.
    """

    name: str
    noise_scale: tuple[float, ...]
    noise_hold: int
    redraw_failures: bool
    after_success: int | None
    passes: int | None
    actor: Mapping[str, Any] = field(hash=False)
    training: BehavioralCloningConfig


PRESETS: Mapping[str, Preset] = MappingProxyType(
    {
        "strong": Preset(
            "strong",
            noise_scale=(0.0, 0.1, 0.2, 0.3, 0.4),
            noise_hold=10,
            redraw_failures=True,
            after_success=20,
            passes=None,
            actor=MappingProxyType({"features": "differences", "width": 512}),
            training=BehavioralCloningConfig(steps=12_000, batch_size=500),
        ),
        "paper": Preset(
            "paper",
            noise_scale=(0.0,),
            noise_hold=1,
            redraw_failures=False,
            after_success=None,
            passes=500,
            actor=MappingProxyType(
                {
                    "features": "raw",
                    "feature_noise": 0.0,
                    "encoder_width": 64,
                    "encoder_depth": 3,
                    "width": (128, 128, 128, 64, 32),
                }
            ),
            training=BehavioralCloningConfig(
                batch_size=200,
                learning_rate=1e-5,
                optimizer="sgd",
                momentum=0.995,
                weight_decay=0.0,
                schedule="constant",
                normalize=False,
                max_grad_norm=1e9,
            ),
        ),
    }
)


@dataclass(frozen=True)
class Unit:
    """One policy, or plans with scripts, of one training seed: what a scheduler runs.

    Attributes:
        setting: one of :data:`SETTINGS`.
        method: one of :data:`METHODS`.
        seed: of demonstrations, initial weights and minibatches.
        preset: how to train.
        episodes: evaluated for each task.
    """

    setting: DataSetting
    method: str
    seed: int
    preset: Preset
    episodes: int = 20

    def __post_init__(self) -> None:
        check_choice("method", self.method, METHODS)

    @property
    def folder(self) -> Path:
        """Where its files go, below the experiment's folder."""
        return Path(self.setting.name) / self.preset.name / self.method / f"seed{self.seed}"

    @property
    def data(self) -> Path:
        """The folder of its demonstrations, which the methods share."""
        return Path("demonstrations") / f"{self.setting.name}-{self.preset.name}-seed{self.seed}"


def _train(unit: Unit, plans: Plans, out: Path, progress: bool) -> PlanConditionedActor | DescriptorConditionedActor:
    """Collect, then train or carry on, from whatever is there."""
    setting, preset = unit.setting, unit.preset
    collect_demonstrations(
        setting.base,
        episodes_per_task=setting.episodes,
        root=out / unit.data,
        seed=unit.seed,
        noise_scale=preset.noise_scale,
        noise_hold=preset.noise_hold,
        redraw_failures=preset.redraw_failures,
        progress=progress,
    )
    replay = LanguageWorldExperienceReplay(
        out / unit.data,
        sampler=TaskBalancedSampler(),
        transform=QAFTransform(plans) if unit.method == "pcbc" else None,
        after_success=preset.after_success,
    )
    config = replace(preset.training, seed=unit.seed)
    if preset.passes is not None:
        config = replace(
            config, steps=max(1, preset.passes * len(replay) // config.batch_size), checkpoint_every=10_000
        )
    torch.manual_seed(unit.seed)
    actor: PlanConditionedActor | DescriptorConditionedActor
    if unit.method == "pcbc":
        actor = PlanConditionedActor(plans, **preset.actor)
    else:
        condition = "description" if unit.method == "dc" else "one-hot"
        actor = DescriptorConditionedActor(MT50, condition=condition, **preset.actor)  # type: ignore[arg-type]
    checkpoint = out / unit.folder / "checkpoint.zip"
    BehavioralCloningTrainer(actor, replay, config, checkpoint=checkpoint, progress=progress).train()
    return actor


def run_unit(
    unit: Unit,
    plans: Plans,
    out: Path,
    *,
    tasks: str | Sequence[str] = "MT50",
    progress: bool = True,
) -> EvaluationResult:
    """Do a unit, or what is left of it; its result is written last, to ``out/unit.folder/results.json``.

    Args:
        unit: what to do.
        plans: a plan for each of the 50 tasks.
        out: the experiment's folder.
        tasks: to evaluate.
        progress: show progress bars.

    Returns:
        The evaluation of the last checkpoint, action noise 0.1.

    Raises:
        ValueError: ``out`` holds the same unit of another configuration.

    Source: paper section 'Conditional Plan Experiments'.
    """
    path = out / unit.folder / "results.json"
    if path.is_file():
        return EvaluationResult.load(path)
    actor: Any = ScriptedSkillActor(plans) if unit.method == "scripted" else _train(unit, plans, out, progress)
    result = evaluate(
        actor,
        tasks=resolve_tasks(tasks),
        episodes_per_task=unit.episodes,
        seed=EVALUATION_SEED + unit.seed,
        noise_scale=0.1,
        stop_at_success=True,
        progress=progress,
    )
    result.save(path)
    return result
