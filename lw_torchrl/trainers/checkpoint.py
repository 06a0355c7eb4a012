"""Checkpoints: one file, replaced whole, read without unpickling, that holds an actor and how its training stands."""

from __future__ import annotations

import os
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torchrl.checkpoint import Checkpoint, CheckpointError

from lw_torchrl._checks import check_choice
from lw_torchrl.language.formats.chain_py import format_plan, parse_plan
from lw_torchrl.language.plans import Plans
from lw_torchrl.modules import ActorEnsemble, DescriptorConditionedActor, PlanConditionedActor

ACTORS = ("ActorEnsemble", "DescriptorConditionedActor", "PlanConditionedActor")
Actor = PlanConditionedActor | DescriptorConditionedActor
Policy = Actor | ActorEnsemble


def describe_actor(actor: nn.Module) -> dict[str, Any]:
    """What is needed to make the actor again, its weights aside, as JSON."""
    if isinstance(actor, ActorEnsemble):
        return {"kind": "ActorEnsemble", "members": [describe_actor(member) for member in actor.members]}
    if isinstance(actor, PlanConditionedActor):
        plans = {task: format_plan(plan) for task, plan in actor.plans.items()}
        return {"kind": "PlanConditionedActor", "options": actor.config, "plans": plans}
    if isinstance(actor, DescriptorConditionedActor):
        return {"kind": "DescriptorConditionedActor", "options": actor.config, "tasks": list(actor.tasks)}
    return {"kind": type(actor).__name__}


def describe_data(replay: Any) -> dict[str, Any] | None:
    """What demonstrations a replay buffer shows, as JSON; None for a buffer that is none of ours."""
    demonstrations = getattr(replay, "demonstrations", None)
    return None if demonstrations is None else demonstrations.config.to_json()


def _make_actor(found: dict[str, Any], text_encoder: Callable[[Sequence[str]], Tensor] | None) -> Policy:
    check_choice("the checkpoint's actor", found["kind"], ACTORS)
    if found["kind"] == "ActorEnsemble":
        return ActorEnsemble([_make_actor(member, text_encoder) for member in found["members"]])
    if found["kind"] == "DescriptorConditionedActor":
        return DescriptorConditionedActor(found["tasks"], text_encoder=text_encoder, **found["options"])
    plans = Plans([parse_plan(text, task, f"plan of {task}") for task, text in found["plans"].items()])
    return PlanConditionedActor(plans, text_encoder=text_encoder, **found["options"])


def read_description(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The description that a checkpoint was saved with.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is no checkpoint of ours, or damaged.
    """
    if not Path(path).exists():
        raise FileNotFoundError(f"checkpoint: no file {str(path)!r}; `lw-torchrl train` writes one")
    try:
        found = Checkpoint(description=None).load(path, components=["description"]).values["description"]
        if not isinstance(found, dict) or not isinstance(found.get("actor"), dict):
            raise ValueError("it describes no actor")
        return found
    except (CheckpointError, zipfile.BadZipFile, OSError, ValueError, KeyError) as error:
        raise ValueError(f"checkpoint: {str(path)!r} is damaged or none of ours ({error})") from error


def save_actor(actor: Policy, path: str | os.PathLike[str], **about: Any) -> None:
    """Write an actor alone, for :func:`load_actor`; an earlier file is replaced whole.

    Args:
        actor: what to write.
        path: the file.
        **about: what else the file is to say, as JSON: ``data`` of :func:`describe_data`, say.
    """
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    Checkpoint(format="archive", description={"actor": describe_actor(actor), **about}, actor=actor).save(path)


def demonstration_seeds(path: str | os.PathLike[str]) -> set[int]:
    """The seeds of the demonstrations that a checkpoint's actor was trained on, as far as the checkpoint says."""
    data = read_description(path).get("data") or {}
    return {part["seed"] for part in data.get("parts", [data]) if "seed" in part}


def check_description(path: Path, ours: dict[str, Any]) -> None:
    """Raise :class:`ValueError` unless the checkpoint was saved with the description ``ours``."""
    found = read_description(path)
    for part in ours:
        if found.get(part) != ours[part]:
            before, now = found.get(part) or {}, ours[part] or {}
            different = [key for key in {**before, **now} if before.get(key) != now.get(key)]
            kind = "architecture" if part == "actor" else "configuration"
            raise ValueError(
                f"checkpoint: {str(path)!r} is of another {kind}, its {part} differs in "
                f"{', '.join(different)}; choose another file, or delete it to start again"
            )


def load_actor(
    path: str | os.PathLike[str], *, text_encoder: Callable[[Sequence[str]], Tensor] | None = None
) -> Policy:
    """Make the actor of a checkpoint, with its plans and weights, in eval mode.

    Args:
        path: the checkpoint.
        text_encoder: the one that the actor was made with, if it was not the shipped one.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is damaged, or of another architecture than it says.
    """
    described = read_description(path)["actor"]
    try:
        actor = _make_actor(described, text_encoder)
    except (ValueError, TypeError, KeyError) as error:
        raise ValueError(f"checkpoint: the actor of {str(path)!r} cannot be made ({error})") from error
    load_into(path, actor=actor)
    return actor.eval()


def load_into(path: str | os.PathLike[str], **components: Any) -> None:
    """Load named components of a checkpoint into live objects; :class:`ValueError` if they do not fit."""
    try:
        Checkpoint(**components).load(path, components=list(components))
    except zipfile.BadZipFile as error:
        raise ValueError(f"checkpoint: {str(path)!r} is damaged ({error})") from error
    except (CheckpointError, RuntimeError, KeyError) as error:
        reason = str(error).split("\n")[0]
        raise ValueError(f"checkpoint: {str(path)!r} does not fit, it is of another architecture ({reason})") from error


class TrainingState:
    """What a trainer must remember beside actor, optimizer and schedule, as tensors."""

    def __init__(self, sampler: Any, generator: torch.Generator) -> None:
        self.sampler, self.generator, self.step = sampler, generator, 0
        self.torch_generator = generator.get_state()  # of what transforms and the actor draw in training

    def state_dict(self) -> dict[str, Any]:
        return {
            "step": torch.tensor(self.step),
            "generator": self.generator.get_state(),
            "torch_generator": self.torch_generator.clone(),
            "sampler": dict(self.sampler.state_dict()),
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.step = int(state_dict["step"])
        self.generator.set_state(state_dict["generator"].clone())
        self.torch_generator = state_dict["torch_generator"].clone()
        if state_dict.get("sampler"):
            self.sampler.load_state_dict(state_dict["sampler"])
