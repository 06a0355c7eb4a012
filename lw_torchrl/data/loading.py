"""load_demonstrations: the rows of demonstration datasets as a TensorDict."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, Literal

import torch
from tensordict import NestedKey, TensorDict

from lw_torchrl._util.checks import Count, Natural, Probability, typed, unknown_name
from lw_torchrl._util.devices import check_device, finite
from lw_torchrl._util.files import AnyPath
from lw_torchrl.data.dataset import DATASET, DONE, REWARD, TRAJECTORY, DatasetError, Demonstrations, load_rows
from lw_torchrl.data.rewards import REWARDS, STEPS, RewardName, n_step_returns
from lw_torchrl.data.selection import EpisodeChoice, EpisodeFilter, Label, kept_rows, select

_FLAGS = ("done", "terminated", "truncated")
ROLLOUT: tuple[NestedKey, ...] = (
    "observation", "task_id", "episode", "action", *_FLAGS, ("next", "observation"), ("next", "task_id"),
    ("next", "reward"), ("next", "success"), *(("next", flag) for flag in _FLAGS),
)  # fmt: skip
"""The columns of a dataset that rollouts of :class:`LanguageWorldEnv` have too."""
Keys = Literal["rollout"] | Iterable[NestedKey]


def _read_part(
    whole: Demonstrations, chosen: Demonstrations, label: Label, reward: RewardName, after: int | None, terminate: bool
) -> TensorDict:
    """Return the rows of a dataset's chosen episodes, memory-mapped where they are the same as in the files."""
    rows = load_rows(whole)
    if label == "executed":
        kind = REWARDS[reward]
        source, success = rows.get(("next", f"reward_{kind.source}")), rows.get(("next", "success"))
        rows.set(REWARD, kind.of(source, success))
    else:
        taken, other = ("expert_action", "unclipped_action")[:: 1 if label == "expert" else -1]
        rows = rows.exclude("next", "action", other).rename_key_(taken, "action")
    # One NaN would spoil the weights of a policy, and the loss shows it only a step later.
    if not finite(rows.get("action")):
        raise DatasetError(f"root: {str(whole.root)!r} holds an action that is NaN or infinite, for label={label!r}")
    if chosen.episodes == whole.episodes and after is None:
        return rows
    kept, lengths = kept_rows(chosen.episodes, after)
    rows = rows[kept]
    if label == "executed" and after is not None:
        ends = torch.zeros(len(kept), 1, dtype=torch.bool)
        ends[lengths.cumsum(0) - 1] = True
        terminated = ends & rows.get(("next", "success"))
        rows.set(DONE, ends).set(("next", "truncated"), ends & ~terminated if terminate else ends)
        if terminate:
            rows.set(("next", "terminated"), terminated)
    return rows


def _choose_keys(rows: TensorDict, keys: Keys) -> TensorDict:
    """Select columns, after adding the flags that precede each step of a rollout (all false), which no file holds."""
    for flag in _FLAGS:
        rows.set(flag, torch.zeros(len(rows), 1, dtype=torch.bool))
    known = list(rows.keys(True, True))
    for key in (chosen := list(ROLLOUT if keys == "rollout" else keys)):
        if key not in known:
            name, *names = ("/".join((each,) if isinstance(each, str) else each) for each in (key, *known))
            raise unknown_name("keys", name, sorted(names))
    return rows.select(*chosen)


def check_options(
    label: Label, after_success: int | None, terminate_on_success: bool, n_steps: int, gamma: float | None, keys: Any
) -> None:
    """Raise :class:`ValueError` for options that exclude or need each other."""
    if n_steps > 1 and gamma is None:
        raise ValueError(f"n_steps={n_steps} needs gamma, the loss's discount")
    if n_steps == 1 and gamma is not None:
        raise ValueError(f"gamma={gamma!r} needs n_steps of 2 or more, got 1")
    if (n_steps > 1 or terminate_on_success or keys == "rollout") and label != "executed":
        raise ValueError(f"n_steps, terminate_on_success and keys='rollout' need label='executed', got {label!r}")
    if terminate_on_success and after_success is not None:
        raise ValueError("terminate_on_success ends episodes at success; leave out after_success")


def labels_of(datasets: Sequence[Demonstrations]) -> tuple[str, ...]:
    """Return the labels of the collecting policies, sorted."""
    return tuple(sorted({dataset.config.behaviour for dataset in datasets}))


def read_rows(
    datasets: Sequence[Demonstrations],
    parts: Sequence[Demonstrations],
    label: Label,
    reward: RewardName,
    after: int | None,
    terminate: bool,
    n_steps: int,
    gamma: float | None,
    keys: Keys | None,
    device: str | torch.device | None,
) -> TensorDict:
    """Read the rows of the selected episodes of datasets; see :func:`load_demonstrations`."""
    labels, rows_of_parts, trajectories = labels_of(datasets), [], 0
    for number, (dataset, part) in enumerate(zip(datasets, parts, strict=True)):
        rows = _read_part(dataset, part, label, reward, after, terminate)
        rows.set("behaviour", torch.full(rows.batch_size, labels.index(dataset.config.behaviour)))
        rows.set("is_demonstration", torch.ones(rows.batch_size, dtype=torch.bool))
        if len(datasets) > 1:
            rows.set(TRAJECTORY, rows.get(TRAJECTORY) + trajectories)
            rows.set(DATASET, torch.full(rows.batch_size, number))
        # n-step returns need columns that the choice may leave out.
        rows_of_parts.append(rows if keys is None or n_steps > 1 else _choose_keys(rows, keys))
        trajectories += len(dataset.episodes)
    rows = rows_of_parts[0] if len(rows_of_parts) == 1 else torch.cat(rows_of_parts)
    if n_steps > 1:
        assert gamma is not None
        rows = n_step_returns(rows, n_steps, gamma)
        rows = rows if keys is None else _choose_keys(rows, keys if keys != "rollout" else (*ROLLOUT, STEPS))
    return rows if device is None else rows.to(check_device("device", device))


@typed
def load_demonstrations(
    root: AnyPath | Iterable[AnyPath],
    *,
    episodes: EpisodeChoice | Sequence[EpisodeChoice] = None,
    keep: EpisodeFilter | None = None,
    label: Label = "expert",
    reward: RewardName = "sparse",
    after_success: Natural | None = None,
    terminate_on_success: bool = False,
    n_steps: Count = 1,
    gamma: Probability | None = None,
    keys: Literal["rollout"] | Iterable[NestedKey] | None = None,
    device: str | torch.device | None = None,
    check: bool = True,
) -> TensorDict:
    """Load the rows of datasets of :func:`collect_demonstrations`, for a :class:`torchrl.data.TensorStorage`.

    The rows of one folder stay in its files, memory-mapped, as long as nothing is selected; changes to them never reach
    the files. Several folders, or a selection of rows, are copied into memory.

    Rows (R,) hold observation (R, 39) float32, action (R, 4) float32, task_id and episode (R,) int64, and the columns
    of ``label``. collector/traj_ids (R,) int64 is unique for each episode of all datasets; behaviour (R,) int64 is the
    rank of the collecting policy's label among those of all folders. is_demonstration (R,) bool is true. dataset (R,)
    int64 is the index of the folder, if there are several.

    Args:
        root: the dataset's folder, or a list of folders.
        episodes: the episodes to use. None: all; a number: the first ones of each task; a mapping: for each task to
            use, the number of first episodes, or a list of indices. For a list of folders, a list of such choices.
        keep: selects among these: successes, the best tenth, one behaviour, ...; see :class:`EpisodeFilter`.
        label: the content of ``action``. "executed": the executed action, with reward and next; required for datasets
            that were collected by other policies than an expert. "expert": the expert's action, in [-1, 1];
            "unclipped": the same before it was clipped, up to 25; both without reward and next, which belong to the
            executed action.
        reward: the content of ``("next", "reward")`` with label="executed", a name in ``REWARDS``: "sparse" (success as
            0 and 1), "dense" (Meta-World's), "cost" or "dense_cost".
        after_success: drop steps more than N steps after an episode's first success.
        terminate_on_success: end each episode at its first success, with ``("next", "terminated")``, as
            ``LanguageWorldEnv(terminate_on_success=True)`` does; with label="executed".
        n_steps, gamma: look N steps ahead with this discount, as :func:`n_step_returns`; with label="executed".
        keys: the columns to load; "rollout" for those that rollouts of :class:`LanguageWorldEnv` have too, so that
            TorchRL's ``OfflineToOnlineReplayBuffer`` can join them with ``rollout.select(*sample.keys(True, True))``;
            None for all.
        device: memory to copy the rows to: "cuda", "mps" or "auto"; None to leave them where they are.
        check: compare the episodes with their checksums, once in a process while the files stay the same. It takes one
            to three seconds a gigabyte.

    Raises:
        ValueError: an episode or a column that the dataset lacks, or options that exclude each other.
        DatasetError: (a ValueError) the dataset is unfinished, damaged, or of another version.

    Example:
        >>> import tempfile, lw_torchrl as lw
        >>> from torchrl.data import TensorDictReplayBuffer, TensorStorage
        >>> with tempfile.TemporaryDirectory() as root:
        ...     _ = lw.collect_demonstrations("reach", episodes_per_task=1, root=root + "/demos", max_steps=80)
        ...     rows = lw.load_demonstrations(root + "/demos")
        ...     replay = TensorDictReplayBuffer(storage=TensorStorage(rows), batch_size=8)
        ...     replay.sample()["action"].shape
        torch.Size([8, 4])

    Source: the datasets of ``torchrl.data.datasets``, which keep their rows in memory-mapped tensordicts.
    """
    check_options(label, after_success, terminate_on_success, n_steps, gamma, keys)
    after = 0 if terminate_on_success else after_success
    datasets, parts = select(root, episodes, keep, label, reward, after, check)
    return read_rows(datasets, parts, label, reward, after, terminate_on_success, n_steps, gamma, keys, device)
