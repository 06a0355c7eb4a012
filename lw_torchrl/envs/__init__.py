"""The batched environment, its simulation engines, and the scripted experts."""

import lw_torchrl._util.keys  # noqa: F401
from lw_torchrl.envs.language_world_env import LanguageWorldEnv
from lw_torchrl.envs.rows import episode_seed
from lw_torchrl.suites.engine import Engine, EngineStep
from lw_torchrl.suites.metaworld.experts import ExpertActor

__all__ = ["Engine", "EngineStep", "ExpertActor", "LanguageWorldEnv", "episode_seed"]
