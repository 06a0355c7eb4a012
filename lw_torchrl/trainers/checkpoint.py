"""Policy files: one file of JSON and safetensors that holds a policy, and how its training stands.

    description.json       format and version, the policy's description, and what training added to it
    weights.safetensors    the policy's state
    texts.safetensors      the vectors that its texts had: another text encoder is found out
    training.safetensors   optimizer, schedule, sampler and generators, while it is trained

Nothing is unpickled, and what the file says of sizes is held against what it holds before anything is made.
"""

from __future__ import annotations

import os
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.modules.module import register_module_parameter_registration_hook

from lw_torchrl._state_tree import check_like, split
from lw_torchrl._tensor_archive import ArchiveError, TensorArchive, write_archive
from lw_torchrl.language.text import TEXT_DIMENSION, TextEncoder
from lw_torchrl.modules.policy import Policy, from_description

FORMAT = "lw_torchrl.policy"
FORMAT_VERSION = 2
_TEXT_TOLERANCE = 0.01  # of numbers of size 1: more than machines differ, far less than encoders do


def describe_data(replay: Any) -> dict[str, Any] | None:
    """What demonstrations a replay buffer shows, as JSON; None for a buffer that is none of ours."""
    demonstrations = getattr(replay, "demonstrations", None)
    return None if demonstrations is None else demonstrations.config.to_json()


def check_can_be_saved(actor: Any) -> Policy:
    """Return the actor if a policy file can hold it: what cannot be loaded again is refused before any training.

    Raises:
        TypeError: it is no :class:`Policy`.
        ValueError: it is one that its own description does not make again.
    """
    if not isinstance(actor, Policy):
        raise TypeError(
            f"actor must be a Policy to be kept in a file, got {type(actor).__name__}: save the policy inside of it, "
            "derive your class from lw_torchrl.Policy, or train without a checkpoint"
        )
    actor.describe()
    return actor


def save_actor(actor: Policy, path: str | os.PathLike[str], **about: Any) -> None:
    """Write a policy, for :func:`load_actor`; an earlier file is replaced whole.

    Args:
        actor: what to write.
        path: the file.
        **about: what else the file is to say, as JSON.

    Raises:
        TypeError: the actor is no :class:`Policy`.
        OSError: it cannot be written; an earlier file stays.

    Example:
        >>> import lw_torchrl as lw, os, tempfile
        >>> path = os.path.join(tempfile.mkdtemp(), "policy.zip")
        >>> lw.save_actor(lw.PlanConditionedActor(lw.load_plans("MT10"), width=8), path)
        >>> lw.load_actor(path).config["width"]
        8
    """
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


def text_vectors(actor: nn.Module) -> dict[str, Tensor]:
    """The vectors of an actor's texts, by the name of the buffer that holds them."""
    return {name: buffer for name, buffer in actor.named_buffers() if name.rpartition(".")[2] == "text_vectors"}


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
        old = _is_version_1(Path(path))
        raise ValueError(
            f"checkpoint: {str(path)!r} is of version 1, whose files can run code when they are read; this package "
            f"reads version {FORMAT_VERSION}. Train it again"
            if old
            else f"checkpoint: {str(path)!r} is damaged or none of ours ({error})"
        ) from error
    if (found.description.get("format"), found.description.get("version")) != (FORMAT, FORMAT_VERSION):
        raise ValueError(
            f"checkpoint: {str(path)!r} is of format {found.description.get('format')!r:.60} version "
            f"{found.description.get('version')!r:.60}; this package reads {FORMAT!r} version {FORMAT_VERSION}"
        )
    if not isinstance(found.description.get("actor"), dict):
        raise ValueError(f"checkpoint: {str(path)!r} is damaged or none of ours (it describes no actor)")
    return found


def _is_version_1(path: Path) -> bool:
    """Whether it is an archive of TorchRL's ``Checkpoint``, told by its entries' names alone."""
    try:
        with zipfile.ZipFile(path) as archive:
            return any(name.startswith(("components/", "manifest", "description/")) for name in archive.namelist())
    except Exception:  # whatever is wrong with it, it is none
        return False


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


def _of_texts(archive: TensorArchive) -> str:
    """What an error is to say beside of texts that the shipped encoder did not encode."""
    try:
        widths = {vectors.shape[-1] for vectors in archive.tensors("texts").values() if vectors.ndim == 2}
    except ArchiveError:
        return ""
    if widths <= {TEXT_DIMENSION} or "'one-hot'" in str(archive.description["actor"].get("options")):
        return ""
    wanted = ", ".join(map(str, sorted(widths)))
    return f"; its texts have {wanted} numbers each: text_encoder must be the one that gave them"


def load_actor(path: str | os.PathLike[str], *, text_encoder: TextEncoder | None = None) -> Policy:
    """Make the policy of a file, with its plans and weights, in eval mode.

    Args:
        path: the file.
        text_encoder: the one that the policy was made with, if it was not the shipped one.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is damaged, or its weights, sizes or texts are not those that it says; or the text encoder is
            another than the policy was trained with.
        ImportError: its texts are not shipped, and the extra ``[text]`` is not installed.
    """
    archive = open_policy(path)
    try:
        weights, texts = archive.tensors("weights"), archive.tensors("texts")
        numbers = sum(tensor.numel() for tensor in weights.values())
        _check_options(archive.description["actor"], numbers)
        with _at_most(numbers):
            actor = from_description(archive.description["actor"], text_encoder)
        check_texts(texts, text_vectors(actor))
        copy_weights(weights, actor.state_dict())
    except ImportError:
        raise
    except Exception as error:  # a file from a stranger may say anything
        said = first_line(error)
        said += "" if "text_encoder" in said else _of_texts(archive)
        raise ValueError(f"checkpoint: the actor of {str(path)!r} cannot be made ({said})") from error
    return actor.eval()


def first_line(error: Exception) -> str:
    """What an error says, up to 400 characters of its first line."""
    return (str(error).splitlines() or [type(error).__name__])[0][:400]


def _check_options(found: Any, numbers: int) -> None:
    """Refuse integers that no network of so many numbers can have, before lists of that length are made."""
    inside = found.values() if isinstance(found, dict) else found if isinstance(found, list) else ()
    if isinstance(found, int) and abs(found) > max(numbers, 2**16):
        raise ValueError(f"it says {found:.3g}, but holds only {numbers} numbers")
    for one in inside:
        _check_options(one, numbers)


@contextmanager
def _at_most(numbers: int) -> Iterator[None]:
    """Stop a module that is being made as soon as its parameters are more than ``numbers``, before they are filled."""
    made = 0

    def count(module: nn.Module, name: str, parameter: nn.Parameter | None) -> None:
        nonlocal made
        made += 0 if parameter is None else parameter.numel()
        if made > numbers:
            raise ValueError(f"it describes a network of more than the {numbers} numbers that it holds")

    handle = register_module_parameter_registration_hook(count)
    try:
        yield
    finally:
        handle.remove()


@torch.no_grad()
def copy_weights(stored: Mapping[str, Tensor], live: Mapping[str, Tensor]) -> None:
    """Copy weights in place; :class:`ValueError` where a name, shape or dtype differs."""
    check_like(stored, dict(live), "weights")
    for name, tensor in live.items():
        tensor.copy_(stored[name])


def check_texts(stored: Mapping[str, Tensor], ours: Mapping[str, Tensor]) -> None:
    """Raise :class:`ValueError` unless the texts have the vectors that they had when the file was written."""
    for name, vectors in ours.items():
        found = stored.get(name)
        if found is None or found.shape != vectors.shape or found.dtype != vectors.dtype:
            said = "none" if found is None else tuple(found.shape)
            raise ValueError(
                f"text_encoder gives vectors of shape {tuple(vectors.shape)}, the policy was made with {said}"
            )
        if not torch.allclose(found, vectors.cpu(), atol=_TEXT_TOLERANCE, rtol=0.0):
            raise ValueError(
                "text_encoder is not the one that the policy was made with: its texts have other vectors; pass that "
                "one as text_encoder"
            )
