"""Files of policies, query evaluators and trainings: one .safetensors file each, whose metadata describe it as JSON."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from lw_torchrl._util.checks import differences, typed
from lw_torchrl._util.files import AnyPath, absent_policy, shipped_policy
from lw_torchrl._util.tensor_files import read_tensors, write_tensors
from lw_torchrl.language.plans import AnyPlans, PlanError, as_plans
from lw_torchrl.language.text import TEXT_DIMENSION, TextEncoder
from lw_torchrl.modules.describe import describe, from_description, same_keys
from lw_torchrl.modules.query_evaluator import QueryEvaluator

VERSION = 2
KINDS: Mapping[str, str] = {"actor": "a policy", "evaluator": "an evaluator", "training": "a training state"}
_ARGUMENTS = {"actor": "checkpoint", "evaluator": "evaluator", "training": "checkpoint"}
_TEXTS = "texts/"  # begins the names of text vectors, which show whether another text encoder is in use
_TEXT_TOLERANCE = 0.01  # machines differ by less, encoders by more


@typed
def save_actor(actor: TensorDictModuleBase, path: AnyPath, **about: Any) -> None:
    """Write a policy for :func:`load_actor`. An earlier file is replaced whole.

    Args:
        actor: a policy made of our parts, and of modules of your own with a ``config``, a dict of their constructor's
            keyword arguments as JSON.
        path: the file, by convention named ``.safetensors``.
        **about: further metadata, as JSON.

    Raises:
        TypeError: a part has no ``config``; the message names the part.
        ValueError: :func:`load_actor` could not rebuild it, because its weights do not fit its description or are not
            finite; or ``about`` uses a reserved name.
        OSError: the file cannot be written; an earlier file stays.

    Example:
        >>> import lw_torchrl as lw, os, tempfile
        >>> path = os.path.join(tempfile.mkdtemp(), "policy.safetensors")
        >>> lw.save_actor(lw.PlanConditionedActor(lw.load_plans("MT10")), path)
        >>> lw.load_actor(path).tasks == lw.MT10
        True
    """
    check_can_be_saved(actor)
    _save(path, "actor", actor, about)


@typed
def load_actor(path: AnyPath, *, text_encoder: TextEncoder | None = None, parts: Sequence[type[nn.Module]] = ()) -> Any:
    """Load a policy with its plans and weights, in eval mode.

    Args:
        path: the file; or "few-shot-mt50", a policy that is shipped, if there is no file of that name.
        text_encoder: the one that the policy was made with, if it was not the shipped one.
        parts: classes of your own that the policy is made of, unless the module that defines them is imported already.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is damaged or not a policy's, its weights do not fit its description or are not finite, a
            class is not known, or the policy was made with another text encoder.
        ImportError: its texts are not shipped, and the extra ``[text]`` is not installed.

    Example:
        >>> import lw_torchrl as lw
        >>> lw.load_actor("few-shot-mt50").tasks == lw.MT50
        True
    """
    return _load(policy_file(path), "actor", lambda found: from_description(found, text_encoder, parts))


@typed
def save_evaluator(evaluator: QueryEvaluator, path: AnyPath, **about: Any) -> None:
    """Write an evaluator's network for :func:`load_evaluator`. An earlier file is replaced whole.

    Args:
        evaluator: the evaluator; a class of your own keeps its constructor's keyword arguments in ``config``.
        path, **about: as for :func:`save_actor`, with its errors.

    Example:
        >>> import lw_torchrl as lw, os, tempfile
        >>> path = os.path.join(tempfile.mkdtemp(), "evaluator.safetensors")
        >>> lw.training.save_evaluator(lw.StateQueryEvaluator(lw.load_plans("MT10"), width=8), path)
        >>> lw.training.load_evaluator(path, lw.load_plans("MT50")).config["width"]
        8
    """
    check_can_be_saved(evaluator, "evaluator")
    _save(path, "evaluator", evaluator, about)


@typed
def load_evaluator(
    path: AnyPath,
    plans: AnyPlans,
    *,
    text_encoder: TextEncoder | None = None,
    parts: Sequence[type[nn.Module]] = (),
) -> QueryEvaluator:
    """Load an evaluator for the conditions of any plans, in eval mode.

    Args:
        path, text_encoder, parts: as for :func:`load_actor`, with its errors.
        plans: the plans; :class:`ValueError` if the evaluator cannot answer their conditions.
    """
    others = [as_plans(plans).to_json()]

    def make(found: Any) -> Any:
        return from_description({**found, "plans": others}, text_encoder, parts)

    evaluator: QueryEvaluator = _load(Path(path), "evaluator", make)
    return evaluator


def _save(path: AnyPath, kind: str, module: nn.Module, about: dict[str, Any]) -> None:
    if reserved := sorted({"format", "version", "versions", kind, "state"} & set(about)):
        raise ValueError(f"about must not be named {', '.join(reserved)}, which {KINDS[kind]}'s file says itself")
    write_file(path, kind, {kind: describe(module), **about}, {**module.state_dict(), **text_vectors(module)})


def write_file(
    path: AnyPath, kind: str, described: Mapping[str, Any], tensors: Mapping[str, Tensor], state: Any = None
) -> None:
    """Write a file of a kind of :data:`KINDS`, from its description, weights and text vectors."""
    write_tensors(path, {**_header(kind), **described}, tensors, state)


def _load(path: Path, kind: str, make: Callable[[Any], nn.Module]) -> Any:
    description, tensors = read_file(path, kind)
    try:
        module = make(description[kind])
        copy_tensors(tensors, {**module.state_dict(keep_vars=True), **text_vectors(module)})
    except ImportError:
        raise
    except Exception as error:  # a file may describe anything
        hint = "; import the module that registers your relations first" if isinstance(error, PlanError) else ""
        message = f"{_ARGUMENTS[kind]}: the {kind} of {str(path)!r} cannot be made ({short_message(error)}){hint}"
        raise ValueError(message) from error
    return module.eval()


def _header(kind: str) -> dict[str, Any]:
    return {"format": f"lw_torchrl.{kind}", "version": VERSION}


def read_file(path: Path, kind: str) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Return the description and the tensors of a file of the given kind."""
    begin = f"{_ARGUMENTS[kind]}: {str(path)!r}"
    if not path.exists():
        command = "train-evaluator" if kind == "evaluator" else "train"
        raise FileNotFoundError(f"{_ARGUMENTS[kind]}: {absent_policy(path, command)}")
    try:
        description, tensors = read_tensors(path)
    except ValueError as error:
        raise ValueError(f"{begin} cannot be read: {error}") from error
    if {name: description.get(name) for name in ("format", "version")} != _header(kind):
        stated = f"format {description.get('format')!r:.60}, version {description.get('version')!r:.60}"
        raise ValueError(f"{begin} must be {KINDS[kind]} of version {VERSION}, got {stated}")
    return description, tensors


def short_message(error: Exception) -> str:
    """Return an error's message in one line."""
    return " ".join(str(error).split())[:400] or type(error).__name__


@torch.no_grad()
def copy_tensors(stored: Mapping[str, Tensor], live: Mapping[str, Tensor]) -> None:
    """Copy weights in place and compare text vectors; :class:`ValueError` where names, shapes or dtypes differ."""
    if odd := sorted(stored.keys() ^ live.keys()):
        raise ValueError(f"it must hold the same tensors as the module, they differ in {', '.join(odd[:8])}")
    weights = {name: tensor for name, tensor in live.items() if not name.startswith(_TEXTS)}
    for name in live.keys() - weights.keys():
        _check_texts(stored[name], live[name])
    for name, tensor in weights.items():
        if isinstance(tensor, nn.parameter.UninitializedParameter):  # of a lazy layer
            tensor.materialize(stored[name].shape)
        if (stored[name].dtype, stored[name].shape) != (tensor.dtype, tensor.shape):
            said = f"{stored[name].dtype} of shape {tuple(stored[name].shape)}"
            raise ValueError(f"{name} must be {tensor.dtype} of shape {tuple(tensor.shape)}, got {said}")
    check_finite({name: stored[name] for name, tensor in weights.items() if isinstance(tensor, nn.Parameter)})
    for name, tensor in weights.items():
        tensor.copy_(stored[name])


def _check_texts(stored: Tensor, vectors: Tensor) -> None:
    difference = "its vectors differ"
    if stored.shape != vectors.shape:
        difference = f"its vectors have shape {tuple(vectors.shape)}, the file's have {tuple(stored.shape)}"
    elif torch.allclose(stored.to(vectors), vectors, atol=_TEXT_TOLERANCE, rtol=0.0):
        return
    raise ValueError(f"text_encoder must be the one that the file was made with: {difference}")


def check_finite(weights: Mapping[str, Tensor]) -> None:
    """Raise :class:`ValueError` if a weight is NaN or infinite."""
    for name, tensor in weights.items():
        if not tensor.isfinite().all():
            raise ValueError(f"weights: {name} must be finite, it holds NaN or infinity")


def text_vectors(module: nn.Module) -> dict[str, Tensor]:
    """Return the vectors of a module's texts by name, which show whether another text encoder is in use."""
    parts = module.named_modules(remove_duplicate=False)  # an ensemble may hold a member twice
    vectors = ((name, getattr(part, "text_vectors", None)) for name, part in parts)
    return {_TEXTS + name: tensor for name, tensor in vectors if tensor is not None}


def check_can_be_saved(module: nn.Module, kind: str = "actor") -> None:
    """Raise an error unless a module could be saved and loaded; called before training, so that none is lost."""
    widths = [vectors.shape[-1] for vectors in text_vectors(module).values()]
    own = [type(part) for part in module.modules() if not type(part).__module__.startswith("torch.")]
    description = describe(module)
    try:
        with torch.random.fork_rng(devices=[]):  # without loading a text model
            again = from_description(
                json.loads(json.dumps(description)),
                lambda texts: torch.ones(len(texts), (widths or [TEXT_DIMENSION])[0]),
                own,
            )
        if not same_keys(module, again):
            raise ValueError("its in_keys or out_keys were changed later: pass them to its constructor")
        copy_tensors(module.state_dict(), again.state_dict(keep_vars=True))
    except Exception as error:
        message = f"{kind} cannot be kept in a file, because its description does not rebuild it"
        raise ValueError(f"{message} ({short_message(error)})") from error


def policy_file(path: AnyPath) -> Path:
    """Return the path itself, or a shipped policy's file of that name."""
    return shipped_policy(path) or Path(path)


def read_description(path: AnyPath) -> dict[str, Any]:
    """Return a policy file's description; errors as for :func:`load_actor`."""
    return read_file(policy_file(path), "actor")[0]


def demonstration_seeds(path: AnyPath) -> set[int]:
    """Return the seeds of the demonstrations that a file's policy was trained on, as far as the file says."""
    data = read_description(path).get("data") or {}
    return {part["seed"] for part in data.get("parts", [data]) if "seed" in part}


def demonstrated_tasks(path: AnyPath) -> set[str]:
    """Return the tasks of the demonstrations that a file's policy was trained on, as far as the file says."""
    data = read_description(path).get("data") or {}
    return {task for tasks in data.get("episodes", [data.get("tasks", ())]) for task in tasks}


def training_file(checkpoint: Path) -> Path:
    """Return the file of the training state beside a policy: ``mt10.training.safetensors`` for ``mt10.safetensors``."""
    return checkpoint.with_name(f"{checkpoint.stem}.training{checkpoint.suffix}")


def check_description(path: Path, ours: Mapping[str, Any]) -> None:
    """Raise :class:`ValueError` unless a policy file has the description ``ours``."""
    check_same_description(path, read_description(path), ours)


def check_same_description(path: Path, stored: Mapping[str, Any], ours: Mapping[str, Any]) -> None:
    """Raise :class:`ValueError` unless a file's description has the parts of ``ours``."""
    for part, now in json.loads(json.dumps(ours)).items():  # as JSON, which has no tuples
        if (before := stored.get(part)) != now:
            names = differences(before if isinstance(before, dict) else {}, now or {})
            kind = "architecture" if part in ("actor", "actors", "evaluator", "loss") else "configuration"
            raise ValueError(
                f"checkpoint: {str(path)!r} is of another {kind}, its {part} differs in {', '.join(names[:8])}"
                f"{', ...' * (len(names) > 8)}; choose another file, or delete it to start again"
            )
