"""What training must remember beside the policy: optimizer, schedule, sampler and generators."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

import torch

from lw_torchrl._state_tree import check_like, check_optimizer_state
from lw_torchrl.trainers.checkpoint import misfit

Schedule = torch.optim.lr_scheduler.LRScheduler


class TrainingState:
    """What a trainer must remember beside actor, optimizer and schedule.

    Attributes:
        step: the minibatches done.
        torch_generator: the state of what transforms and the actor draw from in training.
    """

    def __init__(self, sampler: Any, generator: torch.Generator) -> None:
        self.sampler, self.generator, self.step = sampler, generator, 0
        self.torch_generator = generator.get_state()

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
        if not isinstance(sampler, dict) or state_dict["step"] < 0:
            raise ValueError("state must have a step of at least 0 and a sampler's state")
        self.generator.set_state(state_dict["generator"].clone())
        torch.Generator().set_state(state_dict["torch_generator"].clone())
        self.step = state_dict["step"]
        self.torch_generator = state_dict["torch_generator"].clone()
        if sampler:
            self.sampler.load_state_dict(sampler)


def state_of(optimizer: torch.optim.Optimizer, schedule: Schedule, states: Sequence[TrainingState]) -> dict[str, Any]:
    """All that training goes on from, the weights aside."""
    return {
        "optimizer": optimizer.state_dict(),
        "schedule": schedule.state_dict(),
        "states": [state.state_dict() for state in states],
    }


def load_state(
    path: str | os.PathLike[str],
    found: dict[str, Any],
    optimizer: torch.optim.Optimizer,
    schedule: Schedule,
    states: Sequence[TrainingState],
) -> None:
    """Go on from what :func:`state_of` gave, read from ``path``.

    Raises:
        ValueError: it does not fit.
    """
    try:
        if set(found) != {"optimizer", "schedule", "states"}:
            raise ValueError(f"a training state has optimizer, schedule and states, got {', '.join(map(str, found))}")
        check_optimizer_state(found["optimizer"], optimizer)
        check_like(found["schedule"], schedule.state_dict(), "schedule")
        if not isinstance(found["states"], list) or len(found["states"]) != len(states):
            raise ValueError(f"states must be of {len(states)} trainings")
        for state, one in zip(states, found["states"], strict=True):
            state.load_state_dict(one)
        optimizer.load_state_dict(found["optimizer"])
        schedule.load_state_dict(found["schedule"])
    except (ValueError, KeyError, TypeError, RuntimeError, AttributeError) as error:
        raise misfit(path, error) from error
