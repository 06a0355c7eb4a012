"""What transforms keep of each row of an environment: the answers that it is still to be shown, its task."""

from __future__ import annotations

import torch
from torch import Tensor


def kept(before: Tensor | None, now: Tensor, begun: Tensor | None) -> Tensor:
    """B, a value of each row at a reset: of rows that do not begin, what it was before.

    Where some of a worker's rows are reset, TorchRL's batched environments show zeros for the others.

    Args:
        before: B, at the last reset; None if there was none.
        now: B.
        begun: B bool, or with a last dimension of 1, the rows that are reset; None for all.
    """
    if before is None or begun is None or before.shape != now.shape:
        return now
    return torch.where(begun.reshape(now.shape), now, before)


class HeldTruth:
    """Counts the steps of each row's episode and keeps the answers that it is still to be shown.

    In step t of its episode, 0 at the reset, a row is shown the answers of step
    every · ⌊max(t - delay, 0) / every⌋. Answers are truth, bool, or logits, float32: of one dtype from reset to reset.

    Args:
        every: steps from one taking of the answers to the next, at least 1.
        delay: steps until they are shown, at least 0.
    """

    def __init__(self, every: int = 1, delay: int = 0) -> None:
        self.every, self.delay = every, delay
        self._places = -(-delay // every) + 1  # for all that were taken and are still to be shown
        self._step: Tensor | None = None  # B int64
        self._taken: Tensor | None = None  # (B, places, S); answers that were taken n-th are in place n % places

    @property
    def step(self) -> Tensor:
        """B int64, the step of its episode that each row is at.

        Raises:
            RuntimeError: no episode has begun.
        """
        if self._step is None:
            raise RuntimeError(
                "the rows' episodes have not begun, or not since load_state_dict, which holds no answers of episodes "
                "that were under way: reset the environment (env.reset(), collector.reset()) before the next step"
            )
        return self._step

    def forget(self) -> None:
        """No episode has begun."""
        self._step = self._taken = None

    def begin(self, truth: Tensor, rows: Tensor | None) -> Tensor:
        """Rows are at the beginning of an episode.

        Args:
            truth: (B, S), the answers in the rows' states; only those of rows that begin are read, or of all at first.
            rows: B bool, or with a last dimension of 1, those that begin; None for all.

        Returns:
            (B, S), what each row is shown, of the same dtype.
        """
        shape = truth.shape[:-1]
        if rows is None or self._step is None or self._taken is None:
            self._step = torch.zeros(shape, dtype=torch.int64, device=truth.device)
            self._taken = truth.unsqueeze(-2).repeat(*(1 for _ in shape), self._places, 1)
        else:
            begun = rows.reshape(shape)
            self._step = torch.where(begun, 0, self._step)
            self._taken = torch.where(begun[..., None, None], truth.unsqueeze(-2), self._taken)
        return self._shown()

    def due(self, rows: Tensor | None) -> Tensor:
        """B bool, of the rows that make the step to come those whose answers are taken after it; the others' are not
        read by :meth:`go_on`.

        Args:
            rows: B bool, or with a last dimension of 1, those that make the step; None for all.

        Raises:
            RuntimeError: no episode has begun.
        """
        taken = (self.step + 1) % self.every == 0
        return taken if rows is None else taken & rows.reshape(taken.shape)

    def go_on(self, truth: Tensor, rows: Tensor | None) -> Tensor:
        """Rows have made a step; arguments and result as for :meth:`begin`."""
        due = self.due(rows)
        self._step = step = self.step + (1 if rows is None else rows.reshape(due.shape))
        assert self._taken is not None
        place = torch.arange(self._places, device=step.device) == (step // self.every % self._places).unsqueeze(-1)
        self._taken = torch.where((place & due.unsqueeze(-1)).unsqueeze(-1), truth.unsqueeze(-2), self._taken)
        return self._shown()

    def _shown(self) -> Tensor:
        assert self._taken is not None
        place = (self.step - self.delay).clamp(min=0) // self.every % self._places
        place = place[..., None, None].expand(*place.shape, 1, self._taken.shape[-1])
        return self._taken.gather(-2, place).squeeze(-2)
