"""How a policy is trained in its environment."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from lw_torchrl._checks import check_choice, check_fields, check_int, check_probability, check_scale


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
        for name in (
            "frames",
            "rows",
            "max_steps",
            "round_steps",
            "batch_size",
            "policy_delay",
            "exploration_hold",
            "epochs",
        ):
            check_int(name, getattr(self, name), minimum=1)
        for name in ("first_frames", "warm_up"):
            check_int(name, getattr(self, name), minimum=0)
        for name in (
            "utd",
            "actor_learning_rate",
            "critic_learning_rate",
            "cloning_learning_rate",
            "beta",
            "policy_noise",
            "noise_clip",
            "bc_weight",
            "exploration",
            "stuck_exploration",
            "gripper_exploration",
            "init_std",
            "entropy",
            "clip",
            "residual_scale",
        ):
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
