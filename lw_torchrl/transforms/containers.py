"""Where a transform finds itself: the environment under it, and what runs before it."""

from __future__ import annotations

from itertools import product

from tensordict import unravel_key
from tensordict.utils import NestedKey
from torchrl.envs import Compose, EnvBase, RenameTransform, SerialEnv, Transform, TransformedEnv


def base_env(transform: Transform) -> EnvBase | None:
    """The environment under all transforms, None on a replay buffer and in a Compose that is nowhere yet."""
    try:
        env = transform.container
    except ValueError:
        return None
    while isinstance(env, TransformedEnv):
        env = env.base_env
    return env


def refuse_changed(transform: Transform, key: NestedKey) -> None:
    """Raise :class:`ValueError` where a transform that runs before this one changes what it is to read.

    It goes by the keys that transforms say they write, and looks into a SerialEnv once that runs, not into processes.
    """
    for entry, chain in product((key, unravel_key(("next", key))), _before(transform)):
        for earlier in reversed(chain):
            written = [unravel_key(out) for out in earlier.__dict__.get("_out_keys") or ()]
            if entry not in written:
                continue
            if isinstance(earlier, RenameTransform):
                entry = unravel_key(earlier.in_keys[written.index(entry)])
                continue
            name = type(transform).__name__
            raise ValueError(
                f"{type(earlier).__name__} changes {entry!r} before {name} reads it, which is made for the observation "
                f"as it was: put {name} before {type(earlier).__name__}"
            )


def transforms_beside(transform: Transform) -> int:
    """How many transforms its Compose has, 0 where it is in none: the cheap sign that one was put there."""
    container = _container(transform)
    return len(container.transforms) if isinstance(container, Compose) else 0


def _before(transform: Transform) -> list[list[Transform]]:
    """What runs before a transform; of several workers, a list for each."""
    found: list[Transform] = []
    inner, container = transform, _container(transform)
    while isinstance(container, Compose):
        place = next(n for n, member in enumerate(container.transforms) if member is inner)
        found = [one for member in container.transforms[:place] for one in _flat(member)] + found
        inner, container = container, _container(container)
    while isinstance(container, TransformedEnv) and isinstance(container := container.base_env, TransformedEnv):
        found = _flat(container.transform) + found
    return [inner + found for inner in _inside(container)]


def _inside(env: Compose | EnvBase | None) -> list[list[Transform]]:
    """The transforms in an environment, a list for each worker of a SerialEnv that runs."""
    if isinstance(env, TransformedEnv):
        return [inner + _flat(env.transform) for inner in _inside(env.base_env)]
    workers = env.__dict__.get("_envs", ()) if isinstance(env, SerialEnv) else ()
    return [chain for worker in workers for chain in _inside(worker)] or [[]]


def _container(transform: Transform) -> Compose | EnvBase | None:
    reference = transform.__dict__.get("_container")
    return None if reference is None else reference()


def _flat(transform: Transform) -> list[Transform]:
    if isinstance(transform, Compose):
        return [one for member in transform.transforms for one in _flat(member)]
    return [transform]
