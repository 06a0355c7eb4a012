"""LanguageWorldExperienceReplay: demonstration datasets as a TorchRL replay buffer, and its storage."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Sequence
from hashlib import sha256
from pathlib import Path
from typing import Any, Literal, NoReturn

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torch.utils.data import get_worker_info
from torchrl.data import ImmutableDatasetWriter, TensorStorage
from torchrl.data.datasets.common import BaseDatasetExperienceReplay
from torchrl.data.replay_buffers.samplers import Sampler
from torchrl.envs import Compose, MultiStepTransform, Reward2GoTransform, Transform

from lw_torchrl._util.checks import Count, Natural, Probability, typed
from lw_torchrl._util.devices import CPU, finite
from lw_torchrl._util.files import AnyPath, reading
from lw_torchrl._util.tensor_files import pop_state, read_tensors, write_tensors
from lw_torchrl.data.dataset import DATA, read_metadata, verify
from lw_torchrl.data.loading import check_options, labels_of, read_rows
from lw_torchrl.data.rewards import RewardName
from lw_torchrl.data.samplers import to_device_of
from lw_torchrl.data.selection import EpisodeChoice, EpisodeFilter, JoinedDemonstrations, Label, select

_FILE = "buffer.safetensors"


class DatasetStorage(TensorStorage):
    """A :class:`torchrl.data.TensorStorage` of the rows of datasets, which it neither changes nor saves.

    Uniform samplers draw on the CPU, so the minibatches are the same on every device.

    Args:
        rows: of :func:`load_demonstrations`, (R,).
        fingerprint: identifies the rows; it is all that ``state_dict`` holds.
    """

    def __init__(self, rows: TensorDict, fingerprint: str) -> None:
        super().__init__(rows, device=rows.device or CPU)
        self.fingerprint = fingerprint

    def _rand_given_ndim(self, batch_size: int) -> Tensor:
        return to_device_of(self, torch.randint(0, len(self), (batch_size,), generator=self._rng))

    def get(self, index: Any) -> TensorDict:
        """Return the rows at an index: views for a slice, in a TensorDict of their own; copies for anything else."""
        rows: TensorDict = super().get(index)
        return rows if isinstance(index, Tensor) and index.dim() else rows.clone(recurse=not isinstance(index, slice))

    def add_column(self, name: str, values: Tensor) -> None:
        """Give each row a value, (R, ...)."""
        self._storage.set(name, values)

    def set(self, *args: Any, **kwargs: Any) -> NoReturn:
        raise RuntimeError("a dataset's rows are read-only; change the samples, or use add_column")

    _empty = set

    def state_dict(self) -> dict[str, Any]:
        return {"rows": self.fingerprint}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Check that a state belongs to these rows."""
        if state_dict.get("rows") != self.fingerprint:
            raise ValueError("state_dict belongs to other rows than those of this buffer")


def _check_transform(transform: Any) -> None:
    """Raise for TorchRL's transforms that act only on written rows: they would do nothing to samples."""
    if isinstance(transform, Compose):
        for part in transform:
            _check_transform(part)
    elif isinstance(transform, MultiStepTransform):
        options = f"n_steps={transform.n_steps}, gamma={transform.gamma}"
        raise ValueError(f"transform: MultiStepTransform does nothing to samples; use {options}")
    elif isinstance(transform, Reward2GoTransform):
        raise ValueError("transform: Reward2GoTransform does nothing to samples; compute it once with add_column")


class LanguageWorldExperienceReplay(BaseDatasetExperienceReplay):
    """A read-only replay buffer over the rows of :func:`load_demonstrations`, with their description.

    Samples hold the columns of :func:`load_demonstrations`; a :class:`QAFTransform` adds ``qaf`` and ``qaf_plan``. With
    ``keys``, samples hold no other columns: the sampler's ``index`` and ``is_target`` come with ``return_info=True``.

    Args:
        root, episodes, keep, label, reward, after_success, terminate_on_success, n_steps, gamma, keys, device, check:
            as for :func:`load_demonstrations`. Transforms run on the device of the rows, and minibatches are the same
            on every device.
        batch_size: rows of a sample.
        sampler: a TorchRL sampler, or a function that makes one, for example :class:`TaskBalancedSampler`; None for
            uniform.
        transform: a TorchRL transform, or any function of a TensorDict, applied to each sample.
        **kwargs: for :class:`torchrl.data.TensorDictReplayBuffer`: generator, pin_memory, ...; prefetch is at most 1,
            because several threads would draw in an order that differs from run to run.

    Attributes:
        demonstrations: the description; a :class:`JoinedDemonstrations` if folders are joined or episodes chosen.
        parts: the description of each dataset, with the episodes that are shown.
        roots, behaviours: the folders, and the labels of the collecting policies, sorted.
        columns: the name of each column of :meth:`add_column`, with a digest of its values.

    Raises:
        ValueError: as for :func:`load_demonstrations`.
        RuntimeError: rows are written.

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
        _check_transform(transform)
        if (prefetch := kwargs.get("prefetch") or 0) > 1:
            raise ValueError(f"prefetch must be 0 or 1, got {prefetch}: several threads draw in no fixed order")
        check_options(label, after_success, terminate_on_success, n_steps, gamma, keys)
        is_single = isinstance(root, (str, os.PathLike)) and episodes is None and keep is None
        after = 0 if terminate_on_success else after_success
        datasets, parts = select(root, episodes, keep, label, reward, after, check)
        loaded = read_rows(datasets, parts, label, reward, after, terminate_on_success, n_steps, gamma, keys, device)
        self.parts, self.behaviours = tuple(parts), labels_of(datasets)
        self.demonstrations = parts[0] if is_single else JoinedDemonstrations(self.parts)
        self.roots = tuple(part.root for part in parts)
        self.root = self.roots[0]
        self.label, self.reward, self.terminate_on_success = label, reward, terminate_on_success
        self.n_steps, self.gamma, self.columns = n_steps, gamma, dict[str, str]()
        self._plain = keys is not None
        rows = [[[e.task, e.episode, e.start, e.length, e.checksum] for e in part.episodes] for part in parts]
        shown = json.dumps([rows, after_success, terminate_on_success])  # identifies the rows in saved states
        storage = DatasetStorage(loaded, sha256(shown.encode()).hexdigest())
        kwargs |= {"sampler": sampler, "batch_size": batch_size, "transform": transform}
        super().__init__(storage=storage, writer=ImmutableDatasetWriter(), **kwargs)

    def sample(self, batch_size: int | None = None, return_info: bool = False, include_info: bool | None = None) -> Any:
        """Draw a minibatch; see :meth:`torchrl.data.TensorDictReplayBuffer.sample`."""
        rows, info = super().sample(batch_size, return_info=True, include_info=include_info)
        if self._plain:
            rows = rows.exclude(*info)
        return (rows, info) if return_info else rows

    def set_sampler(self, sampler: Sampler) -> Sampler:
        """Use another sampler, which draws from the buffer's generator; in a worker, call ``set_rng`` after it."""
        before = super().set_sampler(sampler)
        # In a DataLoader's workers the generators are equal copies, so all workers would draw the same rows.
        if get_worker_info() is None:
            self.set_rng(self._rng)
        return before

    def add_column(self, name: str, values: Tensor, *, of: LanguageWorldExperienceReplay | None = None) -> None:
        """Add a column ``name`` to the samples, held in memory: each row's advantage, for example.

        Args:
            values: (R, ...), for each row in the order of ``replay[:]``; a copy is kept on the device of the rows.
            of: another buffer that the values were computed from, with n steps for example. It must show the same rows
                in the same order.

        Raises:
            ValueError: another number of rows, a name that samples have, values that are not finite, or other rows.
        """
        written = {key for part in self.transform.modules() for key in getattr(part, "out_keys", None) or ()}
        if name in {*self.storage.get(slice(0, 1)).keys(), *written, "index", "is_target"}:
            raise ValueError(f"name must be new, samples have {name!r} already")
        if values.dim() == 0 or len(values) != len(self):
            raise ValueError(f"values must have {len(self)} rows, got a tensor of shape {tuple(values.shape)}")
        if not finite(values):
            raise ValueError(f"values of {name!r} must be finite, got NaN or infinity")
        if of is not None and not torch.equal(*(each.storage[:].get("observation").cpu() for each in (self, of))):
            raise ValueError("of must show the rows of this buffer in the same order: use the same episodes and keep")
        own = values.detach().clone()
        self.columns = {**self.columns, name: sha256(own.cpu().contiguous().numpy().tobytes()).hexdigest()}
        self.storage.add_column(name, own.to(self.storage.device))

    @property
    def tasks(self) -> tuple[str, ...]:
        """The names of the tasks that are shown, sorted."""
        return tuple(sorted({episode.task for episode in self.demonstrations.episodes}))

    @property
    def data_path_root(self) -> Path:
        """The dataset's folder; :class:`ValueError` if the buffer joins several."""
        if len(self.roots) > 1:
            raise ValueError(f"this buffer joins {len(self.roots)} datasets; see its roots")
        return self.roots[0]

    @property
    def data_path(self) -> Path:
        """The folder of the rows."""
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
        """Restore a state, after :meth:`verify`; ValueError if it belongs to other rows."""
        self.verify()
        super().load_state_dict(dict(state_dict))

    def dumps(self, path: AnyPath) -> None:
        """Save the state to a folder, as one file, written atomically; the rows stay in the datasets."""
        write_tensors(Path(path) / _FILE, {}, {}, self.state_dict())

    def loads(self, path: AnyPath) -> None:
        """Restore the state that :meth:`dumps` saved, after :meth:`verify`; ValueError if it is damaged or foreign."""
        with reading(path, "buffer's state"):
            self.load_state_dict(pop_state(*read_tensors(Path(path) / _FILE)))
