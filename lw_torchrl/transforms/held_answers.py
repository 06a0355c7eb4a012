"""HeldAnswers: an evaluator's answers in an environment, asked now and then and held in between."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded

from lw_torchrl._blocks import in_blocks
from lw_torchrl._keys import read
from lw_torchrl.transforms.env_state import KeepsEnvState
from lw_torchrl.transforms.held_truth import HeldTruth

HELD = "qaf_held_logits"


class HeldAnswers(KeepsEnvState):
    """Writes ``qaf_held_logits`` (B, S) float32: in step t of its episode, 0 at the reset, a row is shown the answers
    of step every · ⌊max(t - delay, 0) / every⌋.

    Only the rows whose answers are due are asked, in blocks of one size. A ``_step`` or ``_reset`` mask counts for its
    rows alone. Answers of episodes under way are no part of ``state_dict``, which holds the environment's, as
    :class:`EnvState` does: after ``load_state_dict`` the environment must be reset. A replay buffer is refused.

    Args:
        ask: rows with ``in_keys`` to rows with ``qaf_logits`` (n, S) float32; pickled where the environment is.
        in_keys: what it reads.
        num_steps: S.
        every: steps of a row's episode from one asking to the next.
        delay: steps until answers are shown; until then a row is shown those of its reset.
    """

    def __init__(
        self,
        ask: Callable[[TensorDictBase], TensorDictBase],
        in_keys: Sequence[NestedKey],
        num_steps: int,
        every: int,
        delay: int,
    ) -> None:
        super().__init__(in_keys=list(in_keys), out_keys=[HELD])
        self.every, self.delay, self.num_steps = every, delay, num_steps
        self._ask = ask
        self._held = HeldTruth(every, delay)

    def clone(self) -> HeldAnswers:
        """One for another environment, in which no episode has begun."""
        other: HeldAnswers = super().clone()
        other._held = HeldTruth(self.every, self.delay)
        return other

    def set_extra_state(self, state: Tensor) -> None:
        """As :class:`EnvState`; a step wants a reset first."""
        super().set_extra_state(state)
        self._held.forget()

    def _asked(self, tensordict: TensorDictBase, due: Tensor) -> Tensor:
        """(..., S) float32, the answers of the rows that are due; 0 for the others."""
        read(tensordict, self.in_keys)
        shape = tensordict.batch_size
        found = torch.zeros(shape.numel(), self.num_steps)
        if (rows := due.reshape(-1).nonzero().flatten()).numel():
            states = tensordict.select(*self.in_keys).reshape(-1)[rows]
            found[rows] = in_blocks(self._ask)(states).get("qaf_logits").to(found)
        return found.reshape(*shape, self.num_steps)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        begun = tensordict.get("_reset", None)
        shape = tensordict_reset.batch_size
        due = torch.ones(shape, dtype=torch.bool) if begun is None else begun.reshape(shape)
        answers = self._asked(tensordict_reset, due)
        return tensordict_reset.set(HELD, self._held.begin(answers, begun))

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        moved, step = tensordict.get("_step", None), self._held.step
        which = torch.ones_like(step, dtype=torch.bool) if moved is None else moved.reshape(step.shape)
        answers = self._asked(next_tensordict, which & ((step + 1) % self.every == 0))
        return next_tensordict.set(HELD, self._held.go_on(answers, moved))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Raise: rows of a replay buffer do not tell the steps of their episodes."""
        raise ValueError(
            "HeldEvaluator counts the steps of an environment's episodes, which rows of a replay buffer do not tell: "
            "train a policy with the evaluator itself, and hold it when the policy acts, "
            "policy.with_evaluator(lw.HeldEvaluator(policy.evaluator, every=...))"
        )

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Add ``qaf_held_logits`` to the specs."""
        assert isinstance(observation_spec, Composite)
        shape = (*observation_spec.shape, self.num_steps)
        observation_spec[HELD] = Unbounded(shape, dtype=torch.float32, device=observation_spec.device)
        return observation_spec
