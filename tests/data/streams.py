"""Rows as collectors give them, of environments that count: what follows what is known."""

from __future__ import annotations

import torch
from tensordict import TensorDict


def own_rows(lengths, first=-1_000.0, tasks=(3, 7)):
    """Demonstrations of one's own: trajectories of these lengths."""
    total = sum(lengths)
    observation = torch.arange(total, dtype=torch.float32)[:, None] + first + torch.zeros(total, 2)
    ids = torch.repeat_interleave(torch.tensor(lengths))
    done = torch.ones(total, 1, dtype=torch.bool)
    done[:-1, 0] = ids[1:] != ids[:-1]
    return make(observation, torch.tensor(tasks)[ids % len(tasks)], ids, done, torch.zeros_like(done), [total])


def make(observation, task, ids, done, terminated, shape):
    return TensorDict(
        {
            "observation": observation,
            "task_id": task,
            "action": (observation * 0.37).sin(),
            "collector": {"traj_ids": ids},
            "next": {
                "observation": observation + 1,
                "task_id": task,
                "reward": (observation[..., :1] * 1.7).cos(),
                "done": done,
                "terminated": terminated,
                "truncated": done & ~terminated,
            },
        },
        shape,
    )


class Stream:
    """A collector of N environments; an observation never comes twice, but as the next one of the row before."""

    def __init__(self, number, envs, seed, tasks=(3, 7)):
        self.generator = torch.Generator().manual_seed(seed)
        self.envs, self.tasks = envs, torch.tensor(tasks)
        self.at = torch.arange(envs) * 10_000.0 + number * 200_000.0
        self.ids = torch.arange(envs)

    def reset(self):
        """Begin anew without an end, and count trajectories from 0 again."""
        self.at += 100
        self.ids = torch.arange(self.envs)

    def batch(self, steps):
        """(N, T) rows."""
        rows = []
        for _ in range(steps):
            ended = torch.rand(self.envs, 2, generator=self.generator) < torch.tensor([0.2, 0.5])
            done, terminated = ended[:, :1], ended.all(1, keepdim=True)
            task = self.tasks[torch.arange(self.envs) % len(self.tasks)]
            observation = self.at[:, None].repeat(1, 2)
            rows.append(make(observation, task, self.ids.clone(), done, terminated, [self.envs]))
            self.at = self.at + 1 + 50 * done[:, 0]
            self.ids = torch.where(done[:, 0], int(self.ids.max()) + 1 + torch.arange(self.envs), self.ids)
        return torch.stack(rows, 1)
