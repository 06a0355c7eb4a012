"""DescriptorConditionedActor: the baseline that is conditioned on the task's description instead of a plan."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal, Self

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor

from lw_torchrl._checks import checked, passes_on
from lw_torchrl._keys import as_keys, check_apart
from lw_torchrl.language.plans import Plans
from lw_torchrl.language.task_index import TaskIndex
from lw_torchrl.language.tasks import MT50, Task, named_tasks, one_layout, task_ids
from lw_torchrl.language.text import TextEncoder, encoded
from lw_torchrl.modules.conditioned_actor import ConditionedActor
from lw_torchrl.modules.networks import text_to_latent, unit_scale
from lw_torchrl.modules.observation_features import Features, ObservationFeatures
from lw_torchrl.modules.policy import Encoder, Encoding, described_tasks


class DescriptorEncoder(Encoder):
    """The latent of the task's description, or of its number, beside the observation's features.

    Reads ``observation`` (B, 39) float32 and ``task_id`` (B,) int64; writes ``encoding`` (B, D + F) float32.

    Args:
        tasks: those that it knows, as for :func:`resolve_tasks`; a :class:`Task` brings its own description.
        condition: "description", the text's vector; "one-hot", one number for each task, which knows no words.
        features, feature_noise, latent_size, encoder_width, encoder_depth, text_encoder, in_keys, out_keys: as for
            :class:`PlanEncoder`; ``features`` other than "opening" and "none".

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
        if features in ("opening", "none"):
            raise ValueError(
                f"features={features!r} shows nothing of where things are; only plans with roles or focus do"
            )
        self.definitions = named_tasks(tasks)
        self.tasks, self.layout = tuple(self.definitions), one_layout(self.definitions.values())
        self.in_keys = as_keys("in_keys", in_keys, ("observation", "task_id"))
        self.out_keys = as_keys("out_keys", out_keys, ("encoding",))
        check_apart(self.in_keys, self.out_keys)
        seen = dict(condition=condition, features=features, feature_noise=feature_noise)
        texts = dict(latent_size=latent_size, encoder_width=encoder_width, encoder_depth=encoder_depth)
        self.config: dict[str, Any] = {**seen, **texts, "in_keys": self.in_keys}
        self.text_encoder = text_encoder
        own = (lambda texts: torch.eye(len(texts))) if text_encoder is None and condition == "one-hot" else text_encoder
        found = encoded([task.description for task in self.definitions.values()], own)
        self.index = TaskIndex(task_ids(self.tasks))
        order = [self.tasks.index(task) for task in self.index.tasks]
        # A product of another number of rows rounds differently: whatever the tasks, there are 50 or more.
        fill = found.new_zeros(max(0, len(MT50) - len(order)), found.shape[1])
        vectors = torch.cat((unit_scale(found)[order], fill))
        self.register_buffer("text_vectors", vectors, persistent=False)
        self.latent_size = latent_size
        self.texts = text_to_latent(found.shape[1], latent_size, encoder_width, encoder_depth)
        self.features = ObservationFeatures(features, feature_noise, self.layout)

    def definition(self, task: str) -> Task | None:
        return self.definitions.get(task)

    def prepare(self, tensordict: TensorDictBase) -> tuple[Tensor, ...]:
        """Each task's row (B,) int64, and the observation's features (B, F)."""
        observation, task_id = self.read(tensordict)
        rows = self.index.rows(task_id, "tasks this actor was not made for")
        return rows, self.features(observation)

    def encode(self, *prepared: Tensor) -> Encoding:
        rows, seen = prepared
        return Encoding(self.texts(self.text_vectors)[: len(self.tasks)][rows], seen)


class DescriptorConditionedActor(ConditionedActor):
    """The description's latent and the observation give the action: the paper's descriptor conditioning (DC).

    Reads ``observation`` (B, 39) float32 and ``task_id`` (B,) int64; writes ``action`` (B, 4) float32 in (-1, 1);
    with a distribution also ``loc`` and ``scale`` (B, 4) float32 and ``action_log_prob`` (B,) float32.

    Args:
        tasks: the tasks it is to act in, see :class:`DescriptorEncoder`.
        **options: of :class:`ConditionedActor` and of :class:`DescriptorEncoder`; ``out_keys`` are the actor's.

    Raises:
        ValueError: an unknown task; at call time, a task_id outside ``tasks``.

    Example:
        >>> import lw_torchrl as lw
        >>> lw.DescriptorConditionedActor("MT10")(lw.LanguageWorldEnv("reach").reset())["action"].shape
        torch.Size([1, 4])

    Source: paper section 'Conditional Plan Experiments'.
    """

    encoder_class = DescriptorEncoder
    encoder: DescriptorEncoder

    @passes_on(ConditionedActor.__init__, DescriptorEncoder.__init__)
    def __init__(self, tasks: str | Iterable[str | Task], **options: Any) -> None:
        super().__init__(tasks, **options)

    @classmethod
    def for_plans(cls, plans: Plans, *, text_encoder: TextEncoder | None = None, **options: Any) -> Self:
        return cls([plan.definition for plan in plans.values()], text_encoder=text_encoder, **options)

    @classmethod
    def from_description(cls, found: Mapping[str, Any], text_encoder: TextEncoder | None = None) -> Self:
        return cls(described_tasks(found), text_encoder=text_encoder, **found["options"])
