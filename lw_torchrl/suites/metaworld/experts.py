"""The ExpertActor class: Meta-World's scripted policies as a TensorDictModule."""

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
from lw_torchrl.suites.metaworld.environments import import_metaworld

_quiet = Lock()  # warning filters are global: two threads that change them at once would not restore them


class ExpertActor(TensorDictModuleBase):
    """A module that runs the Meta-World scripted policy of each row's task.

    Reads ``observation`` (B, 39) float32 and ``task_id`` (B,) int64; writes ``action`` (B, 4) float32, clipped to [-1,
    1], and ``unclipped_action`` (B, 4) float32, the script's action, which is usually far larger. Rows excluded by a
    ``_step`` mask (B,) get zeros. Raises a ValueError for a task_id that is not in ``tasks``.

    Args:
        tasks: the tasks to support, as for :func:`resolve_tasks`.
        in_keys, out_keys: replacements for the default input and output keys, in the order above; nested keys are
            allowed.

    Example:
        >>> import lw_torchrl as lw
        >>> rollout = lw.LanguageWorldEnv("reach", seed=0).rollout(100, lw.ExpertActor("reach"))
        >>> rollout["next", "success"].any()
        tensor(True)

    Source: ``metaworld.policies``.
    """

    row_by_row = True  # an action depends only on its row of the batch, bit for bit

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
        observation, ids = read(tensordict, self.in_keys)
        if observation.shape[-1:] != (METAWORLD.size,) or ids.shape != observation.shape[:-1]:
            shapes = f"{tuple(observation.shape)} and {tuple(ids.shape)}"
            raise ValueError(f"observation must have shape (B, 39) and task_id (B,), got {shapes}")
        states = observation.reshape(-1, METAWORLD.size).cpu().numpy().astype(np.float64)
        task_ids = ids.reshape(-1).tolist()
        action = np.zeros((len(task_ids), METAWORLD.action_size), dtype=np.float32)
        with _quiet, warnings.catch_warnings():
            # The scripts warn at nearly every time step that actions exceed [-1, 1].
            warnings.filterwarnings("ignore", message="Constant\\(s\\) may be too high")
            for row in np.flatnonzero(row_mask(tensordict, "_step", len(task_ids))):
                if (task := task_ids[row]) not in self._policies:
                    raise ValueError(f"task_id {task} is not one of this expert's tasks: {', '.join(self.tasks)}")
                action[row] = self._policies[task].get_action(states[row])
        unclipped = torch.from_numpy(action).to(observation.device).reshape(*ids.shape, METAWORLD.action_size)
        return write(tensordict, self, [unclipped.clamp(-1.0, 1.0), unclipped])
