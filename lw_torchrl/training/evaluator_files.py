"""Files of query evaluators: the network alone, whatever the plans whose conditions it answers.

    description.json       format and version, the evaluator's description, and what training added to it
    weights.safetensors    its state
    texts.safetensors      the vector of a text, of one that reads texts: another text encoder is found out
    training.safetensors   how its training stands

Read as policy files are, see ``checkpoint.py``.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from lw_torchrl._checks import checked, checked_but
from lw_torchrl._state_tree import split
from lw_torchrl._tensor_archive import ArchiveError, TensorArchive, write_archive
from lw_torchrl.language.plans import ConditionalPlan, Plans, as_plans
from lw_torchrl.language.text import TextEncoder, encoded
from lw_torchrl.modules.query_evaluator import QueryEvaluator, evaluator_from_description
from lw_torchrl.training.policy_checks import (
    check_options,
    check_remade,
    check_size,
    check_texts,
    copy_weights,
    first_line,
)

FORMAT = "lw_torchrl.evaluator"
FORMAT_VERSION = 1
_RESERVED = {"format", "version", "evaluator", "state", "sha256"}
_PROBE = "the robot's gripper is open"


@checked_but("evaluator")
def save_evaluator(evaluator: QueryEvaluator, path: str | os.PathLike[str], **about: Any) -> None:
    """Write an evaluator, for :func:`load_evaluator`; an earlier file is replaced whole.

    Args:
        evaluator: what to write, of a class in :data:`~lw_torchrl.modules.EVALUATORS`.
        path: the file.
        **about: what else the file is to say, as JSON.

    Raises:
        TypeError: it is no :class:`QueryEvaluator`.
        ValueError: it is one that its own description does not make again, or its weights are no finite numbers; or
            ``about`` names what a file says itself.
        OSError: it cannot be written; an earlier file stays.

    Example:
        >>> import lw_torchrl as lw, os, tempfile
        >>> path = os.path.join(tempfile.mkdtemp(), "evaluator.zip")
        >>> lw.training.save_evaluator(lw.StateQueryEvaluator(lw.load_plans("MT10"), width=8), path)
        >>> lw.training.load_evaluator(path, lw.load_plans("MT50")).config["width"]
        8
    """
    if reserved := _RESERVED & set(about):
        raise ValueError(f"about must not be named {', '.join(sorted(reserved))}, which a file says itself")
    write_evaluator(check_evaluator_can_be_saved(evaluator), path, about)


def check_evaluator_can_be_saved(evaluator: Any) -> QueryEvaluator:
    """Return the evaluator if a file can hold it; errors as of :func:`save_evaluator`."""
    if not isinstance(evaluator, QueryEvaluator):
        raise TypeError(f"evaluator must be a QueryEvaluator to be kept in a file, got {type(evaluator).__name__}")
    try:
        described = json.loads(json.dumps(evaluator.describe()))
        encoder = getattr(evaluator, "text_encoder", None)
        with torch.random.fork_rng(devices=[]):
            again = evaluator_from_description(described, evaluator.plans, encoder)
        check_remade(evaluator, again)
    except Exception as error:
        raise ValueError(
            f"evaluator cannot be kept in a file, which would not make it again from its description "
            f"({first_line(error)})"
        ) from error
    return evaluator


def write_evaluator(
    evaluator: QueryEvaluator,
    path: str | os.PathLike[str],
    about: Mapping[str, Any],
    training: Mapping[str, Any] | None = None,
) -> None:
    """Write the file, with how training stands where it is trained."""
    described = {"format": FORMAT, "version": FORMAT_VERSION, "evaluator": evaluator.describe(), **about}
    groups: dict[str, Mapping[str, Tensor]] = {"weights": evaluator.state_dict(), "texts": _texts(evaluator)}
    if training is not None:
        tensors: dict[str, Tensor] = {}
        described["state"] = split(training, tensors)
        groups["training"] = tensors
    write_archive(path, described, groups)


def _texts(evaluator: QueryEvaluator) -> dict[str, Tensor]:
    if getattr(evaluator, "text_vectors", None) is None:
        return {}
    return {"probe": encoded([_PROBE], getattr(evaluator, "text_encoder", None))}


def open_evaluator(path: str | os.PathLike[str]) -> TensorArchive:
    """The archive of an evaluator's file, whose format and version it has checked; errors as of
    :func:`load_evaluator`."""
    if not Path(path).exists():
        raise FileNotFoundError(f"evaluator: no file {str(path)!r}; `lw-torchrl train-evaluator` writes one")
    try:
        found = TensorArchive(path)
    except (ArchiveError, OSError) as error:
        raise ValueError(f"evaluator: {str(path)!r} is damaged or no evaluator's file ({error})") from error
    stated = found.description.get("format"), found.description.get("version")
    if stated != (FORMAT, FORMAT_VERSION):
        hint = "; it is a policy's, give the evaluator's" if stated[0] == "lw_torchrl.policy" else ""
        raise ValueError(
            f"evaluator: {str(path)!r} is of format {stated[0]!r:.60} version {stated[1]!r:.60}; this package reads "
            f"{FORMAT!r} version {FORMAT_VERSION}{hint}"
        )
    return found


@checked
def load_evaluator(
    path: str | os.PathLike[str],
    plans: Plans | Mapping[str, ConditionalPlan],
    *,
    text_encoder: TextEncoder | None = None,
) -> QueryEvaluator:
    """Make the evaluator of a file, for the conditions of some plans, in eval mode.

    Args:
        path: the file.
        plans: whose conditions it is to answer; they need not be those that it was trained beside.
        text_encoder: the one that it was made with, if it reads texts and it was not the shipped one.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is damaged or no evaluator's, or its weights, sizes or texts are not those that it says; the
            plans ask for what it cannot answer; or the text encoder is another than it was trained with.
        ImportError: it reads texts, and the extra ``[text]`` is not installed.
    """
    archive = open_evaluator(path)
    try:
        weights, texts = archive.tensors("weights"), archive.tensors("texts")
        described, asked = archive.description.get("evaluator"), as_plans(plans)
        check_options(described, weights)
        check_size(partial(evaluator_from_description, described, asked), weights, texts)
        evaluator = evaluator_from_description(described, asked, text_encoder)
        check_texts(texts, _texts(evaluator))
        copy_weights(weights, evaluator.state_dict(keep_vars=True))
    except ImportError:
        raise
    except Exception as error:  # a file from a stranger may say anything
        raise ValueError(f"evaluator: that of {str(path)!r} cannot be made ({first_line(error)})") from error
    return evaluator.eval()
