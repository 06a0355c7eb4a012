"""LanguageWorldExperienceReplay: a demonstration dataset as a TorchRL replay buffer."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
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
from lw_torchrl.data.storage import DEMONSTRATION, TRAJECTORY, DeviceStorage, JoinedStorage, WholeStorage


def _choices(episodes: Any, roots: int, joined: bool) -> list[EpisodeChoice]:
    if not roots:
        raise ValueError("root must hold at least one folder, got an empty list")
    if not joined or episodes is None:
        return [episodes] * roots
    if isinstance(episodes, (str, Mapping)) or not isinstance(episodes, Sequence):
        raise TypeError(f"episodes must be a list of choices, one for each of the {roots} folders, got {episodes!r}")
    if len(episodes) != roots:
        raise ValueError(f"episodes must be as many as the folders in root, {roots}, got {len(episodes)}")
    return list(episodes)


_NOT_COLLECTED = ("behaviour", "expert_action", "unclipped_action", ("next", "reward_sparse"), ("next", "reward_dense"))


class LanguageWorldExperienceReplay(RestorableReplay):
    """The rows of datasets that :func:`collect_demonstrations` made; several are joined, and none is copied.

    Samples hold observation (B, 39) float32, action (B, 4) float32, task_id and episode (B,) int64, and what ``label``
    leaves; a :class:`QAFTransform` adds ``qaf`` and ``qaf_plan``. collector/traj_ids (B,) int64 is unique for each
    episode of all datasets; behaviour (B,) int64 says who acted, an index of ``behaviours``. is_demonstration (B,) bool
    is true of a dataset's rows, and false of those that :meth:`extend` wrote.

    Args:
        root: the dataset's folder, or a list of folders; one may come twice if ``episodes`` says what to show of each.
        episodes: which to show. None: all; a number: the first so many of each task; a mapping: for each task to show,
            the first so many, or a list of indices of episodes. For a list of folders, a list of such choices.
        keep: of these, the successes, the best tenth, those of one behaviour, ...; see :class:`EpisodeFilter`.
        batch_size: rows of a sample.
        sampler: a TorchRL sampler, :class:`TaskBalancedSampler` say; None for uniform.
        transform: applied to each sample.
        label: what ``action`` holds. "executed": what was executed, with reward and next; the only one for datasets in
            which others than the expert acted. "expert": what the expert wanted, in [-1, 1]; "unclipped": what its
            script asked for, up to 25; both without reward and next, which belong to the executed action.
        reward: what ``("next", "reward")`` holds with label="executed", a name in ``REWARDS``: "sparse", the success as
            0 and 1; "dense", Meta-World's own; "cost" or "dense_cost". :meth:`extend` gives its rows the same.
        terminate_on_success: end each episode at its first success, with ``("next", "terminated")``, as
            ``LanguageWorldEnv(terminate_on_success=True)`` does; with label="executed".
        n_steps, gamma: as for :class:`JoinedStorage`, within the episode that is shown; with label="executed".
        grow: rows of a ring that :meth:`extend` writes to, see :class:`GrowingStorage`; with label="executed". Samples
            then leave out the expert's actions and the other reward, which a collector does not give.
        device: where the rows are kept and transforms work: None or "cpu" for the files, memory-mapped; "cuda",
            "cuda:1", "mps" or "auto" for a copy in its memory. Minibatches are the same everywhere.
        check: whether to check the episodes that are shown against their checksums, once in a process while the files
            stay the same; at most 2 GiB of them, spread evenly. It takes one to three seconds a gigabyte.
            :meth:`verify` checks all, and so does a trainer that resumes from a checkpoint.
        **kwargs: for :class:`torchrl.data.TensorDictReplayBuffer`: generator, pin_memory, ...; prefetch, at most 1:
            several threads would draw in an order that differs from run to run.

    Attributes:
        demonstrations: the description; a :class:`JoinedDemonstrations` where folders are joined or episodes chosen.
        roots, behaviours: the folders, and the labels of who acted, sorted.
        columns: of :meth:`add_column`, the name to a digest of the values.

    Warns:
        UserWarning: the folders, or with ``grow`` the rows to come, are of different versions of MuJoCo or Meta-World.

    Raises:
        ValueError: an episode that the dataset does not hold; a transform that does nothing to samples, such as
            ``MultiStepTransform``, which ``n_steps`` replaces. From :meth:`extend`: rows that do not fit.
        RuntimeError: :meth:`extend` without ``grow``; an assignment to rows.
        DatasetError: (a ValueError) the dataset is half-written, damaged, or of another format or version.

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
        root: AnyPath | Sequence[AnyPath],
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
        if (n_steps > 1 or grow is not None) and label != "executed":
            raise ValueError(f"n_steps and grow need label='executed', whose actions the rewards are of, got {label!r}")
        if grow is not None:
            replay_checks.check_growing(sampler, kwargs)
        if terminate_on_success and (label != "executed" or after_success is not None):
            raise ValueError(
                "terminate_on_success ends an episode at its first success and needs label='executed' and no "
                f"after_success, got label={label!r}, after_success={after_success!r}"
            )
        where = CPU if device is None else check_device("device", device)
        if grow is not None and where != CPU:
            raise ValueError("device: a buffer that grows is on the CPU; leave it out, trainers move each minibatch")
        joined = not isinstance(root, (str, os.PathLike))
        for folder in root if joined else [root]:  # type: ignore[union-attr]
            check_path("root", folder)
        self.roots = tuple(map(Path, root)) if joined else (Path(root),)  # type: ignore[arg-type]
        if episodes is None:
            replay_checks.check_apart(self.roots)
        choices = _choices(episodes, len(self.roots), joined)
        whole = [read_metadata(folder) for folder in self.roots]
        replay_checks.check_label(label, whole)
        replay_checks.check_behaviours(whole)
        replay_checks.warn_of_simulators(whole, grow is not None)
        shown = [
            selection.choose_episodes(found, choice, f"episodes[{number}]" if joined else "episodes")
            for number, (found, choice) in enumerate(zip(whole, choices, strict=True))
        ]
        for found, chosen in zip(whole, shown, strict=True) if check else ():
            verify(found, chosen.episodes, every=False)
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
            shown_as = reward, terminate_on_success
            admit, fits = partial(replay_checks.admit_rows, *shown_as), partial(replay_checks.check_rows, *shown_as)
            storage = GrowingStorage(parts, kept, grow=grow, n_steps=n_steps, gamma=gamma, admit=admit, check=fits)
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
        """Take another sampler, which draws from the buffer's generator, in a DataLoader's worker after ``set_rng``."""
        if self._grows:
            replay_checks.check_growing(sampler, {})
        before = super().set_sampler(sampler)
        if get_worker_info() is None:
            self.set_rng(self._rng)
        return before

    def append_transform(self, transform: Transform, *, invert: bool = False) -> LanguageWorldExperienceReplay:
        """Apply a transform, or with ``invert`` its inverse, to each sample, after the others."""
        if not invert:
            replay_checks.check_transform(transform)
        return super().append_transform(transform, invert=invert)

    def insert_transform(
        self, index: int, transform: Transform, *, invert: bool = False
    ) -> LanguageWorldExperienceReplay:
        """Apply a transform, or with ``invert`` its inverse, to each sample, before the one at ``index``."""
        if not invert:
            replay_checks.check_transform(transform)
        return super().insert_transform(index, transform, invert=invert)

    def share(self, shared: bool = True) -> LanguageWorldExperienceReplay:
        """Let other processes read it; with ``grow``, a RuntimeError."""
        if shared and self._grows:
            raise RuntimeError(ONE_PROCESS)
        return super().share(shared)

    def __getitems__(self, indices: Sequence[int]) -> list[dict[str, Any]]:
        """The rows at ``indices``, for PyTorch's ``DataLoader``: see :class:`RowDataset`, of all columns."""
        from lw_torchrl.data.torch_datasets import RowDataset

        return RowDataset(self, keys=None).__getitems__(indices)

    def add_column(self, name: str, values: Tensor, *, of: LanguageWorldExperienceReplay | None = None) -> None:
        """Give samples a new column ``name``, held in memory: each row's advantage, say.

        Args:
            values: (R, ...), for each row in the order of ``replay[:]``; a copy is kept on the device of the rows.
            of: the buffer that the values were computed from, if it is another one, with n steps say. It must show the
                same rows in the same order, and so the same episodes where a filter keeps some by their return.

        Raises:
            ValueError: another number of rows, a name that samples have, ``of`` shows other rows, or rows may ``grow``.
        """
        if self._grows:
            raise ValueError(f"add_column: {name!r} would be of no row that comes later, and this buffer grows")
        replay_checks.check_column(name, values, len(self), self.storage.get(slice(0, 1)).keys(), self.transform)
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
            raise ValueError(f"this buffer joins {len(self.roots)} datasets, so it has no one folder; see its roots")
        return self.roots[0]

    @property
    def data_path(self) -> Path:
        """The folder of the rows; as for ``data_path_root``."""
        return self.data_path_root / DATA

    def _is_downloaded(self) -> bool:
        return True
