"""How a unit of an experiment trains: one policy for all tasks, or one for each target."""

from __future__ import annotations

from collections.abc import Sequence
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
from lw_torchrl.trainers.checkpoint import Actor, Policy, load_actor, save_actor
from lw_torchrl.trainers.stacked import StackedBehavioralCloning

if TYPE_CHECKING:
    from lw_torchrl.trainers.experiments import Unit


def _make_actor(unit: Unit, plans: Plans, seed: int) -> Actor:
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
    out: Path,
    files: Sequence[Path],
    progress: bool,
) -> list[Policy]:
    """A policy for each file, where it is kept, of as many actors as the preset has members; all are trained together,
    each on a buffer of its own, the i-th with the i-th seed from 1000 times the unit's."""
    config = replace(config, seed=1_000 * unit.seed)
    actors = [_make_actor(unit, plans, config.seed + number) for number in range(len(replays))]
    checkpoint = out / unit.folder / "checkpoint.zip"
    StackedBehavioralCloning(actors, replays, config, checkpoint=checkpoint, progress=progress).train()
    members = unit.preset.members
    policies: list[Policy] = [*actors]
    if members > 1:
        policies = [ActorEnsemble(actors[first : first + members]) for first in range(0, len(actors), members)]
    for policy, file in zip(policies, files, strict=True):
        save_actor(policy, file)
    checkpoint.unlink()
    return policies


def train_one(unit: Unit, plans: Plans, out: Path, progress: bool) -> Policy:
    """One policy for all tasks, in ``checkpoint.zip``; with several members in ``policy.zip``, once they are done."""
    file = out / unit.folder / "policy.zip"
    if unit.preset.members > 1 and file.is_file():
        return load_actor(file)
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
    if unit.preset.members > 1:
        return _train_stack(unit, plans, replays, config, out, [file], progress)[0]
    actor = _make_actor(unit, plans, unit.seed)
    checkpoint = out / unit.folder / "checkpoint.zip"
    BehavioralCloningTrainer(actor, replays[0], config, checkpoint=checkpoint, progress=progress).train()
    return actor


def train_each(unit: Unit, plans: Plans, out: Path, progress: bool) -> dict[str, Policy]:
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
    files = list(models.values())
    return dict(zip(targets, _train_stack(unit, plans, replays, config, out, files, progress), strict=True))
