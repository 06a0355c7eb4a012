"""A replay buffer whose state is one file without the rows of its datasets, read without unpickling."""

import json
from collections.abc import Sequence
from hashlib import sha256
from pathlib import Path
from typing import Any, NoReturn

from torchrl.data.datasets.common import BaseDatasetExperienceReplay

from lw_torchrl._files import AnyPath, reading
from lw_torchrl._tensor_files import pop_state, read_tensors, write_tensors
from lw_torchrl.data.dataset import Demonstrations, read_metadata
from lw_torchrl.data.memory_map import verify
from lw_torchrl.data.selection import JoinedDemonstrations

_FILE = "buffer.safetensors"


def fingerprint(parts: Sequence[Demonstrations], *cuts: Any) -> str:
    """A digest of the rows of these episodes, cut short as ``cuts`` say."""
    listed = [[[e.task, e.episode, e.start, e.length, e.checksum] for e in part.episodes] for part in parts]
    return sha256(json.dumps([listed, *cuts]).encode()).hexdigest()


class RestorableReplay(BaseDatasetExperienceReplay):
    """A buffer over the rows of datasets, its ``demonstrations``, which it neither changes nor saves."""

    demonstrations: Demonstrations | JoinedDemonstrations
    _fingerprint: str

    @property
    def parts(self) -> tuple[Demonstrations, ...]:
        """The description of each dataset, with the episodes that are shown."""
        demonstrations = self.demonstrations
        return (demonstrations,) if isinstance(demonstrations, Demonstrations) else demonstrations.parts

    def verify(self) -> None:
        """Compare the episodes with their checksums, once while the files stay the same; DatasetError if damaged."""
        for part in self.parts:
            verify(read_metadata(part.root), part.episodes)

    def __setitem__(self, index: Any, value: Any) -> NoReturn:
        """Raise, since datasets are shown as they are on disk."""
        raise RuntimeError("a dataset's rows cannot be assigned to; change the samples, or use add_column")

    def state_dict(self) -> dict[str, Any]:
        """The state of sampler, generator, transforms and added rows, and a fingerprint of the datasets' rows."""
        return super().state_dict() | {"rows": self._fingerprint}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore a state, after :meth:`verify`; ValueError if it is of other rows."""
        self.verify()
        if state_dict.get("rows") != self._fingerprint:
            raise ValueError("state_dict must be of the rows that this buffer shows, got one of other rows")
        super().load_state_dict(dict(state_dict))

    def dumps(self, path: AnyPath) -> None:
        """Save the state to a folder, as one file that is there whole or not at all."""
        write_tensors(Path(path) / _FILE, {}, {}, self.state_dict())

    def loads(self, path: AnyPath) -> None:
        """Restore what :meth:`dumps` saved, after :meth:`verify`; ValueError if it is damaged or of other rows."""
        with reading(path, "buffer's state"):
            self.load_state_dict(pop_state(*read_tensors(Path(path) / _FILE)))
