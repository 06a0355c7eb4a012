"""DescriptorConditionedActor: the baseline that is conditioned on the task's description instead of a plan."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor

from lw_torchrl._checks import check_choice
from lw_torchrl._keys import as_keys
from lw_torchrl.language.plans import Plans
from lw_torchrl.language.task_index import TaskIndex
from lw_torchrl.language.tasks import MT50, TASKS, Task, named_tasks
from lw_torchrl.language.text import encode_texts
from lw_torchrl.modules.decoder import ActionDecoder, text_to_latent, unit_scale
from lw_torchrl.modules.observation_features import Features
from lw_torchrl.modules.policy import Policy, TextEncoding


def _one_hot(texts: Sequence[str]) -> Tensor:
    return torch.eye(len(texts))


class DescriptorConditionedActor(Policy):
    """The description's latent and the observation give the action: the paper's descriptor conditioning (DC).

    Reads ``observation`` (B, 39) float32 and ``task_id`` (B,) int64; writes ``action`` (B, 4) float32 in (-1, 1).

    Args:
        tasks: the tasks it is to act in, as for :func:`resolve_tasks`; a :class:`Task` in a list brings its own
            description.
        condition: "description", the text's vector; "one-hot", one number for each task, which knows no words.
        features, feature_noise, latent_size, width, depth, encoder_width, encoder_depth, squash, text_encoder,
            in_keys, out_keys: as for :class:`PlanConditionedActor`, with the same networks.

    Raises:
        ValueError: an unknown task, a wrong option, or at call time a task_id outside ``tasks``.

    Example:
        >>> import lw_torchrl as lw
        >>> env = lw.LanguageWorldEnv("reach")
        >>> lw.DescriptorConditionedActor("MT10")(env.reset())["action"].shape
        torch.Size([1, 4])
        >>> env.close()

    Source: paper section 'Conditional Plan Experiments'.
    """

    text_vectors: Tensor

    def __init__(
        self,
        tasks: str | Iterable[str | Task],
        *,
        condition: Literal["description", "one-hot"] = "description",
        features: Features = "differences",
        feature_noise: float = 0.05,
        latent_size: int = 64,
        width: int | tuple[int, ...] = 256,
        depth: int = 3,
        encoder_width: int = 128,
        encoder_depth: int = 1,
        squash: bool = True,
        text_encoder: TextEncoding | None = None,
        in_keys: Sequence[NestedKey] | None = None,
        out_keys: Sequence[NestedKey] | None = None,
    ) -> None:
        super().__init__()
        self.definitions = named_tasks(tasks)
        self.tasks = tuple(self.definitions)
        self.in_keys = as_keys("in_keys", in_keys, ("observation", "task_id"))
        self.out_keys = as_keys("out_keys", out_keys, ("action",))
        self.config: dict[str, Any] = {
            "condition": check_choice("condition", condition, ("description", "one-hot")),
            "features": features,
            "feature_noise": feature_noise,
            "latent_size": latent_size,
            "width": width,
            "depth": depth,
            "encoder_width": encoder_width,
            "encoder_depth": encoder_depth,
            "squash": squash,
            "in_keys": self.in_keys,
            "out_keys": self.out_keys,
        }
        encode = text_encoder or (encode_texts if condition == "description" else _one_hot)
        found = encode([task.description for task in self.definitions.values()])
        if found.ndim != 2 or len(found) != len(self.tasks):
            raise ValueError(f"text_encoder must give ({len(self.tasks)}, E), got shape {tuple(found.shape)}")
        self.index = TaskIndex(self.tasks)
        order = [self.tasks.index(task) for task in self.index.tasks]
        # A product of another number of rows rounds differently: whatever the tasks, there are 50 or more.
        fill = found.new_zeros(max(0, len(MT50) - len(order)), found.shape[1])
        vectors = torch.cat((unit_scale(found)[order], fill))
        self.register_buffer("text_vectors", vectors, persistent=False)
        self.encoder = text_to_latent(found.shape[1], latent_size, encoder_width, encoder_depth)
        self.decoder = ActionDecoder(latent_size, features, feature_noise, width, depth, squash)

    @classmethod
    def for_plans(
        cls, plans: Plans, *, text_encoder: TextEncoding | None = None, **options: Any
    ) -> DescriptorConditionedActor:
        return cls([plan.definition for plan in plans.values()], text_encoder=text_encoder, **options)

    def definition(self, task: str) -> Task | None:
        return self.definitions.get(task)

    def prepare(self, tensordict: TensorDictBase) -> tuple[Tensor, ...]:
        """What no trained parameter touches: each task's row (B,) int64, and the observation's features (B, F)."""
        observation, task_id = self.read(tensordict)
        rows = self.index.rows(task_id, "tasks this actor was not made for")
        return rows, self.decoder.features(observation)

    def act(self, *prepared: Tensor) -> tuple[Tensor]:
        """From what :meth:`prepare` gives: action (B, 4)."""
        rows, seen = prepared
        return (self.decoder.decode(self.encoder(self.text_vectors)[rows], seen),)

    def describe(self) -> dict[str, Any]:
        own = {name: task.to_json() for name, task in self.definitions.items() if task != TASKS.get(name)}
        return super().describe() | {"tasks": list(self.tasks), "own_tasks": own}

    @classmethod
    def from_description(
        cls, found: Mapping[str, Any], text_encoder: TextEncoding | None = None
    ) -> DescriptorConditionedActor:
        own = {name: Task.from_json(name, row) for name, row in found["own_tasks"].items()}
        tasks = [own.get(name, name) for name in found["tasks"]]
        return cls(tasks, text_encoder=text_encoder, **found["options"])

    def fit_normalization(self, observation: Tensor, weights: Tensor | None = None) -> None:
        """Take the features' mean and standard deviation, in place, from observations (R, 39) float32; ``weights`` (R,)
        float32, with the sum 1, tell how much each counts."""
        self.decoder.features.fit(observation, weights)
