"""The answers that rows of an environment are shown: held between askings, late, or stuck."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded

from lw_torchrl._keys import check_apart, read
from lw_torchrl.transforms.environment import KeepsEnvState


def reset_rows(before: Tensor | None, now: Tensor, begun: Tensor | None, more: int = 0) -> Tensor:
    """``now`` (B, ...), with ``more`` dimensions beyond B, of each row that has ``begun``, B bool or None for all; the
    others keep ``before``."""
    if before is None or begun is None or before.shape != now.shape:
        return now
    shape = (*now.shape[: now.dim() - more], *[1] * more)
    return torch.where(begun.reshape(shape), now, before)


class DelayedAnswers:
    """Counts the steps of each row's episode, and keeps the answers that it is still to be shown.

    In step t of its episode, 0 at the reset, a row is shown those of step every · ⌊max(t - delay, 0) / every⌋.
    Answers are bool, or logits, float32: of one dtype from reset to reset.
    """

    def __init__(self, every: int = 1, delay: int = 0) -> None:
        self.every, self.delay = every, delay
        self._places = -(-delay // every) + 1  # for all that were taken and are still to be shown
        self._step: Tensor | None = None  # B int64
        self._taken: Tensor | None = None  # (B, places, S); answers that were taken n-th are in place n % places
        self._shown: Tensor | None = None  # (B, S)

    @property
    def step(self) -> Tensor:
        """B int64, the step of its episode that each row is at; :class:`RuntimeError` if no episode has begun."""
        if self._step is None:
            raise RuntimeError(
                "the rows' episodes have not begun, or not since load_state_dict, which holds no answers of episodes "
                "that were under way: reset the environment (env.reset(), collector.reset()) before the next step"
            )
        return self._step

    def begin(self, answers: Tensor, rows: Tensor | None) -> Tensor:
        """Begin the episodes of rows (B bool, None for all) with answers (B, S): what each row is shown."""
        shape = answers.shape[:-1]
        self._step = reset_rows(self._step, torch.zeros(shape, dtype=torch.int64, device=answers.device), rows)
        self._taken = reset_rows(self._taken, answers.unsqueeze(-2).repeat(*[1] * len(shape), self._places, 1), rows, 2)
        self._shown = reset_rows(self._shown, answers.clone(), rows, 1)
        return self._shown.clone()

    def due(self, rows: Tensor | None) -> Tensor:
        """B bool, the rows, of those that make the step, whose answers :meth:`advance` takes after it."""
        taken = (self.step + 1) % self.every == 0
        return taken if rows is None else taken & rows.reshape(taken.shape)

    def advance(self, answers: Tensor, rows: Tensor | None, stuck: Callable[[], Tensor] | None = None) -> Tensor:
        """What rows are shown, (B, S), after a step; ``stuck`` gives (B, S) bool, what stays as it was shown before."""
        due = self.due(rows)
        assert self._taken is not None
        assert self._shown is not None
        self._step = step = self.step + (1 if rows is None else rows.reshape(due.shape))
        place = torch.arange(self._places, device=step.device) == (step // self.every % self._places).unsqueeze(-1)
        self._taken = torch.where((place & due.unsqueeze(-1)).unsqueeze(-1), answers.unsqueeze(-2), self._taken)
        place = (step - self.delay).clamp(min=0) // self.every % self._places
        place = place[..., None, None].expand(*place.shape, 1, self._taken.shape[-1])
        now = self._taken.gather(-2, place).squeeze(-2)
        if stuck is not None:
            stays = stuck() if rows is None else stuck() | ~rows.reshape(due.shape).unsqueeze(-1)
            now = torch.where(stays, self._shown, now)
        self._shown = now
        return now.clone()


class HeldAnswers(KeepsEnvState):
    """Writes logits (B, S) float32 as :class:`DelayedAnswers` shows them; :meth:`HeldEvaluator.transform` makes it.

    ``ask`` gives those of the rows that are due, from a TensorDict of n rows with ``in_keys`` to (n, S) float32; S is
    ``columns``. Behind a transform that changes the observation it reads the changed one. Its ``state_dict`` holds the
    environment's, as :class:`EnvState` does; after ``load_state_dict`` the environment must be reset.
    """

    def __init__(
        self,
        ask: Callable[[TensorDictBase], Tensor],
        columns: int,
        *,
        every: int,
        delay: int,
        in_keys: Sequence[NestedKey],
        out_key: NestedKey,
    ) -> None:
        super().__init__(in_keys=list(in_keys), out_keys=[out_key])
        check_apart(self.in_keys, self.out_keys)
        self.ask, self.columns, self.every, self.delay = ask, columns, every, delay
        self._forget_episodes()

    def _forget_episodes(self) -> None:
        self._rows = DelayedAnswers(self.every, self.delay)

    def _asked(self, tensordict: TensorDictBase, due: Tensor) -> Tensor:
        """(B, S) float32, the answers of the rows that are due, B bool; zeros of the others."""
        first, *_ = read(tensordict, self.in_keys)
        found = torch.zeros(due.numel(), self.columns, device=first.device)
        rows = due.reshape(-1).nonzero().squeeze(-1)
        if len(rows):
            found[rows] = self.ask(tensordict.select(*self.in_keys).reshape(-1)[rows]).to(found.device)
        return found.reshape(*due.shape, self.columns)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        begun, shape = tensordict.get("_reset", None), tensordict_reset.batch_size
        due = torch.ones(shape, dtype=torch.bool) if begun is None else begun.reshape(shape)
        return tensordict_reset.set(self.out_keys[0], self._rows.begin(self._asked(tensordict_reset, due), begun))

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        moved = tensordict.get("_step", None)
        answers = self._asked(next_tensordict, self._rows.due(moved))
        return next_tensordict.set(self.out_keys[0], self._rows.advance(answers, moved))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        raise ValueError(
            f"HeldEvaluator(every={self.every}, delay={self.delay}) counts the steps of an environment's episodes, "
            "which rows of a replay buffer do not tell: train a policy with the evaluator inside it, and hold that "
            "when acting, policy.with_evaluator(lw.HeldEvaluator(policy.evaluator, every=...))"
        )

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        assert isinstance(observation_spec, Composite)
        key, shape, device = self.out_keys[0], (*observation_spec.shape, self.columns), observation_spec.device
        if key in observation_spec.keys(True, True):
            raise ValueError(
                f"two HeldEvaluators write {key!r}, the second over the first's answers: hold one, give the policy "
                "qaf in the other's place"
            )
        observation_spec[key] = Unbounded(shape, dtype=torch.float32, device=device)
        return observation_spec
