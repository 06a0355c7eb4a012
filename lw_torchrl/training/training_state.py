"""What training must remember beside the policy (optimizer, schedule, sampler and generators), and reading it back."""

from __future__ import annotations

import json
import os
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torchrl.data import TensorDictReplayBuffer

from lw_torchrl._checks import differences, shown
from lw_torchrl._files import held, sweep
from lw_torchrl._state_tree import check_like, check_optimizer_state, check_same, join
from lw_torchrl._versions import LIBRARIES, warn_of_other_versions
from lw_torchrl.modules.policy import Policy
from lw_torchrl.training.checkpoint import open_policy, read_description
from lw_torchrl.training.policy_checks import check_texts, copy_weights, first_line, text_vectors

_ADDED = {"actors", "replay"}
"""What descriptions did not say at first: a training that was begun before then goes on."""

Schedule = torch.optim.lr_scheduler.LRScheduler


class TrainingState:
    """What a trainer must remember beside actor, optimizer and schedule; from its seed on the buffer draws.

    Attributes:
        step: the minibatches done.
        torch_generator: the state of what transforms and the actor draw from in training.
    """

    def __init__(self, replay: TensorDictReplayBuffer, seed: int) -> None:
        self.sampler, self.generator, self.step = replay.sampler, torch.Generator().manual_seed(seed), 0
        replay.set_rng(self.generator)
        self.torch_generator = self.generator.get_state()

    def state_dict(self) -> dict[str, Any]:
        return {
            "step": self.step,
            "generator": self.generator.get_state(),
            "torch_generator": self.torch_generator.clone(),
            "sampler": dict(self.sampler.state_dict()),
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        sampler = state_dict.get("sampler")
        check_like({**state_dict, "sampler": None}, {**self.state_dict(), "sampler": None}, "state")
        if not isinstance(sampler, dict) or set(sampler) != set(self.sampler.state_dict()):
            raise ValueError(f"state must have a sampler's state, one of a {type(self.sampler).__name__}")
        self.generator.set_state(state_dict["generator"].clone())
        torch.Generator().set_state(state_dict["torch_generator"].clone())
        self.step = state_dict["step"]
        self.torch_generator = state_dict["torch_generator"].clone()
        if sampler:
            self.sampler.load_state_dict(sampler)


class OneWriter:
    """Keeps a checkpoint to one training at a time; what killed ones left beside it goes.

    Args:
        path: the checkpoint; None for a training without one.
    """

    def __init__(self, path: Path | None) -> None:
        self.path = path
        if path is not None:
            sweep(path)
        self.know()

    def know(self) -> None:
        """This training knows the file as it is now: it goes on from it, or wrote it."""
        self._known = self._found()

    def _found(self) -> tuple[int, ...] | None:
        if self.path is None or not self.path.exists():
            return None
        stat = self.path.stat()
        return stat.st_ino, stat.st_size, stat.st_mtime_ns

    @contextmanager
    def alone(self) -> Iterator[None]:
        """Keep other trainings out while the block lasts.

        Raises:
            ValueError: another one is at work, or has written the checkpoint meanwhile.
        """
        if self.path is None:
            yield
            return
        with held(self.path, "checkpoint", "training"):
            if self._found() not in (None, self._known):
                raise ValueError(
                    f"checkpoint: {str(self.path)!r} was written by another training after this one had begun; begin "
                    "anew to go on from it, or choose another file"
                )
            yield


def state_of(optimizer: torch.optim.Optimizer, schedule: Schedule, states: Sequence[TrainingState]) -> dict[str, Any]:
    """All that training goes on from, the weights aside."""
    return {
        "optimizer": optimizer.state_dict(),
        "schedule": schedule.state_dict(),
        "states": [state.state_dict() for state in states],
    }


def check_description(path: Path, ours: dict[str, Any]) -> None:
    """Raise :class:`ValueError` unless the policy file was saved with the description ``ours``."""
    check_same_description(path, read_description(path), ours)


def check_same_description(path: Path, found: dict[str, Any], ours: dict[str, Any]) -> None:
    """Raise :class:`ValueError` unless a file's description ``found`` is ``ours``."""
    ours = json.loads(json.dumps(ours))  # JSON has lists alone
    for part in ours:
        if part in _ADDED and part not in found:
            continue
        if found.get(part) != ours[part]:
            before, now = found.get(part) or {}, ours[part] or {}
            different = differences(before if isinstance(before, dict) else {}, now)
            kind = "architecture" if part in ("actor", "actors", "loss") else "configuration"
            raise ValueError(
                f"checkpoint: {str(path)!r} is of another {kind}, its {part} differs in "
                f"{', '.join(different[:8])}{', ...' * (len(different) > 8)}; choose another file, or delete it to "
                "start again"
            )


def where(device: torch.device) -> dict[str, str]:
    """What a checkpoint says of the device that it was trained on; of the CPU, nothing."""
    return {} if device.type == "cpu" else {"device": device.type}


def warn_of_another_device(path: Path, device: torch.device) -> None:
    """Warn that a training which was begun on another kind of device will not go on bit for bit."""
    if (before := read_description(path).get("device", "cpu")) != device.type:
        warnings.warn(
            f"checkpoint: {str(path)!r} was trained on {shown(before)} and goes on on {device.type!r}: with the same "
            "minibatches, but sums are rounded, and noise is drawn, in another way",
            stacklevel=3,
        )


def load_training(
    path: str | os.PathLike[str],
    actor: Policy,
    weights: Mapping[str, Tensor],
    packages: Sequence[str] = LIBRARIES,
) -> dict[str, Any]:
    """Copy a file's weights into those of live actors, in place, and return the state of their training.

    Args:
        path: the file.
        actor: whose texts it must have.
        weights: of the live actors.
        packages: what the bits of the training hang on.

    Warns:
        UserWarning: the file was written under other versions of these.

    Raises:
        ValueError: they do not fit, or the file has no training state.
    """
    archive = open_policy(path)
    warn_of_other_versions(path, archive.description.get("versions"), packages)
    try:
        state = join(archive.description.get("state"), archive.tensors("training"))
        if not isinstance(state, dict):
            raise ValueError("it has no training state")
        check_texts(archive.tensors("texts"), text_vectors(actor))
        copy_weights(archive.tensors("weights"), weights)
    except (ValueError, RecursionError) as error:
        raise misfit(path, error) from error
    return state


def load_state(
    path: str | os.PathLike[str],
    found: dict[str, Any],
    optimizer: torch.optim.Optimizer,
    schedule: Schedule,
    states: Sequence[TrainingState],
    steps: int,
) -> None:
    """Go on from what :func:`state_of` gave, read from ``path``, in a training of so many steps.

    Raises:
        ValueError: it does not fit.
    """
    try:
        if set(found) != {"optimizer", "schedule", "states"}:
            raise ValueError(f"a training state has optimizer, schedule and states, got {', '.join(map(str, found))}")
        if not isinstance(found["states"], list) or len(found["states"]) != len(states):
            raise ValueError(f"states must be of {len(states)} trainings")
        step = found["states"][0]["step"]
        if type(step) is not int or not 0 <= step <= steps or any(one["step"] != step for one in found["states"]):
            raise ValueError(f"states must all have one step from 0 to {steps}")
        check_optimizer_state(found["optimizer"], optimizer, step)
        _check_schedule(found["schedule"], schedule.state_dict(), found["optimizer"]["param_groups"], step)
        for state, one in zip(states, found["states"], strict=True):
            state.load_state_dict(one)
        optimizer.load_state_dict(found["optimizer"])
        schedule.load_state_dict(found["schedule"])
    except (ValueError, KeyError, TypeError, RuntimeError, AttributeError) as error:
        raise misfit(path, error) from error


def _check_schedule(found: Any, live: dict[str, Any], groups: list[dict[str, Any]], step: int) -> None:
    """Raise :class:`ValueError` unless ``found`` is the live schedule's state after so many steps."""
    check_like(found, live, "schedule")
    now = {"last_epoch": step, "_step_count": step + 1, "_last_lr": [group["lr"] for group in groups]}
    check_same(found, {**live, **now}, "schedule", set())


def misfit(path: str | os.PathLike[str], error: Exception) -> ValueError:
    """The error for a file whose parts do not fit."""
    return ValueError(
        f"checkpoint: {str(path)!r} does not fit, it is of another architecture or damaged ({first_line(error)})"
    )
