"""Encoder: what actors and critics are built on, whatever they are conditioned on."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import Transform

from lw_torchrl._keys import dispatched, read, write
from lw_torchrl.language.layout import METAWORLD, Layout
from lw_torchrl.language.plans import ConditionalPlan, Plans
from lw_torchrl.language.tasks import TASKS, Task
from lw_torchrl.language.text import TextEncoder
from lw_torchrl.modules.observation_features import ObservationFeatures


class Encoding(NamedTuple):
    """What an encoder makes of a batch."""

    latent: Tensor  # (B, D) float32, what is to be done
    features: Tensor  # (B, F) float32, where things are
    weights: Tensor | None = None  # (B, S) float32, the attention over the plan's steps; None without plans

    @property
    def joined(self) -> Tensor:
        """(B, D + F) float32, the latent beside the features: what networks read."""
        return torch.cat((self.latent, self.features), -1)


class Prepared(TensorDictModuleBase):
    """What policies and encoders share: they read ``in_keys``, know tasks, and say what must run before them.

    Attributes:
        config: the keyword arguments that make it again, as JSON.
        plans: the plans that it is conditioned on; None for none.
        tasks: the names of the tasks that it knows.
        layout: what the observations and actions are: its plans', or Meta-World's.
    """

    config: dict[str, Any]
    plans: Plans | None = None
    tasks: tuple[str, ...]
    layout: Layout = METAWORLD

    def definition(self, task: str) -> Task | None:
        """What it knows of a task: its plan's definition, or the shipped one; None if it knows none."""
        return TASKS.get(task) if self.plans is None else self.plans[task].definition

    def transform(self) -> Transform | None:
        """A new transform that writes what it reads and the environment does not give; None for none."""
        return None

    def read(self, tensordict: TensorDictBase) -> list[Tensor]:
        """The tensors of ``in_keys``; :class:`ValueError` names those that are missing."""
        return read(tensordict, self.in_keys)

    def prepare(self, tensordict: TensorDictBase) -> tuple[Tensor, ...]:
        """What no trained parameter touches, and all checks of values, outside of vmap."""
        raise NotImplementedError(f"{type(self).__name__} must override prepare")

    def describe(self) -> dict[str, Any]:
        """What a policy's description needs beside the options, as JSON."""
        return {}

    def fit_contacts(self, observation: Tensor, task_id: Tensor) -> None:
        """Take contacts from demonstrations, (R, 39) float32 and (R,) int64, in place; by default none."""


class Encoder(Prepared):
    """From what is to be done, and where things are, to a latent and features.

    A subclass splits its work into :meth:`prepare`, which no trained parameter touches and which checks the values,
    and :meth:`encode`, which can be vmapped over parameters. As a module it writes ``encoding`` (B, D + F) float32,
    for networks of yours.

    Attributes:
        features: what it sees of the observation.
        latent_size: D.

    Source: paper section 'Plan Conditioning'.
    """

    features: ObservationFeatures
    latent_size: int
    text_encoder: TextEncoder | None = None

    @property
    def width(self) -> int:
        """D + F, the width of ``encoding``."""
        return self.latent_size + self.features.width

    def encode(self, *prepared: Tensor) -> Encoding:
        """From what :meth:`prepare` gives."""
        raise NotImplementedError(f"{type(self).__name__} must override encode")

    @dispatched
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return write(tensordict, self, [self.encode(*self.prepare(tensordict)).joined])

    def with_plans(self, plans: Plans | Mapping[str, ConditionalPlan]) -> Encoder:
        """The same weights for other plans: training either trains both."""
        raise TypeError(f"with_plans is for policies with plans, {type(self).__name__} is conditioned on descriptions")
