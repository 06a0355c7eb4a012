"""What an environment knows of each of its rows."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from lw_torchrl.envs.engine import ACTION_SIZE, OBSERVATION_SIZE
from lw_torchrl.language.tasks import task_id

Rows = NDArray[np.intp]
Truth = NDArray[np.bool_]


class RowStates:
    """The last observation of N rows, the episode and step that each is at, and how it stands.

    Args:
        tasks: the name of each row's task.

    Attributes:
        task_id: (N,) int64.
        observation: (N, 39) float32.
        episode: (N,) int64; -1 before the first reset.
        steps: (N,) int64, of the simulation since the reset.
        over, terminated, fault, success: (N,) bool; a row that was never reset is over.
    """

    def __init__(self, tasks: Sequence[str]) -> None:
        self.tasks = tasks
        self.task_id = torch.tensor([task_id(task) for task in tasks])
        n = len(tasks)
        self.observation = np.zeros((n, OBSERVATION_SIZE), dtype=np.float32)
        self.episode = np.full(n, -1, dtype=np.int64)
        self.steps = np.zeros(n, dtype=np.int64)
        self._flags = np.zeros((4, n), dtype=bool)
        self.over, self.terminated, self.fault, self.success = self._flags
        self.over[:] = True

    def begin(self, rows: Rows, episodes: NDArray[np.int64], observation: NDArray[np.float64]) -> None:
        """Rows stand at the beginning of an episode."""
        self.observation[rows] = observation
        self.episode[rows] = episodes
        self.steps[rows] = 0
        self._flags[:, rows] = False

    def as_tensordict(self, executed_action: NDArray[np.float32] | None = None, **more: Tensor) -> TensorDict:
        """All of it as fresh tensors, N rows.

        Args:
            executed_action: (N, 4) float32; None for zeros.
            more: what else there is to tell, (N, ...).
        """
        n = len(self.tasks)
        over, terminated, fault, success = (torch.from_numpy(flag.copy()).unsqueeze(-1) for flag in self._flags)
        executed = torch.zeros(n, ACTION_SIZE) if executed_action is None else torch.from_numpy(executed_action)
        return TensorDict(
            {
                "observation": torch.from_numpy(self.observation.copy()),
                "task_id": self.task_id.clone(),
                "episode": torch.from_numpy(self.episode.copy()),
                "success": success,
                "fault": fault,
                "executed_action": executed,
                "done": over,
                "terminated": terminated,
                "truncated": over & ~terminated,
                **more,
            },
            batch_size=(n,),
            device=torch.device("cpu"),
        )

    def refuse_other_tasks(self, tensordict: TensorDictBase, rows: Rows) -> None:
        """Raise :class:`ValueError` where a state to go to is of other tasks."""
        given = tensordict.get("task_id", None)
        if given is not None and not torch.equal(given.cpu().reshape(-1)[rows], self.task_id[rows]):
            raise ValueError(
                "set_state=True needs the state of an environment with the same rows, and task_id names other tasks "
                f"than those of this one, {', '.join(self.tasks[:6])}{', ...' * (len(self.tasks) > 6)}"
            )

    def refuse_later_steps(self, tensordict: TensorDictBase, rows: Rows) -> None:
        """Raise :class:`ValueError`, and want a reset, where a state to go to is not the first of its episode."""
        wanted = tensordict.get("observation", None)
        if wanted is None:
            return
        wanted = wanted.cpu().numpy().reshape(-1, OBSERVATION_SIZE)[rows]
        later = rows[(wanted != self.observation[rows]).any(-1)]
        if len(later):
            self.over[later] = True
            raise ValueError(
                f"set_state=True goes to the beginning of an episode, and the observation of rows {later[:5].tolist()} "
                "is of a later step, or of another seed: physics in the middle cannot be restored. Leave observation "
                "out, or repeat the episode's executed actions from its beginning"
            )
