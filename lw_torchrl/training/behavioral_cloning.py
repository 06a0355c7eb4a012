"""Behavioral cloning with TorchRL's BCLoss: AdamW, a cosine schedule, checkpoints that resume bit for bit."""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any, Literal, Unpack

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torch.nn.utils import clip_grad_norm_
from torchrl.data import TensorDictReplayBuffer
from torchrl.objectives import BCLoss

from lw_torchrl._checks import Count, Positive, Scale, check_fields, checked, passes_on
from lw_torchrl._devices import place
from lw_torchrl.data.replay_checks import check_replay
from lw_torchrl.language.task_index import PlanTables
from lw_torchrl.modules.describe import describe
from lw_torchrl.modules.features import Features
from lw_torchrl.modules.query_evaluator import QueryEvaluator
from lw_torchrl.training.checkpoint import check_can_be_saved
from lw_torchrl.training.descriptions import describe_data, describe_replay
from lw_torchrl.training.loop import ReplayState, Training, TrainingOptions, make_schedule
from lw_torchrl.training.normalization import check_contacts, fit_normalization
from lw_torchrl.transforms.qaf import plan_program


@dataclass(frozen=True)
class BehavioralCloningConfig:
    """How an actor is trained.

    Attributes:
        steps: minibatches.
        batch_size: rows of a minibatch; with ``TaskBalancedSampler(exact=True)`` the number of tasks must divide it.
        learning_rate: at the start.
        optimizer: "adamw" or "sgd".
        weight_decay: the optimizer's.
        momentum: of "sgd".
        schedule: of the learning rate, "cosine" to 0 or "constant".
        normalize: first take the statistics of the observation's features from the demonstrations.
        loss_function: between the actor's and the demonstrated action: "l1", "l2" or "smooth_l1".
        max_grad_norm: gradients are clipped to it.
        seed: of the minibatches, and of what the buffer's transforms and the actor draw while training.
        checkpoint_every: steps between checkpoints; the last step always makes one.
        qaf_anchor: weight of the cross entropy of an evaluator's answers with the query answering function's, of a
            policy with an evaluator: its conditions keep to their words.
    """

    steps: Count = 8000
    batch_size: Count = 500
    learning_rate: Scale = 1e-3
    optimizer: Literal["adamw", "sgd"] = "adamw"
    weight_decay: Scale = 1e-4
    momentum: Scale = 0.9
    schedule: Literal["cosine", "constant"] = "cosine"
    normalize: bool = True
    loss_function: Literal["l1", "l2", "smooth_l1"] = "l2"
    max_grad_norm: Positive = 1.0
    seed: int = 0
    checkpoint_every: Count = 500
    qaf_anchor: Scale = 0.0

    def __post_init__(self) -> None:
        check_fields(self)

    def describe(self) -> dict[str, Any]:
        """Return the options, as JSON."""
        return asdict(self)


def make_optimizer(parameters: Iterable[Tensor], config: BehavioralCloningConfig) -> torch.optim.Optimizer:
    """The optimizer of a configuration."""
    rate, decay = float(config.learning_rate), config.weight_decay  # a float, as it is in a checkpoint
    if config.optimizer == "adamw":
        return torch.optim.AdamW(parameters, lr=rate, weight_decay=decay, fused=True)
    return torch.optim.SGD(parameters, lr=rate, momentum=config.momentum, weight_decay=decay, fused=True)


def bc_loss(actor: nn.Module, distance: str) -> BCLoss:
    """TorchRL's BCLoss, without its warning about itself."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*target_actor_network_params.*")
        return BCLoss(actor, loss_function=distance)


class EvaluatorAnchor:
    """The mean cross entropy of the answers of an actor's evaluator with the query answering function's: it holds the
    evaluator to the words while the loss of imitation trains it."""

    def __init__(self, actor: Any) -> None:
        evaluator = getattr(actor, "evaluator", None)
        if not isinstance(evaluator, QueryEvaluator):
            raise ValueError(f"qaf_anchor is for a policy with an evaluator, this {type(actor).__name__} has none")
        self.evaluator = evaluator
        self.program, self.tables = plan_program(evaluator.plans), PlanTables(evaluator.plans)

    def __call__(self, batch: TensorDictBase) -> Tensor:
        """() float32, of a minibatch with ``observation``, ``task_id`` and what the evaluator reads."""
        task = batch.get("task_id")
        logits = self.evaluator.logits(*(batch.get(key) for key in self.evaluator.in_keys))
        truth = self.program(batch.get("observation"), task).to(logits.dtype)
        steps = self.tables.mask.to(task.device)[self.tables.rows(task)]
        return nn.functional.binary_cross_entropy_with_logits(logits[steps], truth[steps])


class BehavioralCloningTrainer(Training):
    """Trains an actor to give the demonstrated actions.

    Any TensorDictModule that writes ``action`` can be trained; a :class:`Policy` alone has statistics and checkpoints.

    Args:
        actor: it is trained in place.
        replay: samples with what the actor reads and ``action`` (B, 4) float32.
        config, checkpoint, logger, progress, title: as of :class:`~lw_torchrl.training.loop.Training`, with its errors.
        device: where to train: "cpu", "cuda", "cuda:1", "mps", or "auto" for the fastest that there is. The actor is
            moved there, and stays; None for where it is. On a GPU no step waits for another: losses are read every 100
            steps. Make the buffer with the same ``device``, or each minibatch has to go over.

    Raises:
        ValueError: the actor writes no ``action``, or has no evaluator for the anchor.
        TypeError: a checkpoint for an actor that is no :class:`Policy`.

    Example:
        >>> import lw_torchrl as lw, tempfile
        >>> plans = lw.load_plans("MT10")
        >>> with tempfile.TemporaryDirectory() as root:
        ...     _ = lw.collect_demonstrations("reach", episodes_per_task=1, root=root + "/demos", max_steps=80)
        ...     replay = lw.LanguageWorldExperienceReplay(root + "/demos", transform=lw.QAFTransform(plans))
        ...     config = lw.BehavioralCloningConfig(steps=5, batch_size=16)
        ...     lw.BehavioralCloningTrainer(lw.PlanConditionedActor(plans), replay, config).train() < 1.0
        True

    Source: paper section 'Conditional Plan Experiments'; ``torchrl.objectives.BCLoss``.
    """

    part = "actor"

    @passes_on(Training.__init__)
    @checked
    def __init__(
        self,
        actor: TensorDictModuleBase,
        replay: TensorDictReplayBuffer,
        config: BehavioralCloningConfig | None = None,
        *,
        device: str | torch.device | None = None,
        **options: Unpack[TrainingOptions],
    ) -> None:
        config = config or BehavioralCloningConfig()
        super().__init__(config, [replay], **options)
        self.actor, self.module, self.replay, self.networks = actor, actor, replay, [actor]
        self.device = place(actor, device)
        check_replay(actor, replay, config.batch_size)
        self._anchor = EvaluatorAnchor(actor) if config.qaf_anchor else None
        if self.checkpoint is not None:
            check_can_be_saved(actor)
            self.described = {"actor": describe(actor), "training": config.describe()}
            self.described |= {"data": describe_data(replay), "replay": describe_replay(replay)}
        self.loss = bc_loss(actor, config.loss_function)
        self.optimizer = make_optimizer(self.loss.parameters(), config)
        self.schedule = make_schedule(config.schedule, self.optimizer, config.steps)
        self.states = [ReplayState(replay, config.seed)]
        if self.resume():
            return
        if config.normalize and any(isinstance(part, Features) for part in actor.modules()):
            fit_normalization(actor, replay)
        else:
            check_contacts(actor)

    def step(self) -> Tensor:
        """Train on one minibatch and return its loss, () float32, on the device: nobody has waited for it."""
        (state,) = self.states
        with state.drawing(self.device):
            batch = state.minibatch(self.config.batch_size, self.device)
            loss = self.loss(batch)["loss_bc"]
        if self._anchor is not None:
            loss = loss + self.config.qaf_anchor * self._anchor(batch)
        return self.descend(loss)

    def clip_gradients(self) -> None:
        clip_grad_norm_(self.loss.parameters(), self.config.max_grad_norm)

    def means(self, losses: Tensor) -> dict[str, float]:
        assert self.schedule is not None
        return {"loss": _mean(losses), "learning_rate": float(self.schedule.get_last_lr()[0])}

    def train(self, until: int | None = None) -> float:
        """Train to the last step, from wherever training stands.

        Ctrl-C ends it between two steps, with a checkpoint; a second Ctrl-C at once.

        Args:
            until: end after so many steps in all, with a checkpoint, and learn the same; None for the configuration's.

        Returns:
            The mean loss over the last 100 steps made; NaN if there were none left to make.
        """
        return _mean(self.run(until))


def _mean(losses: Tensor) -> float:
    return sum(losses.tolist()) / len(losses) if len(losses) else float("nan")
