"""DescriptorEncoder: what a task's description, or its number, says is to be done, and where things are."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, Literal

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor

from lw_torchrl._checks import check_choice, checked
from lw_torchrl._keys import as_keys, check_apart
from lw_torchrl.language.task_index import TaskIndex
from lw_torchrl.language.tasks import MT50, TASKS, Task, named_tasks
from lw_torchrl.language.text import TextEncoder, encoded
from lw_torchrl.modules.encoder import Encoder, Encoding
from lw_torchrl.modules.networks import text_to_latent, unit_scale
from lw_torchrl.modules.observation_features import Features, ObservationFeatures


def _one_hot(texts: Sequence[str]) -> Tensor:
    return torch.eye(len(texts))


class DescriptorEncoder(Encoder):
    """The latent of the task's description, or of its number, beside the observation's features.

    Reads ``observation`` (B, 39) float32 and ``task_id`` (B,) int64; writes ``encoding`` (B, D + F) float32.

    Args:
        tasks, condition: as for :class:`DescriptorConditionedActor`.
        features, latent_size, encoder_width, encoder_depth, text_encoder, in_keys: as for
            :class:`PlanConditionedActor`.
        feature_noise: standard deviation of the noise on the normalised features while training.
        out_keys: another name for what it writes.

    Raises:
        ValueError: as for :class:`DescriptorConditionedActor`.

    Source: paper section 'Conditional Plan Experiments'.
    """

    text_vectors: Tensor

    @checked
    def __init__(
        self,
        tasks: str | Iterable[str | Task],
        *,
        condition: Literal["description", "one-hot"] = "description",
        features: Features = "differences",
        feature_noise: float = 0.0,
        latent_size: int = 64,
        encoder_width: int = 128,
        encoder_depth: int = 1,
        text_encoder: TextEncoder | None = None,
        in_keys: Sequence[NestedKey] | None = None,
        out_keys: Sequence[NestedKey] | None = None,
    ) -> None:
        super().__init__()
        if features == "opening":
            raise ValueError("features='opening' shows nothing of where things are; only plans with roles or focus do")
        self.definitions = named_tasks(tasks)
        self.tasks = tuple(self.definitions)
        self.in_keys = as_keys("in_keys", in_keys, ("observation", "task_id"))
        self.out_keys = as_keys("out_keys", out_keys, ("encoding",))
        check_apart(self.in_keys, self.out_keys)
        self.config: dict[str, Any] = {
            "condition": check_choice("condition", condition, ("description", "one-hot")),
            "features": features,
            "feature_noise": feature_noise,
            "latent_size": latent_size,
            "encoder_width": encoder_width,
            "encoder_depth": encoder_depth,
            "in_keys": self.in_keys,
        }
        self.text_encoder = text_encoder
        own = _one_hot if text_encoder is None and condition == "one-hot" else text_encoder
        found = encoded([task.description for task in self.definitions.values()], own)
        self.index = TaskIndex(self.tasks)
        order = [self.tasks.index(task) for task in self.index.tasks]
        # A product of another number of rows rounds differently: whatever the tasks, there are 50 or more.
        fill = found.new_zeros(max(0, len(MT50) - len(order)), found.shape[1])
        vectors = torch.cat((unit_scale(found)[order], fill))
        self.register_buffer("text_vectors", vectors, persistent=False)
        self.latent_size = latent_size
        self.texts = text_to_latent(found.shape[1], latent_size, encoder_width, encoder_depth)
        self.features = ObservationFeatures(features, feature_noise)

    def definition(self, task: str) -> Task | None:
        return self.definitions.get(task)

    def prepare(self, tensordict: TensorDictBase) -> tuple[Tensor, ...]:
        """What no trained parameter touches: each task's row (B,) int64, and the observation's features (B, F)."""
        observation, task_id = self.read(tensordict)
        rows = self.index.rows(task_id, "tasks this actor was not made for")
        return rows, self.features(observation)

    def encode(self, *prepared: Tensor) -> Encoding:
        """From what :meth:`prepare` gives."""
        rows, seen = prepared
        return Encoding(self.texts(self.text_vectors)[: len(self.tasks)][rows], seen)

    def describe(self) -> dict[str, Any]:
        own = {name: task.to_json() for name, task in self.definitions.items() if task != TASKS.get(name)}
        return {"tasks": list(self.tasks), "own_tasks": own}
