"""Policy files: one file of JSON and safetensors that holds a policy, and how its training stands.

    description.json       format and version, the policy's description, and what training added to it
    weights.safetensors    the policy's state
    texts.safetensors      the vectors that its texts had: another text encoder is found out
    training.safetensors   optimizer, schedule, sampler and generators, while it is trained

Nothing is unpickled, and what the file says of sizes is held against what it holds before anything is made.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from torch import Tensor
from torchrl.envs import Compose, Transform

from lw_torchrl._checks import checked
from lw_torchrl._state_tree import split
from lw_torchrl._tensor_archive import ArchiveError, TensorArchive, write_archive
from lw_torchrl.language.text import TextEncoder
from lw_torchrl.modules.policy import Policy, from_description
from lw_torchrl.training.policy_checks import (
    check_can_be_saved,
    check_options,
    check_size,
    check_texts,
    copy_weights,
    first_line,
    text_vectors,
)

FORMAT = "lw_torchrl.policy"
FORMAT_VERSION = 3
_RESERVED = {"format", "version", "versions", "actor", "state", "sha256"}


def describe_data(replay: Any) -> dict[str, Any] | None:
    """What demonstrations a replay buffer shows, as JSON; None for a buffer that is none of ours."""
    demonstrations = getattr(replay, "demonstrations", None)
    return None if demonstrations is None else demonstrations.config.to_json()


def describe_replay(replay: Any) -> dict[str, Any]:
    """How a replay buffer shows its rows, as JSON: what else than :func:`describe_data` its batches hang on."""
    parts = [part for part in replay.transform.modules() if isinstance(part, Transform)]
    return {
        "label": getattr(replay, "label", None),
        "rows": None if describe_data(replay) is None else len(replay),  # after_success leaves so many
        "sampler": type(replay.sampler).__name__,
        "transforms": [_describe_transform(part) for part in parts if not isinstance(part, Compose)],
    }


def describe_learning(replay: Any) -> dict[str, Any]:
    """As :func:`describe_replay`, for what learns from rewards too; of a buffer that is none of ours, no more."""
    names = ("reward", "terminate_on_success", "n_steps", "gamma", "columns")
    told = {name: getattr(replay, name) for name in names if hasattr(replay, name)}
    grow = getattr(replay.storage, "grow", None)
    return describe_replay(replay) | told | ({} if grow is None else {"grow": grow})


def _describe_transform(transform: Transform) -> dict[str, str]:
    options = {name: value for name, value in vars(transform).items() if name[0] != "_" and name != "training"}
    simple = {name: repr(value) for name, value in options.items() if isinstance(value, (bool, int, float, str))}
    return {"class": type(transform).__name__, **simple}


@checked
def save_actor(actor: Policy, path: str | os.PathLike[str], **about: Any) -> None:
    """Write a policy, for :func:`load_actor`; an earlier file is replaced whole.

    Args:
        actor: what to write.
        path: the file.
        **about: what else the file is to say, as JSON.

    Raises:
        TypeError: the actor is no :class:`Policy`.
        ValueError: it is one that :func:`load_actor` would not make again: its weights are of other names, shapes or
            dtypes than its description's, or are no finite numbers; or ``about`` names what a file says itself.
        OSError: it cannot be written; an earlier file stays.

    Example:
        >>> import lw_torchrl as lw, os, tempfile
        >>> path = os.path.join(tempfile.mkdtemp(), "policy.zip")
        >>> lw.save_actor(lw.PlanConditionedActor(lw.load_plans("MT10"), width=8), path)
        >>> lw.load_actor(path).config["width"]
        8
    """
    if reserved := _RESERVED & set(about):
        raise ValueError(f"about must not be named {', '.join(sorted(reserved))}, which a policy file says itself")
    checked = check_can_be_saved(actor)
    write(path, {"actor": checked.describe(), **about}, checked, checked.state_dict())


def write(
    path: str | os.PathLike[str],
    described: Mapping[str, Any],
    actor: Policy,
    weights: Mapping[str, Tensor],
    training: Mapping[str, Any] | None = None,
) -> None:
    """Write a policy file.

    Args:
        path: the file.
        described: what it says, as JSON, ``actor`` among it.
        actor: whose texts' vectors it holds.
        weights: the actor's, or those of many stacked.
        training: how their training stands, where they are trained.
    """
    groups: dict[str, Mapping[str, Tensor]] = {"weights": weights, "texts": text_vectors(actor)}
    described = {"format": FORMAT, "version": FORMAT_VERSION, **described}
    if training is not None:
        tensors: dict[str, Tensor] = {}
        described["state"] = split(training, tensors)
        groups["training"] = tensors
    try:
        write_archive(path, described, groups)
    except OSError as error:
        raise OSError(
            error.errno,
            f"checkpoint: {str(path)!r} cannot be written ({error.strerror}); what stood there before is as it was",
        ) from error


def open_policy(path: str | os.PathLike[str]) -> TensorArchive:
    """The archive of a policy file, whose format, version and actor it has checked; errors as of
    :func:`read_description`."""
    if not Path(path).exists():
        raise FileNotFoundError(f"checkpoint: no file {str(path)!r}; `lw-torchrl train` writes one")
    if Path(path).is_dir():
        raise ValueError(f"checkpoint: {str(path)!r} is a folder; a policy is one file")
    try:
        found = TensorArchive(path)
    except (ArchiveError, OSError) as error:
        names = error.names if isinstance(error, ArchiveError) else []
        old = any(name.startswith(("components/", "manifest", "description/")) for name in names)
        raise ValueError(
            f"checkpoint: {str(path)!r} is of version 1, whose files can run code when they are read; this package "
            f"reads version {FORMAT_VERSION}. Train it again"
            if old
            else f"checkpoint: {str(path)!r} is damaged or none of ours ({error})"
        ) from error
    if (found.description.get("format"), found.description.get("version")) != (FORMAT, FORMAT_VERSION):
        raise ValueError(
            f"checkpoint: {str(path)!r} is of format {found.description.get('format')!r:.60} version "
            f"{found.description.get('version')!r:.60}; this package reads {FORMAT!r} version {FORMAT_VERSION}. "
            "Train it again"
        )
    if not isinstance(found.description.get("actor"), dict):
        raise ValueError(f"checkpoint: {str(path)!r} is damaged or none of ours (it describes no actor)")
    return found


def read_description(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The description that a policy file was saved with.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is no policy file, or damaged.
    """
    return open_policy(path).description


def demonstration_seeds(path: str | os.PathLike[str]) -> set[int]:
    """The seeds of the demonstrations that a file's policy was trained on, as far as the file says."""
    data = read_description(path).get("data")
    parts = data.get("parts", [data]) if isinstance(data, dict) else []
    return {part["seed"] for part in parts if isinstance(part, dict) and isinstance(part.get("seed"), int)}


def demonstrated_tasks(path: str | os.PathLike[str]) -> set[str]:
    """The tasks of the demonstrations that a file's policy was trained on, as far as the file says."""
    data = read_description(path).get("data")
    found = data if isinstance(data, dict) else {}
    parts = found.get("episodes", [found.get("tasks")])  # of joined datasets, task name to episodes each
    named = [part for part in parts if isinstance(part, (dict, list))] if isinstance(parts, list) else []
    return {task for part in named for task in part if isinstance(task, str)}


@checked
def load_actor(path: str | os.PathLike[str], *, text_encoder: TextEncoder | None = None) -> Policy:
    """Make the policy of a file, with its plans and weights, in eval mode.

    Args:
        path: the file.
        text_encoder: the one that the policy was made with, if it was not the shipped one.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is damaged, or its weights, sizes or texts are not those that it says, or are no finite numbers;
            or the text encoder is another than the policy was trained with.
        ImportError: its texts are not shipped, and the extra ``[text]`` is not installed.
    """
    archive = open_policy(path)
    try:
        weights, texts = archive.tensors("weights"), archive.tensors("texts")
        described = archive.description["actor"]
        check_options(described, weights)
        check_size(partial(from_description, described), weights, texts)
        actor = from_description(described, text_encoder)
        check_texts(texts, text_vectors(actor))
        copy_weights(weights, actor.state_dict(keep_vars=True))
    except ImportError:
        raise
    except Exception as error:  # a file from a stranger may say anything
        raise ValueError(f"checkpoint: the actor of {str(path)!r} cannot be made ({first_line(error)})") from error
    return actor.eval()
