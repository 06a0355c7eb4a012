"""The one envelope of the files of policies, query evaluators and training: an archive that says what it is.

    description.json       format and version, the module's description, and what training added to it
    weights.safetensors    the module's state; ``loss.safetensors`` of a loss, targets and statistics among it
    texts.safetensors      the vectors that its texts had: another text encoder is found out
    training.safetensors   optimizer, schedule, sampler and generators, while it is trained

Nothing is unpickled, and what the file says of sizes is held against what it holds before anything is made.
"""

import json
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor, nn

from lw_torchrl._checks import differences, shown
from lw_torchrl._files import AnyPath, absent_policy
from lw_torchrl._tensor_archive import ArchiveError, TensorArchive, join, split, write_archive
from lw_torchrl._versions import LIBRARIES, warn_of_other_versions
from lw_torchrl.language.plans import PlanError
from lw_torchrl.language.text import TextEncoder
from lw_torchrl.training.file_checks import check_integers, check_size, check_texts, copy_weights, first_line

_ADDED = {"actors", "replay"}
"""What older descriptions do not say: a training that was begun without it goes on."""

Module = TypeVar("Module", bound=nn.Module)


@dataclass(frozen=True)
class Envelope:
    """How files of a kind are written and read."""

    format: str
    version: int
    part: str
    argument: str
    called: str
    command: str
    group: str = "weights"

    def save(self, path: AnyPath, module: Any, texts: Mapping[str, Tensor], about: dict) -> None:
        """Write a module that a file can hold, and ``about``; :class:`ValueError` if it names what a file says."""
        if reserved := sorted({"format", "version", "versions", self.part, "state", "sha256"} & set(about)):
            raise ValueError(f"about must not be named {', '.join(reserved)}, which {self.called} file says itself")
        self.write(path, {self.part: module.describe(), **about}, {"weights": module.state_dict(), "texts": texts})

    def write(
        self,
        path: AnyPath,
        described: Mapping[str, Any],
        groups: Mapping[str, Mapping[str, Tensor]],
        training: Mapping[str, Any] | None = None,
    ) -> None:
        """Write a file whole, or leave the earlier one and raise :class:`OSError`."""
        described = {"format": self.format, "version": self.version, **described}
        if training is not None:
            tensors: dict[str, Tensor] = {}
            described["state"] = split(training, tensors)
            groups = {**groups, "training": tensors}
        try:
            write_archive(path, described, groups)
        except OSError as error:
            what = f"{self.argument}: {str(path)!r} cannot be written ({error.strerror}); an earlier file is as it was"
            raise OSError(error.errno, what) from error

    def open(self, path: AnyPath) -> TensorArchive:
        """The archive of a file whose format, version and part have been checked."""
        begin = f"{self.argument}: {str(path)!r}"
        if not Path(path).exists():
            raise FileNotFoundError(f"{self.argument}: {absent_policy(path, self.command)}")
        if Path(path).is_dir():
            raise ValueError(f"{begin} is a folder; {self.called} is one file")
        try:
            found = TensorArchive(path)
        except (ArchiveError, OSError) as error:
            names = error.names if isinstance(error, ArchiveError) else []
            if any(name.startswith(("components/", "manifest", "description/")) for name in names):
                raise ValueError(
                    f"{begin} is of version 1, whose files can run code when they are read; this package reads version "
                    f"{self.version}. Train it again"
                ) from error
            raise ValueError(f"{begin} is damaged or none of ours ({error})") from error
        name, version = found.description.get("format"), found.description.get("version")
        if (name, version) != (self.format, self.version):
            other = [kind for kind in (POLICY, EVALUATOR, TRAINING) if kind.format == name != self.format]
            hint = f"It is {other[0].called}'s, give {self.called}'s" if other else "Train it again"
            raise ValueError(
                f"{begin} is of format {name!r:.60} version {version!r:.60}; this package reads {self.format!r} "
                f"version {self.version}. {hint}"
            )
        if not isinstance(found.description.get(self.part), dict):
            raise ValueError(f"{begin} is damaged or none of ours (it describes no {self.part})")
        return found

    def check_can_be_saved(self, module: Any, make: Callable[[Any], nn.Module]) -> None:
        """Raise :class:`ValueError` if a file could not hold a module: its description makes another, or it has NaN."""
        described = module.describe()
        try:
            with torch.random.fork_rng(devices=[]):
                again = make(json.loads(json.dumps(described)))
            copy_weights(module.state_dict(), again.state_dict(keep_vars=True))
        except Exception as error:
            what = f"{self.part} cannot be kept in a file, whose description would not make it again"
            raise ValueError(f"{what} ({first_line(error)})") from error

    def load(
        self,
        path: AnyPath,
        make: Callable[[Any, TextEncoder | None], Module],
        encoder: TextEncoder | None,
        texts_of: Callable[[Module], dict[str, Tensor]],
    ) -> Module:
        """The module of a file, in eval mode, that ``make`` makes of its description and a text encoder;
        :class:`ValueError` if its weights, sizes or texts, which ``texts_of`` gives, are not those it says."""
        archive = self.open(path)
        described = archive.description[self.part]
        try:
            weights, texts = archive.tensors(self.group), archive.tensors("texts")
            check_integers(described, sum(tensor.numel() for tensor in weights.values()), len(weights))
            check_size(lambda stand_in: make(described, stand_in), weights, texts)
            module = make(described, encoder)
            check_texts(texts, texts_of(module))
            copy_weights(weights, module.state_dict(keep_vars=True))
        except ImportError:
            raise
        except Exception as error:  # a file from a stranger may say anything
            what = f"{self.argument}: the {self.part} of {str(path)!r} cannot be made"
            own = "; a relation of yours must be imported first" if isinstance(error, PlanError) else ""
            raise ValueError(f"{what} ({first_line(error)}){own}") from error
        return module.eval()

    def resume(
        self,
        path: Path,
        described: Mapping[str, Any],
        contents: Mapping[str, Mapping[str, Tensor]],
        load: Callable[[dict[str, Any]], None],
        *,
        device: torch.device | None = None,
        packages: Sequence[str] = LIBRARIES,
    ) -> None:
        """Go on with a file's training; warn if another kind of device, or other versions of packages, wrote it."""
        archive = self.open(path)
        check_same_description(path, archive.description, described)
        if device is not None and (before := archive.description.get("device", "cpu")) != device.type:
            warnings.warn(
                f"checkpoint: {str(path)!r} was trained on {shown(before)} and goes on on {device.type!r}: with the "
                "same minibatches, but sums are rounded, and noise is drawn, in another way",
                stacklevel=3,
            )
        warn_of_other_versions(path, archive.description.get("versions"), packages)
        try:
            state = join(archive.description.get("state"), archive.tensors("training"))
            if not isinstance(state, dict):
                raise ValueError("it has no training state")
            if "texts" in contents:
                check_texts(archive.tensors("texts"), contents["texts"])
            copy_weights(archive.tensors(self.group), contents[self.group])
            load(state)
        except (ValueError, KeyError, TypeError, RuntimeError, AttributeError) as error:  # RecursionError among them
            what = f"checkpoint: {str(path)!r} does not fit, it is of another architecture or damaged"
            raise ValueError(f"{what} ({first_line(error)})") from error


POLICY: Envelope = Envelope("lw_torchrl.policy", 3, "actor", "checkpoint", "a policy", "train")
EVALUATOR: Envelope = Envelope("lw_torchrl.evaluator", 1, "evaluator", "evaluator", "an evaluator", "train-evaluator")
TRAINING: Envelope = Envelope("lw_torchrl.training", 1, "loss", "checkpoint", "a loss's training", "offline", "loss")


def check_description(path: Path, ours: Mapping[str, Any]) -> None:
    """Raise :class:`ValueError` unless the policy file was saved with the description ``ours``."""
    check_same_description(path, POLICY.open(path).description, ours)


def _unplaced(found: Any) -> Any:
    """A description without the modules that classes are of, which may move."""
    if isinstance(found, list):
        return [_unplaced(one) for one in found]
    if not isinstance(found, dict):
        return found
    return {name: _unplaced(one) for name, one in found.items() if name != "module" or "kind" not in found}


def check_same_description(path: Path, found: Mapping[str, Any], ours: Mapping[str, Any]) -> None:
    """Raise :class:`ValueError` unless a file's description ``found`` is ``ours``."""
    for part, wanted in json.loads(json.dumps(ours)).items():  # JSON has lists, but no tuples
        before, wanted = _unplaced(found.get(part)), _unplaced(wanted)
        if part == "online" and isinstance(before, dict):  # older files list the options of all methods
            before = {name: value for name, value in before.items() if name in wanted}
        if before == wanted or (part in _ADDED and part not in found):
            continue
        different = differences(before if isinstance(before, dict) else {}, wanted or {})
        kind = "architecture" if part in ("actor", "actors", "evaluator", "loss") else "configuration"
        raise ValueError(
            f"checkpoint: {str(path)!r} is of another {kind}, its {part} differs in {', '.join(different[:8])}"
            f"{', ...' * (len(different) > 8)}; choose another file, or delete it to start again"
        )
