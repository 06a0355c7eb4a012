"""Checkpoint files of policies, query evaluators and training states: .safetensors files with a JSON description."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from lw_torchrl._util.checks import shown, typed
from lw_torchrl._util.devices import finite
from lw_torchrl._util.files import AnyPath, absent_policy, expanded, locked, shipped_policy
from lw_torchrl._util.reproducibility import LIBRARIES, differences, warn_of_other_versions
from lw_torchrl._util.tensor_files import AllocationLimit, pop_state, read_tensors, write_tensors
from lw_torchrl.language.plans import AnyPlans, PlanError, as_plans
from lw_torchrl.language.text import TEXT_DIMENSION, TextEncoder
from lw_torchrl.modules.describe import describe, from_description, same_keys
from lw_torchrl.modules.query_evaluator import QueryEvaluator

VERSION = 2
KINDS: Mapping[str, str] = {"actor": "a policy", "evaluator": "an evaluator", "training": "a training state"}
_ARGUMENTS = {"actor": "checkpoint", "evaluator": "evaluator", "training": "checkpoint"}
_ADVICE = "choose another file, or delete this file to start again"
_TEXTS = "texts/"  # prefix of text vectors, which identify the text encoder that a file was saved with
_TEXT_TOLERANCE = 0.01  # between machines, the vectors of the same encoder differ by less than this


@typed
def save_actor(actor: TensorDictModuleBase, path: AnyPath, **about: Any) -> None:
    """Save a policy to a file that :func:`load_actor` reads. An existing file is replaced atomically.

    Args:
        actor: a policy built from this library's modules and custom modules. A custom module needs an attribute
            ``config``, a JSON-serializable dict of the keyword arguments of its constructor.
        path: the file to write, by convention with the suffix ``.safetensors``.
        **about: additional JSON-serializable metadata.

    Raises:
        TypeError: a module has no ``config``; the message names the module.
        ValueError: :func:`load_actor` could not rebuild the policy, because the weights do not fit the description or
            are not finite; or ``about`` uses a reserved name.
        OSError: the file cannot be written; an existing file is kept.

    Example:
        >>> import lw_torchrl as lw, os, tempfile
        >>> path = os.path.join(tempfile.mkdtemp(), "policy.safetensors")
        >>> lw.save_actor(lw.PlanConditionedActor(lw.load_plans("MT10")), path)
        >>> lw.load_actor(path).tasks == lw.MT10
        True
    """
    _save(path, "actor", actor, about)


@typed
def load_actor(path: AnyPath, *, text_encoder: TextEncoder | None = None, parts: Sequence[type[nn.Module]] = ()) -> Any:
    """Load a policy with its plans and weights, in eval mode.

    Args:
        path: the file, or the name of a shipped policy, such as "few-shot-mt50", if no file has that name.
        text_encoder: the text encoder that the policy was saved with; None for the shipped text encoder.
        parts: custom module classes in the policy. Classes whose Python module is already imported can be left out.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: the file is corrupted or not a policy, the weights do not fit the description or are not finite, a
            class is unknown, or the policy was saved with a different text encoder.
        ImportError: the policy uses texts whose vectors are not shipped, and the extra ``[text]`` is not installed.

    Example:
        >>> import lw_torchrl as lw
        >>> lw.load_actor("few-shot-mt50").tasks == lw.MT50
        True
    """
    return _load(policy_file(path), "actor", lambda node: from_description(node, text_encoder, parts))


@typed
def save_evaluator(evaluator: QueryEvaluator, path: AnyPath, **about: Any) -> None:
    """Save an evaluator's network to a file that :func:`load_evaluator` reads. An existing file is replaced atomically.

    Args:
        evaluator: the evaluator; a custom class must store the keyword arguments of its constructor in ``config``.
        path, **about: see :func:`save_actor`, which also lists the errors.

    Example:
        >>> import lw_torchrl as lw, os, tempfile
        >>> path = os.path.join(tempfile.mkdtemp(), "evaluator.safetensors")
        >>> lw.training.save_evaluator(lw.modules.StateQueryEvaluator(lw.load_plans("MT10"), width=8), path)
        >>> lw.training.load_evaluator(path, lw.load_plans("MT50")).config["width"]
        8
    """
    _save(path, "evaluator", evaluator, about)


@typed
def load_evaluator(
    path: AnyPath, plans: AnyPlans, *, text_encoder: TextEncoder | None = None, parts: Sequence[type[nn.Module]] = ()
) -> QueryEvaluator:
    """Load an evaluator in eval mode, for the conditions of any plans.

    Args:
        path, text_encoder, parts: see :func:`load_actor`, which also lists the errors.
        plans: the plans to evaluate; a :class:`ValueError` is raised if the evaluator cannot evaluate their conditions.
    """
    new = {"plans": [as_plans(plans).to_json()]}
    loaded = _load(Path(path), "evaluator", lambda node: from_description({**node, **new}, text_encoder, parts))
    evaluator: QueryEvaluator = loaded
    return evaluator


def _save(path: AnyPath, kind: str, module: nn.Module, about: dict[str, Any]) -> None:
    if reserved := sorted({"format", "version", "versions", kind, "state"} & set(about)):
        raise ValueError(f"about must not use reserved names, got {', '.join(reserved)}")
    check_can_be_saved(module, kind)
    write_tensors(path, {**_header(kind), kind: describe(module), **about}, contents_of(module))


def _header(kind: str) -> dict[str, Any]:
    return {"format": f"lw_torchrl.{kind}", "version": VERSION}


def _load(path: Path, kind: str, make: Callable[[Any], nn.Module]) -> Any:
    description, tensors = _read(path, kind)
    try:
        with AllocationLimit(500_000_000 + 20 * path.stat().st_size):
            module = make(description[kind])
        _copy_tensors(tensors, contents_of(module))
    except ImportError:
        raise
    except Exception as error:  # a corrupted description can make any constructor fail with any error
        hint = "; import the module that registers your relations first" if isinstance(error, PlanError) else ""
        name = f"{_ARGUMENTS[kind]}: the {kind} in {str(path)!r}"
        raise ValueError(f"{name} cannot be rebuilt ({_one_line(error)}){hint}") from error
    return module.eval()


def _read(path: Path, kind: str) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Read the description and the tensors of a file, and check that the file is of the given kind."""
    if not path.exists():
        command = "train-evaluator" if kind == "evaluator" else "train"
        raise FileNotFoundError(f"{_ARGUMENTS[kind]}: {absent_policy(path, command)}")
    name = f"{_ARGUMENTS[kind]}: {str(path)!r}"
    try:
        description, tensors = read_tensors(path)
    except ValueError as error:
        raise ValueError(f"{name} cannot be read: {error}") from error
    if (header := {key: description.get(key) for key in ("format", "version")}) != _header(kind):
        raise ValueError(f"{name} must hold {KINDS[kind]} of version {VERSION}, got {shown(header)}")
    return description, tensors


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:400] or type(error).__name__


def contents_of(module: nn.Module) -> dict[str, Tensor]:
    """Return the tensors that a file stores for a module: the weights and the text vectors."""
    return {**module.state_dict(keep_vars=True), **text_vectors(module)}


def text_vectors(module: nn.Module) -> dict[str, Tensor]:
    """Return the vectors of a module's texts by name; the vectors identify the text encoder."""
    parts = module.named_modules(remove_duplicate=False)  # an ensemble may contain the same member twice
    vectors = ((name, getattr(part, "text_vectors", None)) for name, part in parts)
    return {_TEXTS + name: tensor for name, tensor in vectors if tensor is not None}


@torch.no_grad()
def _copy_tensors(stored: Mapping[str, Tensor], live: Mapping[str, Tensor]) -> None:
    """Copy weights in place; raise :class:`ValueError` if names, shapes, dtypes or text vectors differ."""
    if different := sorted(stored.keys() ^ live.keys()):
        raise ValueError(f"the file and the module must have the same tensors, but differ in {different[:8]}")
    weights = {name: tensor for name, tensor in live.items() if not name.startswith(_TEXTS)}
    for name in live.keys() - weights.keys():
        old, new = stored[name], live[name]
        if old.shape != new.shape or not torch.allclose(old.to(new), new, atol=_TEXT_TOLERANCE, rtol=0.0):
            raise ValueError("text_encoder must be the encoder that the file was saved with, but its vectors differ")
    for name, tensor in weights.items():
        if isinstance(tensor, nn.parameter.UninitializedParameter):  # a lazy layer has no shape yet
            tensor.materialize(stored[name].shape)
        if (stored[name].dtype, stored[name].shape) != (tensor.dtype, tensor.shape):
            got = f"{stored[name].dtype} of shape {tuple(stored[name].shape)}"
            raise ValueError(f"{name} must be {tensor.dtype} of shape {tuple(tensor.shape)}, got {got}")
        if isinstance(tensor, nn.Parameter) and not finite(stored[name]):
            raise ValueError(f"weights: {name} must be finite, but holds NaN or infinity")
    for name, tensor in weights.items():
        tensor.copy_(stored[name])


def not_finite(weights: Mapping[str, Tensor]) -> list[str]:
    """Return the names of the weights that hold NaN or infinity."""
    return [name for name, tensor in weights.items() if not tensor.isfinite().all()]


def check_can_be_saved(module: nn.Module, kind: str = "actor") -> None:
    """Raise an error unless a module can be saved and loaded. Trainers call this before training."""
    widths = [vectors.shape[-1] for vectors in text_vectors(module).values()] or [TEXT_DIMENSION]
    custom = [type(part) for part in module.modules() if not type(part).__module__.startswith("torch.")]
    description = json.loads(json.dumps(describe(module)))
    try:
        with torch.random.fork_rng(devices=[]):  # a dummy text encoder, because a language model takes long to load
            again = from_description(description, lambda texts: torch.ones(len(texts), widths[0]), custom)
        if not same_keys(module, again):
            raise ValueError("in_keys or out_keys were changed after construction; pass them to the constructor")
        _copy_tensors(module.state_dict(), again.state_dict(keep_vars=True))
    except Exception as error:
        reason = f"it cannot be rebuilt from its description ({_one_line(error)})"
        raise ValueError(f"{kind} cannot be saved, because {reason}") from error


def policy_file(path: AnyPath) -> Path:
    """Return the file of the shipped policy named ``path``, or the path itself if there is none."""
    return shipped_policy(path) or Path(path)


def read_description(path: AnyPath) -> dict[str, Any]:
    """Read the JSON description in a policy file; see :func:`load_actor` for the errors."""
    return _read(policy_file(path), "actor")[0]


def demonstration_seeds(path: AnyPath) -> set[int]:
    """Return the seeds of the demonstrations that a policy was trained on, if the policy's file records the seeds."""
    data = read_description(path).get("data") or {}
    return {part["seed"] for part in data.get("parts", [data]) if "seed" in part}


def demonstrated_tasks(path: AnyPath) -> set[str]:
    """Return the tasks of the demonstrations that a policy was trained on, if the policy's file records the tasks."""
    data = read_description(path).get("data") or {}
    return {task for tasks in data.get("episodes", [data.get("tasks", ())]) for task in tasks}


def training_file(checkpoint: Path) -> Path:
    """Return the path of the training state stored next to a policy, for example ``mt10.training.safetensors``."""
    return checkpoint.with_name(f"{checkpoint.stem}.training{checkpoint.suffix}")


def check_description(path: Path, expected: Mapping[str, Any], stored: Mapping[str, Any] | None = None) -> None:
    """Raise :class:`ValueError` unless the description in the policy file ``path`` has the entries ``expected``."""
    stored = read_description(path) if stored is None else stored
    for part, now in json.loads(json.dumps(expected)).items():  # as JSON, which has no tuples
        if (before := stored.get(part)) != now:
            names = differences(before if isinstance(before, dict) else {}, now or {})
            kind = "architecture" if part in ("actor", "actors", "evaluator", "loss") else "configuration"
            differs = f"its {part} differs in {', '.join(names[:8])}{', ...' * (len(names) > 8)}"
            raise ValueError(f"checkpoint: {str(path)!r} has a different {kind}: {differs}; {_ADVICE}")


class CheckpointFiles:
    """The checkpoint files of a training run: a policy or evaluator, and the training state next to it.

    A lock file prevents concurrent runs from writing to them.

    Args:
        checkpoint: the path of the policy, evaluator or training state.
        part: the content of ``checkpoint``, "actor" or "evaluator"; None if ``checkpoint`` is the training state.
    """

    def __init__(self, checkpoint: AnyPath, part: str | None) -> None:
        self.checkpoint, self.part = expanded(checkpoint), part
        self.state = training_file(self.checkpoint) if part else self.checkpoint
        self._known: tuple[int, ...] | None = None  # identifies the training state that this run last read or wrote

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Lock the files within a ``with`` block, so that no other training run writes to them.

        Raise :class:`ValueError` if another run has written to them since this run read or wrote them.
        """
        with locked(self.checkpoint, "checkpoint", "training"):
            if self._version() not in (None, self._known):
                message = "was written by another training run in the meantime; start this run again to resume from it"
                raise ValueError(f"checkpoint: {str(self.checkpoint)!r} {message}, or choose another file")
            yield

    def _version(self) -> tuple[int, ...] | None:
        if not self.state.exists():
            return None
        status = self.state.stat()
        return status.st_ino, status.st_size, status.st_mtime_ns

    def write(
        self, description: Mapping[str, Any], device: torch.device, tensors: Any, state: Any, part: nn.Module | None
    ) -> None:
        """Atomically write the training state (``tensors``, ``state``), then the policy or evaluator (``part``)."""
        write_tensors(self.state, {**_header("training"), **description, "device": device.type}, tensors, state)
        self._known = self._version()
        if self.part is not None and part is not None:
            write_tensors(self.checkpoint, {**_header(self.part), **description}, contents_of(part))

    def exist(self) -> bool:
        """Return whether the training state exists; raise ValueError if only the policy exists, because training would
        overwrite the policy."""
        if not self.state.exists() and self.checkpoint.exists():
            message = f"{str(self.checkpoint)!r} exists, but its training state {str(self.state)!r} does not"
            raise ValueError(f"checkpoint: {message}; {_ADVICE}")
        return self.state.exists()

    def restore(
        self,
        description: Mapping[str, Any],
        device: torch.device,
        tensors: Mapping[str, Tensor],
        load_state: Callable[[dict[str, Any]], None],
    ) -> None:
        """Copy the stored tensors into ``tensors`` and pass the stored state to ``load_state``."""
        name = f"checkpoint: {str(self.state)!r}"
        self._known = self._version()
        stored_description, stored = _read(self.state, "training")
        check_description(self.state, description, stored_description)
        if self.part is not None and self.checkpoint.exists():
            policy, _ = _read(self.checkpoint, self.part)
            check_description(self.checkpoint, {self.part: description[self.part]}, policy)
        if (before := stored_description["device"]) != device.type:
            message = f"{name} was trained on {before!r} and resumes on {device.type!r}: training continues with the"
            message += " same minibatches, but results will not be bit-identical to an uninterrupted run"
            warnings.warn(message, stacklevel=4)
        warn_of_other_versions(self.state, stored_description["versions"], LIBRARIES)
        try:
            state = pop_state(stored_description, stored)
            _copy_tensors(stored, tensors)
            load_state(state)
        except (ValueError, KeyError, TypeError, RuntimeError) as error:
            raise ValueError(f"{name} is corrupted, or of a different architecture ({_one_line(error)})") from error
