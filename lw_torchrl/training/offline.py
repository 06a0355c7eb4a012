"""OfflineTrainer: train any loss from TorchRL or from this library on a replay buffer."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from hashlib import sha256
from typing import Any, Literal, Unpack

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.data import TensorDictReplayBuffer
from torchrl.envs import MultiStepTransform
from torchrl.objectives import CQLLoss, IQLLoss, LossModule, SoftUpdate, TD3BCLoss

from lw_torchrl._util.checks import Count, Positive, Probability, Scale, check_choice, typed, typed_fields
from lw_torchrl.language.plans import Plans
from lw_torchrl.modules.critics import PlanConditionedQValue, PlanConditionedValue
from lw_torchrl.modules.describe import describe
from lw_torchrl.objectives import AdvantageWeightedLoss, ExpectileValueLoss, standardize_by_task
from lw_torchrl.objectives.offline import with_n_steps
from lw_torchrl.training.checkpoint import check_can_be_saved
from lw_torchrl.training.loop import Training, TrainingOptions, make_optimizer
from lw_torchrl.training.minibatches import (
    Minibatches,
    check_augmentations,
    check_minibatches,
    describe_data,
    describe_replay,
    plain_options,
)
from lw_torchrl.training.normalization import fit_normalization, fit_untrained, statistics_of

GAMMA, N_STEPS = 0.99, 10
"""The discount factor per time step, and the number n of time steps in n-step value targets."""
DISTRIBUTIONS = {"advantage": None, "iql": "normal", "td3-bc": None, "cql": "tanh_normal"}
"""A mapping from each loss to the action distribution that it requires of the actor."""
_CHUNK = 20_000  # number of rows whose advantages are computed together
_REPLACED = {"loss_actor_bc"}  # CQL offers this entry as a substitute for loss_actor in the first training steps


def make_loss(name: str, actor: TensorDictModuleBase, plans: Plans, replay: TensorDictReplayBuffer) -> LossModule:
    """Create the loss ``name`` for an actor, with plan-conditioned critics normalized to the buffer's rows.

    The actor must have the distribution in :data:`DISTRIBUTIONS`. "advantage" reads the column ``advantage``; the other
    losses require a buffer with ``n_steps`` = :data:`N_STEPS` and ``gamma`` = :data:`GAMMA`.

    Source: Kostrikov et al., "Implicit Q-Learning"; Fujimoto and Gu, "A Minimalist Approach to Offline Reinforcement
    Learning"; Kumar et al., "Conservative Q-Learning".
    """
    check_choice("loss", name, DISTRIBUTIONS)
    if name == "advantage":
        return AdvantageWeightedLoss(actor, beta=2.0, loss_function="l1")
    qvalue = PlanConditionedQValue(plans)
    fit_normalization(qvalue, replay)
    pair: dict[str, Any] = {"num_qvalue_nets": 2, "loss_function": "l2"}
    if name == "iql":
        value = PlanConditionedValue(plans)
        fit_normalization(value, replay)
        loss: LossModule = IQLLoss(actor, qvalue, value, expectile=0.7, temperature=3.0, **pair)
    elif name == "td3-bc":
        loss = TD3BCLoss(actor, qvalue, bounds=(-1.0, 1.0), delay_actor=True, **pair)
    else:
        loss = CQLLoss(actor, qvalue, loss_function="l2", num_random=1)
    loss.make_value_estimator(gamma=GAMMA)
    return loss


def learn_advantages(
    plans: Plans, replay: TensorDictReplayBuffer, config: OfflineConfig, device: torch.device, **options: Any
) -> Tensor:
    """Train a state-value network by expectile regression, and return the advantage (R, 1) float32 of each row,
    standardized per task.

    The buffer must have ``n_steps`` = :data:`N_STEPS` and ``gamma`` = :data:`GAMMA`.
    """
    value = PlanConditionedValue(plans, ensemble=2).to(device)
    loss = ExpectileValueLoss(value, expectile=0.7).make_value_estimator(gamma=GAMMA)
    OfflineTrainer(loss, replay, config, **options).train()
    starts = range(0, len(replay), _CHUNK)
    chunks = [replay[start : min(start + _CHUNK, len(replay))].to(device) for start in starts]
    advantage = torch.cat([loss.advantage(chunk).cpu() for chunk in chunks])
    return standardize_by_task(advantage, torch.cat([chunk["task_id"].cpu() for chunk in chunks]))


@typed_fields
@dataclass(frozen=True)
class OfflineConfig:
    """Hyperparameters for training with any loss and AdamW. See :class:`BehavioralCloningConfig` for the other fields.

    Attributes:
        learning_rate: initial learning rate of the actor.
        critic_learning_rate: initial learning rate of all other trained parameters.
        target_eps: the fraction of a target network's weights that is kept at each update (as in ``SoftUpdate``).
        normalize: fit the normalization statistics of the features to the buffer's rows before training; use False
            for networks that were trained on other rows.
        max_grad_norm: maximum norm to which the actor's gradients, and separately all other gradients, are clipped.
    """

    steps: Count = 5000
    batch_size: Count = 250
    learning_rate: Scale = 1e-3
    critic_learning_rate: Scale = 5e-4
    weight_decay: Scale = 1e-4
    target_eps: Probability = 0.995
    schedule: Literal["cosine", "constant"] = "cosine"
    normalize: bool = True
    max_grad_norm: Positive = 1.0
    seed: int = 0
    checkpoint_every: Count = 1000


class OfflineTrainer(Training):
    """A trainer for the networks of a loss on a replay buffer.

    Each optimizer step minimizes the sum of the loss's ``loss_`` entries (each has gradients only for one network), and
    then updates the target networks. CQL's entry ``loss_actor_bc`` is left out.

    Args:
        loss: a loss from ``torchrl.objectives`` or ``lw_torchrl.objectives``, with its value estimator
            (``make_value_estimator`` returns None in TorchRL's losses, so call it in a separate statement). The
            networks of the loss are trained in place, on their device.
        replay: a replay buffer whose samples hold the keys that the loss reads.
        config: hyperparameters; None for the defaults.
        actor: the policy inside the loss, which is written to ``checkpoint``, with the training state next to it; None
            writes only the training state to ``checkpoint``.
        **options: keyword arguments of :class:`~lw_torchrl.training.loop.Training`, which also lists their errors.

    Raises:
        ValueError: the buffer does not fit: it evaluates the conditions of other plans, has a PrioritizedSampler, lacks
            rewards or next observations that the loss reads, has an n-step ``gamma`` that differs from the value
            estimator's, or has RandomYaw or JitterTarget, whose keys the loss would not pass on to FocusFeatures or
            RoleFeatures. Or the loss does not fit: it is not reduced to a mean, is a CQLLoss with a Lagrange
            multiplier, or, with ``normalize``, contains a network that was fitted to other statistics.
        TypeError: the loss is not a LossModule.

    Example:
        >>> import lw_torchrl as lw, tempfile
        >>> plans = lw.load_plans("MT10")
        >>> with tempfile.TemporaryDirectory() as root:
        ...     _ = lw.collect_demonstrations("reach", episodes_per_task=1, root=root + "/data", policy="random")
        ...     options = {"label": "executed", "n_steps": 5, "gamma": 0.99, "transform": lw.QAFTransform(plans)}
        ...     replay = lw.LanguageWorldExperienceReplay(root + "/data", **options)
        ...     loss = lw.objectives.ExpectileValueLoss(lw.PlanConditionedValue(plans)).make_value_estimator(gamma=0.99)
        ...     trainer = lw.OfflineTrainer(loss, replay, lw.OfflineConfig(steps=5, batch_size=16), progress=False)
        ...     _ = trainer.train()
        >>> sorted(trainer.last)
        ['loss', 'loss_value', 'value']

    Source: ``torchrl.trainers.Trainer``, without an environment.
    """

    @typed
    def __init__(
        self,
        loss: LossModule,
        replay: TensorDictReplayBuffer,
        config: OfflineConfig | None = None,
        *,
        actor: TensorDictModuleBase | None = None,
        **options: Unpack[TrainingOptions],
    ) -> None:
        check_loss(loss, replay)
        config, self.actor = config or OfflineConfig(), actor
        self.part = None if actor is None else "actor"
        super().__init__(config, **options)
        self.loss, self.module, self.replay, self.networks = loss, loss, replay, networks_of(loss)
        self.device = next(loss.parameters()).device
        check_minibatches(self.networks, replay, config.batch_size)
        check_augmentations(loss, self.networks, replay)
        getattr(loss, "target_entropy", None)  # SACLoss registers this buffer on first access
        self.minibatches = [Minibatches(replay, config.batch_size, config.seed, self.device)]
        delayed = any(name.startswith("target_") and name.endswith("_params") for name, _ in loss.named_children())
        self.targets = SoftUpdate(loss, eps=config.target_eps) if delayed else None
        groups: dict[bool, list[Tensor]] = {True: [], False: []}
        for name, parameter in loss.named_parameters():
            if parameter.requires_grad:
                groups[name.startswith("actor_network_params")].append(parameter)
        rates = (groups[True], config.learning_rate), (groups[False], config.critic_learning_rate)
        self.optimizer = make_optimizer(rates, config, self.device)
        if self.checkpoint is not None:
            self.description = {"loss": describe_loss(loss), "training": asdict(config)}
            self.description |= {"data": describe_data(replay), "replay": describe_replay(replay)}
            if actor is not None:
                check_can_be_saved(actor)
                self.description["actor"] = describe(actor)
        if config.normalize:
            fit_untrained(loss, replay)
        self.resume()

    @property
    def saved(self) -> nn.Module:
        return self.module if self.actor is None else self.actor

    def contents(self) -> dict[str, Tensor]:
        """Return all parameters and buffers of the loss, including target networks and normalization statistics."""
        return {**dict(self.loss.named_parameters()), **dict(self.loss.named_buffers())}

    def losses(self, batch: TensorDictBase) -> Mapping[str, Tensor]:
        values = self.loss(with_n_steps(self.loss, batch))
        if not any(name.startswith("loss_") for name in values.keys()):
            raise ValueError(f"loss must return entries that begin with 'loss_', got {', '.join(values.keys())}")
        return {name: value for name, value in values.items() if name not in _REPLACED}

    def after_update(self) -> None:
        if self.targets is not None:
            self.targets.step()


def networks_of(loss: LossModule) -> list[nn.Module]:
    """Return the networks of a loss; the loss stores their parameters separately."""
    networks = (getattr(loss, name.removesuffix("_params"), None) for name, _ in loss.named_children())
    return [network for network in networks if isinstance(network, nn.Module)]


def check_loss(loss: LossModule, replay: TensorDictReplayBuffer) -> None:
    """Raise an error unless a loss can be trained on a buffer; create TorchRL's default value estimator if missing."""
    if getattr(loss, "reduction", "mean") == "none":
        raise ValueError("loss must be reduced to the mean over the rows, got reduction='none'; use reduction='mean'")
    if getattr(loss, "with_lagrange", False):
        raise ValueError("loss: with_lagrange=True keeps loss_cql from training the critics; use with_lagrange=False")
    ahead = [key for key in loss.in_keys if isinstance(key, tuple) and key[0] == "next"]
    if ahead and len(replay) and "next" not in replay.storage[0].keys():
        raise ValueError("loss requires next observations, which replay lacks; open the buffer with label='executed'")
    gammas = [part.gamma for part in replay.transform if isinstance(part, MultiStepTransform)]
    expected = next(iter(gammas), getattr(replay, "gamma", None))  # None if ``next`` is one time step ahead
    if expected is None or loss.default_value_estimator is None:
        return
    gamma = getattr(loss.value_estimator, "gamma", None)
    if gamma is not None and abs(float(gamma) - expected) > 1e-6:
        advice = f"call loss.make_value_estimator(gamma={expected})"
        raise ValueError(f"loss: gamma must be that of replay, {expected}, got {float(gamma):.6g}; {advice}")


def describe_loss(loss: LossModule) -> dict[str, Any]:
    """Return a JSON description of a loss: class, options, networks, parameter shapes, and a digest of constants."""
    digest, fitted = sha256(), statistics_of(loss)
    for name, tensor in sorted(loss.named_buffers()):
        digest.update(f"{name} {tuple(tensor.shape)}".encode())
        if not name.startswith("target_") and name not in fitted:
            digest.update(tensor.detach().cpu().contiguous().numpy().tobytes())
    return {
        "class": type(loss).__name__,
        "options": plain_options(loss),
        "networks": [type(network).__name__ for network in networks_of(loss)],
        "shapes": {name: list(parameter.shape) for name, parameter in loss.named_parameters()},
        "fixed": digest.hexdigest(),
    }
