"""StackedBehavioralCloning: train many actors with the same architecture at once, with stacked parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Unpack

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torch.func import functional_call, stack_module_state, vmap
from torchrl.data import TensorDictReplayBuffer
from torchrl.objectives.utils import distance_loss

from lw_torchrl._util.checks import typed
from lw_torchrl._util.devices import place
from lw_torchrl._util.reproducibility import differences
from lw_torchrl.modules.describe import describe
from lw_torchrl.training.checkpoint import check_can_be_saved, text_vectors
from lw_torchrl.training.cloning import BehavioralCloningConfig
from lw_torchrl.training.loop import Training, TrainingOptions, make_optimizer
from lw_torchrl.training.minibatches import Minibatches, check_minibatches, describe_data, describe_replay
from lw_torchrl.training.normalization import check_contacts, fit_normalization, statistics_of
from lw_torchrl.transforms import FallbackTurns, JitterTarget, QAFTransform, RandomYaw

_BY_ROW = (FallbackTurns, JitterTarget, QAFTransform, RandomYaw)
"""Transforms that compute each row independently of other rows."""


def _check_actors(actors: Sequence[TensorDictModuleBase]) -> None:
    """Raise :class:`ValueError` unless the actors differ only in their weights."""
    first, *others = map(describe, actors)
    for number, other in enumerate(others, 1):
        if different := differences(first, other):
            raise ValueError(
                f"actors must have the same parts and plans; actors 0 and {number} differ in {', '.join(different)}"
            )
    weights = [id(parameter) for actor in actors for parameter in actor.parameters()]
    if len({*weights}) < len(weights):
        raise ValueError("actors must not share weights")


class StackedBehavioralCloning(Training):
    """A trainer of M actors, each on its own minibatches, as :class:`BehavioralCloningTrainer` trains one actor.

    One ``vmap`` computes all M actors. The minibatches and augmentations of an actor depend only on its own seed, so
    its losses are the same as when it is trained alone, up to rounding and feature noise. On a GPU, the augmentations
    of all actors share one seed.

    Args:
        actors: M policies with the same parts and plans and with their own weights, trained in place.
        replays: M buffers, each with its own sampler; actor i learns from buffer i.
        config: the hyperparameters of all actors; actor i has the seed ``config.seed + i``.
        device: the device to train on, as for :class:`BehavioralCloningTrainer`; None for the first actor's device.
        **options: keyword arguments of :class:`~lw_torchrl.training.loop.Training`, which also lists their errors.

    Raises:
        ValueError: the numbers of buffers and actors differ, one is repeated, or the actors' parts differ.

    Source: paper section 'Conditional Plan Experiments', which trains 50 one-shot models; ``torch.func``.
    """

    @typed
    def __init__(
        self,
        actors: Sequence[TensorDictModuleBase],
        replays: Sequence[TensorDictReplayBuffer],
        config: BehavioralCloningConfig | None = None,
        *,
        device: str | torch.device | None = None,
        **options: Unpack[TrainingOptions],
    ) -> None:
        config = config or BehavioralCloningConfig()
        if not actors or len(replays) != len(actors):
            raise ValueError(
                f"replays must have one buffer for each of the actors, at least one, got {len(replays)} buffers for "
                f"{len(actors)} actors"
            )
        options.setdefault("title", f"training {len(actors)} models")
        options.setdefault("capture", True)
        super().__init__(config, **options)
        self.actors = list(actors)
        self.module, self.networks = actors[0], [*actors]
        _check_actors(actors)
        if len({*map(id, replays)}) < len(replays) or len({id(one.sampler) for one in replays}) < len(replays):
            raise ValueError("replays must be different buffers with different samplers")
        if config.qaf_anchor:
            raise ValueError("qaf_anchor is for BehavioralCloningTrainer, which trains one policy at a time")
        self.device = place(actors[0], device)
        if self.checkpoint is not None:
            check_can_be_saved(actors[0])
            self.description = {
                "actor": describe(actors[0]) | {"number": len(actors)},
                "training": asdict(config),
                "data": {str(number): describe_data(replay) for number, replay in enumerate(replays)},
                "replay": {str(number): describe_replay(replay) for number, replay in enumerate(replays)},
            }
        for number, (actor, replay) in enumerate(zip(actors, replays, strict=True)):
            actor.to(self.device)
            check_minibatches([actor], replay, config.batch_size)
            self.minibatches.append(Minibatches(replay, config.batch_size, config.seed + number, self.device))
            if config.normalize and statistics_of(actor):
                fit_normalization(actor, replay)
            else:
                check_contacts(actor)
            actor.train()
        parameters, buffers = stack_module_state([*actors])  # type: ignore[arg-type]
        # All actors have the same plan tables, which are not part of the state.
        self._buffers = {name: value for name, value in buffers.items() if name in actors[0].state_dict()}
        self._parameters = {name: nn.Parameter(value.detach()) for name, value in parameters.items()}
        self._act = vmap(
            lambda p, b, batch: functional_call(actors[0], (p, b), (batch,)).get("action"), randomness="different"
        )
        transforms = [describe_replay(replay)["transforms"] for replay in replays]
        self._are_alike = all(each == transforms[0] for each in transforms)
        self.optimizer = make_optimizer([(self._parameters.values(), config.learning_rate)], config, self.device)
        self.resume()

    def parameters(self) -> dict[str, Tensor]:
        return {**self._parameters}

    def contents(self) -> dict[str, Tensor]:
        return {**self.parameters(), **text_vectors(self.actors[0])}

    def combined(self, drawn: list[TensorDictBase]) -> TensorDictBase:
        return torch.stack([each.exclude("next") for each in drawn])

    def batch(self, drawn: TensorDictBase) -> TensorDictBase:
        sources = [each.indexed for each in self.minibatches]
        if any(source is None for source in sources):
            return drawn
        pairs = list(zip(sources, drawn.unbind(0), strict=True))
        if not self._are_alike:
            return torch.stack([source.rows(own).exclude("next") for source, own in pairs])
        rows = torch.stack([source.stored(own) for source, own in pairs])
        for parts in zip(*(source.replay.transform for source in sources), strict=True):
            if isinstance(parts[0], _BY_ROW):  # one call for all models takes a GPU as long as one model
                rows = parts[0](rows)
            else:
                rows = torch.stack([part(own) for part, own in zip(parts, rows.unbind(0), strict=True)])
        return rows.exclude("next")

    def losses(self, batch: TensorDictBase) -> Mapping[str, Tensor]:
        actions = self._act(self._parameters, self._buffers, batch.exclude("action"))
        distances = distance_loss(actions, batch.get("action"), self.config.loss_function)
        return {"loss": distances.flatten(1).mean(1)}

    def clip_gradients(self) -> None:
        gradients = [p.grad for p in self._parameters.values() if p.grad is not None]
        norms = torch.stack([g.flatten(1).square().sum(1) for g in gradients]).sum(0).sqrt()
        factor = (self.config.max_grad_norm / (norms + 1e-6)).clamp(max=1.0)  # as clip_grad_norm_ does
        for gradient in gradients:
            gradient.mul_(factor.reshape(-1, *[1] * (gradient.ndim - 1)))

    def train(self, until: int | None = None) -> Tensor:  # type: ignore[override]
        """Train to the last step and copy the weights to the actors; Ctrl-C as in :class:`BehavioralCloningTrainer`.

        Returns:
            (M,) float32, each actor's mean loss over the latest 100 steps; NaN if there were none left.
        """
        losses = self.run(until)
        self.write_back()
        return losses.mean(0) if len(losses) else torch.full((len(self.actors),), torch.nan)

    @torch.no_grad()
    def write_back(self) -> None:
        """Copy the stacked parameters into the actors, and put them in eval mode."""
        for number, actor in enumerate(self.actors):
            own = dict(actor.named_parameters())
            for name, value in self._parameters.items():
                own[name].copy_(value[number])
            actor.eval()
