"""FallbackTurns: alternate between a plan and its fallback plan when neither the hand nor an object moves."""

from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Composite, Unbounded
from torchrl.envs import Transform

from lw_torchrl._util.checks import Count, Scale, typed
from lw_torchrl._util.keys import Keys, as_keys, check_apart, read
from lw_torchrl.language.layout import METAWORLD, Layout
from lw_torchrl.transforms.environment import begun, reset_rows


class _Rows(NamedTuple):
    """The state of each row's episode."""

    turn: Tensor  # B int64
    waited: Tensor  # B int64, time steps without motion
    lasted: Tensor  # B int64, time steps since the turn began
    stood: Tensor  # (B, P, 3), metres, positions when something last moved


class FallbackTurns(Transform):
    """A transform that counts the turns of an episode. In these turns, a plan alternates with its fallback plan.

    Six turns form a cycle. In turns 0 and 3 the policy follows the plan, in turns 1 and 4 it releases the object, and
    in turns 2 and 5 it tries the two motions of the fallback plan. A turn ends when neither the hand nor an object has
    moved farther than ``still`` for ``patience`` time steps, and after at most ``longest`` time steps; turns 1 and 4
    last ``release`` time steps. :class:`~lw_torchrl.modules.PlanAttention` reads the turn if the plans have fallback
    steps, see :func:`~lw_torchrl.canonical_plans`.

    In an environment, the transform reads ``observation`` (B, 39) float32, metres, and writes ``turn`` (B,) int64, from
    0. Rows of a replay buffer keep the recorded ``turn``; rows without ``turn`` get 0.

    Args:
        layout: the layout of the observations.
        patience: number of time steps without motion that end a turn.
        longest: maximum length of a turn, in time steps.
        release: length of a turn that releases the object, in time steps.
        still: the largest distance, in metres, that does not count as motion.
        in_keys, out_keys: replacements for the keys ``observation`` and ``turn``.

    Raises:
        ValueError: at call time, the observation is missing.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> import lw_torchrl as lw
        >>> env = TransformedEnv(lw.LanguageWorldEnv("reach"), lw.transforms.FallbackTurns(patience=5, release=5))
        >>> env.rollout(12, lambda td: td.set("action", td["observation"].new_zeros(1, 4)))["turn"].max()
        tensor(2)

    Source: original to this library, after the time-outs of fallback nodes in behavior trees.
    """

    @typed
    def __init__(
        self,
        layout: Layout = METAWORLD,
        *,
        patience: Count = 60,
        longest: Count = 250,
        release: Count = 20,
        still: Scale = 0.02,
        in_keys: Keys | None = None,
        out_keys: Keys | None = None,
    ) -> None:
        keys = as_keys("in_keys", in_keys, ("observation",))
        super().__init__(in_keys=keys, out_keys=as_keys("out_keys", out_keys, ("turn",)))
        check_apart(self.in_keys, self.out_keys)
        self.layout, self.patience, self.longest = layout, patience, longest
        self.release, self.still = release, still
        self._rows: _Rows | None = None

    def _positions(self, tensordict: TensorDictBase) -> Tensor:
        """Return the positions (B, P, 3) of the hand and the objects, without the goal, which does not move."""
        (observation,) = read(tensordict, self.in_keys)
        return torch.stack([observation[..., part] for part in self.layout.positions[:-1]], -2)

    def _keep(self, tensordict: TensorDictBase, now: _Rows, which: Tensor | None) -> TensorDictBase:
        """Store the state of the rows where ``which`` (B bool, or None for all rows) is true, and write ``turn``."""
        before = self._rows or [None] * len(now)
        kept = (reset_rows(old, new, which, new.dim() - now.turn.dim()) for old, new in zip(before, now, strict=True))
        self._rows = _Rows(*kept)
        return tensordict.set(self.out_keys[0], self._rows.turn.clone())

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        now = self._positions(tensordict_reset)
        zeros = torch.zeros(now.shape[:-2], dtype=torch.int64, device=now.device)
        return self._keep(tensordict_reset, _Rows(zeros, zeros, zeros, now), tensordict.get("_reset", None))

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        now, (turn, waited, lasted, stood) = self._positions(next_tensordict), begun(self._rows)
        moved = ((now - stood).norm(dim=-1) > self.still).any(-1)
        waited, lasted = torch.where(moved, 0, waited + 1), lasted + 1
        over = torch.where(turn % 3 == 1, lasted >= self.release, (waited >= self.patience) | (lasted >= self.longest))
        stood = torch.where((moved | over)[..., None, None], now, stood)
        after = _Rows(turn + over, torch.where(over, 0, waited), torch.where(over, 0, lasted), stood)
        return self._keep(next_tensordict, after, tensordict.get("_step", None))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        for rows in (tensordict, tensordict.get("next", None)):
            if rows is not None and rows.get(self.out_keys[0], None) is None:
                zeros = torch.zeros(rows.batch_size, dtype=torch.int64, device=tensordict.device)
                rows.set(self.out_keys[0], zeros)
        return tensordict

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        shape, device = observation_spec.shape, observation_spec.device
        observation_spec[self.out_keys[0]] = Unbounded(shape, dtype=torch.int64, device=device)
        return observation_spec
