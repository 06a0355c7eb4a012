"""StackedBehavioralCloning: many actors of one architecture trained at once, their parameters stacked."""

from __future__ import annotations

import json
from collections.abc import Sequence
from hashlib import sha256
from typing import Any, Unpack

import torch
from lw_torchrl.training.behavioral_cloning import BehavioralCloningConfig, make_optimizer
from torch import Tensor, nn
from torch.func import functional_call, stack_module_state, vmap
from torchrl.data import TensorDictReplayBuffer
from torchrl.objectives.utils import distance_loss

from lw_torchrl._checks import checked, passes_on
from lw_torchrl._devices import place
from lw_torchrl.data.replay_checks import check_replay
from lw_torchrl.modules.policy import Policy
from lw_torchrl.training.checkpoint import check_can_be_saved, text_vectors
from lw_torchrl.training.descriptions import describe_data, describe_replay
from lw_torchrl.training.loop import ReplayState, Training, TrainingOptions, make_schedule
from lw_torchrl.training.normalization import check_contacts, fit_normalization


class _Act(nn.Module):
    """``functional_call`` calls a module's forward: this one's is the actor's ``act``."""

    def __init__(self, actor: Any) -> None:
        super().__init__()
        self.actor = actor

    def forward(self, *prepared: Tensor) -> Tensor:
        return self.actor.act(*prepared)[0]


def _check_actors(actors: Sequence[Policy]) -> None:
    """Raise :class:`ValueError` unless the actors differ in their weights, plans and tasks alone."""
    described = [actor.describe() for actor in actors]
    first, *others = ({"kind": one["kind"], "evaluator": one.get("evaluator"), **one["options"]} for one in described)
    for number, other in enumerate(others, 1):
        if names := [name for name in {**first, **other} if first.get(name) != other.get(name)]:
            raise ValueError(f"actors must be of one architecture, 0 and {number} differ in {', '.join(names)}")
    weights = [id(parameter) for actor in actors for parameter in actor.parameters()]
    if len({*weights}) < len(weights):
        raise ValueError("actors must have weights of their own, some are the same or share theirs")


class StackedBehavioralCloning(Training):
    """Trains M actors, each on batches of its own, as :class:`BehavioralCloningTrainer` trains one.

    Every product is done for all M at once. Each actor draws its batches, turns and feature noise from the seed that
    it would have alone, so its losses are those it would have alone, up to rounding.

    Args:
        actors: M policies, each with weights of its own, trained in place, that differ in plans and tasks alone.
        replays: M buffers, each with its sampler; the i-th actor's batches come from the i-th.
        config: how to train each; the i-th has the seed ``config.seed + i``.
        checkpoint, logger, progress, title: as of :class:`~lw_torchrl.training.loop.Training`, with its errors.
        device: where to train, as for :class:`BehavioralCloningTrainer`; None for where the first actor is.

    Raises:
        ValueError: not as many buffers as actors, one twice, or actors of different options.

    Source: paper section 'Conditional Plan Experiments', which trains 50 one-shot models; ``torch.func``.
    """

    @passes_on(Training.__init__)
    @checked
    def __init__(
        self,
        actors: Sequence[Policy],
        replays: Sequence[TensorDictReplayBuffer],
        config: BehavioralCloningConfig | None = None,
        *,
        device: str | torch.device | None = None,
        **options: Unpack[TrainingOptions],
    ) -> None:
        config = config or BehavioralCloningConfig()
        if not actors or len(replays) != len(actors):
            raise ValueError(f"replays must be as many as actors, at least one, got {len(replays)} and {len(actors)}")
        options.setdefault("title", f"training {len(actors)} models")
        super().__init__(config, replays, **options)
        self.actors = list(actors)
        self.networks = [*actors]
        _check_actors(actors)
        if len({*map(id, replays)}) < len(replays) or len({id(one.sampler) for one in replays}) < len(replays):
            raise ValueError("replays must be different buffers, each with a sampler of its own")
        if config.qaf_anchor:
            raise ValueError("qaf_anchor is for BehavioralCloningTrainer, which trains one policy at a time")
        self.device = place(actors[0], device)
        if self.checkpoint is not None:
            described = [json.dumps(actor.describe(), sort_keys=True).encode() for actor in actors]
            self.described = {
                "actor": check_can_be_saved(actors[0]).describe() | {"number": len(actors)},
                "actors": {str(number): sha256(one).hexdigest()[:16] for number, one in enumerate(described)},
                "training": config.describe(),
                "data": {str(number): describe_data(replay) for number, replay in enumerate(replays)},
                "replay": {str(number): describe_replay(replay) for number, replay in enumerate(replays)},
            }
        for number, (actor, replay) in enumerate(zip(actors, replays, strict=True)):
            actor.to(self.device)
            check_replay(actor, replay, config.batch_size)
            self.states.append(ReplayState(replay, config.seed + number))
            if config.normalize:
                fit_normalization(actor, replay)
            else:
                check_contacts(actor)
            actor.train()
        modules: list[nn.Module] = [_Act(actor) for actor in actors]
        try:
            parameters, self._buffers = stack_module_state(modules)
        except RuntimeError as error:
            raise ValueError(f"actors must be of one architecture ({error})") from error
        self._parameters = {name: nn.Parameter(value.detach()) for name, value in parameters.items()}
        self._act = vmap(lambda p, b, prepared: functional_call(modules[0], (p, b), prepared))
        self.optimizer = make_optimizer(self._parameters.values(), config)
        self.schedule = make_schedule(config.schedule, self.optimizer, config.steps)
        self.resume()

    def parameters(self) -> dict[str, Tensor]:
        return {**self._parameters}

    def contents(self) -> dict[str, Tensor]:
        return {**self.parameters(), **text_vectors(self.actors[0])}

    def step(self) -> Tensor:
        """Train every actor on one minibatch and return their losses, (M,) float32, on the device."""
        prepared, targets = [], []
        for actor, state in zip(self.actors, self.states, strict=True):
            with state.drawing(self.device):
                batch = state.minibatch(self.config.batch_size, self.device)
                prepared.append(actor.prepare(batch))
            targets.append(batch.get("action"))
        inputs = tuple(torch.stack(column) for column in zip(*prepared, strict=True))
        actions = self._act(self._parameters, self._buffers, inputs)
        losses = distance_loss(actions, torch.stack(targets), self.config.loss_function).flatten(1).mean(1)
        return self.descend(losses)

    def clip_gradients(self) -> None:
        gradients = [p.grad for p in self._parameters.values() if p.grad is not None]
        norms = torch.stack([g.flatten(1).square().sum(1) for g in gradients]).sum(0).sqrt()
        factor = (self.config.max_grad_norm / (norms + 1e-6)).clamp(max=1.0)  # as clip_grad_norm_ does
        for gradient in gradients:
            gradient.mul_(factor.reshape(-1, *[1] * (gradient.ndim - 1)))

    def train(self, until: int | None = None) -> Tensor:
        """Train to the last step and give the actors their weights; Ctrl-C as in :class:`BehavioralCloningTrainer`.

        Returns:
            (M,) float32, each actor's mean loss over the last 100 steps made; NaN if there were none left to make.
        """
        found = self.run(until)
        self.write_back()
        return found.mean(0) if len(found) else torch.full((len(self.actors),), torch.nan)

    @torch.no_grad()
    def write_back(self) -> None:
        """Copy the stacked parameters into the actors, and put them in eval mode."""
        for number, actor in enumerate(self.actors):
            own = dict(actor.named_parameters())
            for name, value in self._parameters.items():
                own[name.removeprefix("actor.")].copy_(value[number])
            actor.eval()
