"""Behavioral cloning with TorchRL's BCLoss: AdamW, a cosine schedule, checkpoints that resume bit for bit."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torch.nn.utils import clip_grad_norm_
from torchrl.data import TensorDictReplayBuffer
from torchrl.record.loggers import Logger

from lw_torchrl._checks import checked
from lw_torchrl._devices import CPU, drawn_on, place
from lw_torchrl._progress import Progress
from lw_torchrl.modules.policy import Policy
from lw_torchrl.training.checkpoint import describe_data, describe_replay, write
from lw_torchrl.training.config import BehavioralCloningConfig, last_step, make_optimizer
from lw_torchrl.training.evaluator_anchor import EvaluatorAnchor
from lw_torchrl.training.interrupts import interrupts_between_steps
from lw_torchrl.training.latent_terms import LatentTerms
from lw_torchrl.training.loss_state import bc_loss
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


class BehavioralCloningTrainer:
    """Trains an actor to give the demonstrated actions.

    Any TensorDictModule that writes ``action`` can be trained; a :class:`Policy` first takes its statistics from the
    demonstrations, and it alone can have a checkpoint.

    Args:
        actor: it is trained in place.
        replay: samples with what the actor reads and ``action`` (B, 4) float32. Its generator is set to the
            configuration's seed.
        config: how to train.
        checkpoint: a file to write checkpoints to. If it is there already, training carries on from it.
        logger: a TorchRL logger for the loss and the learning rate.
        progress: show a progress bar.
        device: where to train: "cpu", "cuda", "cuda:1", "mps", or "auto" for the fastest that there is. The actor is
            moved there, and stays; None for where it is. On a GPU no step waits for another: losses are read every 100
            steps. Make the buffer with the same ``device``, or each minibatch has to go over.

    Warns:
        UserWarning: the checkpoint is of training on another kind of device: it goes on with the same minibatches, but
            not bit for bit. Or it was written under another version of torch or another package that bits hang on.

    Raises:
        ValueError: the checkpoint is damaged, of another architecture, configuration or data; the actor writes no
            ``action``, or has no plans and the configuration has a term on skills' latents, or no evaluator and
            it has an anchor; or, in :meth:`train`, the
            loss or the weights are no numbers.
        TypeError: a checkpoint for an actor that is no :class:`Policy`.
        OSError: the checkpoint cannot be written; the earlier one stays.

    Example:
        >>> import lw_torchrl as lw, tempfile
        >>> plans = lw.load_plans("MT10")
        >>> with tempfile.TemporaryDirectory() as root:
        ...     _ = lw.collect_demonstrations("reach", episodes_per_task=1, root=root + "/demos", max_steps=80)
        ...     replay = lw.LanguageWorldExperienceReplay(root + "/demos", transform=lw.QAFTransform(plans))
        ...     trainer = lw.BehavioralCloningTrainer(
        ...         lw.PlanConditionedActor(plans), replay, lw.BehavioralCloningConfig(steps=5, batch_size=16)
        ...     )
        ...     trainer.train() < 1.0
        True

    Source: paper section 'Conditional Plan Experiments'; ``torchrl.objectives.BCLoss``.
    """

    @checked
    def __init__(
        self,
        actor: TensorDictModuleBase,
        replay: TensorDictReplayBuffer,
        config: BehavioralCloningConfig | None = None,
        *,
        checkpoint: str | os.PathLike[str] | None = None,
        logger: Logger | None = None,
        progress: bool = True,
        device: str | torch.device | None = None,
    ) -> None:
        self.actor, self.replay, self.logger, self.progress = actor, replay, logger, progress
        self.device = place(actor, device)
        self.config = config = config or BehavioralCloningConfig()
        self.checkpoint = None if checkpoint is None else Path(checkpoint)
        self._writer = OneWriter(self.checkpoint)
        check_replay(actor, replay, config.batch_size)
        self._latent_terms = LatentTerms(actor, config)
        self._anchor = EvaluatorAnchor(actor) if config.qaf_anchor else None
        self._policy = None if self.checkpoint is None else check_can_be_saved(actor)
        self._described: dict[str, Any] = {}
        if self.checkpoint is not None and self._policy is not None:
            self._described = {"actor": self._policy.describe(), "training": config.describe()}
            self._described |= {"data": describe_data(replay), "replay": describe_replay(replay)}
        self.loss = bc_loss(actor, config.loss_function)
        self.optimizer, self.schedule = make_optimizer(self.loss.parameters(), config)
        self._losses = RecentLosses(("the loss",), config.learning_rate)
        self.state = TrainingState(replay, config.seed)
        if self.checkpoint is not None and self._policy is not None and self.checkpoint.exists():
            verify_rows(replay)
            check_description(self.checkpoint, self._described)
            warn_of_another_device(self.checkpoint, self.device)
            found = load_training(self.checkpoint, self._policy, self._policy.state_dict(keep_vars=True))
            load_state(self.checkpoint, found, self.optimizer, self.schedule, [self.state], config.steps)
        elif config.normalize and isinstance(actor, Policy):
            fit_normalization(actor, replay)
        else:
            check_contacts(actor)

    def save(self) -> None:
        """Write the checkpoint, if there is to be one; an earlier one is replaced whole.

        Raises:
            ValueError: the weights are no finite numbers.
        """
        check_trained(dict(self.actor.named_parameters()), self.state.step)
        if self.checkpoint is not None and self._policy is not None:
            state = state_of(self.optimizer, self.schedule, [self.state])
            described = self._described | where(self.device)
            write(self.checkpoint, described, self._policy, self._policy.state_dict(), state)
            self._writer.know()

    def step(self) -> Tensor:
        """Train on one minibatch and return its loss, () float32, on the device: nobody has waited for it."""
        # What transforms and the actor draw hangs on the configuration's seed.
        with drawn_on(self.device, self.state.torch_generator):
            batch = draw_batch(self.replay, self.config.batch_size, self.device)
            loss = self.loss(batch)["loss_bc"]
            self.state.torch_generator = torch.get_rng_state()
        if self._latent_terms.weights:
            loss = loss + self._latent_terms()
        if self._anchor is not None:
            loss = loss + self.config.qaf_anchor * self._anchor(batch)
        if self.device == CPU:
            self._losses.check(loss, self.state.step)
        self.optimizer.zero_grad()
        loss.backward()
        clip_grad_norm_(self.loss.parameters(), self.config.max_grad_norm)
        self.optimizer.step()
        self.schedule.step()
        self.state.step += 1
        return loss.detach()

    @property
    def steps(self) -> int:
        """How many minibatches the actor has been trained on."""
        return self.state.step

    def train(self, until: int | None = None) -> float:
        """Train to the last step, from wherever training stands.

        Ctrl-C ends it between two steps, with a checkpoint; a second Ctrl-C at once.

        Args:
            until: end after so many steps in all, with a checkpoint, to look at the actor; None for all that the
                configuration has. What is learned is the same.

        Returns:
            The mean loss over the last 100 steps made; NaN if there were none left to make.
        """
        losses = self._losses
        losses.clear()
        self.actor.train()
        every, total = self.config.checkpoint_every, last_step(self.config, until)
        bar = Progress("training", self.config.steps, "step", initial=self.state.step, show=self.progress)
        with self._writer.alone(), bar, interrupts_between_steps() as interrupt:
            while self.state.step < total and not interrupt.asked:
                losses.add(self.step())
                step = self.state.step
                bar.update()
                saves = step % every == 0 or step == total
                if saves or step % READ_EVERY == 0:
                    mean = _mean(losses.read(step))
                if step % READ_EVERY == 0 or step == total:
                    bar.note(loss=f"{mean:.4f}")
                    if self.logger is not None:
                        self.logger.log_scalar("train/loss", mean, step=step)
                        self.logger.log_scalar("train/learning_rate", self.schedule.get_last_lr()[0], step=step)
                if saves:
                    self.save()
            if interrupt.asked:
                losses.read(self.state.step)
                self.save()
        self.actor.eval()
        return _mean(losses.read(self.state.step))


def _mean(losses: Tensor) -> float:
    return sum(losses.tolist()) / len(losses) if len(losses) else float("nan")
