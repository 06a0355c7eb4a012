"""Imports TorchRL, for the rooms that use it to import first: an absent rendering library is then named."""

from lw_torchrl._rendering import naming_absent_renderer

with naming_absent_renderer():
    import torchrl.envs  # noqa: F401
