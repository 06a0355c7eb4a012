"""A replay buffer of datasets whose state is one file: the rows stay in their datasets, and no pickle is read."""

import json
from collections.abc import Mapping, Sequence
from hashlib import sha256
from pathlib import Path
from reprlib import repr as short
from typing import Any, NoReturn

from torch import Tensor
from torchrl.data import TensorStorage
from torchrl.data.datasets.common import BaseDatasetExperienceReplay
from torchrl.data.replay_buffers.storages import Storage

from lw_torchrl._files import AnyPath, reading
from lw_torchrl._tensor_archive import TensorArchive, join, split, write_archive
from lw_torchrl.data.dataset import Demonstrations, read_metadata
from lw_torchrl.data.memory_map import verify
from lw_torchrl.data.selection import JoinedDemonstrations

_FILE = "buffer.zip"
_VERSION = 2


def fingerprint(parts: Sequence[Demonstrations], *cuts: Any) -> str:
    """A digest of the rows of these episodes, cut short as ``cuts`` say."""
    listed = [[[e.task, e.episode, e.start, e.length, e.checksum] for e in part.episodes] for part in parts]
    return sha256(json.dumps([listed, *cuts]).encode()).hexdigest()


class RestorableReplay(BaseDatasetExperienceReplay):
    """A buffer that shows rows of datasets, its ``demonstrations``, which it neither changes nor saves."""

    demonstrations: Demonstrations | JoinedDemonstrations
    _fingerprint: str

    @property
    def parts(self) -> tuple[Demonstrations, ...]:
        """The description of each dataset, of the episodes that are shown."""
        shown = self.demonstrations
        return (shown,) if isinstance(shown, Demonstrations) else shown.parts

    def verify(self) -> None:
        """Check the episodes that are shown, once while the files stay the same; DatasetError if they are damaged."""
        for part in self.parts:
            verify(read_metadata(part.root), part.episodes)

    def __setitem__(self, index: Any, value: Any) -> NoReturn:
        """Raise: datasets are shown as they are on disk."""
        raise RuntimeError("a dataset's rows cannot be assigned to: change what sample() gives, or use add_column")

    def preprocess(self, *args: Any, **kwargs: Any) -> TensorStorage:
        """As TorchRL's, which needs the rows in one tensordict."""
        shown = self.storage
        self._storage: Storage = TensorStorage(shown[:])
        try:
            return super().preprocess(*args, **kwargs)
        finally:
            self._storage = shown

    def state_dict(self) -> dict[str, Any]:
        """The state of sampler, generator and transforms, the rows written, and which rows of datasets are shown."""
        return super().state_dict() | {"rows": self._fingerprint}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore a state, after :meth:`verify`; ValueError, and no change, if it is none of this buffer's rows."""
        self.verify()
        self._restore(state_dict)

    def _restore(self, state: Any) -> None:
        if not isinstance(state, Mapping) or state.get("rows") != self._fingerprint:
            raise ValueError("state_dict must be of the rows that this buffer shows, got one of others")
        size = state.get("_batch_size")
        if size is not None and (type(size) is not int or size < 1):
            raise ValueError(f"state_dict: _batch_size must be None or at least 1, got {short(size)}")
        before, generator = super().state_dict(), self._rng
        try:
            super().load_state_dict(dict(state))
        except Exception as error:
            super().load_state_dict(before)
            if generator is not None:
                self.set_rng(generator)
            if isinstance(error, ValueError):
                raise
            raise ValueError(f"state_dict does not fit this buffer ({type(error).__name__}: {error})") from error

    def dumps(self, path: AnyPath) -> None:
        """Save the state to a folder, as one file that is there whole or not at all."""
        tensors: dict[str, Tensor] = {}
        tree = split(self.state_dict(), tensors)
        write_archive(Path(path) / _FILE, {"format_version": _VERSION, "state": tree}, {"tensors": tensors})

    def loads(self, path: AnyPath) -> None:
        """Restore what :meth:`dumps` saved, after :meth:`verify`; ValueError, and no change, if it is damaged."""
        self.verify()
        with reading(path, "buffer's state"):
            archive = TensorArchive(Path(path) / _FILE)
            if (version := archive.description.get("format_version")) != _VERSION:
                raise ValueError(f"it is of version {short(version)}, this package reads {_VERSION}")
            self._restore(join(archive.description.get("state"), archive.tensors("tensors")))
