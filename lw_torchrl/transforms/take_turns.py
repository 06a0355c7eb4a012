"""TakeTurns: whose turn it is, the plan's own steps or those in reserve, by whether anything still moves."""

from collections.abc import Sequence
from typing import NamedTuple

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


class _Rows(NamedTuple):
    """What is kept of each row's episode."""

    turn: Tensor  # B int64
    waited: Tensor  # B int64, steps without motion
    lasted: Tensor  # B int64, steps of the turn
    stood: Tensor  # (B, P, 3), where everything was when it last moved


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
        self._rows: _Rows | None = None

    def _positions(self, tensordict: TensorDictBase) -> Tensor:
        observation = tensordict.get(self.in_keys[0], None)
        if observation is None:
            raise missing_keys(tensordict.keys(True, True), str(self.in_keys[0]))
        return torch.stack([observation[..., part] for part in self.layout.positions[:-1]], -2)

    def _keep(self, tensordict: TensorDictBase, now: _Rows, which: Tensor | None) -> TensorDictBase:
        """Keep the state of the rows ``which``, B bool or None for all, and write whose turn it is."""
        before = self._rows or [None] * len(now)
        kept = (reset_rows(old, new, which, new.dim() - now.turn.dim()) for old, new in zip(before, now, strict=True))
        self._rows = _Rows(*kept)
        return tensordict.set(self.out_keys[0], self._rows.turn.clone())

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        now = self._positions(tensordict_reset)
        none = torch.zeros(now.shape[:-2], dtype=torch.int64, device=now.device)
        return self._keep(tensordict_reset, _Rows(none, none, none, now), tensordict.get("_reset", None))

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        if self._rows is None:
            raise RuntimeError("rows have begun no episode: reset the environment")
        now, (turn, waited, lasted, stood) = self._positions(next_tensordict), self._rows
        moved = ((now - stood).norm(dim=-1) > self.still).any(-1)
        waited, lasted = torch.where(moved, 0, waited + 1), lasted + 1
        over = (waited >= self.patience) | (lasted >= self.longest)
        stood = torch.where((moved | over)[..., None, None], now, stood)
        after = _Rows(turn + over, torch.where(over, 0, waited), torch.where(over, 0, lasted), stood)
        return self._keep(next_tensordict, after, tensordict.get("_step", None))

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
