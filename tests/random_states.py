"""RandomStates: an environment of random states, in which the answers of a plan's conditions change all the time."""

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

import lw_torchrl as lw

CONDITIONS = ["open", "left of the {0}", "right of the {0}", "not left of the {0}"]


def plan(task: str, thing: str, conditions: list[str]) -> lw.ConditionalPlan:
    pairs = [("the gripper is " + condition.format(thing), "hold still") for condition in conditions]
    return lw.ConditionalPlan.from_pairs(task, pairs)


PLANS = lw.Plans([plan("reach", "reach target", CONDITIONS), plan("push", "puck", CONDITIONS[:2])])


class RandomStates(EnvBase):
    """Row i is of "push" or "reach" in turn, its episode m, of ``length + i`` steps, has states that (i, m) fixes."""

    def __init__(self, rows: int, length: int = 10_000, first: int = 0) -> None:
        super().__init__(batch_size=(rows,))
        self.first, self.lengths = first, length + torch.arange(rows)
        ids = torch.tensor([lw.task_id(("push", "reach")[row % 2]) for row in range(rows)])
        self.ids, self.episode, self.at = ids, torch.full((rows,), -1), torch.zeros(rows, dtype=torch.int64)
        flag = Categorical(2, shape=(rows, 1), dtype=torch.bool)
        numbers = {name: Unbounded((rows,), dtype=torch.int64) for name in ("task_id", "episode")}
        self.observation_spec = Composite(observation=Unbounded((rows, 39)), **numbers, shape=(rows,))
        self.action_spec = Bounded(-1.0, 1.0, (rows, 4))
        self.reward_spec = Unbounded((rows, 1))
        self.done_spec = Composite(done=flag, terminated=flag.clone(), shape=(rows,))

    def _state(self, **more: torch.Tensor) -> TensorDict:
        states = []
        for row, (episode, step) in enumerate(zip(self.episode.tolist(), self.at.tolist(), strict=True)):
            drawn = torch.Generator().manual_seed(((self.first + row) * 1000 + episode + 1) * 10_000 + step)
            states.append(torch.rand(39, generator=drawn))
        done = (self.at >= self.lengths).unsqueeze(-1)
        found = {"observation": torch.stack(states), "task_id": self.ids.clone(), "episode": self.episode.clone()}
        return TensorDict({**found, "done": done, "terminated": done.clone(), **more}, self.batch_size)

    def _mask(self, tensordict: TensorDictBase | None, key: str) -> torch.Tensor:
        mask = None if tensordict is None else tensordict.get(key, None)
        return torch.ones_like(self.ids, dtype=torch.bool) if mask is None else mask.reshape(self.batch_size)

    def _reset(self, tensordict: TensorDictBase | None = None, **options) -> TensorDict:
        rows = self._mask(tensordict, "_reset")
        self.episode = torch.where(rows, self.episode + 1, self.episode)
        self.at = torch.where(rows, 0, self.at)
        return self._state()

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        self.at = self.at + self._mask(tensordict, "_step")
        return self._state(reward=torch.zeros(*self.batch_size, 1))

    def _set_seed(self, seed: int | None) -> None:
        self.episode = torch.full_like(self.episode, -1)
