"""The losses of the last steps, which stay on their device until somebody must know."""

from __future__ import annotations

from collections import deque

import torch
from torch import Tensor

READ_EVERY = 100


class RecentLosses:
    """The losses of the last 100 steps. To read them is to wait for their device, so that is done 100 at a time.

    Args:
        of: whose they are, ``("the loss",)``, or a name for each of several that are trained at once.
        learning_rate: for errors.
    """

    def __init__(self, of: tuple[str, ...], learning_rate: float) -> None:
        self.of, self.learning_rate = of, learning_rate
        self._kept: deque[Tensor] = deque(maxlen=READ_EVERY)

    def clear(self) -> None:
        """Forget them."""
        self._kept.clear()

    def add(self, loss: Tensor) -> None:
        """Keep the loss of a step, () or (M,) float32."""
        self._kept.append(loss)

    def read(self, step: int) -> Tensor:
        """All that are kept, (n,) or (n, M) float32 on the CPU.

        Args:
            step: the minibatches done.

        Raises:
            ValueError: one is no finite number.
        """
        if not self._kept:
            return torch.empty(0)
        found = torch.stack(tuple(self._kept)).cpu()
        if not found.isfinite().all():
            for number, loss in enumerate(found, step - len(found)):
                self.check(loss, number)
        return found

    def check(self, loss: Tensor, step: int) -> None:
        """Raise :class:`ValueError` unless the loss of a step, () or (M,) float32, is finite."""
        if loss.isfinite().all():
            return
        which = int((~loss.reshape(-1).isfinite()).nonzero()[0])
        raise ValueError(
            f"{self.of[which]} is {loss.reshape(-1)[which].item()} at step {step}: the demonstrations hold NaN, or the "
            f"learning rate {self.learning_rate} is too high"
        )
