"""How a unit of an experiment trains: one policy for all tasks, or one for each target."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torchrl.data import TensorDictReplayBuffer

from lw_torchrl.data import CoLearningSampler, LanguageWorldExperienceReplay, TaskBalancedSampler
from lw_torchrl.envs import QAFTransform
from lw_torchrl.language.plans import Plans
from lw_torchrl.language.tasks import MT50, resolve_tasks
from lw_torchrl.modules import ActorEnsemble, DescriptorConditionedActor, PlanConditionedActor
from lw_torchrl.trainers.behavioral_cloning import BehavioralCloningConfig, BehavioralCloningTrainer
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


def _train_stack(
    unit: Unit,
    plans: Plans,
    replays: Sequence[TensorDictReplayBuffer],
    config: BehavioralCloningConfig,
    checkpoint: Path,
    progress: bool,
) -> list[Trained] | list[ActorEnsemble]:
    """An actor for each buffer, all trained together; the i-th has the i-th seed from 1000 times the unit's."""
    config = replace(config, seed=1_000 * unit.seed)
    actors = [_make_actor(unit, plans, config.seed + number) for number in range(len(replays))]
    StackedBehavioralCloning(actors, replays, config, checkpoint=checkpoint, progress=progress).train()
    members = unit.preset.members
    if members == 1:
        return actors
    return [ActorEnsemble(actors[first : first + members]) for first in range(0, len(actors), members)]


def train_one(unit: Unit, plans: Plans, out: Path, progress: bool) -> Trained | ActorEnsemble:
    """One policy for all tasks, in ``checkpoint.zip``; with several members in ``policy.zip``, once they are done."""
    replays = [
        LanguageWorldExperienceReplay(
            out / unit.datasets[0].folder,
            sampler=TaskBalancedSampler(),
            transform=_transform(unit, plans),
            after_success=unit.preset.after_success,
        )
        for _ in range(unit.preset.members)
    ]
    config = replace(unit.preset.training, seed=unit.seed)
    if unit.preset.passes is not None:
        config = replace(config, steps=max(1, unit.preset.passes * len(replays[0]) // config.batch_size))
    checkpoint, policy = out / unit.folder / "checkpoint.zip", out / unit.folder / "policy.zip"
    if len(replays) == 1:
        actor = _make_actor(unit, plans, unit.seed)
        BehavioralCloningTrainer(actor, replays[0], config, checkpoint=checkpoint, progress=progress).train()
        return actor
    if policy.is_file():
        return load_actor(policy)
    ensemble = _train_stack(unit, plans, replays, config, checkpoint, progress)[0]
    save_actor(ensemble, policy)
    checkpoint.unlink()
    return ensemble


def train_each(unit: Unit, plans: Plans, out: Path, progress: bool) -> Mapping[str, Trained | ActorEnsemble]:
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
        for _ in range(unit.preset.members)
    ]
    config = unit.preset.training
    if unit.preset.passes is not None:  # over the base tasks, which have half of each minibatch
        base = LanguageWorldExperienceReplay(roots[0], after_success=unit.preset.after_success)
        config = replace(config, steps=max(1, 2 * unit.preset.passes * len(base) // config.batch_size))
    checkpoint = out / unit.folder / "checkpoint.zip"
    policies = dict(zip(targets, _train_stack(unit, plans, replays, config, checkpoint, progress), strict=True))
    for target, policy in policies.items():
        save_actor(policy, models[target])
    checkpoint.unlink()
    return policies
