"""DescriptorConditionedActor: the baseline that is conditioned on the task's description instead of a plan."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal

from tensordict.utils import NestedKey

from lw_torchrl._checks import checked
from lw_torchrl.language.plans import Plans
from lw_torchrl.language.tasks import Task
from lw_torchrl.language.text import TextEncoder
from lw_torchrl.modules.action_head import DistributionName
from lw_torchrl.modules.conditioned_actor import ConditionedActor, noise_of_features
from lw_torchrl.modules.descriptor_encoder import DescriptorEncoder
from lw_torchrl.modules.observation_features import Features


class DescriptorConditionedActor(ConditionedActor):
    """The description's latent and the observation give the action: the paper's descriptor conditioning (DC).

    Reads ``observation`` (B, 39) float32 and ``task_id`` (B,) int64; writes ``action`` (B, 4) float32 in (-1, 1);
    with a distribution also ``loc`` and ``scale`` (B, 4) float32 and ``action_log_prob`` (B,) float32.

    Args:
        tasks: the tasks it is to act in, as for :func:`resolve_tasks`; a :class:`Task` in a list brings its own
            description.
        condition: "description", the text's vector; "one-hot", one number for each task, which knows no words.
        features, feature_noise, latent_size, width, depth, encoder_width, encoder_depth, squash, distribution,
            init_std, text_encoder, in_keys, out_keys: as for :class:`PlanConditionedActor`, with the same networks.

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

    encoder: DescriptorEncoder

    @checked
    def __init__(
        self,
        tasks: str | Iterable[str | Task],
        *,
        condition: Literal["description", "one-hot"] = "description",
        features: Features = "differences",
        feature_noise: float | None = None,
        latent_size: int = 64,
        width: int | tuple[int, ...] = 256,
        depth: int = 3,
        encoder_width: int = 128,
        encoder_depth: int = 1,
        squash: bool = True,
        distribution: DistributionName | None = None,
        init_std: float = 0.3,
        text_encoder: TextEncoder | None = None,
        in_keys: Sequence[NestedKey] | None = None,
        out_keys: Sequence[NestedKey] | None = None,
    ) -> None:
        encoder = DescriptorEncoder(
            tasks,
            condition=condition,
            features=features,
            feature_noise=noise_of_features(feature_noise, distribution),
            latent_size=latent_size,
            encoder_width=encoder_width,
            encoder_depth=encoder_depth,
            text_encoder=text_encoder,
            in_keys=in_keys,
        )
        super().__init__(
            encoder,
            (),
            width=width,
            depth=depth,
            squash=squash,
            distribution=distribution,
            init_std=init_std,
            out_keys=out_keys,
        )

    @classmethod
    def for_plans(
        cls, plans: Plans, *, text_encoder: TextEncoder | None = None, **options: Any
    ) -> DescriptorConditionedActor:
        return cls([plan.definition for plan in plans.values()], text_encoder=text_encoder, **options)

    @classmethod
    def from_description(
        cls, found: Mapping[str, Any], text_encoder: TextEncoder | None = None
    ) -> DescriptorConditionedActor:
        own = {name: Task.from_json(name, row) for name, row in found["own_tasks"].items()}
        tasks = [own.get(name, name) for name in found["tasks"]]
        return cls(tasks, text_encoder=text_encoder, **found["options"])
