"""OfflineTrainer: any of TorchRL's losses, or of ours, over a buffer, in steps that resume bit for bit."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.nn.utils import clip_grad_norm_
from torchrl.data import TensorDictReplayBuffer
from torchrl.objectives import LossModule
from torchrl.record.loggers import Logger

from lw_torchrl._checks import (
    check_choice,
    check_fields,
    check_int,
    check_positive,
    check_probability,
    check_scale,
    checked_but,
)
from lw_torchrl._devices import CPU, drawn_on
from lw_torchrl._progress import Progress
from lw_torchrl.objectives.reduction import with_n_steps
from lw_torchrl.training.checkpoint import describe_data, describe_learning
from lw_torchrl.training.interrupts import interrupts_between_steps
from lw_torchrl.training.loss_state import (
    check_loss,
    describe_loss,
    load_tensors,
    networks_of,
    open_training,
    sum_of_losses,
    targets_of,
    tensors_of,
    trained_parameters,
    write_training,
)
from lw_torchrl.training.minibatches import check_minibatches, draw_batch, verify_rows
from lw_torchrl.training.normalization import fit_untrained
from lw_torchrl.training.policy_checks import check_trained
from lw_torchrl.training.recent_losses import READ_EVERY, RecentLosses
from lw_torchrl.training.training_state import OneWriter, TrainingState, load_state, state_of


@dataclass(frozen=True)
class OfflineConfig:
    """How a loss is trained over a buffer.

    Attributes:
        steps: minibatches.
        batch_size: rows of a minibatch; with a :class:`TaskBalancedSampler` the number of tasks must divide it.
        learning_rate: of the loss's actor, at the start; the schedule is a cosine to 0.
        critic_learning_rate: of everything else that it trains.
        weight_decay: AdamW's.
        target_eps: how much of target networks stays at a step, where the loss has any.
        schedule: "cosine" to 0 or "constant".
        normalize: first take the statistics of the observation's features from the buffer, for all networks; False
            for those that were trained before on others.
        max_grad_norm: the actor's gradients, and those of all else, are clipped to it.
        seed: of the minibatches, and of what networks and transforms draw while training.
        checkpoint_every: steps between checkpoints.

    Raises:
        ValueError, TypeError: a wrong value, by its name.
    """

    steps: int = 5000
    batch_size: int = 250
    learning_rate: float = 1e-3
    critic_learning_rate: float = 5e-4
    weight_decay: float = 1e-4
    target_eps: float = 0.995
    schedule: str = "cosine"
    normalize: bool = True
    max_grad_norm: float = 1.0
    seed: int = 0
    checkpoint_every: int = 1000

    def __post_init__(self) -> None:
        check_fields(self)
        for name in ("steps", "batch_size", "checkpoint_every"):
            check_int(name, getattr(self, name), minimum=1)
        for name in ("learning_rate", "critic_learning_rate", "weight_decay"):
            check_scale(name, getattr(self, name))
        check_positive("max_grad_norm", self.max_grad_norm)
        check_probability("target_eps", self.target_eps)
        check_choice("schedule", self.schedule, ("cosine", "constant"))
        check_int("seed", self.seed)


class OfflineTrainer:
    """Trains what a loss holds on a buffer's minibatches: a step minimises the sum of the loss's ``loss_`` entries,
    each of which reaches its own network alone, and moves its targets. CQL's ``loss_actor_bc``, which is for its first
    steps instead of ``loss_actor``, is left out.

    Args:
        loss: of ``torchrl.objectives`` or ``lw_torchrl.objectives``, with its value estimator; networks are trained in
            place, on the device where they are, in train mode, and are in eval mode afterwards.
        replay: samples with what the loss reads. Its generator is set to the configuration's seed.
        config: how to train.
        checkpoint: a file to write checkpoints to. If it is there already, training carries on from it.
        logger: a TorchRL logger for what the loss gives.
        progress: show a progress bar.
        title: of the progress bar.

    Attributes:
        last: the means over the last 100 steps of what the loss gives, by name.

    Warns:
        UserWarning: the checkpoint was written under another version of torch or another package that bits hang on: it
            goes on, but not bit for bit.

    Raises:
        ValueError: the checkpoint is damaged, or of another loss, configuration or data; a buffer that answers the
            queries of other plans, or draws by priorities; a loss whose value estimator has another gamma than the
            buffer's n steps, that gives no mean, or CQL's with a Lagrange multiplier; networks that were
            trained with other statistics, where ``normalize``; or, in :meth:`train`, the loss or
            the weights are no numbers.
        TypeError: the loss is none of TorchRL's kind.
        OSError: the checkpoint cannot be written; the earlier one stays.

    Example:
        >>> import lw_torchrl as lw, tempfile
        >>> plans = lw.load_plans("MT10")
        >>> with tempfile.TemporaryDirectory() as root:
        ...     _ = lw.collect_demonstrations("reach", episodes_per_task=1, root=root + "/data", policy="random")
        ...     replay = lw.LanguageWorldExperienceReplay(
        ...         root + "/data", label="executed", n_steps=5, gamma=0.99, transform=lw.QAFTransform(plans)
        ...     )
        ...     loss = lw.ExpectileValueLoss(lw.PlanConditionedValue(plans)).make_value_estimator(gamma=0.99)
        ...     trainer = lw.OfflineTrainer(loss, replay, lw.OfflineConfig(steps=5, batch_size=16), progress=False)
        ...     trainer.train()
        >>> sorted(trainer.last)
        ['loss_value', 'value']

    Source: ``torchrl.trainers.Trainer``, without an environment.
    """

    @checked_but("loss")
    def __init__(
        self,
        loss: LossModule,
        replay: TensorDictReplayBuffer,
        config: OfflineConfig | None = None,
        *,
        checkpoint: str | os.PathLike[str] | None = None,
        logger: Logger | None = None,
        progress: bool = True,
        title: str = "training",
    ) -> None:
        check_loss(loss, replay)
        self.loss, self.replay, self.logger, self.progress, self.title = loss, replay, logger, progress, title
        self.config = config = config or OfflineConfig()
        self.checkpoint = None if checkpoint is None else Path(checkpoint)
        self._writer = OneWriter(self.checkpoint)
        self.networks = networks_of(loss)
        self.device = next(loss.parameters()).device
        check_minibatches(self.networks, replay, config.batch_size)
        getattr(loss, "target_entropy", None)  # SAC's is a buffer from the first time on that it is asked for
        self.state = TrainingState(replay, config.seed)
        self.targets = targets_of(loss, config.target_eps)
        actor, others = trained_parameters(loss)
        rates = (actor, config.learning_rate), (others, config.critic_learning_rate)
        self.groups = [group for group, _ in rates if group]
        options = [{"params": group, "lr": float(rate)} for group, rate in rates if group]
        self.optimizer = torch.optim.AdamW(options, weight_decay=config.weight_decay, fused=True)
        self.schedule: torch.optim.lr_scheduler.LRScheduler = (
            torch.optim.lr_scheduler.CosineAnnealingLR(self.optimizer, config.steps)
            if config.schedule == "cosine"
            else torch.optim.lr_scheduler.LambdaLR(self.optimizer, lambda _: 1.0)
        )
        self.last: dict[str, float] = {}
        self._recent = RecentLosses(("the loss",), config.learning_rate)
        if self.checkpoint is not None:
            self._described = {
                "loss": describe_loss(loss),
                "training": asdict(config),
                "data": describe_data(replay),
                "replay": describe_learning(replay),
            }
        if config.normalize:
            fit_untrained(loss, replay)
        if self.checkpoint is not None and self.checkpoint.exists():
            verify_rows(replay)
            found, tensors = open_training(self.checkpoint, self._described)
            load_state(self.checkpoint, found, self.optimizer, self.schedule, [self.state], config.steps)
            load_tensors(loss, tensors)

    def save(self) -> None:
        """Write the checkpoint, if there is to be one; an earlier one is replaced whole.

        Raises:
            ValueError: the weights are no finite numbers.
        """
        check_trained(dict(self.loss.named_parameters()), self.state.step)
        if self.checkpoint is not None:
            state = state_of(self.optimizer, self.schedule, [self.state])
            write_training(self.checkpoint, self._described, state, tensors_of(self.loss))
            self._writer.know()

    def step(self) -> TensorDictBase:
        """Train on one minibatch and return what the loss gives, detached."""
        with drawn_on(self.device, self.state.torch_generator):
            batch = draw_batch(self.replay, self.config.batch_size, self.device)
            found = self.loss(with_n_steps(self.loss, batch))
            self.state.torch_generator = torch.get_rng_state()
        total = sum_of_losses(found)
        if self.device == CPU:
            self._recent.check(total, self.state.step)
        self._recent.add(total.detach())
        self.optimizer.zero_grad()
        total.backward()
        for group in self.groups:
            clip_grad_norm_(group, self.config.max_grad_norm)
        self.optimizer.step()
        self.schedule.step()
        if self.targets is not None:
            self.targets.step()
        self.state.step += 1
        return found.detach()

    def train(self) -> None:
        """Train to the last step, from wherever training stands; Ctrl-C as in :class:`BehavioralCloningTrainer`."""
        for network in self.networks:
            network.train()
        config, state = self.config, self.state
        given: list[Mapping[str, Tensor]] = []
        bar = Progress(self.title, config.steps, "step", initial=state.step, show=self.progress)
        with self._writer.alone(), bar, interrupts_between_steps() as interrupt:
            while state.step < config.steps and not interrupt.asked:
                given.append(self.step())
                bar.update()
                if state.step % READ_EVERY == 0 or state.step == config.steps:
                    self._tell(given)
                    given = []
                    bar.note(**{name: f"{value:.4f}" for name, value in self.last.items() if "loss" in name})
                if state.step % config.checkpoint_every == 0 or state.step == config.steps:
                    self.save()
            if interrupt.asked:
                self.save()
        for network in self.networks:
            network.eval()

    def _tell(self, given: list[Mapping[str, Tensor]]) -> None:
        self._recent.read(self.state.step)
        names = [name for name, value in given[0].items() if value.numel() == 1]
        self.last = {name: float(torch.stack([one[name].reshape(()) for one in given]).mean()) for name in names}
        if self.logger is not None:
            for name, value in self.last.items():
                self.logger.log_scalar(f"train/{name}", value, step=self.state.step)
