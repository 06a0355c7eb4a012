"""LanguageWorldExperienceReplay: demonstration datasets as a TorchRL replay buffer."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from hashlib import sha256
from pathlib import Path
from typing import Any, Literal

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torch.utils.data import get_worker_info
from torchrl.data import ImmutableDatasetWriter
from torchrl.data.datasets.common import BaseDatasetExperienceReplay
from torchrl.data.replay_buffers.samplers import Sampler
from torchrl.envs import Transform

from lw_torchrl._util.checks import Count, Natural, typed
from lw_torchrl._util.devices import finite
from lw_torchrl._util.files import AnyPath, reading
from lw_torchrl._util.tensor_files import pop_state, read_tensors, write_tensors
from lw_torchrl.data.dataset import DATA, read_metadata
from lw_torchrl.data.loading import load
from lw_torchrl.data.memory_map import verify
from lw_torchrl.data.selection import EpisodeChoice, EpisodeFilter, JoinedDemonstrations, Label
from lw_torchrl.data.storage import DatasetStorage, RewardName, check_transform, rows_fingerprint

_FILE = "buffer.safetensors"


class LanguageWorldExperienceReplay(BaseDatasetExperienceReplay):
    """A replay buffer over the rows of :func:`load_demonstrations`, with their description, and read-only.

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
        **kwargs: for :class:`torchrl.data.TensorDictReplayBuffer`: generator, pin_memory, ...; prefetch at most 1:
            several threads would draw in an order that differs from run to run.

    Attributes:
        demonstrations: the description; a :class:`JoinedDemonstrations` if folders are joined or episodes chosen.
        parts: the description of each dataset, with the episodes that are shown.
        roots, behaviours: the folders, and the labels of the collecting policies, sorted.
        columns: name to a digest of the values, for columns of :meth:`add_column`.

    Raises:
        ValueError: as for :func:`load_demonstrations`.
        RuntimeError: at an attempt to write rows.

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
        n_steps: int = 1,
        gamma: float | None = None,
        keys: Literal["rollout"] | Iterable[NestedKey] | None = None,
        device: str | torch.device | None = None,
        check: bool = True,
        **kwargs: Any,
    ) -> None:
        check_transform(transform)
        if (prefetch := kwargs.get("prefetch") or 0) > 1:
            raise ValueError(f"prefetch must be None, 0 or 1, got {prefetch}: several threads draw in no fixed order")
        several = not isinstance(root, (str, os.PathLike))
        root = list(root) if several else root  # type: ignore[arg-type]
        loaded = load(
            root, episodes=episodes, keep=keep, label=label, reward=reward, after_success=after_success,
            terminate_on_success=terminate_on_success, n_steps=n_steps, gamma=gamma, keys=keys, device=device,
            check=check,
        )  # fmt: skip
        self.parts, self.behaviours = loaded.parts, loaded.behaviours
        self.demonstrations = JoinedDemonstrations(loaded.parts) if loaded.is_joined else loaded.parts[0]
        self.roots = tuple(part.root for part in loaded.parts)
        self.root = self.roots[0]
        self.label, self.reward, self.terminate_on_success = label, reward, terminate_on_success
        self.n_steps, self.gamma, self.columns = n_steps, gamma, dict[str, str]()
        self._plain = keys is not None
        storage = DatasetStorage(loaded.rows, rows_fingerprint(loaded.parts, after_success, terminate_on_success))
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
        if get_worker_info() is None:
            self.set_rng(self._rng)
        return before

    def add_column(self, name: str, values: Tensor, *, of: LanguageWorldExperienceReplay | None = None) -> None:
        """Give samples a new column ``name``, held in memory: each row's advantage, for example.

        Args:
            values: (R, ...), for each row in the order of ``replay[:]``; a copy is kept on the device of the rows.
            of: the buffer that the values were computed from, if it is another one, with n steps for example. It must
                show the same rows in the same order.

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
            raise ValueError("of must show the rows of this buffer, in their order: the same episodes and keep")
        own = values.detach().clone()
        self.columns = {**self.columns, name: sha256(own.cpu().contiguous().numpy().tobytes()).hexdigest()}
        self.storage.add_column(name, own.to(self.storage.device))

    @property
    def tasks(self) -> tuple[str, ...]:
        """The names of the tasks that are shown, sorted."""
        return tuple(sorted({episode.task for episode in self.demonstrations.episodes}))

    @property
    def data_path_root(self) -> Path:
        """The dataset's folder; ValueError if there are several, see ``roots``."""
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
        """Compare the episodes with their checksums, once while the files stay the same; DatasetError if damaged."""
        for part in self.parts:
            verify(read_metadata(part.root), part.episodes)

    def __setitem__(self, index: Any, value: Any) -> None:
        self.storage.set(index, value)  # which refuses it

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore a state, after :meth:`verify`; ValueError if it is of other rows."""
        self.verify()
        super().load_state_dict(dict(state_dict))

    def dumps(self, path: AnyPath) -> None:
        """Save the state to a folder, as one file, written atomically; the rows stay in the datasets."""
        write_tensors(Path(path) / _FILE, {}, {}, self.state_dict())

    def loads(self, path: AnyPath) -> None:
        """Restore what :meth:`dumps` saved, after :meth:`verify`; ValueError if it is damaged or of other rows."""
        with reading(path, "buffer's state"):
            self.load_state_dict(pop_state(*read_tensors(Path(path) / _FILE)))
