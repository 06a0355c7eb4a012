"""Files of policies, query evaluators and training states: one .safetensors file each, with a description as JSON."""

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

from lw_torchrl._util.checks import differences, typed
from lw_torchrl._util.files import AnyPath, absent_policy, locked, shipped_policy
from lw_torchrl._util.reproducibility import LIBRARIES, warn_of_other_versions
from lw_torchrl._util.tensor_files import pop_state, read_tensors, write_tensors
from lw_torchrl.language.plans import AnyPlans, PlanError, as_plans
from lw_torchrl.language.text import TEXT_DIMENSION, TextEncoder
from lw_torchrl.modules.describe import describe, from_description, same_keys
from lw_torchrl.modules.query_evaluator import QueryEvaluator

VERSION = 2
KINDS: Mapping[str, str] = {"actor": "a policy", "evaluator": "an evaluator", "training": "a training state"}
_ARGUMENTS = {"actor": "checkpoint", "evaluator": "evaluator", "training": "checkpoint"}
_TEXTS = "texts/"  # prefix of text vectors, by which a file recognises the text encoder it was made with
_TEXT_TOLERANCE = 0.01  # the vectors of one encoder differ by less between machines


@typed
def save_actor(actor: TensorDictModuleBase, path: AnyPath, **about: Any) -> None:
    """Write a policy for :func:`load_actor`. An earlier file is replaced whole.

    Args:
        actor: a policy made of this library's modules and of custom modules. A custom module needs an attribute
            ``config``, a dict of its constructor's keyword arguments as JSON.
        path: the file, by convention named ``.safetensors``.
        **about: further metadata, as JSON.

    Raises:
        TypeError: a module has no ``config``; the message names the module.
        ValueError: :func:`load_actor` could not rebuild the policy, because its weights do not fit its description or
            are not finite; or ``about`` uses a reserved name.
        OSError: the file cannot be written; an earlier file stays.

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
        path: the file, or the name of a shipped policy, "few-shot-mt50", if there is no file of that name.
        text_encoder: the encoder that the policy was made with, if it was not the shipped one.
        parts: custom classes in the policy. Classes whose module is imported already need not be listed.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is damaged or not a policy, its weights do not fit its description or are not finite, a
            class is unknown, or the policy was made with another text encoder.
        ImportError: its texts are not shipped, and the extra ``[text]`` is not installed.

    Example:
        >>> import lw_torchrl as lw
        >>> lw.load_actor("few-shot-mt50").tasks == lw.MT50
        True
    """
    return _load(policy_file(path), "actor", lambda node: from_description(node, text_encoder, parts))


@typed
def save_evaluator(evaluator: QueryEvaluator, path: AnyPath, **about: Any) -> None:
    """Write an evaluator's network for :func:`load_evaluator`. An earlier file is replaced whole.

    Args:
        evaluator: the evaluator; a custom class keeps its constructor's keyword arguments in ``config``.
        path, **about: as for :func:`save_actor`, with its errors.

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
    answered = [as_plans(plans).to_json()]
    evaluator: QueryEvaluator = _load(
        Path(path), "evaluator", lambda node: from_description({**node, "plans": answered}, text_encoder, parts)
    )
    return evaluator


def _save(path: AnyPath, kind: str, module: nn.Module, about: dict[str, Any]) -> None:
    if reserved := sorted({"format", "version", "versions", kind, "state"} & set(about)):
        raise ValueError(f"about must not use the reserved name {', '.join(reserved)}")
    check_can_be_saved(module, kind)
    _write(path, kind, {kind: describe(module), **about}, contents_of(module))


def _header(kind: str) -> dict[str, Any]:
    return {"format": f"lw_torchrl.{kind}", "version": VERSION}


def _write(path: AnyPath, kind: str, description: Mapping[str, Any], tensors: Any, state: Any = None) -> None:
    write_tensors(path, {**_header(kind), **description}, tensors, state)


def _load(path: Path, kind: str, make: Callable[[Any], nn.Module]) -> Any:
    description, tensors = _read(path, kind)
    try:
        module = make(description[kind])
        _copy_tensors(tensors, contents_of(module))
    except ImportError:
        raise
    except Exception as error:  # a damaged description can make any constructor fail
        hint = "; import the module that registers your relations first" if isinstance(error, PlanError) else ""
        message = f"{_ARGUMENTS[kind]}: the {kind} of {str(path)!r} cannot be made ({_one_line(error)}){hint}"
        raise ValueError(message) from error
    return module.eval()


def _read(path: Path, kind: str) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Return the description and the tensors of a file of the given kind."""
    if not path.exists():
        command = "train-evaluator" if kind == "evaluator" else "train"
        raise FileNotFoundError(f"{_ARGUMENTS[kind]}: {absent_policy(path, command)}")
    try:
        description, tensors = read_tensors(path)
    except ValueError as error:
        raise ValueError(f"{_ARGUMENTS[kind]}: {str(path)!r} cannot be read: {error}") from error
    if {name: description.get(name) for name in ("format", "version")} != _header(kind):
        raise ValueError(
            f"{_ARGUMENTS[kind]}: {str(path)!r} must be {KINDS[kind]} of version {VERSION}, got format "
            f"{description.get('format')!r:.60}, version {description.get('version')!r:.60}"
        )
    return description, tensors


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:400] or type(error).__name__


def contents_of(module: nn.Module) -> dict[str, Tensor]:
    """Return the tensors that a file stores for a module: its weights, and its text vectors."""
    return {**module.state_dict(keep_vars=True), **text_vectors(module)}


def text_vectors(module: nn.Module) -> dict[str, Tensor]:
    """Return the vectors of a module's texts by name; they identify the text encoder."""
    parts = module.named_modules(remove_duplicate=False)  # an ensemble may hold a member twice
    vectors = ((name, getattr(part, "text_vectors", None)) for name, part in parts)
    return {_TEXTS + name: tensor for name, tensor in vectors if tensor is not None}


@torch.no_grad()
def _copy_tensors(stored: Mapping[str, Tensor], live: Mapping[str, Tensor]) -> None:
    """Copy weights in place; raise :class:`ValueError` where names, shapes, dtypes or text vectors differ."""
    if different := sorted(stored.keys() ^ live.keys()):
        raise ValueError(f"the file and the module must have the same tensors, they differ in {different[:8]}")
    weights = {name: tensor for name, tensor in live.items() if not name.startswith(_TEXTS)}
    for name in live.keys() - weights.keys():
        old, new = stored[name], live[name]
        if old.shape != new.shape or not torch.allclose(old.to(new), new, atol=_TEXT_TOLERANCE, rtol=0.0):
            raise ValueError("text_encoder must be the one that the file was made with: its vectors differ")
    for name, tensor in weights.items():
        if isinstance(tensor, nn.parameter.UninitializedParameter):  # of a lazy layer
            tensor.materialize(stored[name].shape)
        if (stored[name].dtype, stored[name].shape) != (tensor.dtype, tensor.shape):
            got = f"{stored[name].dtype} of shape {tuple(stored[name].shape)}"
            raise ValueError(f"{name} must be {tensor.dtype} of shape {tuple(tensor.shape)}, got {got}")
    check_finite({name: stored[name] for name, tensor in weights.items() if isinstance(tensor, nn.Parameter)})
    for name, tensor in weights.items():
        tensor.copy_(stored[name])


def check_finite(weights: Mapping[str, Tensor]) -> None:
    """Raise :class:`ValueError` if a weight is NaN or infinite."""
    for name, tensor in weights.items():
        if not tensor.isfinite().all():
            raise ValueError(f"weights: {name} must be finite, it holds NaN or infinity")


def check_can_be_saved(module: nn.Module, kind: str = "actor") -> None:
    """Raise an error unless a module can be saved and loaded. Trainers call it first, so that no training is lost."""
    widths = [vectors.shape[-1] for vectors in text_vectors(module).values()] or [TEXT_DIMENSION]
    custom = [type(part) for part in module.modules() if not type(part).__module__.startswith("torch.")]
    description = json.loads(json.dumps(describe(module)))
    try:
        with torch.random.fork_rng(devices=[]):
            # The stand-in encoder avoids loading a language model just for the check.
            again = from_description(description, lambda texts: torch.ones(len(texts), widths[0]), custom)
        if not same_keys(module, again):
            raise ValueError("its in_keys or out_keys were changed later: pass them to its constructor")
        _copy_tensors(module.state_dict(), again.state_dict(keep_vars=True))
    except Exception as error:
        message = f"{kind} cannot be saved, because its description does not rebuild it"
        raise ValueError(f"{message} ({_one_line(error)})") from error


def policy_file(path: AnyPath) -> Path:
    """Return the file of a policy: the path itself, or the file of the shipped policy of that name."""
    return shipped_policy(path) or Path(path)


def read_description(path: AnyPath) -> dict[str, Any]:
    """Return a policy file's description; errors as for :func:`load_actor`."""
    return _read(policy_file(path), "actor")[0]


def demonstration_seeds(path: AnyPath) -> set[int]:
    """Return the seeds of the demonstrations that a policy was trained on, as far as its file records them."""
    data = read_description(path).get("data") or {}
    return {part["seed"] for part in data.get("parts", [data]) if "seed" in part}


def demonstrated_tasks(path: AnyPath) -> set[str]:
    """Return the tasks of the demonstrations that a policy was trained on, as far as its file records them."""
    data = read_description(path).get("data") or {}
    return {task for tasks in data.get("episodes", [data.get("tasks", ())]) for task in tasks}


def training_file(checkpoint: Path) -> Path:
    """Return the file of the training state next to a policy, for example ``mt10.training.safetensors``."""
    return checkpoint.with_name(f"{checkpoint.stem}.training{checkpoint.suffix}")


def check_description(path: Path, expected: Mapping[str, Any], stored: Mapping[str, Any] | None = None) -> None:
    """Raise :class:`ValueError` unless the description of a file agrees with ``expected``; None to read a policy's."""
    stored = read_description(path) if stored is None else stored
    for part, now in json.loads(json.dumps(expected)).items():  # as JSON, which has no tuples
        if (before := stored.get(part)) != now:
            names = differences(before if isinstance(before, dict) else {}, now or {})
            kind = "architecture" if part in ("actor", "actors", "evaluator", "loss") else "configuration"
            raise ValueError(
                f"checkpoint: {str(path)!r} is of another {kind}, its {part} differs in {', '.join(names[:8])}"
                f"{', ...' * (len(names) > 8)}; choose another file, or delete it to start again"
            )


class CheckpointFiles:
    """The file of a policy or evaluator and the training state next to it, written by one training at a time.

    Args:
        checkpoint: the file.
        part: what the file holds, "actor" or "evaluator"; None if it is the training state itself.
    """

    def __init__(self, checkpoint: AnyPath, part: str | None) -> None:
        self.checkpoint, self.part = Path(checkpoint), part
        self.state = training_file(self.checkpoint) if part else self.checkpoint
        self._known: tuple[int, ...] | None = None  # identifies the version of the state that was read or written last

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Lock these files against other trainings within the block."""
        with locked(self.checkpoint, "checkpoint", "training"):
            if self._version() not in (None, self._known):
                message = "was written by another training after this one began; start again to resume from it"
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
        """Write ``tensors`` and ``state``, then the policy or evaluator ``part``. Earlier files are replaced whole."""
        _write(self.state, "training", {**description, "device": device.type}, tensors, state)
        self._known = self._version()
        if self.part is not None and part is not None:
            _write(self.checkpoint, self.part, description, contents_of(part))

    def exist(self) -> bool:
        """Return whether there is a state; ValueError if there is only a policy, which would be overwritten."""
        if not self.state.exists() and self.checkpoint.exists():
            message = f"{str(self.checkpoint)!r} exists, but not its training state {str(self.state)!r}"
            raise ValueError(f"checkpoint: {message}; choose another file, or delete it to start again")
        return self.state.exists()

    def restore(
        self,
        description: Mapping[str, Any],
        device: torch.device,
        tensors: Mapping[str, Tensor],
        load_state: Callable[[dict[str, Any]], None],
    ) -> None:
        """Copy the stored tensors into ``tensors`` and pass the stored state to ``load_state``."""
        name, version = f"checkpoint: {str(self.state)!r}", self._version()
        stored_description, stored = _read(self.state, "training")
        check_description(self.state, description, stored_description)
        if self.part is not None and self.checkpoint.exists():
            policy, _ = _read(self.checkpoint, self.part)
            check_description(self.checkpoint, {self.part: description[self.part]}, policy)
        if (before := stored_description["device"]) != device.type:
            warnings.warn(
                f"{name} was trained on {before!r} and resumes on {device.type!r}: training continues with the "
                "same minibatches, but results will not be bit-identical to an uninterrupted run",
                stacklevel=4,
            )
        warn_of_other_versions(self.state, stored_description["versions"], LIBRARIES)
        try:
            state = pop_state(stored_description, stored)
            _copy_tensors(stored, tensors)
            load_state(state)
        except (ValueError, KeyError, TypeError, RuntimeError) as error:
            message = f"{name} does not fit, it is damaged or of another architecture"
            raise ValueError(f"{message} ({_one_line(error)})") from error
        self._known = version
