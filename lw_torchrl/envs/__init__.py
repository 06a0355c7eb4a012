"""The environment, the engines behind it, query answering as a transform, and the scripted experts."""

from lw_torchrl.envs.engine import Engine, EngineStep
from lw_torchrl.envs.experts import ExpertActor
from lw_torchrl.envs.language_world_env import LanguageWorldEnv
from lw_torchrl.envs.qaf_transform import QAFTransform
from lw_torchrl.envs.seeding import episode_seed

__all__ = ["Engine", "EngineStep", "ExpertActor", "LanguageWorldEnv", "QAFTransform", "episode_seed"]
