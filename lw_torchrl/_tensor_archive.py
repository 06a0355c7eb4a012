"""States of any nesting as JSON and tensors; and one file of these, which is read without unpickling.

It is a zip archive without compression: ``description.json``, and ``<group>.safetensors`` for each group of tensors,
whose SHA-256 the description states. The sizes that it states are not trusted.
"""

import io
import json
import re
import zipfile
from collections.abc import Iterable, Mapping
from hashlib import sha256
from math import inf
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load, save
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from lw_torchrl._files import AnyPath, parse_json, read_bytes, replacing
from lw_torchrl._versions import package_versions

_DESCRIPTION = "description.json"
_MOST_BYTES = 8 * 2**30  # of a file, which is read whole; most have 1 MB
_MOST_JSON = 64 * 2**20  # bytes; 50 plans take 100 kB
_MOST_ENTRIES = 8
_GROUP = re.compile(r"([a-z_]{1,40})\.safetensors")


class ArchiveError(ValueError):
    """A file that is no archive of ours, or damaged; ``names`` are the entries of a zip archive that is not ours."""

    def __init__(self, message: str, names: Iterable[str] = ()) -> None:
        super().__init__(message)
        self.names = list(names)


def write_archive(path: AnyPath, description: Mapping[str, Any], groups: Mapping[str, Mapping[str, Tensor]]) -> None:
    """Write a file whole or not at all: the ``description``, JSON to which ``sha256`` and the ``versions`` of packages
    are added, and ``groups`` of tensors by name. What could not be read again is a :class:`ValueError`."""
    data = {}
    for name, tensors in groups.items():
        own = {key: tensor.detach().cpu().contiguous().clone() for key, tensor in tensors.items()}
        data[f"{name}.safetensors"] = save(own)
    digests = {name: sha256(content).hexdigest() for name, content in data.items()}
    stated = {**description, "versions": package_versions(), "sha256": digests}
    text = json.dumps(stated, indent=1, allow_nan=False).encode()
    parse_json(text)
    if len(text) > _MOST_JSON or sum(map(len, data.values())) + 2 * _MOST_JSON > _MOST_BYTES:
        raise ValueError(f"files of over {_MOST_BYTES} bytes, or {_MOST_JSON} of JSON, are not read: none is written")
    with replacing(path) as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_STORED) as archive:
        for name, content in {_DESCRIPTION: text, **data}.items():
            archive.writestr(name, content)


class TensorArchive:
    """A file that :func:`write_archive` wrote, in memory; :class:`ArchiveError`, a ValueError, for any other."""

    def __init__(self, path: AnyPath) -> None:
        try:
            self._data = _entries(read_bytes(Path(path), _MOST_BYTES))
            self.description = parse_json(self._data.pop(_DESCRIPTION))
        except (ArchiveError, OSError):
            raise
        except Exception as error:  # zipfile raises many kinds of a stranger's bytes, and memory may be short
            raise ArchiveError(f"{type(error).__name__}: {error}") from error
        stated = self.description.get("sha256")
        if not isinstance(stated, dict) or set(stated) != set(self._data):
            raise ArchiveError("its entries are not those that it describes")
        for name, content in self._data.items():
            if sha256(content).hexdigest() != stated[name]:
                raise ArchiveError(f"{name} is not what was written: its SHA-256 differs")

    def tensors(self, group: str) -> dict[str, Tensor]:
        """The tensors of a group by name; :class:`ArchiveError` if there is none, or it cannot be read."""
        name = f"{group}.safetensors"
        if name not in self._data:
            raise ArchiveError(f"it holds no {name}")
        try:
            return load(self._data[name])
        except Exception as error:  # as above
            raise ArchiveError(f"{name}: {error}") from error


def _entries(content: bytes) -> dict[str, bytes]:
    """The entries of a zip archive; none may be compressed or overlap another, so they are no larger than the file."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        entries = archive.infolist()
        names = [entry.filename for entry in entries]
        for name in names:
            if name != _DESCRIPTION and not _GROUP.fullmatch(name):
                raise ArchiveError(f"it has an entry {name[:60]!r}, which no file of ours has", names)
        if len({*names}) < len(names) or len(names) > _MOST_ENTRIES:
            raise ArchiveError(f"it must have each of at most {_MOST_ENTRIES} entries once, it has {len(names)}")
        if _DESCRIPTION not in names:
            raise ArchiveError(f"it has no {_DESCRIPTION}")
        for entry in entries:
            if entry.compress_type != zipfile.ZIP_STORED or entry.file_size != entry.compress_size:
                raise ArchiveError(f"{entry.filename} is compressed, which no file of ours is")
        if (stated := sum(entry.file_size for entry in entries)) > len(content):
            raise ArchiveError(f"its entries say that they have {stated} bytes, it has {len(content)}")
        if (stated := archive.getinfo(_DESCRIPTION).file_size) > _MOST_JSON:
            raise ArchiveError(f"{_DESCRIPTION} has {stated} bytes, at most {_MOST_JSON} are read")
        return {entry.filename: archive.read(entry) for entry in entries}


_STATE = {torch.optim.AdamW: {"step", "exp_avg", "exp_avg_sq"}, torch.optim.SGD: {"momentum_buffer"}}


def split(state: Any, tensors: dict[str, Tensor]) -> Any:
    """JSON for a nested state, whose tensors go into ``tensors``; :class:`TypeError` for what cannot be saved."""
    if isinstance(state, Tensor):
        name = str(len(tensors))
        tensors[name] = state.detach()
        return {"tensor": name}
    if isinstance(state, TensorDictBase):
        device = None if state.device is None else str(state.device)
        return {"tensordict": [list(state.batch_size), device, split(state.to_dict(), tensors)]}
    if isinstance(state, Mapping):
        return {"dict": [[split(key, tensors), split(value, tensors)] for key, value in state.items()]}
    if isinstance(state, (list, tuple)):
        return {type(state).__name__: [split(value, tensors) for value in state]}
    if state is None or isinstance(state, (bool, int, float, str)):
        return state
    raise TypeError(f"a training state holds {type(state).__name__}, which cannot be saved without pickling")


def join(tree: Any, tensors: Mapping[str, Tensor]) -> Any:
    """The state that :func:`split` took apart; :class:`ValueError` if it cannot have made the tree."""
    if not isinstance(tree, dict):
        if isinstance(tree, list):
            raise ValueError("a list stands where a value was to be")
        return tree
    try:
        ((kind, inside),) = tree.items()
        if kind == "tensor":
            return tensors[inside]
        if kind == "tensordict":
            shape, device, entries = inside
            return TensorDict(join(entries, tensors), shape, device=device)
        if kind == "dict":
            return {join(key, tensors): join(value, tensors) for key, value in inside}
        return {"list": list, "tuple": tuple}[kind](join(value, tensors) for value in inside)
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"it is not as a training state is written ({error})") from error


def check_like(found: Any, live: Any, where: str) -> None:
    """Raise :class:`ValueError` unless ``found`` has the structure, types, dtypes and shapes of ``live``."""
    if isinstance(live, Tensor):
        if not isinstance(found, Tensor) or found.dtype != live.dtype or found.shape != live.shape:
            raise ValueError(f"{where} must be {live.dtype} of shape {tuple(live.shape)}, got {_said(found)}")
    elif isinstance(live, Mapping):
        if not isinstance(found, Mapping) or set(found) != set(live):
            raise ValueError(f"{where} must have the keys {sorted(map(str, live))}, got {_said(found)}")
        for key, value in live.items():
            check_like(found[key], value, f"{where}[{key!r}]")
    elif isinstance(live, (list, tuple)):
        if type(found) is not type(live) or len(found) != len(live):
            raise ValueError(f"{where} must be a {type(live).__name__} of {len(live)}, got {_said(found)}")
        for number, (one, other) in enumerate(zip(found, live, strict=True)):
            check_like(one, other, f"{where}[{number}]")
    elif type(found) is not type(live):
        raise ValueError(f"{where} must be {type(live).__name__}, got {_said(found)}")


def check_optimizer_state(found: Any, optimizer: torch.optim.Optimizer, step: int) -> None:
    """Raise :class:`ValueError` unless ``found`` is a state that the optimizer may have after so many steps."""
    live = optimizer.state_dict()
    if not isinstance(found, dict) or set(found) != set(live) or not isinstance(found["state"], dict):
        raise ValueError(f"optimizer must have the keys {sorted(live)}, got {_said(found)}")
    check_like(found["param_groups"], live["param_groups"], "optimizer['param_groups']")
    for group, own in zip(found["param_groups"], live["param_groups"], strict=True):
        check_same(group, own, "optimizer['param_groups']", {"lr"})
        if not 0 <= group["lr"] <= own["initial_lr"]:
            raise ValueError(f"optimizer['param_groups']: lr must be from 0 to {own['initial_lr']}, got {group['lr']}")
    parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    names = _STATE[type(optimizer)]
    for number, state in found["state"].items():
        if type(number) is not int or not 0 <= number < len(parameters) or not isinstance(state, dict):
            raise ValueError(f"optimizer['state'] must be of parameters 0 to {len(parameters) - 1}, got {number!r}")
        if state and set(state) != names:
            raise ValueError(f"optimizer['state'][{number}] must have {sorted(names)}, got {_said(state)}")
        for name, value in state.items():
            if value is None:
                continue
            where = f"optimizer['state'][{number}][{name!r}]"
            shape = () if name == "step" else parameters[number].shape
            check_like(value, torch.empty(shape, dtype=torch.float32, device="meta"), where)
            low, high = {"step": (1.0, step), "exp_avg_sq": (0.0, inf)}.get(name, (-inf, inf))
            if not bool((value.isfinite() & (value >= low) & (value <= high)).all()):
                raise ValueError(f"{where} holds what {step} steps cannot give")


def check_same(found: Mapping[str, Any], live: Mapping[str, Any], where: str, but: set[str]) -> None:
    """Raise :class:`ValueError` unless two states of one structure are the same, but for some entries."""
    for name, value in live.items():
        if name not in but and found[name] != value:
            raise ValueError(f"{where}: {name} must be {value!r}, got {_said(found[name])}")


def _said(value: Any) -> str:
    if isinstance(value, Tensor):
        return f"{value.dtype} of shape {tuple(value.shape)}"
    return f"{value!r:.80}"
