"""Imports TorchRL, with an error that names a missing rendering library: rooms that use TorchRL import this first."""

from lw_torchrl._util.rendering import naming_absent_renderer

with naming_absent_renderer():
    import torchrl.envs  # noqa: F401
