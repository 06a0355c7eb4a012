"""The methods of ``lw-torchrl online``: a file each, and a line in :data:`LEARNERS`."""

from lw_torchrl.training.algorithms.advantage import AdvantageLearner
from lw_torchrl.training.algorithms.expert_iteration import ExpertIterationLearner
from lw_torchrl.training.algorithms.learner import Learner, OnlineConfig
from lw_torchrl.training.algorithms.ppo import PPOLearner
from lw_torchrl.training.algorithms.sac import SACLearner
from lw_torchrl.training.algorithms.td3 import ResidualLearner, TD3Learner

LEARNERS: dict[str, type[Learner]] = {
    "advantage": AdvantageLearner,
    "td3": TD3Learner,
    "sac": SACLearner,
    "residual": ResidualLearner,
    "ppo": PPOLearner,
    "expert-iteration": ExpertIterationLearner,
}
"""Name to method; yours can be added."""

__all__ = ["LEARNERS", "Learner", "OnlineConfig"]
