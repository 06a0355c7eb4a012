"""LanguageWorldExperienceReplay: a demonstration dataset as a TorchRL replay buffer."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, Literal

import torch
from tensordict import TensorDictBase
from torchrl.data import ImmutableDatasetWriter, TensorStorage
from torchrl.data.datasets.common import BaseDatasetExperienceReplay
from torchrl.data.replay_buffers.samplers import Sampler
from torchrl.envs import Transform

from lw_torchrl._checks import check_choice, check_int
from lw_torchrl.data.dataset import DATA, Demonstrations, load_rows, read_metadata


def _until_success(rows: TensorDictBase, demonstrations: Demonstrations, after: int) -> TensorDictBase:
    """The rows up to ``after`` steps past each episode's first success; the last one kept is truncated."""
    keep = torch.ones(rows.batch_size[0], dtype=torch.bool)
    last = torch.zeros_like(keep)
    for episode in demonstrations.episodes:
        length = episode.length
        if episode.first_success is not None:
            length = min(length, episode.first_success + after)
        keep[episode.start + length : episode.start + episode.length] = False
        last[episode.start + length - 1] = True
    kept = rows[keep].clone()  # in memory: indexing a memory map reads it
    for key in ("done", "truncated"):
        flag = kept.get(("next", key))
        kept.set(("next", key), flag | last[keep].reshape(flag.shape))
    return kept


class LanguageWorldExperienceReplay(BaseDatasetExperienceReplay):
    """The rows of a dataset that :func:`collect_demonstrations` made.

    Samples hold observation (B, 39) float32, action (B, 4) float32, task_id and episode (B,) int64, and what
    ``label`` leaves; a :class:`QAFTransform` adds ``qaf``.

    Args:
        root: the dataset's folder.
        batch_size: rows of a sample.
        sampler: a TorchRL sampler, :class:`TaskBalancedSampler` say; None for uniform.
        transform: applied to each sample.
        label: what ``action`` holds. "expert": what the expert wanted; reward and next are left out, since they
            belong to the executed action. "executed": what was executed, with reward and next.
        after_success: drop the steps that come more than so many after the first success; None keeps all.
        **kwargs: for :class:`torchrl.data.TensorDictReplayBuffer`: generator, prefetch, pin_memory, ...

    Attributes:
        demonstrations: the dataset's description.

    Raises:
        FileNotFoundError: there is no such folder.
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

    def __init__(
        self,
        root: str | os.PathLike[str],
        *,
        batch_size: int | None = None,
        sampler: Sampler | None = None,
        transform: Transform | None = None,
        label: Literal["expert", "executed"] = "expert",
        after_success: int | None = None,
        **kwargs: Any,
    ) -> None:
        check_choice("label", label, ("expert", "executed"))
        if batch_size is not None:
            check_int("batch_size", batch_size, minimum=1)
        self.demonstrations = read_metadata(root)
        self.root = root
        rows = load_rows(self.demonstrations)
        if after_success is not None:
            rows = _until_success(rows, self.demonstrations, check_int("after_success", after_success, minimum=0))
        if label == "expert":
            rows = rows.exclude("next", "action").rename_key_("expert_action", "action")
        self.label = label
        super().__init__(
            storage=TensorStorage(rows),
            sampler=sampler,
            writer=ImmutableDatasetWriter(),
            batch_size=batch_size,
            transform=transform,
            **kwargs,
        )

    @property
    def tasks(self) -> tuple[str, ...]:
        """The names of the dataset's tasks, sorted."""
        return self.demonstrations.config.tasks

    @property
    def data_path_root(self) -> Path:
        """The dataset's folder."""
        return Path(self.root)

    @property
    def data_path(self) -> Path:
        """The folder of the rows."""
        return self.data_path_root / DATA

    def _is_downloaded(self) -> bool:
        return True
