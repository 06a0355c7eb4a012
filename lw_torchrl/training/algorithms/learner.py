"""What learns from the environment, whatever the method: the contract of a learner, and options of several."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from contextlib import nullcontext
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.data import TensorDictReplayBuffer
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import LossModule, SoftUpdate

from lw_torchrl._checks import Count, Natural, Probability, Scale, check_choice, check_fields
from lw_torchrl.modules.conditioned_actor import ConditionedActor, encoder_from_description
from lw_torchrl.modules.critics import QValue
from lw_torchrl.modules.descriptor_conditioned_actor import DescriptorEncoder
from lw_torchrl.modules.networks import DistributionName
from lw_torchrl.modules.plan_encoder import PlanEncoder
from lw_torchrl.modules.policy import Encoder, Policy, kind_of
from lw_torchrl.modules.residual_actor import ResidualActor
from lw_torchrl.training.checkpoint import copy_tensors


@dataclass(frozen=True, kw_only=True)
class OnlineConfig:
    """How a policy is trained in its environment: what every method reads. Each has a subclass with what else it reads.

    Attributes:
        frames: steps of the environment in all, of every row; ``rows`` must divide it.
        rows: environments at once.
        max_steps: of an episode, until truncation.
        round_steps: steps of each row in a round. At its end all rows begin new episodes, and a checkpoint is written.
        exploration_hold: steps of each row between two turns of the learner, for which each draw of noise is kept.
        batch_size: rows of a minibatch; half of it is demonstrations, of methods that learn from them.
        gamma: the discount; that of the buffer.
        seed: of the environment's episodes, of critics' first weights, of minibatches and noise.
    """

    frames: Count = 60_000
    rows: Count = 20
    max_steps: Count = 250
    round_steps: Count = 250
    exploration_hold: Count = 5
    batch_size: Count = 200
    gamma: Probability = 0.99
    seed: int = 0

    def __post_init__(self) -> None:
        check_fields(self)
        if self.frames % self.rows:
            raise ValueError(
                f"frames must be a multiple of rows, {self.rows}, got {self.frames}; the nearest is "
                f"{max(1, round(self.frames / self.rows)) * self.rows}"
            )

    @property
    def steps(self) -> int:
        """Steps of each row in all."""
        return self.frames // self.rows

    @property
    def rounds(self) -> int:
        """How many there are, the last one perhaps shorter."""
        return -(-self.steps // self.round_steps)

    def due(self, frames: int) -> int:
        """The gradient steps that are to be made in the first so many steps of the environment, before a round ends."""
        return 0


@dataclass(frozen=True, kw_only=True)
class ReplayConfig(OnlineConfig):
    """Of methods that learn from the buffer: demonstrations and rows that came."""

    utd: Scale = 0.4  # gradient steps for each step of the environment
    first_frames: Natural = 1_000  # steps of the environment before the first gradient step
    distance: Literal["l1", "l2"] = "l1"  # to the action that is imitated

    def due(self, frames: int) -> int:
        return int(max(0, frames - self.first_frames) * self.utd)


@dataclass(frozen=True, kw_only=True)
class NoiseConfig(ReplayConfig):
    """Of methods that explore by noise on the executed action; others draw actions from a distribution."""

    exploration: Scale = 0.05  # the noise's standard deviation
    stuck_exploration: Scale = 0.5  # of the hand where a plan has not gone on for longer than in any demonstration
    gripper_exploration: Scale = 0.2  # what ``exploration`` is multiplied by for the gripper


@dataclass(frozen=True, kw_only=True)
class CriticConfig(ReplayConfig):
    """Of methods with critics and their targets."""

    warm_up: Natural = 2_000  # gradient steps in which the critics alone are trained
    critic_learning_rate: Scale = 5e-4  # of AdamW
    target_eps: Probability = 0.995  # how much of the target networks stays, in each gradient step


class Learner:
    """How a policy learns: a subclass makes what it trains, and says what it does with rows and at a round's end.

    Args:
        start: the policy to begin with.
        replay, config, critic: as of :class:`~lw_torchrl.OnlineTrainer`; the configuration is of ``config_type``.

    Attributes:
        config_type: of its configuration; a :class:`NoiseConfig` adds noise to its actions, others draw them.
        policy: what acts, and is kept: the start itself, or another made of it.
        loss: holds all that is trained.
        optimizers: by what they train.
        wants_round: whether :meth:`end_round` reads the round's rows.
        made: gradient steps.
    """

    config_type: ClassVar[type[OnlineConfig]] = OnlineConfig
    wants_round = False
    config: Any
    loss: nn.Module

    def __init__(
        self, start: Policy, replay: TensorDictReplayBuffer, config: OnlineConfig, critic: QValue | None = None
    ) -> None:
        self.policy, self.replay, self.config = start.eval(), replay, config
        self.optimizers: dict[str, torch.optim.Optimizer] = {}
        self.made = 0
        self._told: dict[str, list[Tensor]] = {}
        kind = type(self)
        if kind.learn is not Learner.learn and type(config).due is OnlineConfig.due:
            what = f"config_type of {kind.__name__} must be derived from ReplayConfig or NoiseConfig"
            raise TypeError(f"{what}, of whose configurations gradient steps are due, got {type(config).__name__}")
        self.make(critic)
        if not isinstance(getattr(self, "loss", None), nn.Module):
            raise TypeError(f"make of {kind.__name__} must set self.loss, a module that holds all that is trained")

    def make(self, critic: Any) -> None:
        """Make ``loss`` and ``optimizers`` of ``policy`` and a critic that was given, or None: :meth:`q_value` makes
        one then."""

    def q_value(self, given: Any) -> QValue:
        """The critic that is given, or one that sees what the policy sees, normalised as it is, in eval mode."""
        if given is None:
            return QValue(encoder_like(self.policy)).eval()
        if not isinstance(given, QValue):
            raise TypeError(f"critic must be a QValue, which judges actions, got {type(given).__name__}")
        return given.eval()

    def act(self, state: TensorDictBase) -> TensorDictBase:
        """Write ``action`` (N, 4) float32, without the noise."""
        with nullcontext() if isinstance(self.config, NoiseConfig) else set_exploration_type(ExplorationType.RANDOM):
            return self.policy(state)

    def noise_weight(self, state: TensorDictBase) -> Tensor | float:
        """What the noise is multiplied by, (N, 1) float32 or 1.0: a residual of some steps has noise in these alone."""
        policy = self.policy
        of_steps = isinstance(policy, ResidualActor) and policy.steps is not None
        return state.get(policy.out_keys_source[2]) if of_steps else 1.0

    def observe(self, rows: TensorDictBase) -> None:
        """Take rows (N, T) that came, time last; what samples from the buffer extends it here."""

    def learn(self, steps: int) -> None:
        """Make so many gradient steps."""

    def end_round(self, rows: TensorDictBase | None, steps: int) -> None:
        """Take all rows (N, T) of a round, in which so many gradient steps were due."""

    def tell(self, **values: Tensor) -> None:
        """Note what is to be logged, () float32 each."""
        for name, value in values.items():
            self._told.setdefault(name, []).append(value.detach())

    def told(self) -> dict[str, float]:
        """The mean of each of what was noted since the last call."""
        means = {name: float(torch.stack(values).mean()) for name, values in self._told.items()}
        self._told = {}
        return means

    def optimize(self, name: str, loss: Tensor) -> None:
        """A step of an optimizer; :class:`ValueError` names the nearest if there is none of that name."""
        check_choice("name of an optimizer", name, self.optimizers)
        self.optimizers[name].zero_grad()
        loss.backward()
        self.optimizers[name].step()

    def state_dict(self) -> dict[str, Any]:
        """All that learning goes on from."""
        return {
            "made": self.made,
            "tensors": {name: tensor.detach() for name, tensor in tensors_of(self.loss).items()},
            "optimizers": {name: one.state_dict() for name, one in self.optimizers.items()},
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from what :meth:`state_dict` gave; :class:`ValueError` if it is another learner's, or holds NaN."""
        copy_tensors(state["tensors"], tensors_of(self.loss))
        for name, optimizer in self.optimizers.items():
            optimizer.load_state_dict(state["optimizers"][name])
        self.made = state["made"]


def tensors_of(module: nn.Module) -> dict[str, Tensor]:
    """All parameters and buffers of a module by name; a loss's targets and statistics among them."""
    return {**dict(module.named_parameters()), **dict(module.named_buffers())}


@dataclass(frozen=True, kw_only=True)
class OffPolicyConfig(CriticConfig):
    """Of methods whose actor follows critics that judge actions."""

    actor_learning_rate: Scale = 1e-4  # of AdamW
    bc_weight: Scale = 2.0  # of the imitation of demonstrations


class OffPolicyLearner(Learner):
    """Learns from demonstrations and rows that came, half of a minibatch each, with critics and their targets."""

    config: OffPolicyConfig
    loss: Any
    targets: SoftUpdate

    def set_loss(self, loss: LossModule) -> None:
        """What is trained: a loss with ``actor_network`` and ``qvalue_network``."""
        self.loss = loss
        loss.make_value_estimator(gamma=self.config.gamma)
        self.targets = SoftUpdate(loss, eps=self.config.target_eps)
        actor, critics = loss.actor_network_params, loss.qvalue_network_params
        self.optimizers["actor"] = adamw(actor.values(True, True), self.config.actor_learning_rate)
        self.optimizers["critic"] = adamw(critics.values(True, True), self.config.critic_learning_rate)

    def observe(self, rows: TensorDictBase) -> None:
        self.replay.extend(rows)


def adamw(parameters: Iterable[Tensor], learning_rate: float) -> torch.optim.Optimizer:
    """AdamW on what is trained of some parameters."""
    trained = [parameter for parameter in parameters if parameter.requires_grad]
    rate = float(learning_rate)
    return torch.optim.AdamW([{"params": trained, "initial_lr": rate}], lr=rate, fused=True)


def encoder_like(policy: Policy) -> Encoder:
    """A fresh encoder, without noise, that sees what a policy's sees, with its statistics."""
    actor = policy.base if isinstance(policy, ResidualActor) else policy
    if not isinstance(actor, ConditionedActor):
        raise TypeError(f"critic must be given for a {type(policy).__name__}, which has no encoder to make one like")
    encoder: Encoder = actor.encoder
    options: dict[str, Any] = {"features": encoder.features.kind, "text_encoder": encoder.text_encoder}
    made: Encoder
    if isinstance(encoder, DescriptorEncoder):
        made = DescriptorEncoder(encoder.definitions.values(), condition=encoder.config["condition"], **options)
    elif isinstance(encoder, PlanEncoder):
        made = PlanEncoder(encoder.plans, **options)
    else:
        told = {**kind_of(encoder), "options": encoder.config, **encoder.describe()}
        made = encoder_from_description(told, encoder.text_encoder)
        made.features.noise = 0.0
    made.features.load_state_dict(encoder.features.state_dict())
    return made


def stochastic(policy: Policy, distribution: DistributionName, init_std: float) -> ConditionedActor:
    """An actor with a distribution, in eval mode: the policy itself if it has one."""
    if not isinstance(policy, ConditionedActor):
        raise TypeError(f"actor must be one that can have a distribution, got {type(policy).__name__}")
    return (policy.stochastic(distribution, init_std) if policy.head.distribution is None else policy).eval()
