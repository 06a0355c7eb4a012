"""What learns from the environment, whatever the method: the options, and the contract of a learner."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.data import TensorDictReplayBuffer
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import LossModule, SoftUpdate

from lw_torchrl._checks import check_choice, check_fields, check_int, check_probability, check_scale
from lw_torchrl._state_tree import check_like, check_optimizer_state
from lw_torchrl.modules.conditioned_actor import ConditionedActor
from lw_torchrl.modules.critics import QValue
from lw_torchrl.modules.descriptor_conditioned_actor import DescriptorEncoder
from lw_torchrl.modules.encoder import Encoder
from lw_torchrl.modules.networks import DistributionName
from lw_torchrl.modules.plan_encoder import PlanEncoder
from lw_torchrl.modules.policy import Policy
from lw_torchrl.modules.residual_actor import ResidualActor
from lw_torchrl.training.file_checks import copy_weights, tensors_of

_FROM_1 = ("frames", "rows", "max_steps", "round_steps", "batch_size", "policy_delay", "exploration_hold", "epochs")
_RATES = ("actor_learning_rate", "critic_learning_rate", "cloning_learning_rate", "utd")
_WEIGHTS = ("beta", "bc_weight", "entropy", "clip", "residual_scale")
_NOISES = ("policy_noise", "noise_clip", "exploration", "stuck_exploration", "gripper_exploration", "init_std")


@dataclass(frozen=True)
class OnlineConfig:
    """How a policy is trained in its environment. What a method does not do, it does not read.

    Attributes:
        frames: steps of the environment in all, of every row; ``rows`` must divide it.
        rows: environments at once.
        max_steps: of an episode, until truncation.
        round_steps: steps of each row in a round. At its end all rows begin new episodes, and a checkpoint is written.
        utd: gradient steps for each step of the environment.
        batch_size: rows of a minibatch; half of it is demonstrations.
        first_frames: steps of the environment before the first gradient step.
        warm_up: gradient steps in which the critics alone are trained.
        actor_learning_rate, critic_learning_rate: of AdamW.
        cloning_learning_rate: of AdamW, of the actors of "advantage" and "expert-iteration".
        gamma: the discount; that of the buffer.
        target_eps: how much of the target networks stays, in each gradient step.
        expectile: of the value, of "advantage".
        beta: how sharply advantages weigh, of "advantage".
        policy_delay: gradient steps of the critics for one of the actor, of "td3" and "residual".
        policy_noise, noise_clip: of the targets' actions, of "td3" and "residual".
        bc_weight: of the imitation of demonstrations.
        distance: to the action that is imitated.
        exploration: standard deviation of the noise on the executed action.
        stuck_exploration: the same for the hand where the plan has not gone on for longer than in any demonstration; of
            a policy without a plan, and of distributions, "sac" and "ppo", it is not read.
        exploration_hold: steps for which each draw of it is kept.
        gripper_exploration: what it is multiplied by for the gripper.
        init_std: the distribution's standard deviation at first, of "sac" and "ppo".
        entropy: weight of the entropy, of "ppo", and where that of "sac" begins.
        gae_lambda, epochs, clip: of "ppo"; ``utd`` is not read.
        residual_scale: how far the action can be corrected, of "residual".
        seed: of the environment's episodes, of critics' first weights, of minibatches and noise.
    """

    frames: int = 60_000
    rows: int = 20
    max_steps: int = 250
    round_steps: int = 250
    utd: float = 0.4
    batch_size: int = 200
    first_frames: int = 1_000
    warm_up: int = 2_000
    actor_learning_rate: float = 1e-4
    critic_learning_rate: float = 5e-4
    cloning_learning_rate: float = 3e-4
    gamma: float = 0.99
    target_eps: float = 0.995
    expectile: float = 0.7
    beta: float = 2.0
    policy_delay: int = 2
    policy_noise: float = 0.1
    noise_clip: float = 0.3
    bc_weight: float = 2.0
    distance: Literal["l1", "l2"] = "l1"
    exploration: float = 0.05
    stuck_exploration: float = 0.5
    exploration_hold: int = 5
    gripper_exploration: float = 0.2
    init_std: float = 0.15
    entropy: float = 1e-3
    gae_lambda: float = 0.95
    epochs: int = 10
    clip: float = 0.2
    residual_scale: float = 0.3
    seed: int = 0

    def __post_init__(self) -> None:
        check_fields(self)
        for name in (*_FROM_1, "first_frames", "warm_up"):
            check_int(name, getattr(self, name), minimum=int(name in _FROM_1))
        for name in (*_RATES, *_WEIGHTS, *_NOISES):
            check_scale(name, getattr(self, name))
        for name in ("gamma", "target_eps", "expectile", "gae_lambda"):
            check_probability(name, getattr(self, name))
        check_choice("distance", self.distance, ("l1", "l2"))
        check_int("seed", self.seed)
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


class Learner:
    """How a policy learns: a subclass makes what it trains, and says what it does with rows and at a round's end.

    Args:
        start: the policy to begin with.
        replay: demonstrations, and what comes.
        config: how to train.
        critic: whose copies are trained, where the method has one; None for one that sees what the policy sees.

    Attributes:
        policy: what acts, and is kept: the start itself, or another made of it.
        loss: holds all that is trained.
        optimizers: by what they train.
        noisy: whether noise is added to its actions; if not, they are drawn from its distribution.
        wants_round: whether :meth:`end_round` reads the round's rows.
        made: gradient steps.
    """

    loss: nn.Module
    noisy = True
    wants_round = False

    def __init__(
        self, start: Policy, replay: TensorDictReplayBuffer, config: OnlineConfig, critic: QValue | None = None
    ) -> None:
        self.policy, self.replay, self.config = start.eval(), replay, config
        self.optimizers: dict[str, torch.optim.Optimizer] = {}
        self.made = 0
        self._told: dict[str, list[Tensor]] = {}
        self.make(critic)

    def make(self, critic: Any) -> None:
        """Make ``loss`` and ``optimizers`` of ``policy`` and a critic that was given, or None."""

    def act(self, state: TensorDictBase) -> TensorDictBase:
        """Write ``action`` (N, 4) float32, without the noise."""
        if self.noisy:
            return self.policy(state)
        with set_exploration_type(ExplorationType.RANDOM):
            return self.policy(state)

    def noise_weight(self, state: TensorDictBase) -> Tensor | float:
        """What the noise is multiplied by, (N, 1) float32 or 1.0: a residual of some steps has noise in these alone."""
        policy = self.policy
        of_steps = isinstance(policy, ResidualActor) and policy.steps is not None
        return state.get(policy.out_keys_source[2]) if of_steps else 1.0

    def observe(self, rows: TensorDictBase) -> None:
        """Take rows (N, T) that came, time last."""

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
        """A step of an optimizer."""
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
        ours = self.state_dict()
        check_like({**state, "optimizers": None}, {**ours, "optimizers": None}, "learner")
        if not isinstance(state["optimizers"], Mapping) or set(state["optimizers"]) != set(self.optimizers):
            raise ValueError(f"optimizers must be {', '.join(self.optimizers)}")
        for name, optimizer in self.optimizers.items():
            check_optimizer_state(state["optimizers"][name], optimizer, state["made"])
        copy_weights(state["tensors"], tensors_of(self.loss))
        for name, optimizer in self.optimizers.items():
            optimizer.load_state_dict(state["optimizers"][name])
        self.made = state["made"]


class OffPolicyLearner(Learner):
    """Learns from demonstrations and rows that came, half of a minibatch each, with critics and their targets."""

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

    def q_value(self, given: Any) -> QValue:
        """The critic that is given, or one that sees what the policy sees, in eval mode."""
        if given is None:
            return QValue(encoder_like(self.policy)).eval()
        if not isinstance(given, QValue):
            raise TypeError(f"critic must be a QValue, which judges actions, got {type(given).__name__}")
        return given.eval()

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
    encoder = actor.encoder
    options: dict[str, Any] = {"features": encoder.features.kind, "text_encoder": encoder.text_encoder}
    made: Encoder
    if isinstance(encoder, DescriptorEncoder):
        made = DescriptorEncoder(encoder.definitions.values(), condition=encoder.config["condition"], **options)
    else:
        assert encoder.plans is not None
        made = PlanEncoder(encoder.plans, **options)
    made.features.load_state_dict(encoder.features.state_dict())
    return made


def stochastic(policy: Policy, distribution: DistributionName, init_std: float) -> ConditionedActor:
    """An actor with a distribution, in eval mode: the policy itself if it has one."""
    if not isinstance(policy, ConditionedActor):
        raise TypeError(f"actor must be one that can have a distribution, got {type(policy).__name__}")
    return (policy.stochastic(distribution, init_std) if policy.head.distribution is None else policy).eval()
