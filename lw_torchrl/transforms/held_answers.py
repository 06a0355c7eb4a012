"""HeldAnswers: what a costly evaluator says of an environment's rows, asked now and then, and shown late."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded

from lw_torchrl._keys import check_apart, read
from lw_torchrl.transforms.env_state import KeepsEnvState
from lw_torchrl.transforms.held_truth import HeldTruth


class HeldAnswers(KeepsEnvState):
    """Writes logits (B, S) float32, asked for at a row's reset and then every so many steps of its episode, held in
    between and shown so many steps late; :meth:`HeldEvaluator.transform` makes it.

    Only the rows whose answers are due are asked about; rows that a ``_step`` or ``_reset`` mask leaves out are not. It
    reads what is there where it stands: after a transform that changes the observation, the changed one. In an
    environment its ``state_dict`` holds the environment's, as :class:`EnvState` does; after ``load_state_dict`` the
    environment must be reset.

    Args:
        ask: from a TensorDict of n rows with ``in_keys`` to their logits (n, S) float32.
        columns: S.
        every: steps of a row's episode from one asking to the next, at least 1.
        delay: steps until answers are shown, at least 0; until then a row is shown those of its reset.
        in_keys: what is read.
        out_key: where the logits go.

    Raises:
        ValueError: on a replay buffer; something that is to be read is absent; something before it writes ``out_key``.
        RuntimeError: a step of an environment that was never reset, or not since ``load_state_dict``.
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
        self.ask, self.columns = ask, columns
        self._held = HeldTruth(every, delay)

    @property
    def every(self) -> int:
        """Steps from one asking to the next."""
        return self._held.every

    @property
    def delay(self) -> int:
        """Steps until answers are shown."""
        return self._held.delay

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
        return tensordict_reset.set(self.out_keys[0], self._held.begin(self._asked(tensordict_reset, due), begun))

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        moved = tensordict.get("_step", None)
        answers = self._asked(next_tensordict, self._held.due(moved))
        return next_tensordict.set(self.out_keys[0], self._held.go_on(answers, moved))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Raise: rows of a replay buffer are in no episode whose steps could be counted."""
        raise ValueError(
            f"HeldEvaluator(every={self.every}, delay={self.delay}) counts the steps of an environment's episodes, "
            "which rows of a replay buffer do not tell: train a policy with the evaluator inside it, and hold that "
            "when acting, policy.with_evaluator(lw.HeldEvaluator(policy.evaluator, every=...))"
        )

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Add the logits to the specs."""
        assert isinstance(observation_spec, Composite)
        key, shape, device = self.out_keys[0], (*observation_spec.shape, self.columns), observation_spec.device
        if key in observation_spec.keys(True, True):
            raise ValueError(
                f"two HeldEvaluators write {key!r}, the second over the first's answers: hold one, give the policy "
                "qaf in the other's place"
            )
        observation_spec[key] = Unbounded(shape, dtype=torch.float32, device=device)
        return observation_spec
