"""The versions of the packages that results depend on."""

from __future__ import annotations

from importlib.metadata import version

from lw_torchrl import __version__

_PACKAGES = ("metaworld", "mujoco", "numpy", "tensordict", "torch", "torchrl")


def package_versions() -> dict[str, str]:
    """Package name to version: what results depend on. Ours is that of the code that runs, which the metadata of an
    editable install need not know."""
    return {"lw_torchrl": __version__, **{name: version(name) for name in _PACKAGES}}
