"""Reproducible random generators for episodes, and comparisons of settings and package versions."""

import warnings
from collections.abc import Iterable, Mapping
from hashlib import blake2b
from importlib.metadata import version
from typing import Any

import numpy as np

from lw_torchrl import __version__
from lw_torchrl._util.checks import Natural, check_value, shown
from lw_torchrl.language.tasks import Task, get_task

SIMULATORS: tuple[str, ...] = ("metaworld", "mujoco")  # packages that determine the physics
LIBRARIES: tuple[str, ...] = ("lw_torchrl", "numpy", "tensordict", "torch", "torchrl")  # can change the last bits


def episode_hash(purpose: str, task: str | Task, seed: int, episode: int) -> int:
    """Return a hash in [0, 2**63) of a purpose, task, seed and episode, the same on every machine."""
    # A name with a prefix, such as "desk/push", is used as given, so its suite need not be installed.
    name = task if isinstance(task, str) and "/" in task else get_task(task).name
    text = f"lw_torchrl/{purpose}/{name}/{check_value('seed', seed, int)}/{check_value('episode', episode, Natural)}"
    return int.from_bytes(blake2b(text.encode(), digest_size=8).digest(), "little") >> 1


def episode_generator(purpose: str, task: str | Task, seed: int, episode: int) -> np.random.Generator:
    """Return a new random number generator for one purpose in an episode."""
    return np.random.Generator(np.random.Philox(episode_hash(purpose, task, seed, episode)))


def package_versions() -> dict[str, str]:
    """Return the versions, by package name, of the packages that results depend on. For lw_torchrl, this is the version
    of the running code."""
    return {name: _installed(name) for name in ("lw_torchrl", *sorted({*SIMULATORS, *LIBRARIES} - {"lw_torchrl"}))}


def _installed(name: str) -> str:
    return __version__ if name == "lw_torchrl" else version(name)


def differences(was: Mapping[str, Any], now: Mapping[str, Any], inside: str = "") -> list[str]:
    """Return the keys that differ in two nested mappings, with their values if short, as in "steps (40, now 30)"."""
    names = []
    for key in sorted({**was, **now}):
        before, after = was.get(key), now.get(key)
        if isinstance(before, Mapping) and isinstance(after, Mapping):
            names += differences(before, after, f"{inside}{key}.")
        elif before != after:
            values = f"{shown(before)}, now {shown(after)}"
            names.append(f"{inside}{key}" + (f" ({values})" if len(values) <= 60 else ""))
    return names


def version_changes(recorded: Any, names: Iterable[str]) -> list[str]:
    """Return the packages whose installed version differs from the recorded one, as "mujoco 3.2.0, now 3.3.0"."""
    before = recorded if isinstance(recorded, Mapping) else {}
    pairs = [(name, before[name], _installed(name)) for name in names if isinstance(before.get(name), str)]
    return [f"{name} {shown(was)[1:-1]}, now {now}" for name, was, now in pairs if was != now]


def warn_of_other_versions(path: object, recorded: Any, names: Iterable[str] = LIBRARIES) -> None:
    """Warn if a checkpoint was written with different package versions, in which case training will not resume
    bit-exactly."""
    if changes := version_changes(recorded, names):
        warnings.warn(
            f"checkpoint: {str(path)!r} was written with other versions ({'; '.join(changes)}): training continues, "
            "but results will not be bit-identical to an uninterrupted run; install the recorded versions for that",
            stacklevel=4,
        )
