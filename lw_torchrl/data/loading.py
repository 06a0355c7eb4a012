"""load_demonstrations: load the rows of demonstration datasets as a TensorDict."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Literal

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
"""The columns that datasets share with rollouts of :class:`LanguageWorldEnv`."""
Keys = Literal["rollout"] | Iterable[NestedKey]


def _read_part(
    whole: Demonstrations, chosen: Demonstrations, label: Label, reward: RewardName, after: int | None, terminate: bool
) -> TensorDict:
    """Read the rows of a dataset's chosen episodes; columns that equal the files' columns stay memory-mapped."""
    rows = load_rows(whole)
    if label == "executed":
        kind = REWARDS[reward]
        source, success = rows.get(("next", f"reward_{kind.source}")), rows.get(("next", "success"))
        rows.set(REWARD, kind.of(source, success))
    else:
        taken, other = ("expert_action", "unclipped_action")[:: 1 if label == "expert" else -1]
        rows = rows.exclude("next", "action", other).rename_key_(taken, "action")
    # A single NaN would ruin the weights of a policy, and the loss would show this only one step later.
    if not finite(rows.get("action")):
        raise DatasetError(f"root: {str(whole.root)!r} holds an action that is NaN or infinite with label={label!r}")
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
    """Select columns, after adding a rollout's root-level done flags (all False; not stored in files)."""
    for flag in _FLAGS:
        rows.set(flag, torch.zeros(len(rows), 1, dtype=torch.bool))
    known = list(rows.keys(True, True))
    for key in (chosen := list(ROLLOUT if keys == "rollout" else keys)):
        if key not in known:
            name, *names = ("/".join((each,) if isinstance(each, str) else each) for each in (key, *known))
            raise unknown_name("keys", name, sorted(names))
    return rows.select(*chosen)


def select_and_read(
    root: AnyPath | Iterable[AnyPath],
    episodes: EpisodeChoice | Sequence[EpisodeChoice],
    keep: EpisodeFilter | None,
    label: Label,
    reward: RewardName,
    after_success: int | None,
    terminate_on_success: bool,
    n_steps: int,
    gamma: float | None,
    keys: Keys | None,
    device: str | torch.device | None,
    check: bool,
) -> tuple[list[Demonstrations], tuple[str, ...], TensorDict]:
    """Return the selected part of each dataset, the sorted labels of the collection policies, and the rows.

    See :func:`load_demonstrations` for the arguments.
    """
    if (n_steps > 1) != (gamma is not None):
        raise ValueError(f"n_steps above 1 and gamma require each other, got n_steps={n_steps} and gamma={gamma}")
    if (n_steps > 1 or terminate_on_success or keys == "rollout") and label != "executed":
        raise ValueError(f"n_steps, terminate_on_success and keys='rollout' require label='executed', got {label!r}")
    if terminate_on_success and after_success is not None:
        raise ValueError("terminate_on_success already ends episodes at success; leave out after_success")
    after = 0 if terminate_on_success else after_success
    datasets, parts = select(root, episodes, keep, label, reward, after, check)
    labels, rows_of_parts, trajectories = sorted({each.config.behaviour for each in datasets}), [], 0
    for number, (dataset, part) in enumerate(zip(datasets, parts, strict=True)):
        rows = _read_part(dataset, part, label, reward, after, terminate_on_success)
        rows.set("behaviour", torch.full(rows.batch_size, labels.index(dataset.config.behaviour)))
        rows.set("is_demonstration", torch.ones(rows.batch_size, dtype=torch.bool))
        if len(datasets) > 1:
            rows.set(TRAJECTORY, rows.get(TRAJECTORY) + trajectories)
            rows.set(DATASET, torch.full(rows.batch_size, number))
        # Select columns later if n-step returns are computed, which may require other columns.
        rows_of_parts.append(rows if keys is None or n_steps > 1 else _choose_keys(rows, keys))
        trajectories += len(dataset.episodes)
    rows = rows_of_parts[0] if len(rows_of_parts) == 1 else torch.cat(rows_of_parts)
    if gamma is not None:
        rows = n_step_returns(rows, n_steps, gamma)
        rows = rows if keys is None else _choose_keys(rows, keys if keys != "rollout" else (*ROLLOUT, STEPS))
    return parts, tuple(labels), rows if device is None else rows.to(check_device("device", device))


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
    """Load the rows of datasets written by :func:`collect_demonstrations`, for a :class:`torchrl.data.TensorStorage`.

    The rows of a single folder stay memory-mapped unless a selection is loaded; changes to the rows never reach the
    files. Several folders, or a selection of rows, are copied into memory.

    The R rows hold observation (R, 39) float32, action (R, 4) float32, task_id and episode (R,) int64, and the columns
    of ``label``. collector/traj_ids (R,) int64 is unique for each episode across datasets. behaviour (R,) int64 is the
    index of the collection policy's label in the sorted labels of all folders. is_demonstration (R,) bool is True.
    dataset (R,) int64 is the index of the folder, if there are several folders.

    Args:
        root: the dataset's folder, or a list of folders.
        episodes: the episodes to load. None for all; N for the first N of each task; or a mapping from task to N or to
            a list of episode indices, which loads only these tasks. For a list of folders, a list of such choices.
        keep: a filter on these episodes, for example by success, return or behaviour; see :class:`EpisodeFilter`.
        label: the content of ``action``. "executed" is the executed action, with reward and next; it is required unless
            an expert collected the dataset. "expert" is the expert's action, in [-1, 1], and "unclipped" the expert's
            action before clipping, up to 25; both omit reward and next, which belong to the executed action.
        reward: the content of ``("next", "reward")`` with label="executed", a name in ``REWARDS``: "sparse" (success as
            0 or 1), "dense" (Meta-World's reward), "cost" or "dense_cost".
        after_success: drop rows more than N time steps after the first success of an episode.
        terminate_on_success: end each episode at the first success, with ``("next", "terminated")``, as
            ``LanguageWorldEnv(terminate_on_success=True)`` does; requires label="executed".
        n_steps, gamma: compute n-step returns with this discount, see :func:`n_step_returns`; require label="executed".
        keys: the columns to load; None for all; "rollout" for the columns that :class:`LanguageWorldEnv` rollouts also
            have, so that TorchRL's ``OfflineToOnlineReplayBuffer`` can mix these rows with
            ``rollout.select(*sample.keys(True, True))``.
        device: the device to copy the rows to, such as "cuda", "mps" or "auto"; None does not copy the rows.
        check: verify the checksums of the episodes, once per process while the files do not change. Verification takes
            one to three seconds per gigabyte.

    Raises:
        ValueError: the dataset lacks an episode or a column, or options contradict each other.
        DatasetError: (a ValueError) the dataset is unfinished, corrupted, or of another version.

    Example:
        >>> import tempfile, lw_torchrl as lw
        >>> from torchrl.data import TensorDictReplayBuffer, TensorStorage
        >>> with tempfile.TemporaryDirectory() as root:
        ...     _ = lw.collect_demonstrations("reach", episodes_per_task=1, root=root + "/demos", max_steps=80)
        ...     rows = lw.load_demonstrations(root + "/demos")
        ...     replay = TensorDictReplayBuffer(storage=TensorStorage(rows), batch_size=8)
        ...     replay.sample()["action"].shape
        torch.Size([8, 4])

    Source: the datasets in ``torchrl.data.datasets``, which also keep their rows in memory-mapped tensordicts.
    """
    how = label, reward, after_success, terminate_on_success, n_steps, gamma, keys, device, check
    return select_and_read(root, episodes, keep, *how)[2]
