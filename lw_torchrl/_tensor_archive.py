"""One file of JSON and tensors, read without unpickling and without trusting the sizes that it states.

It is a zip archive without compression: ``description.json``, and ``<group>.safetensors`` for each group of tensors,
whose SHA-256 the description states.
"""

from __future__ import annotations

import io
import json
import re
import zipfile
from collections.abc import Iterable, Mapping
from hashlib import sha256
from pathlib import Path
from typing import Any

from safetensors.torch import load, save
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
