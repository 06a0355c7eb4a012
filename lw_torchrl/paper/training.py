"""How a run of an experiment trains: one policy for all tasks, or one for each target."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torchrl.envs import Compose, Transform

from lw_torchrl._devices import CPU
from lw_torchrl.data import CoLearningSampler, LanguageWorldExperienceReplay, TaskBalancedSampler
from lw_torchrl.language.plans import Plans
from lw_torchrl.language.tasks import resolve_tasks
from lw_torchrl.language.text import TextEncoder
from lw_torchrl.modules import ActorEnsemble
from lw_torchrl.modules.policy import Policy, make_policy
from lw_torchrl.paper.recipes import Member
from lw_torchrl.paper.runs import Run
from lw_torchrl.training.behavioral_cloning import BehavioralCloningConfig, BehavioralCloningTrainer
from lw_torchrl.training.envelope import check_description
from lw_torchrl.training.files import describe_data, load_actor, save_actor
from lw_torchrl.training.stacked import StackedBehavioralCloning
from lw_torchrl.transforms import RandomYaw


def _make_actor(run: Run, member: Member, plans: Plans, seed: int, text_encoder: TextEncoder | None) -> Policy:
    torch.manual_seed(seed)
    return make_policy(run.method, plans, text_encoder=text_encoder, **run.actor_options(member))


def _transform(run: Run, actor: Policy, member: Member) -> Transform:
    queries = actor.transform()
    turned = RandomYaw(member.yaw, plans=actor.plans if run.any_yaw(member) else None)
    return Compose(*([] if queries is None else [queries]), *([turned] if member.yaw else []))


def _config(run: Run, rows: int, seed: int) -> BehavioralCloningConfig:
    """The preset's, with as many steps as its passes over so many rows take, where it counts passes."""
    config, passes = run.preset.training, run.preset.passes
    steps = config.steps if passes is None else max(1, passes * rows // config.batch_size)
    return replace(config, steps=steps, seed=seed)


def _keep(
    described: dict[str, Any], actors: Sequence[Policy], file: Path, replay: LanguageWorldExperienceReplay
) -> Policy:
    policy = actors[0] if len(actors) == 1 else ActorEnsemble(actors)
    save_actor(policy, file, data=describe_data(replay), run=described)
    return policy


def _forget_checkpoints(folder: Path) -> None:
    for checkpoint in folder.glob("checkpoint-*.zip"):
        checkpoint.unlink()


Look = Callable[[dict[str, Policy] | Policy, int], None]
"""Called in the midst of training with what is trained, and the steps that were made."""


def _train(
    trainer: BehavioralCloningTrainer | StackedBehavioralCloning,
    run: Run,
    policy: dict[str, Policy] | Policy,
    look: Look,
) -> None:
    for step in run.preset.evaluated_before(trainer.config.steps):
        if trainer.steps <= step:
            trainer.train(until=step)
            look(policy, step)
    trainer.train()


def _kept(described: dict[str, Any], file: Path, text_encoder: TextEncoder | None) -> Policy:
    check_description(file, {"run": described})
    return load_actor(file, text_encoder=text_encoder)


def train_one(
    run: Run,
    plans: Plans,
    out: Path,
    progress: bool,
    look: Look,
    text_encoder: TextEncoder | None = None,
    device: torch.device = CPU,
) -> Policy:
    """One policy for all tasks, kept in ``policy.zip``; until all its members are done, each has a checkpoint."""
    folder, described = out / run.folder, run.describe(plans)
    file = folder / "policy.zip"
    if file.is_file():
        policy = _kept(described, file, text_encoder)
        _forget_checkpoints(folder)
        return policy
    actors = []
    for number, member in enumerate(run.preset.members):
        replay = LanguageWorldExperienceReplay(
            out / run.datasets[0].folder,
            sampler=TaskBalancedSampler(),
            label=run.preset.label,
            after_success=run.preset.after_success,
            device=device,
        )
        config = _config(run, len(replay), run.seed + 1_000 * number)
        actors.append(_make_actor(run, member, plans, config.seed, text_encoder))
        replay.append_transform(_transform(run, actors[-1], member))
        checkpoint = folder / f"checkpoint-{number}.zip"
        options: dict[str, Any] = {"checkpoint": checkpoint, "progress": progress, "device": device}
        _train(BehavioralCloningTrainer(actors[-1], replay, config, **options), run, actors[-1], look)
    policy = _keep(described, actors, file, replay)
    _forget_checkpoints(folder)
    return policy


def train_each(
    run: Run,
    plans: Plans,
    out: Path,
    progress: bool,
    look: Look,
    text_encoder: TextEncoder | None = None,
    device: torch.device = CPU,
) -> dict[str, Policy]:
    """A policy for each target, kept in ``models/<target>.zip``; all are trained together, member by member.

    The i-th target's seed is the i-th from 1000 times the run's; the next member's follow.
    """
    folder, described = out / run.folder, run.describe(plans)
    targets = resolve_tasks(run.setting.targets or ())
    files = {target: folder / "models" / f"{target}.zip" for target in targets}
    if all(file.is_file() for file in files.values()):
        policies = {target: _kept(described, file, text_encoder) for target, file in files.items()}
        _forget_checkpoints(folder)
        return policies
    roots = [out / dataset.folder for dataset in run.datasets]
    rows = 0
    if run.preset.passes is not None:  # over the base tasks, which have half of each minibatch
        rows = 2 * len(LanguageWorldExperienceReplay(roots[0], after_success=run.preset.after_success))
    members = []
    for number, member in enumerate(run.preset.members):
        config = _config(run, rows, 1_000 * run.seed + len(targets) * number)
        actors = [_make_actor(run, member, plans, config.seed + i, text_encoder) for i in range(len(targets))]
        replays = [
            LanguageWorldExperienceReplay(
                roots,
                episodes=[None, {target: 1}],
                sampler=CoLearningSampler(target),
                transform=_transform(run, actor, member),
                label=run.preset.label,
                after_success=run.preset.after_success,
                device=device,
            )
            for target, actor in zip(targets, actors, strict=True)
        ]
        members.append(actors)
        checkpoint = folder / f"checkpoint-{number}.zip"
        options: dict[str, Any] = {"checkpoint": checkpoint, "progress": progress, "device": device}
        stack = StackedBehavioralCloning(actors, replays, config, **options)
        _train(stack, run, dict(zip(targets, actors, strict=True)), look)
    policies = {
        target: _keep(described, each, files[target], replay)
        for target, replay, *each in zip(targets, replays, *members, strict=True)
    }
    _forget_checkpoints(folder)
    return policies
