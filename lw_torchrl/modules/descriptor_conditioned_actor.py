"""DescriptorConditionedActor: a baseline policy, conditioned on the task's description instead of a plan."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterable
from typing import Literal

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictSequential
from torch import Tensor, nn

from lw_torchrl._util.checks import typed
from lw_torchrl._util.keys import Keys, dispatched, read, write
from lw_torchrl.language.task_index import TaskIndex, pick
from lw_torchrl.language.tasks import MT50, Task, named_tasks, one_layout, task_ids
from lw_torchrl.language.text import TextEncoder, encoded
from lw_torchrl.modules.features import as_features
from lw_torchrl.modules.mixer import SkillEncoder, unit_scale
from lw_torchrl.modules.parts import Part, materialize, probe
from lw_torchrl.modules.plan_conditioned_actor import ConditionedActor

Condition = Literal["description", "one-hot"]


class TaskLatent(Part):
    """A module that encodes the task's description, or a one-hot vector of the task, as a latent.

    Reads ``task_id`` (B,) int64; writes ``task_latent`` (B, D) float32.

    Args:
        tasks: the known tasks, see :func:`resolve_tasks`; a :class:`Task` object holds its own description.
        condition: "description", the embedding of the description; "one-hot", a one-hot vector of the task.
        encoder: a module that maps T task vectors (T, E) float32 to latents (T, D); None for :class:`SkillEncoder`.
        text_encoder: a function that maps n texts to vectors (n, E) float32; None for the shipped sentence encoder.
        in_keys, out_keys: replacements for the default input and output keys; nested keys are allowed.

    Raises:
        ValueError: a task is unknown; at call time, a ``task_id`` is not among ``tasks``.

    Source: paper section 'Conditional Plan Experiments'.
    """

    _options = ("condition", "encoder")
    vectors: Tensor

    @typed
    def __init__(
        self,
        tasks: str | Iterable[str | Task],
        condition: Condition = "description",
        encoder: nn.Module | None = None,
        *,
        text_encoder: TextEncoder | None = None,
        in_keys: Keys | None = None,
        out_keys: Keys | None = None,
    ) -> None:
        super().__init__(("task_id",), ("task_latent",), in_keys, out_keys)
        self.definitions = named_tasks(tasks)
        self.tasks, self.layout = tuple(self.definitions), one_layout(self.definitions.values())
        self.condition, self.text_encoder = condition, text_encoder
        if text_encoder is None and condition == "one-hot":
            vectors = torch.eye(len(self.tasks), dtype=torch.float32)
        else:
            vectors = encoded([task.description for task in self.definitions.values()], text_encoder)
        self.index = TaskIndex(task_ids(self.tasks))
        order = [self.tasks.index(task) for task in self.index.tasks]
        # Matrix products round differently for different numbers of rows, so pad to at least 50 rows.
        fill = vectors.new_zeros(max(0, len(MT50) - len(order)), vectors.shape[1])
        self.register_buffer("vectors", torch.cat((unit_scale(vectors)[order], fill)), persistent=False)
        self.encoder = SkillEncoder() if encoder is None else encoder
        materialize(self.encoder, self.vectors)
        self.latent_size = probe(self.encoder, self.vectors[:1]).shape[-1]

    @property
    def text_vectors(self) -> Tensor:
        """The embeddings of the descriptions, (T, E) float32."""
        return self.vectors

    @property
    def config(self) -> dict[str, object]:
        """The keyword arguments that reconstruct this module."""
        return {"tasks": list(self.definitions.values()), **super().config}

    @dispatched
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        (task_id,) = read(tensordict, self.in_keys)
        rows = self.index.rows(_one_per_row(task_id, tensordict), "tasks that the actor does not know")
        return write(tensordict, self, [pick(self.encoder(self.vectors)[: len(self.tasks)], rows)])


def _one_per_row(task_id: Tensor, tensordict: TensorDictBase) -> Tensor:
    """Remove the last dimension of task ids (..., 1) if another entry of the tensordict lacks this dimension."""
    if task_id.shape[-1:] != (1,) or task_id.dim() <= tensordict.batch_dims:
        return task_id
    shapes = [value.shape[: task_id.dim()] for value in tensordict.values(True, True)]
    return task_id if all(shape == task_id.shape for shape in shapes) else task_id.squeeze(-1)


class DescriptorConditionedActor(ConditionedActor):
    """A policy that is conditioned on the task's description instead of a plan (the paper's baseline DC).

    The parts are ``latent`` (a :class:`TaskLatent`), and ``features`` and ``decoder`` as in
    :class:`PlanConditionedActor`. Reads ``observation`` (B, 39) float32 and ``task_id`` (B,) int64; writes
    ``task_latent`` (B, D), ``features`` (B, F) and ``action`` (B, 4) float32 in (-1, 1).

    Args:
        tasks, condition, text_encoder: see :class:`TaskLatent`.
        task_encoder: a module that maps task vectors (T, E) float32 to latents (T, D); None for :class:`SkillEncoder`.
        features, decoder, in_keys, out_keys: see :class:`PlanConditionedActor`.

    Raises:
        ValueError: a task is unknown; at call time, a ``task_id`` is not among ``tasks``.

    Example:
        >>> import lw_torchrl as lw
        >>> lw.modules.DescriptorConditionedActor("MT10")(lw.LanguageWorldEnv("reach").reset())["action"].shape
        torch.Size([1, 4])

    Source: paper section 'Conditional Plan Experiments'.
    """

    @typed
    def __init__(
        self,
        tasks: str | Iterable[str | Task],
        *,
        condition: Condition = "description",
        task_encoder: nn.Module | None = None,
        features: nn.Module | None = None,
        decoder: nn.Module | None = None,
        text_encoder: TextEncoder | None = None,
        in_keys: Keys | None = None,
        out_keys: Keys | None = None,
    ) -> None:
        known = list(named_tasks(tasks).values())
        features = as_features(features, one_layout(known), noise=0.05)
        trunk = descriptor_trunk(
            known, condition=condition, task_encoder=task_encoder, features=features, text_encoder=text_encoder
        )
        super().__init__(trunk, decoder, in_keys=in_keys, out_keys=out_keys)


def descriptor_trunk(
    tasks: str | Iterable[str | Task],
    *,
    condition: Condition = "description",
    task_encoder: nn.Module | None = None,
    features: nn.Module | None = None,
    text_encoder: TextEncoder | None = None,
) -> TensorDictSequential:
    """Build a trunk that writes two keys: the latent of the task description, and the features.

    See :class:`DescriptorConditionedActor` for the arguments, and :func:`plan_trunk` for the counterpart with plans.
    """
    latent = TaskLatent(tasks, condition, task_encoder, text_encoder=text_encoder)
    return TensorDictSequential(OrderedDict(latent=latent, features=as_features(features, latent.layout)))
