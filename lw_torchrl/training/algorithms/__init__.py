"""The methods of ``lw-torchrl online``: a file each, with what it reads and does, and a line in :data:`LEARNERS`."""

from lw_torchrl._checks import check_choice
from lw_torchrl._registry import Registry, is_class
from lw_torchrl.training.algorithms.advantage import AdvantageConfig, AdvantageLearner
from lw_torchrl.training.algorithms.expert_iteration import ExpertIterationConfig, ExpertIterationLearner
from lw_torchrl.training.algorithms.learner import (
    CriticConfig,
    Learner,
    NoiseConfig,
    OffPolicyConfig,
    OffPolicyLearner,
    OnlineConfig,
    ReplayConfig,
    adamw,
)
from lw_torchrl.training.algorithms.ppo import PPOConfig, PPOLearner
from lw_torchrl.training.algorithms.sac import SACConfig, SACLearner
from lw_torchrl.training.algorithms.td3 import ResidualConfig, ResidualLearner, TD3Config, TD3Learner

LEARNERS = Registry(
    "algorithm",
    "lw_torchrl.algorithms",
    {
        "advantage": AdvantageLearner,
        "td3": TD3Learner,
        "sac": SACLearner,
        "residual": ResidualLearner,
        "ppo": PPOLearner,
        "expert-iteration": ExpertIterationLearner,
    },
    is_class("algorithm", Learner, own_name=False),
)
"""Name to method; yours can be added."""


def method_config(method: str, given: OnlineConfig | None = None) -> OnlineConfig:
    """The configuration of a method: the given one; of a plain :class:`OnlineConfig` with the method's other defaults.

    Raises:
        TypeError: it is another method's.

    Example:
        >>> method_config("td3", OnlineConfig(frames=200)).policy_delay
        2
    """
    own, given = LEARNERS[check_choice("method", method, LEARNERS)].config_type, given or OnlineConfig()
    if type(given) is OnlineConfig:
        return own(**vars(given))
    if type(given) is not own:
        others = " and ".join(repr(name) for name, one in LEARNERS.items() if one.config_type is type(given))
        found = type(given).__name__ + (f", which is of {others}" if others else "")
        raise TypeError(f"config of the method {method!r} must be of class {own.__name__}, got {found}")
    return given


__all__ = [
    "LEARNERS", "AdvantageConfig", "CriticConfig", "ExpertIterationConfig", "Learner", "NoiseConfig",
    "OffPolicyConfig", "OffPolicyLearner", "OnlineConfig", "PPOConfig", "ReplayConfig", "ResidualConfig", "SACConfig",
    "TD3Config", "adamw", "method_config",
]  # fmt: skip
