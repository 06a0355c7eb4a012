"""The versions of the packages that results depend on."""

from __future__ import annotations

from importlib.metadata import version

_PACKAGES = ("lw_torchrl", "metaworld", "mujoco", "numpy", "tensordict", "torch", "torchrl")


def package_versions() -> dict[str, str]:
    """Package name to version: what results depend on."""
    return {name: version(name) for name in _PACKAGES}
