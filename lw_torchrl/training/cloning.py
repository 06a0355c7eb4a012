"""Behavioral cloning with TorchRL's BCLoss, AdamW, a cosine schedule, and checkpoints that resume bit-exactly."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Literal, NamedTuple, Unpack

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.data import TensorDictReplayBuffer
from torchrl.objectives import BCLoss

from lw_torchrl._util.checks import Count, Positive, Scale, typed, typed_fields
from lw_torchrl._util.devices import place
from lw_torchrl.language.task_index import PlanTables, TaskTables
from lw_torchrl.modules.describe import describe
from lw_torchrl.modules.query_evaluator import evaluators_of
from lw_torchrl.training.checkpoint import check_can_be_saved
from lw_torchrl.training.loop import Training, TrainingOptions, make_optimizer
from lw_torchrl.training.minibatches import Minibatches, check_minibatches, describe_data, describe_replay
from lw_torchrl.training.normalization import check_contacts, fit_normalization, statistics_of
from lw_torchrl.transforms.qaf import plan_program


@typed_fields
@dataclass(frozen=True)
class BehavioralCloningConfig:
    """Hyperparameters of behavioral cloning.

    Attributes:
        steps: number of minibatches.
        batch_size: rows per minibatch; a multiple of the number of tasks with ``TaskBalancedSampler(exact=True)``.
        learning_rate: initial learning rate.
        momentum: momentum of the optimizer "sgd".
        schedule: learning rate schedule, "cosine" (to 0) or "constant".
        normalize: fit the normalization statistics of the observation features to the demonstrations before training.
        loss_function: distance between the actor's action and the demonstrated action.
        max_grad_norm: maximum norm to which gradients are clipped.
        seed: seed of the minibatches, and of random numbers in the buffer's transforms and in the actor.
        checkpoint_every: number of minibatches between checkpoints; the last minibatch always writes a checkpoint.
        qaf_anchor: weight of the cross entropy between a learned evaluator's answers and the exact answers. This loss
            term keeps the answers close to the conditions' meaning while imitation trains the evaluator.
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


def bc_loss(actor: nn.Module, distance: str) -> BCLoss:
    """Return TorchRL's BCLoss, without its warning about target networks."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*target_actor_network_params.*")
        return BCLoss(actor, loss_function=distance)


class _Steps(NamedTuple):
    mask: Tensor  # (T, S) bool, True for the plan steps that exist in each task's plan


class EvaluatorAnchor:
    """A loss term: the cross entropy between the answers of a policy's learned evaluator and the exact answers."""

    def __init__(self, actor: nn.Module) -> None:
        evaluators = evaluators_of(actor)
        if len(evaluators) != 1:
            got = f"got {type(actor).__name__} with {len(evaluators)} evaluators"
            raise ValueError(f"qaf_anchor requires one evaluator, as in TensorDictSequential(evaluator, actor), {got}")
        self.evaluator, plans = evaluators[0], evaluators[0].plans
        self.program, tables = plan_program(plans), PlanTables(plans)
        self.steps = TaskTables(tables.index, _Steps(tables.mask), f"tasks without a plan in {plans!r}")

    def __call__(self, batch: TensorDictBase) -> Tensor:
        """Return the loss () float32 of a batch with ``observation``, ``task_id`` and the evaluator's input keys.

        Plans with conditions on earlier steps ("once ...") also need ``qaf_latches``, from the buffer's QAFTransform.
        """
        observation, task = batch.get("observation"), batch.get("task_id")
        logits = self.evaluator.logits_of(batch)
        truth = self.program(observation, task, batch.get("qaf_latches", None)).to(logits.dtype)
        mask = self.steps.select(task, observation).mask.to(logits.dtype)
        errors = nn.functional.binary_cross_entropy_with_logits(logits, truth, reduction="none")
        return (errors * mask).sum() / mask.sum()


class BehavioralCloningTrainer(Training):
    """A trainer that fits an actor to the demonstrated actions.

    The actor can be any TensorDict module that writes ``action``, for example
    ``TensorDictSequential(evaluator, actor)``, in which evaluator and actor are trained together.

    Args:
        actor: the actor, trained in place.
        replay: a replay buffer whose samples hold the keys that the actor reads and ``action`` (B, 4) float32.
        config: hyperparameters; None for the defaults.
        device: the device to train on: "cpu", "cuda", "cuda:1", "mps", or "auto" for a GPU if available. The actor is
            moved to the device and stays there; None does not move the actor. Create the buffer with the same
            ``device``; otherwise each minibatch is copied.
        **options: keyword arguments of :class:`~lw_torchrl.training.loop.Training`, which also lists their errors.

    Raises:
        ValueError: the actor does not write ``action``, or ``qaf_anchor`` is set and the actor has no evaluator.
        TypeError: ``checkpoint`` is set and the actor cannot be saved.

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

    @typed
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
        super().__init__(config, **options)
        self.actor, self.module, self.replay, self.networks = actor, actor, replay, [actor]
        self.device = place(actor, device)
        if "action" not in actor.out_keys:
            raise ValueError(f"actor must write 'action', but writes {', '.join(map(str, actor.out_keys))}")
        check_minibatches([actor], replay, config.batch_size)
        self._anchor = EvaluatorAnchor(actor) if config.qaf_anchor else None
        if self.checkpoint is not None:
            check_can_be_saved(actor)
            self.description = {"actor": describe(actor), "training": asdict(config)}
            self.description |= {"data": describe_data(replay), "replay": describe_replay(replay)}
        self.loss = bc_loss(actor, config.loss_function)
        self.optimizer = make_optimizer([(self.loss.parameters(), config.learning_rate)], config, self.device)
        self.minibatches = [Minibatches(replay, config.batch_size, config.seed, self.device)]
        if self.resume():  # the checkpoint includes the normalization statistics
            return
        if config.normalize and statistics_of(actor):
            fit_normalization(actor, replay)
        else:
            check_contacts(actor)

    def losses(self, batch: TensorDictBase) -> Mapping[str, Tensor]:
        loss = self.loss(batch)["loss_bc"]
        if self._anchor is None:
            return {"loss": loss}
        return {"loss_bc": loss, "loss_qaf": self.config.qaf_anchor * self._anchor(batch)}
