"""TakeTurns: whose turn it is, the plan's own steps or those in reserve, by whether anything still moves."""

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs import Transform

from lw_torchrl._checks import Count, Scale, checked, missing_keys
from lw_torchrl._keys import as_keys, check_apart, key_beside
from lw_torchrl.language.layout import METAWORLD, Layout
from lw_torchrl.transforms.environment import reset_rows


def turn_key(observation: NestedKey) -> NestedKey:
    """Where :class:`TakeTurns` writes the turn: beside ``observation``, ``observation_turn``."""
    return key_beside(observation, "_turn")


class TakeTurns(Transform):
    """Counts an episode's turns: 0 while the plan's own steps get somewhere, 1 when those in reserve are to be tried, 2
    when the plan's own are once more, and so on.

    A turn ends when neither the hand nor a thing has moved farther than ``still`` for ``patience`` steps, and at the
    latest after ``longest`` steps. Nobody has to tell it whether the task was done.

    In an environment it reads ``observation`` (B, 39) float32, metres, and writes ``observation_turn`` (B,) int64. Rows
    of a replay buffer keep the turn with which they were collected, and have 0 without one.

    Args:
        layout: where the hand and the things are in an observation.
        patience: steps without motion that end a turn.
        longest: steps that end a turn in any case.
        still: metres, a motion that is none.
        in_keys: where the observation is.

    Raises:
        ValueError: a wrong argument, or no observation.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> import lw_torchrl as lw
        >>> env = TransformedEnv(lw.LanguageWorldEnv("reach"), lw.transforms.TakeTurns(patience=5))
        >>> env.rollout(12, lambda td: td.set("action", td["observation"].new_zeros(1, 4)))["observation_turn"].max()
        tensor(2)
        >>> env.close()

    Source: ours; time-outs of a behaviour tree's fallback node.
    """

    @checked
    def __init__(
        self,
        layout: Layout = METAWORLD,
        *,
        patience: Count = 60,
        longest: Count = 250,
        still: Scale = 0.02,
        in_keys: Sequence[NestedKey] | None = None,
    ) -> None:
        read = as_keys("in_keys", in_keys, ("observation",))
        super().__init__(in_keys=read, out_keys=[turn_key(read[0])])
        check_apart(self.in_keys, self.out_keys)
        self.layout, self.patience, self.longest, self.still = layout, patience, longest, still
        self._turn: Tensor | None = None  # (B,) int64
        self._waited: Tensor | None = None  # (B,), steps without motion
        self._lasted: Tensor | None = None  # (B,), steps of the turn
        self._stood: Tensor | None = None  # (B, P, 3), where everything was when it last moved

    def _positions(self, tensordict: TensorDictBase) -> Tensor:
        observation = tensordict.get(self.in_keys[0], None)
        if observation is None:
            raise missing_keys(tensordict.keys(True, True), str(self.in_keys[0]))
        return torch.stack([observation[..., part] for part in self.layout.positions[:-1]], -2)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        begun, now = tensordict.get("_reset", None), self._positions(tensordict_reset)
        none = torch.zeros(now.shape[:-2], dtype=torch.int64, device=now.device)
        self._turn, self._waited = reset_rows(self._turn, none, begun), reset_rows(self._waited, none, begun)
        self._lasted, self._stood = reset_rows(self._lasted, none, begun), reset_rows(self._stood, now, begun, 2)
        return tensordict_reset.set(self.out_keys[0], self._turn.clone())

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        now = self._positions(next_tensordict)
        if self._turn is None or self._waited is None or self._lasted is None or self._stood is None:
            raise RuntimeError("rows have begun no episode: reset the environment")
        every = torch.ones_like(self._turn, dtype=torch.bool)
        stepping = tensordict.get("_step", every).reshape(every.shape)
        moved = ((now - self._stood).norm(dim=-1) > self.still).any(-1)
        waited, lasted = torch.where(moved, 0, self._waited + 1), self._lasted + 1
        over = (waited >= self.patience) | (lasted >= self.longest)
        anew, count = stepping & (moved | over), torch.where(over, 0, 1)
        self._stood = torch.where(anew[..., None, None], now, self._stood)
        self._waited = torch.where(stepping, waited * count, self._waited)
        self._lasted = torch.where(stepping, lasted * count, self._lasted)
        self._turn = self._turn + (stepping & over)
        return next_tensordict.set(self.out_keys[0], self._turn.clone())

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        for rows in (tensordict, tensordict.get("next", None)):
            if rows is not None and rows.get(self.out_keys[0], None) is None:
                none = torch.zeros(rows.batch_size, dtype=torch.int64, device=tensordict.device)
                rows.set(self.out_keys[0], none)
        return tensordict

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        assert isinstance(observation_spec, Composite)
        shape, device = observation_spec.shape, observation_spec.device
        observation_spec[self.out_keys[0]] = Unbounded(shape, dtype=torch.int64, device=device)
        return observation_spec
