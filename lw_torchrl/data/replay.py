"""LanguageWorldExperienceReplay: demonstration datasets as a TorchRL replay buffer."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.utils.data import get_worker_info
from torchrl.data import ImmutableDatasetWriter
from torchrl.data.replay_buffers.samplers import Sampler
from torchrl.data.replay_buffers.writers import Writer
from torchrl.envs import Transform

from lw_torchrl._checks import Count, Natural, check_path, checked
from lw_torchrl._devices import CPU, check_device
from lw_torchrl._files import AnyPath
from lw_torchrl.data import replay_checks, selection
from lw_torchrl.data.buffer_state import RestorableReplay, fingerprint
from lw_torchrl.data.dataset import DATA, read_metadata
from lw_torchrl.data.growing import ONE_PROCESS, GrowingStorage, GrowingWriter
from lw_torchrl.data.memory_map import verify
from lw_torchrl.data.rewards import RewardName, check_n_steps
from lw_torchrl.data.selection import EpisodeChoice, EpisodeFilter, JoinedDemonstrations, Label
from lw_torchrl.data.storage import (
    DEMONSTRATION,
    TRAJECTORY,
    DeviceStorage,
    JoinedStorage,
    WholeStorage,
    flat_columns,
    row_dictionaries,
)
from lw_torchrl.language.value_checks import finite


def _choices(episodes: Any, roots: int, joined: bool) -> list[EpisodeChoice]:
    if not joined or episodes is None:
        return [episodes] * roots
    if not isinstance(episodes, Sequence) or len(episodes) != roots:
        raise ValueError(f"episodes must be a list of a choice for each of the {roots} folders, got {episodes!r}")
    return list(episodes)


_NOT_COLLECTED = ("behaviour", "expert_action", "unclipped_action", ("next", "reward_sparse"), ("next", "reward_dense"))


class LanguageWorldExperienceReplay(RestorableReplay):
    """A replay buffer over datasets of :func:`collect_demonstrations`. Several are joined without being copied.

    Samples hold observation (B, 39) float32, action (B, 4) float32, task_id and episode (B,) int64, and the columns of
    ``label``; a :class:`QAFTransform` adds ``qaf`` and ``qaf_plan``. collector/traj_ids (B,) int64 is unique for each
    episode of all datasets; behaviour (B,) int64 is the index of the collecting policy in ``behaviours``.
    is_demonstration (B,) bool is true for a dataset's rows, and false for rows that :meth:`extend` wrote.

    Args:
        root: the dataset's folder, or a list of folders.
        episodes: the episodes to use. None: all; a number: the first ones of each task; a mapping: for each task to
            use, the number of first episodes, or a list of indices. For a list of folders, a list of such choices.
        keep: selects among these: successes, the best tenth, one behaviour, ...; see :class:`EpisodeFilter`.
        batch_size: rows of a sample.
        sampler: a TorchRL sampler, for example :class:`TaskBalancedSampler`; None for uniform.
        transform: applied to each sample.
        label: the content of ``action``. "executed": the executed action, with reward and next; required for datasets
            that were collected by other policies than an expert. "expert": the expert's action, in [-1, 1];
            "unclipped": the same before it was clipped, up to 25; both without reward and next, which belong to the
            executed action.
        reward: the content of ``("next", "reward")`` with label="executed", a name in ``REWARDS``: "sparse" (success as
            0 and 1), "dense" (Meta-World's), "cost" or "dense_cost". Rows of :meth:`extend` get the same.
        after_success: drop steps more than N steps after an episode's first success.
        terminate_on_success: end each episode at its first success, with ``("next", "terminated")``, as
            ``LanguageWorldEnv(terminate_on_success=True)`` does; with label="executed".
        n_steps, gamma: as for :class:`JoinedStorage`; with label="executed".
        grow: rows of a ring that :meth:`extend` writes to, see :class:`GrowingStorage`; with label="executed". Samples
            then lack the expert's actions and the other reward, which a collector does not give.
        device: where the rows are kept and transforms run: None or "cpu" for the memory-mapped files; "cuda", "cuda:1",
            "mps" or "auto" for a copy in that memory. Minibatches are the same everywhere.
        check: compare the episodes with their checksums, once in a process while the files stay the same. It takes one
            to three seconds a gigabyte.
        **kwargs: for :class:`torchrl.data.TensorDictReplayBuffer`: generator, pin_memory, ...; prefetch at most 1:
            several threads would draw in an order that differs from run to run.

    Attributes:
        demonstrations: the description; a :class:`JoinedDemonstrations` if folders are joined or episodes chosen.
        roots, behaviours: the folders, and the labels of the collecting policies, sorted.
        columns: name to a digest of the values, for columns of :meth:`add_column`.

    Raises:
        ValueError: an episode that the dataset lacks, or options that exclude each other.
        RuntimeError: :meth:`extend` without ``grow``; an assignment to rows.
        DatasetError: (a ValueError) the dataset is unfinished, damaged, or of another version.

    Example:
        >>> import tempfile, lw_torchrl as lw
        >>> with tempfile.TemporaryDirectory() as root:
        ...     _ = lw.collect_demonstrations("reach", episodes_per_task=1, root=root + "/demos", max_steps=80)
        ...     replay = lw.LanguageWorldExperienceReplay(root + "/demos", batch_size=8)
        ...     replay.sample()["action"].shape
        torch.Size([8, 4])

    Source: the datasets of ``torchrl.data.datasets``.
    """

    @checked
    def __init__(
        self,
        root: AnyPath | Iterable[AnyPath],
        *,
        episodes: EpisodeChoice | Sequence[EpisodeChoice] = None,
        keep: EpisodeFilter | None = None,
        batch_size: Count | None = None,
        sampler: Sampler | None = None,
        transform: Transform | None = None,
        label: Label = "expert",
        reward: RewardName = "sparse",
        after_success: Natural | None = None,
        terminate_on_success: bool = False,
        n_steps: int = 1,
        gamma: float | None = None,
        grow: int | None = None,
        device: str | torch.device | None = None,
        check: bool = True,
        **kwargs: Any,
    ) -> None:
        check_n_steps(n_steps, gamma)
        replay_checks.check_transform(transform)
        if (prefetch := kwargs.get("prefetch") or 0) > 1:
            raise ValueError(f"prefetch must be None, 0 or 1, got {prefetch}: several threads draw in no fixed order")
        if (n_steps > 1 or grow is not None or terminate_on_success) and label != "executed":
            raise ValueError(f"n_steps, grow and terminate_on_success need label='executed', got {label!r}")
        if terminate_on_success and after_success is not None:
            raise ValueError("terminate_on_success ends episodes at success; leave out after_success")
        if grow is not None:
            replay_checks.check_growing(sampler, kwargs)
        where = CPU if device is None else check_device("device", device)
        if grow is not None and where != CPU:
            raise ValueError("device: a growing buffer is on the CPU; leave it out, trainers move each minibatch")
        joined = not isinstance(root, (str, os.PathLike))
        folders: list[AnyPath] = list(root) if joined else [root]  # type: ignore[arg-type, list-item]
        for folder in folders:
            check_path("root", folder)
        self.roots = tuple(map(Path, folders))
        twice = episodes is None and len({folder.resolve() for folder in self.roots}) < len(self.roots)
        if not self.roots or twice:
            raise ValueError(f"root must be a folder, or a list that names each folder once, got {root}")
        choices = _choices(episodes, len(self.roots), joined)
        whole = [read_metadata(folder) for folder in self.roots]
        replay_checks.check_label(label, whole)
        replay_checks.check_behaviours(whole)
        shown = [
            selection.choose_episodes(found, choice, f"episodes[{number}]" if joined else "episodes")
            for number, (found, choice) in enumerate(zip(whole, choices, strict=True))
        ]
        for found, chosen in zip(whole, shown, strict=True) if check else ():
            verify(found, chosen.episodes)
        after = 0 if terminate_on_success else after_success
        if keep is not None:
            pairs = zip(whole, shown, strict=True)
            shown = keep.choose(shown, [selection.returns_of(found, chosen, reward, after) for found, chosen in pairs])
        self.behaviours = tuple(sorted({found.config.behaviour for found in whole}))
        parts: list[TensorDictBase] = []
        kept: list[Tensor | None] = []
        trajectories = 0
        for found, chosen in zip(whole, shown, strict=True):
            who = self.behaviours.index(found.config.behaviour)
            rows, taken = selection.read_part(found, chosen, label, reward, after, terminate_on_success)
            if trajectories:
                rows.set(TRAJECTORY, rows.get(TRAJECTORY) + trajectories)
            rows.set("behaviour", torch.full(rows.batch_size, who))
            rows.set(DEMONSTRATION, torch.ones(rows.batch_size, dtype=torch.bool))
            parts.append(rows if grow is None else rows.exclude(*_NOT_COLLECTED))
            kept.append(taken)
            trajectories += len(found.episodes)
        storage: JoinedStorage
        several = joined or episodes is not None or keep is not None
        self.demonstrations = JoinedDemonstrations(tuple(shown)) if several else shown[0]
        if grow is not None:
            admit = partial(replay_checks.admit_rows, reward, terminate_on_success)
            storage = GrowingStorage(parts, kept, grow=grow, n_steps=n_steps, gamma=gamma, admit=admit)
        elif several or n_steps > 1 or where != CPU:
            storage = JoinedStorage(parts, kept, n_steps=n_steps, gamma=gamma)
            storage = storage if where == CPU else DeviceStorage(storage, where)
        else:
            storage = WholeStorage([parts[0] if kept[0] is None else parts[0][kept[0]]])  # the second is in memory
        kwargs.setdefault("collate_fn", torch.nn.Identity())
        writer: Writer = ImmutableDatasetWriter() if grow is None else GrowingWriter()
        self.root = self.roots[0]
        self._fingerprint = fingerprint(shown, after_success, terminate_on_success)
        self.n_steps, self.gamma, self.columns = n_steps, gamma, dict[str, str]()
        self.label, self.reward, self.terminate_on_success = label, reward, terminate_on_success
        self._grows = grow is not None
        kwargs |= {"sampler": sampler, "writer": writer, "batch_size": batch_size, "transform": transform}
        super().__init__(storage=storage, **kwargs)

    def set_sampler(self, sampler: Sampler) -> Sampler:
        """Use another sampler, which draws from the buffer's generator; in a worker, call ``set_rng`` after it."""
        if self._grows:
            replay_checks.check_growing(sampler, {})
        before = super().set_sampler(sampler)
        if get_worker_info() is None:
            self.set_rng(self._rng)
        return before

    def share(self, shared: bool = True) -> LanguageWorldExperienceReplay:
        """Let other processes read it; RuntimeError for a growing buffer."""
        if shared and self._grows:
            raise RuntimeError(ONE_PROCESS)
        return super().share(shared)

    def __getitems__(self, indices: Sequence[int]) -> list[dict[str, Any]]:
        """The rows at ``indices`` for PyTorch's ``DataLoader``, as dictionaries of all columns."""
        return row_dictionaries(flat_columns(self[torch.as_tensor(indices, dtype=torch.int64)]))

    def add_column(self, name: str, values: Tensor, *, of: LanguageWorldExperienceReplay | None = None) -> None:
        """Give samples a new column ``name``, held in memory: each row's advantage, for example.

        Args:
            values: (R, ...), for each row in the order of ``replay[:]``; a copy is kept on the device of the rows.
            of: the buffer that the values were computed from, if it is another one, with n steps for example. It must
                show the same rows in the same order.

        Raises:
            ValueError: another number of rows, a name that samples have, values that are not finite, or other rows.
        """
        if self._grows:
            raise ValueError("add_column is not supported on a growing buffer: rows added later would have no value")
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
        self.storage.add_column(name, own)

    @property
    def grows(self) -> bool:
        """Whether it was made with ``grow``."""
        return self._grows

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
