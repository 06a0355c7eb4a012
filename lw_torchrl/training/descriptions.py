"""Descriptions of replay buffers, transforms and losses as JSON, by which a resumed training knows its own."""

from __future__ import annotations

from typing import Any

from torch import nn
from torchrl.envs import Compose, Transform

_REPLAY_OPTIONS = ("label", "reward", "terminate_on_success", "n_steps", "gamma", "columns")


def describe_data(replay: Any) -> dict[str, Any] | None:
    """Describe a replay buffer's demonstrations as JSON; None for a buffer without :class:`Demonstrations`."""
    demonstrations = getattr(replay, "demonstrations", None)
    return None if demonstrations is None else demonstrations.config.to_json()


def describe_replay(replay: Any) -> dict[str, Any]:
    """Describe how a replay buffer makes its batches, as JSON."""
    transforms = [one for one in replay.transform.modules() if isinstance(one, Transform)]
    options = {name: getattr(replay, name) for name in _REPLAY_OPTIONS if hasattr(replay, name)}
    return options | {
        "rows": None if describe_data(replay) is None else len(replay),  # after_success leaves so many
        "sampler": type(replay.sampler).__name__,
        "transforms": [
            {"class": type(one).__name__} | {name: repr(value) for name, value in plain_options(one).items()}
            for one in transforms
            if not isinstance(one, Compose)
        ],
    }


def plain_options(module: nn.Module) -> dict[str, bool | int | float | str]:
    """Return the attributes of a transform or a loss that are flags, numbers and texts."""
    options = {name: value for name, value in vars(module).items() if name[0] != "_" and name != "training"}
    return {name: value for name, value in options.items() if isinstance(value, (bool, int, float, str))}
