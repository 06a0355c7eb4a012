"""How a unit of an experiment trains: one policy for all tasks, or one for each target."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from lw_torchrl.data import CoLearningSampler, LanguageWorldExperienceReplay, TaskBalancedSampler
from lw_torchrl.envs import QAFTransform
from lw_torchrl.language.plans import Plans
from lw_torchrl.language.tasks import MT50, resolve_tasks
from lw_torchrl.modules import DescriptorConditionedActor, PlanConditionedActor
from lw_torchrl.trainers.behavioral_cloning import BehavioralCloningTrainer
from lw_torchrl.trainers.checkpoint import load_actor, save_actor
from lw_torchrl.trainers.stacked import StackedBehavioralCloning

if TYPE_CHECKING:
    from lw_torchrl.trainers.experiments import Unit

Trained = PlanConditionedActor | DescriptorConditionedActor


def _make_actor(unit: Unit, plans: Plans, seed: int) -> Trained:
    torch.manual_seed(seed)
    if unit.method == "pcbc":
        return PlanConditionedActor(plans, **unit.actor_options)
    condition: Any = "description" if unit.method == "dc" else "one-hot"
    return DescriptorConditionedActor(MT50, condition=condition, **unit.actor_options)


def _transform(unit: Unit, plans: Plans) -> QAFTransform | None:
    return QAFTransform(plans) if unit.method == "pcbc" else None


def train_one(unit: Unit, plans: Plans, out: Path, progress: bool) -> Trained:
    """One policy for all tasks; training carries on from its checkpoint."""
    replay = LanguageWorldExperienceReplay(
        out / unit.datasets[0].folder,
        sampler=TaskBalancedSampler(),
        transform=_transform(unit, plans),
        after_success=unit.preset.after_success,
    )
    config = replace(unit.preset.training, seed=unit.seed)
    if unit.preset.passes is not None:
        config = replace(config, steps=max(1, unit.preset.passes * len(replay) // config.batch_size))
    actor = _make_actor(unit, plans, unit.seed)
    checkpoint = out / unit.folder / "checkpoint.zip"
    BehavioralCloningTrainer(actor, replay, config, checkpoint=checkpoint, progress=progress).train()
    return actor


def train_each(unit: Unit, plans: Plans, out: Path, progress: bool) -> dict[str, Trained]:
    """A policy for each target, all trained together; ``models/<target>.zip`` holds each, once they are done."""
    targets = resolve_tasks(unit.setting.targets or ())
    models = {target: out / unit.folder / "models" / f"{target}.zip" for target in targets}
    if all(path.is_file() for path in models.values()):
        return {target: load_actor(path) for target, path in models.items()}
    roots = [out / dataset.folder for dataset in unit.datasets]
    replays = [
        LanguageWorldExperienceReplay(
            roots,
            episodes=[None, {target: 1}],
            sampler=CoLearningSampler(target),
            transform=_transform(unit, plans),
            after_success=unit.preset.after_success,
        )
        for target in targets
    ]
    config = replace(unit.preset.training, seed=1_000 * unit.seed)  # the i-th model has the i-th seed from here
    if unit.preset.passes is not None:  # over the base tasks, which have half of each minibatch
        base = LanguageWorldExperienceReplay(roots[0], after_success=unit.preset.after_success)
        config = replace(config, steps=max(1, 2 * unit.preset.passes * len(base) // config.batch_size))
    actors = [_make_actor(unit, plans, config.seed + number) for number in range(len(targets))]
    checkpoint = out / unit.folder / "checkpoint.zip"
    StackedBehavioralCloning(actors, replays, config, checkpoint=checkpoint, progress=progress).train()
    for actor, path in zip(actors, models.values(), strict=True):
        save_actor(actor, path)
    checkpoint.unlink()
    return dict(zip(targets, actors, strict=True))
