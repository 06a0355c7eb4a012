"""Meta-World's scripted experts as a TensorDictModule."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Sequence
from threading import Lock

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey

from lw_torchrl._util.keys import as_keys, dispatched, read, row_mask, write
from lw_torchrl.language.layout import METAWORLD
from lw_torchrl.language.tasks import resolve_tasks, task_id
from lw_torchrl.suites.metaworld.plain_engine import import_metaworld

_quiet = Lock()  # Python's filters of warnings are the process's: two threads would leave ours behind


class ExpertActor(TensorDictModuleBase):
    """Meta-World's scripted policy of each row's task.

    Reads ``observation`` (B, 39) float32 and ``task_id`` (B,) int64; writes ``action`` (B, 4) float32, clipped to [-1,
    1], and ``unclipped_action`` (B, 4) float32, the script's action, usually far larger. Rows that a ``_step`` mask
    (B,) leaves out get zeros. A task_id outside ``tasks`` raises a ValueError.

    Args:
        tasks: the tasks that it knows, as for :func:`resolve_tasks`.
        in_keys, out_keys: other names for these keys, in the order above; nested keys are allowed.

    Example:
        >>> import lw_torchrl as lw
        >>> rollout = lw.LanguageWorldEnv("reach", seed=0).rollout(100, lw.ExpertActor("reach"))
        >>> rollout["next", "success"].any()
        tensor(True)

    Source: ``metaworld.policies``.
    """

    row_by_row = True  # no network: its rows need no blocks of one size

    def __init__(
        self,
        tasks: str | Iterable[str],
        *,
        in_keys: Sequence[NestedKey] | None = None,
        out_keys: Sequence[NestedKey] | None = None,
    ) -> None:
        super().__init__()
        self.in_keys = as_keys("in_keys", in_keys, ("observation", "task_id"))
        self.out_keys = as_keys("out_keys", out_keys, ("action", "unclipped_action"))
        self.tasks = resolve_tasks(tasks)
        policies = import_metaworld().policies.ENV_POLICY_MAP
        self._policies = {task_id(task): policies[f"{task}-v3"]() for task in self.tasks}

    @dispatched
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        observation, given = read(tensordict, self.in_keys)
        if observation.shape[-1:] != (METAWORLD.size,):
            raise ValueError(f"observation must have 39 numbers, got shape {tuple(observation.shape)}")
        if given.shape != observation.shape[:-1]:
            shape = tuple(observation.shape[:-1])
            raise ValueError(f"task_id must be of shape {shape}, one per observation, got {tuple(given.shape)}")
        states = observation.reshape(-1, METAWORLD.size).cpu().numpy().astype(np.float64)
        task_ids = given.reshape(-1).tolist()
        action = np.zeros((len(task_ids), METAWORLD.action_size), dtype=np.float32)
        with _quiet, warnings.catch_warnings():
            # The scripts warn nearly every step that they ask for more than [-1, 1].
            warnings.filterwarnings("ignore", message="Constant\\(s\\) may be too high")
            for row in np.flatnonzero(row_mask(tensordict, "_step", len(task_ids))):
                if (task := task_ids[row]) not in self._policies:
                    raise ValueError(f"task_id {task} is none of this expert's tasks: {', '.join(self.tasks)}")
                action[row] = self._policies[task].get_action(states[row])
        asked = torch.from_numpy(action).to(observation.device).reshape(*observation.shape[:-1], METAWORLD.action_size)
        return write(tensordict, self, [asked.clamp(-1.0, 1.0), asked])
