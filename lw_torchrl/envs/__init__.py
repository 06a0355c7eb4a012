"""The environment, the engines behind it, and the scripted experts."""

import lw_torchrl._torchrl  # noqa: F401
from lw_torchrl.envs.engine import Engine, EngineStep
from lw_torchrl.envs.experts import ExpertActor
from lw_torchrl.envs.language_world_env import LanguageWorldEnv
from lw_torchrl.envs.seeding import episode_seed

__all__ = ["Engine", "EngineStep", "ExpertActor", "LanguageWorldEnv", "episode_seed"]
