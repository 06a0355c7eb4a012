"""The fast engine: Meta-World bit for bit, at nearly the speed of its physics."""

from lw_torchrl.envs.engines.vectorized.engine import VectorizedEngine, available_cores

__all__ = ["VectorizedEngine", "available_cores"]
