"""DescriptorConditionedActor: the baseline that is conditioned on the task's description instead of a plan."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, Literal

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from torch import Tensor

from lw_torchrl._checks import check_choice
from lw_torchrl.language.task_index import TaskIndex
from lw_torchrl.language.tasks import MT50, TASKS, resolve_tasks
from lw_torchrl.language.text import encode_texts
from lw_torchrl.modules.decoder import ActionDecoder, text_to_latent, unit_scale
from lw_torchrl.modules.observation_features import Features


def _one_hot(texts: Sequence[str]) -> Tensor:
    return torch.eye(len(texts))


class DescriptorConditionedActor(TensorDictModuleBase):
    """The description's latent and the observation give the action: the paper's descriptor conditioning (DC).

    Reads ``observation`` (B, 39) float32 and ``task_id`` (B,) int64; writes ``action`` (B, 4) float32 in (-1, 1).

    Args:
        tasks: the tasks it is to act in, as for :func:`resolve_tasks`.
        condition: "description", the text's vector; "one-hot", one number for each task, which knows no words.
        features, feature_noise, latent_size, width, depth, encoder_width, encoder_depth, text_encoder: as for
            :class:`PlanConditionedActor`, with the same networks.

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

    in_keys = ["observation", "task_id"]
    out_keys = ["action"]
    description_vectors: Tensor

    def __init__(
        self,
        tasks: str | Iterable[str],
        *,
        condition: Literal["description", "one-hot"] = "description",
        features: Features = "differences",
        feature_noise: float = 0.05,
        latent_size: int = 64,
        width: int | tuple[int, ...] = 256,
        depth: int = 3,
        encoder_width: int = 128,
        encoder_depth: int = 1,
        text_encoder: Callable[[Sequence[str]], Tensor] | None = None,
    ) -> None:
        super().__init__()
        self.tasks = resolve_tasks(tasks)
        self.config: dict[str, Any] = {
            "condition": check_choice("condition", condition, ("description", "one-hot")),
            "features": features,
            "feature_noise": feature_noise,
            "latent_size": latent_size,
            "width": width,
            "depth": depth,
            "encoder_width": encoder_width,
            "encoder_depth": encoder_depth,
        }
        encode = text_encoder or (encode_texts if condition == "description" else _one_hot)
        found = encode([TASKS[task].description for task in self.tasks])
        if found.ndim != 2 or len(found) != len(self.tasks):
            raise ValueError(f"text_encoder must give ({len(self.tasks)}, E), got shape {tuple(found.shape)}")
        self.index = TaskIndex(self.tasks)
        order = [self.tasks.index(task) for task in self.index.tasks]
        # A product of another number of rows rounds differently: whatever the tasks, there are 50 or more.
        fill = found.new_zeros(max(0, len(MT50) - len(order)), found.shape[1])
        vectors = torch.cat((unit_scale(found)[order], fill))
        self.register_buffer("description_vectors", vectors, persistent=False)
        self.encoder = text_to_latent(found.shape[1], latent_size, encoder_width, encoder_depth)
        self.decoder = ActionDecoder(latent_size, features, feature_noise, width, depth)

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict.set("action", self.act(*self.prepare(tensordict))[0])

    def prepare(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        """What no trained parameter touches: each task's row (B,) int64, and the observation's features (B, F)."""
        task = tensordict.get("task_id")
        rows = self.index.rows(task, "tasks this actor was not made for")
        return rows, self.decoder.features(tensordict.get("observation"))

    def act(self, rows: Tensor, seen: Tensor) -> tuple[Tensor, Tensor]:
        """From what :meth:`prepare` gives: action (B, 4), and the task's latent (B, D)."""
        latent = self.encoder(self.description_vectors)[rows]
        return self.decoder.decode(latent, seen), latent

    def fit_normalization(self, observation: Tensor, weights: Tensor | None = None) -> None:
        """Take the features' mean and standard deviation, in place, from observations (R, 39) float32; ``weights`` (R,)
        float32, with the sum 1, tell how much each counts."""
        self.decoder.features.fit(observation, weights)
