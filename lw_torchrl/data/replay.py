"""LanguageWorldExperienceReplay: a TorchRL replay buffer over demonstration datasets, and its storage."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Sequence
from hashlib import sha256
from pathlib import Path
from typing import Any, Literal, NoReturn

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from torch import Tensor, nn
from torch.utils.data import get_worker_info
from torchrl.data import ImmutableDatasetWriter, TensorStorage
from torchrl.data.datasets.common import BaseDatasetExperienceReplay
from torchrl.data.replay_buffers.samplers import Sampler, SliceSampler
from torchrl.envs import MultiStepTransform, Reward2GoTransform, Transform

from lw_torchrl._util.checks import Count, Natural, Probability, typed
from lw_torchrl._util.devices import CPU, finite
from lw_torchrl._util.files import AnyPath, reading
from lw_torchrl._util.tensor_files import pop_state, read_tensors, write_tensors
from lw_torchrl.data.dataset import DATA, TRAJECTORY, read_metadata, verify
from lw_torchrl.data.loading import select_and_read
from lw_torchrl.data.rewards import STEPS, RewardName
from lw_torchrl.data.samplers import to_device_of
from lw_torchrl.data.selection import EpisodeChoice, EpisodeFilter, JoinedDemonstrations, Label
from lw_torchrl.transforms.qaf import QAFTransform, latches_of_rows

_FILE = "buffer.safetensors"
_OVER_TIME = {  # TorchRL's transforms that read several time steps of an episode; some versions lack some of them
    *("ActionChunkTransform", "BurnInTransform", "CatFrames", "NextStateReconstructor", "RandomCropTensorDict"),
    *("RewardSum", "TimeMaxPool"),
}
_ON_WRITING = {MultiStepTransform: "n_steps and gamma", Reward2GoTransform: "add_column"}  # act when rows are written


class DatasetStorage(TensorStorage):
    """A read-only :class:`torchrl.data.TensorStorage` over the rows of datasets.

    Uniform samplers draw on the CPU, so minibatches are the same on every device.

    Args:
        rows: the rows (R,) returned by :func:`load_demonstrations`.
        fingerprint: a digest that identifies the rows; ``state_dict`` contains only this digest, not the rows.
    """

    def __init__(self, rows: TensorDict, fingerprint: str) -> None:
        super().__init__(rows, device=rows.device or CPU)
        self.fingerprint = fingerprint

    def _rand_given_ndim(self, batch_size: int) -> Tensor:
        return to_device_of(self, self.draw(batch_size))

    def draw(self, batch_size: int) -> Tensor:
        """Draw the indices (B,) int64 of uniformly random rows, on the CPU."""
        return torch.randint(0, len(self), (batch_size,), generator=self._rng)

    def get(self, index: Any) -> TensorDict:
        """Return the rows at an index in a new TensorDict: views for a slice, copies for any other index."""
        rows: TensorDict = super().get(index)
        return rows if isinstance(index, Tensor) and index.dim() else rows.clone(recurse=not isinstance(index, slice))

    def add_column(self, name: NestedKey, values: Tensor) -> None:
        """Add a column of values (R, ...), one for each of the R rows."""
        self._storage.set(name, values)

    def set(self, *args: Any, **kwargs: Any) -> NoReturn:
        raise RuntimeError("a dataset's rows are read-only; modify the samples, or use add_column")

    _empty = set

    def state_dict(self) -> dict[str, Any]:
        return {"rows": self.fingerprint}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Raise :class:`ValueError` unless a state was saved for the same rows."""
        if state_dict.get("rows") != self.fingerprint:
            raise ValueError("state_dict was saved for other rows; open the buffer with the same datasets and options")


def _check_transforms(sampler: Sampler, *transforms: Any) -> None:
    """Raise ValueError for a transform that acts only when rows are written, or that would mix episodes."""
    is_reshaped = False  # a SliceSampler returns consecutive rows in flat samples, which a transform must reshape
    for part in (part for transform in transforms if isinstance(transform, Transform) for part in transform.modules()):
        if instead := next((hint for kind, hint in _ON_WRITING.items() if isinstance(part, kind)), None):
            raise ValueError(f"transform: {type(part).__name__} does not change samples; use {instead} instead")
        kinds = {kind.__name__ for kind in type(part).__mro__}
        is_reshaped |= bool(kinds & {"BatchSizeTransform", "_CallableTransform"})
        if (names := kinds & _OVER_TIME) and not (is_reshaped and isinstance(sampler, SliceSampler)):
            problem = f"transform: {names.pop()} reads consecutive time steps, but samples mix episodes"
            raise ValueError(f"{problem}; use sampler=SliceSampler(...) and BatchSizeTransform (see docs/data.md)")


class LanguageWorldExperienceReplay(BaseDatasetExperienceReplay):
    """A read-only replay buffer over demonstration datasets.

    Samples hold the columns of :func:`load_demonstrations`; a :class:`QAFTransform` adds ``qaf`` and ``qaf_plan``. With
    ``keys``, samples hold only these columns; ``return_info=True`` returns the sampler's ``index`` and ``is_target``.

    Args:
        root, episodes, keep, label, reward, after_success, terminate_on_success, n_steps, gamma, keys, device, check:
            see :func:`load_demonstrations`. Transforms run on the device of the rows; minibatches are the same on
            every device.
        batch_size: number of rows per sample.
        sampler: a TorchRL sampler, or a function that creates a sampler, such as :class:`TaskBalancedSampler`; None
            to sample uniformly.
        transform: a TorchRL transform, or any function of a TensorDict, applied to each sample.
        prefetch: 1 to draw the next sample in a thread. More threads would draw in an order that differs between runs.
        **kwargs: keyword arguments of :class:`torchrl.data.TensorDictReplayBuffer`, such as generator or pin_memory.

    Attributes:
        demonstrations: the dataset's description; :class:`JoinedDemonstrations` for several folders or a selection.
        parts: the description of each dataset, with the selected episodes.
        roots, behaviours: the folders, and the sorted labels of the collection policies.
        columns: the names of the columns added by :meth:`add_column`, with a digest of the values.

    Raises:
        ValueError: see :func:`load_demonstrations`.
        RuntimeError: rows are written to the buffer.

    Example:
        >>> import tempfile, lw_torchrl as lw
        >>> with tempfile.TemporaryDirectory() as root:
        ...     _ = lw.collect_demonstrations("reach", episodes_per_task=1, root=root + "/demos", max_steps=80)
        ...     replay = lw.LanguageWorldExperienceReplay(root + "/demos", batch_size=8)
        ...     replay.sample()["action"].shape
        torch.Size([8, 4])

    Source: the datasets of ``torchrl.data.datasets``.
    """

    @typed
    def __init__(
        self,
        root: AnyPath | Iterable[AnyPath],
        *,
        episodes: EpisodeChoice | Sequence[EpisodeChoice] = None,
        keep: EpisodeFilter | None = None,
        batch_size: Count | None = None,
        prefetch: Literal[0, 1] | None = None,
        sampler: Sampler | Callable[[], Sampler] | None = None,
        transform: Transform | Callable[[TensorDictBase], TensorDictBase] | None = None,
        label: Label = "expert",
        reward: RewardName = "sparse",
        after_success: Natural | None = None,
        terminate_on_success: bool = False,
        n_steps: Count = 1,
        gamma: Probability | None = None,
        keys: Literal["rollout"] | Iterable[NestedKey] | None = None,
        device: str | torch.device | None = None,
        check: bool = True,
        **kwargs: Any,
    ) -> None:
        is_single = isinstance(root, (str, os.PathLike)) and episodes is None and keep is None
        how = label, reward, after_success, terminate_on_success, n_steps, gamma, keys, device, check
        parts, self.behaviours, loaded = select_and_read(root, episodes, keep, *how)
        self.parts = tuple(parts)
        self.demonstrations = parts[0] if is_single else JoinedDemonstrations(self.parts)
        self.roots = tuple(part.root for part in parts)
        self.root = self.roots[0]
        self.label, self.reward, self.terminate_on_success = label, reward, terminate_on_success
        self.n_steps, self.gamma, self.columns = n_steps, gamma, dict[str, str]()
        self._plain = keys is not None
        rows = [[[e.task, e.episode, e.start, e.length, e.checksum] for e in part.episodes] for part in parts]
        shown = json.dumps([rows, after_success, terminate_on_success])  # identifies the rows in saved states
        storage = DatasetStorage(loaded, sha256(shown.encode()).hexdigest())
        kwargs |= {"sampler": sampler, "batch_size": batch_size, "transform": transform, "prefetch": prefetch}
        super().__init__(storage=storage, writer=ImmutableDatasetWriter(), **kwargs)
        _check_transforms(self.sampler, self.transform)
        self._add_latches(self.transform)

    def sample(self, batch_size: int | None = None, return_info: bool = False, include_info: bool | None = None) -> Any:
        """Draw a minibatch; see :meth:`torchrl.data.TensorDictReplayBuffer.sample`."""
        rows, info = super().sample(batch_size, return_info=True, include_info=include_info)
        if self._plain:
            rows = rows.exclude(*info)
        return (rows, info) if return_info else rows

    def append_transform(self, transform: Transform, *, invert: bool = False) -> Any:
        """Append a transform. For a :class:`QAFTransform` whose conditions depend on earlier steps, also add the column
        ``qaf_latches`` to the rows."""
        _check_transforms(self.sampler, self.transform, transform)
        self._add_latches(transform)
        return super().append_transform(transform, invert=invert)

    def insert_transform(self, index: int, transform: Transform, *, invert: bool = False) -> Any:
        """Insert a transform, like :meth:`append_transform`."""
        _check_transforms(self.sampler, *self.transform[:index], transform)
        self._add_latches(transform)
        return super().insert_transform(index, transform, invert=invert)

    def _add_latches(self, transform: Any) -> None:
        """Compute the latches of each QAFTransform for all rows, because a sample does not contain earlier steps."""
        for part in transform.modules() if isinstance(transform, nn.Module) else ():
            if isinstance(part, QAFTransform) and part.program.num_latches:
                self._compute_latches(part)

    def _compute_latches(self, part: QAFTransform) -> None:
        rows, (seen, task), key = self.storage[:], part.in_keys, part.out_keys[2]
        if (trajectory := rows.get(TRAJECTORY, None)) is None:
            raise ValueError(f"keys must contain {TRAJECTORY!r}, since the plans' conditions depend on earlier steps")
        latches = latches_of_rows(part.program, rows.get(seen), rows.get(task), trajectory)
        self.storage.add_column(key, latches)
        if (following := rows.get(("next", seen), None)) is not None:
            last = torch.arange(len(rows), device=latches.device) + rows.get(STEPS, 1) - 1
            after = part.program.remember(following, rows.get(("next", task), rows.get(task)), latches[last])[1]
            self.storage.add_column(unravel_key(("next", key)), after)

    def set_sampler(self, sampler: Sampler) -> Sampler:
        """Set a sampler, which uses the buffer's generator; in a DataLoader worker, call ``set_rng`` afterwards."""
        _check_transforms(sampler, getattr(self, "_transform", None))
        before = super().set_sampler(sampler)
        # The workers of a DataLoader have equal copies of the generator, so all workers would draw the same rows.
        if get_worker_info() is None:
            self.set_rng(self._rng)
        return before

    def add_column(self, name: str, values: Tensor, *, of: LanguageWorldExperienceReplay | None = None) -> None:
        """Add a column ``name`` to the samples, for example the advantage of each row; the values are kept in memory.

        Args:
            values: one value per row, (R, ...), in the order of ``replay[:]``; copied to the device of the rows.
            of: the buffer from which the values were computed, if not this buffer (for example one with n steps). It
                must hold the same rows in the same order.

        Raises:
            ValueError: samples already have the name, a value is not finite, or ``of`` holds other rows.
            RuntimeError: the number of values is not the number of rows.
        """
        written = {key for part in self.transform.modules() for key in getattr(part, "out_keys", None) or ()}
        if name in {*self.storage.get(slice(0, 1)).keys(), *written, "index", "is_target"}:
            raise ValueError(f"name must be new, but samples already have a column {name!r}")
        if not finite(values):
            raise ValueError(f"values of {name!r} must be finite, got NaN or infinity")
        if of is not None and not torch.equal(*(each.storage[:].get("observation").cpu() for each in (self, of))):
            raise ValueError("of= must hold this buffer's rows in the same order: pass the same episodes= and keep=")
        own = values.detach().clone()
        self.storage.add_column(name, own.to(self.storage.device))
        self.columns = {**self.columns, name: sha256(own.cpu().contiguous().numpy().tobytes()).hexdigest()}

    @property
    def tasks(self) -> tuple[str, ...]:
        """The sorted task names of the selected episodes."""
        return tuple(sorted({episode.task for episode in self.demonstrations.episodes}))

    @property
    def data_path_root(self) -> Path:
        """The dataset's folder; raises :class:`ValueError` if the buffer joins several datasets."""
        if len(self.roots) > 1:
            raise ValueError(f"this buffer joins {len(self.roots)} datasets; use the attribute roots")
        return self.roots[0]

    @property
    def data_path(self) -> Path:
        """The folder that contains the dataset's rows."""
        return self.data_path_root / DATA

    def _is_downloaded(self) -> bool:
        return True

    def verify(self) -> None:
        """Raise DatasetError unless all episodes match their checksums."""
        for part in self.parts:
            verify(read_metadata(part.root), part.episodes)

    def __setitem__(self, index: Any, value: Any) -> None:
        self.storage.set(index, value)  # raises: the rows are read-only

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Call :meth:`verify` and restore a state; raise ValueError if the state was saved for other rows."""
        self.verify()
        super().load_state_dict(dict(state_dict))

    def dumps(self, path: AnyPath) -> None:
        """Save the state (without the rows) atomically to one file in a folder."""
        write_tensors(Path(path) / _FILE, {}, {}, self.state_dict())

    def loads(self, path: AnyPath) -> None:
        """Restore a state saved by :meth:`dumps`; raise ValueError if the file is corrupted or is for other rows."""
        with reading(path, "buffer's state"):
            self.load_state_dict(pop_state(*read_tensors(Path(path) / _FILE)))
