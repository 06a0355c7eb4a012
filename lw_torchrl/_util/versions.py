"""The versions of the packages that results depend on: what was recorded is compared with what is installed."""

import warnings
from collections.abc import Iterable, Mapping
from importlib.metadata import version
from typing import Any

from lw_torchrl import __version__
from lw_torchrl._util.checks import shown

SIMULATORS: tuple[str, ...] = ("metaworld", "mujoco")  # what an episode's physics depend on
LIBRARIES: tuple[str, ...] = ("lw_torchrl", "numpy", "tensordict", "torch", "torchrl")  # and the last bits of results


def package_versions() -> dict[str, str]:
    """Package name to version, of what results depend on; ours is that of the running code."""
    others = sorted({*SIMULATORS, *LIBRARIES} - {"lw_torchrl"})
    return {"lw_torchrl": __version__, **{name: version(name) for name in others}}


def version_changes(recorded: Any, names: Iterable[str]) -> list[str]:
    """The packages installed in another version than was recorded: "mujoco 3.2.0, now 3.3.0"."""
    before, now = recorded if isinstance(recorded, Mapping) else {}, package_versions()
    pairs = [(name, before.get(name), now[name]) for name in names]
    return [f"{name} {shown(was)[1:-1]}, now {is_}" for name, was, is_ in pairs if isinstance(was, str) and was != is_]


def warn_of_other_versions(path: object, recorded: Any, names: Iterable[str] = LIBRARIES) -> None:
    """Warn that a training which began under other versions will not continue bit for bit."""
    if changes := version_changes(recorded, names):
        warnings.warn(
            f"checkpoint: {str(path)!r} was written under other versions ({'; '.join(changes)}): training continues, "
            "but results will not be bit-identical to an uninterrupted run; install these versions for that",
            stacklevel=4,
        )
