"""StackedBehavioralCloning: many actors of one architecture trained at once, their parameters stacked."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from hashlib import sha256
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.func import functional_call, stack_module_state, vmap
from torchrl.data import TensorDictReplayBuffer
from torchrl.objectives.utils import distance_loss

from lw_torchrl._checks import checked
from lw_torchrl._devices import CPU, drawn_on, place
from lw_torchrl._progress import Progress
from lw_torchrl.modules.policy import Policy
from lw_torchrl.training.checkpoint import describe_data, describe_replay, write
from lw_torchrl.training.config import BehavioralCloningConfig, last_step, make_optimizer
from lw_torchrl.training.interrupts import interrupts_between_steps
from lw_torchrl.training.latent_terms import LatentTerms
from lw_torchrl.training.minibatches import check_replay, draw_batch, verify_rows
from lw_torchrl.training.normalization import check_contacts, fit_normalization
from lw_torchrl.training.policy_checks import check_can_be_saved, check_trained
from lw_torchrl.training.recent_losses import READ_EVERY, RecentLosses
from lw_torchrl.training.training_state import (
    OneWriter,
    TrainingState,
    check_description,
    load_state,
    load_training,
    state_of,
    warn_of_another_device,
    where,
)


class _Act(nn.Module):
    """``functional_call`` calls a module's forward: this one's is the actor's ``act``."""

    def __init__(self, actor: Any) -> None:
        super().__init__()
        self.actor = actor

    def forward(self, *prepared: Tensor) -> Tensor:
        return self.actor.act(*prepared)[0]


def _fingerprint(actor: Policy) -> str:
    """16 signs that differ for actors of other descriptions: plans, tasks, options."""
    return sha256(json.dumps(actor.describe(), sort_keys=True).encode()).hexdigest()[:16]


def _architecture(actor: Policy) -> dict[str, Any]:
    found = actor.describe()
    return {"kind": found["kind"], "evaluator": found.get("evaluator"), **found["options"]}


def _check_actors(actors: Sequence[Policy]) -> None:
    """Raise :class:`ValueError` unless the actors differ in their weights, plans and tasks alone."""
    first, *others = map(_architecture, actors)
    for number, other in enumerate(others, 1):
        if names := [name for name in {**first, **other} if first.get(name) != other.get(name)]:
            raise ValueError(f"actors must be of one architecture, 0 and {number} differ in {', '.join(names)}")
    weights = [id(parameter) for actor in actors for parameter in actor.parameters()]
    if len({*weights}) < len(weights):
        raise ValueError("actors must have weights of their own, some are the same or share theirs")


class StackedBehavioralCloning:
    """Trains M actors, each on batches of its own, as :class:`BehavioralCloningTrainer` trains one.

    Every product is done for all M at once. Each actor draws its batches, turns and feature noise from the seed that
    it would have alone, so its losses are those it would have alone, up to rounding.

    Args:
        actors: M policies, each with weights of its own, that differ in plans and tasks alone; they are trained in
            place.
        replays: M buffers, each with its sampler; the i-th actor's batches come from the i-th.
        config: how to train each; the i-th has the seed ``config.seed + i``.
        checkpoint: a file to write checkpoints to. If it is there already, training carries on from it.
        progress: show a progress bar.
        device: where to train, as for :class:`BehavioralCloningTrainer`; None for where the first actor is.

    Warns:
        UserWarning: the checkpoint was written under another version of torch or another package that bits hang on: it
            goes on, but not bit for bit.

    Raises:
        ValueError: not as many buffers as actors, one twice, or actors of different options; a checkpoint that is
            damaged, or of other actors, data or another configuration; in :meth:`train`, a loss or weights that are no
            numbers.

    Example:
        >>> import lw_torchrl as lw, tempfile
        >>> plans = lw.load_plans("MT10")
        >>> with tempfile.TemporaryDirectory() as root:
        ...     _ = lw.collect_demonstrations("reach", episodes_per_task=1, root=root + "/demos", max_steps=80)
        ...     load = lambda: lw.LanguageWorldExperienceReplay(root + "/demos", transform=lw.QAFTransform(plans))
        ...     trainer = lw.training.StackedBehavioralCloning(
        ...         [lw.PlanConditionedActor(plans), lw.PlanConditionedActor(plans)],
        ...         [load(), load()],
        ...         lw.BehavioralCloningConfig(steps=5, batch_size=16),
        ...     )
        ...     trainer.train().shape
        torch.Size([2])

    Source: paper section 'Conditional Plan Experiments', which trains 50 one-shot models; ``torch.func``.
    """

    @checked
    def __init__(
        self,
        actors: Sequence[Policy],
        replays: Sequence[TensorDictReplayBuffer],
        config: BehavioralCloningConfig | None = None,
        *,
        checkpoint: str | os.PathLike[str] | None = None,
        progress: bool = True,
        device: str | torch.device | None = None,
    ) -> None:
        self.config = config = config or BehavioralCloningConfig()
        if not actors or len(replays) != len(actors):
            raise ValueError(f"replays must be as many as actors, at least one, got {len(replays)} and {len(actors)}")
        self.actors, self.replays, self.progress = list(actors), list(replays), progress
        self.checkpoint = None if checkpoint is None else Path(checkpoint)
        self._writer = OneWriter(self.checkpoint)
        _check_actors(self.actors)
        if len({*map(id, replays)}) < len(replays) or len({id(one.sampler) for one in replays}) < len(replays):
            raise ValueError("replays must be different buffers, each with a sampler of its own")
        self.device = place(self.actors[0], device)
        for actor in self.actors[1:]:
            actor.to(self.device)
        of = [f"the loss of actor {number}" for number in range(len(self.actors))]
        self._losses = RecentLosses(tuple(of), config.learning_rate)
        self._described: dict[str, Any] = {}
        if self.checkpoint is not None:
            check_can_be_saved(self.actors[0])
            self._described = self._describe()
        self.states = []
        for number, (actor, replay) in enumerate(zip(actors, replays, strict=True)):
            check_replay(actor, replay, config.batch_size)
            self.states.append(TrainingState(replay, config.seed + number))
            if config.normalize:
                fit_normalization(actor, replay)
            else:
                check_contacts(actor)
            actor.train()
        modules: list[nn.Module] = [_Act(actor) for actor in actors]
        try:
            parameters, buffers = stack_module_state(modules)
        except RuntimeError as error:
            raise ValueError(f"actors must be of one architecture ({error})") from error
        self._parameters = {name: nn.Parameter(value.detach()) for name, value in parameters.items()}
        shared = modules[0]
        if config.qaf_anchor:
            raise ValueError("qaf_anchor is for BehavioralCloningTrainer, which trains one policy at a time")
        terms = LatentTerms(actors[0], config)
        self._latent_terms = vmap(lambda p, b: functional_call(terms, (p, b), ())) if terms.weights else None
        self._act = vmap(lambda p, b, prepared: functional_call(shared, (p, b), prepared))
        self._buffers = buffers
        self.optimizer, self.schedule = make_optimizer(list(self._parameters.values()), config)
        if self.checkpoint is not None and self.checkpoint.exists():
            verify_rows(*replays)
            check_description(self.checkpoint, self._described)
            warn_of_another_device(self.checkpoint, self.device)
            found = load_training(self.checkpoint, self.actors[0], self._parameters)
            load_state(self.checkpoint, found, self.optimizer, self.schedule, self.states, config.steps)

    def _describe(self) -> dict[str, Any]:
        return {
            "actor": self.actors[0].describe() | {"number": len(self.actors)},
            "actors": {str(number): _fingerprint(actor) for number, actor in enumerate(self.actors)},
            "training": self.config.describe(),
            "data": {str(number): describe_data(replay) for number, replay in enumerate(self.replays)},
            "replay": {str(number): describe_replay(replay) for number, replay in enumerate(self.replays)},
        }

    def save(self) -> None:
        """Write the checkpoint, if there is to be one; an earlier one is replaced whole.

        Raises:
            ValueError: the weights are no finite numbers.
        """
        check_trained(self._parameters, self.steps)
        if self.checkpoint is not None:
            state = state_of(self.optimizer, self.schedule, self.states)
            write(self.checkpoint, self._described | where(self.device), self.actors[0], self._parameters, state)
            self._writer.know()

    @property
    def steps(self) -> int:
        """How many minibatches each actor has been trained on."""
        return self.states[0].step

    def step(self) -> Tensor:
        """Train every actor on one minibatch and return their losses, (M,) float32, on the device."""
        prepared, targets = [], []
        for actor, replay, state in zip(self.actors, self.replays, self.states, strict=True):
            with drawn_on(self.device, state.torch_generator):
                batch = draw_batch(replay, self.config.batch_size, self.device)
                prepared.append(actor.prepare(batch))
                state.torch_generator = torch.get_rng_state()
            targets.append(batch.get("action"))
        inputs = tuple(torch.stack(column) for column in zip(*prepared, strict=True))
        actions = self._act(self._parameters, self._buffers, inputs)
        losses = distance_loss(actions, torch.stack(targets), self.config.loss_function).flatten(1).mean(1)
        if self._latent_terms is not None:
            losses = losses + self._latent_terms(self._parameters, self._buffers)
        if self.device == CPU:
            self._losses.check(losses, self.steps)
        self.optimizer.zero_grad()
        losses.sum().backward()
        self._clip()
        self.optimizer.step()
        self.schedule.step()
        for state in self.states:
            state.step += 1
        return losses.detach()

    def _clip(self) -> None:
        gradients = [p.grad for p in self._parameters.values() if p.grad is not None]
        norms = torch.stack([g.flatten(1).square().sum(1) for g in gradients]).sum(0).sqrt()
        factor = (self.config.max_grad_norm / (norms + 1e-6)).clamp(max=1.0)  # as clip_grad_norm_ does
        for gradient in gradients:
            gradient.mul_(factor.reshape(-1, *[1] * (gradient.ndim - 1)))

    def train(self, until: int | None = None) -> Tensor:
        """Train to the last step and give the actors their weights; Ctrl-C as in :class:`BehavioralCloningTrainer`.

        Args:
            until: end after so many steps in all, as there.

        Returns:
            (M,) float32, each actor's mean loss over the last 100 steps made; NaN if there were none left to make.
        """
        losses = self._losses
        losses.clear()
        total = last_step(self.config, until)
        for actor in self.actors:
            actor.train()
        what = f"training {len(self.actors)} models"
        bar = Progress(what, self.config.steps, "step", initial=self.steps, show=self.progress)
        with self._writer.alone(), bar, interrupts_between_steps() as interrupt:
            while self.steps < total and not interrupt.asked:
                losses.add(self.step())
                bar.update()
                saves = self.steps % self.config.checkpoint_every == 0 or self.steps == total
                if saves or self.steps % READ_EVERY == 0:
                    losses.read(self.steps)
                if saves:
                    self.save()
            if interrupt.asked:
                losses.read(self.steps)
                self.save()
        self.write_back()
        found = losses.read(self.steps)
        return found.mean(0) if len(found) else torch.full((len(self.actors),), torch.nan)

    @torch.no_grad()
    def write_back(self) -> None:
        """Copy the stacked parameters into the actors, and put them in eval mode."""
        for number, actor in enumerate(self.actors):
            own = dict(actor.named_parameters())
            for name, value in self._parameters.items():
                own[name.removeprefix("actor.")].copy_(value[number])
            actor.eval()
