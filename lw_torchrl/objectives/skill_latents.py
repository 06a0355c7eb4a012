"""SkillLatentLoss: what skills' latents should be to each other, as their texts are, or apart."""

from __future__ import annotations

from typing import Any, Literal

from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModule
from torch import Tensor
from torch.nn.functional import normalize
from torchrl.objectives import LossModule

from lw_torchrl._checks import checked
from lw_torchrl.modules.plan_encoder import PlanEncoder
from lw_torchrl.objectives.reduction import Reduction, let_go, set_reduction

Kind = Literal["consistency", "contrastive"]
_TEMPERATURE = 0.1


class SkillLatentLoss(LossModule):
    """A term on the latents of a plan's skills, to be added to any loss of the policy that has them.

    "consistency": skills whose texts are near stay near. The cosine of two latents is drawn to that of the texts'
    vectors: the mean over pairs of the squared difference. A new text then lies where texts like it are.

    "contrastive": latents of different skills keep apart. InfoNCE with each skill as its own positive and the others as
    negatives, at temperature 0.1; the least is 0. It draws nothing at random.

    It reads no batch, and gives ``loss_latents`` () float32, of K skills (K,) by ``reduction="none"``.

    Args:
        network: a :class:`PlanEncoder`, or a policy or critic with one, of two skills or more; it is trained itself.
        kind: "consistency" or "contrastive".
        reduction: "mean", "none" or "sum" of the skills' terms, each of which is a mean over the others.

    Raises:
        ValueError: a network without plans, fewer than two skills, or another kind.

    Example:
        >>> import lw_torchrl as lw
        >>> actor = lw.PlanConditionedActor(lw.load_plans("MT10"))
        >>> sorted(lw.objectives.SkillLatentLoss(actor)().keys())
        ['loss_latents']

    Source: paper, what it leaves to future work: 'regularization or contrastive learning'. "consistency": Tung, Mori,
    "Similarity-Preserving Knowledge Distillation", 2019. "contrastive": van den Oord, Li, Vinyals, "Representation
    Learning with Contrastive Predictive Coding", 2018; what remains is the uniformity of Wang, Isola, 2020.
    """

    out_keys = ["loss_latents"]
    in_keys: list[str] = []
    reduction: Reduction = "mean"

    encoder: TensorDictModule
    encoder_params: TensorDictParams
    target_encoder_params: TensorDictParams

    @checked
    def __init__(self, network: Any, kind: Kind = "consistency", *, reduction: Reduction | None = None) -> None:
        super().__init__()
        set_reduction(self, reduction)
        self.kind = kind
        self.convert_to_functional(skill_encoder("network", network), "encoder")

    def forward(self, tensordict: TensorDictBase | None = None) -> TensorDictBase:
        """The term."""
        with self.encoder_params.to_module(self.encoder, preserve_module_state=False):
            found = TensorDict(loss_latents=latent_term(self.encoder, self.kind, self.reduction))
        let_go(found, self.encoder_params)
        return found


def skill_encoder(argument: str, network: Any) -> PlanEncoder:
    """The encoder of a network that is one or has one; :class:`ValueError` if it has no two skills to tell apart."""
    encoder = network if isinstance(network, PlanEncoder) else getattr(network, "encoder", None)
    if not isinstance(encoder, PlanEncoder):
        what = f"{argument} is for policies with plans, whose skills have latents"
        raise ValueError(f"{what}; {type(network).__name__} has none")
    if len(encoder.skills) < 2:
        raise ValueError(f"{argument} is for plans of at least two different skills, got {', '.join(encoder.skills)}")
    return encoder


def latent_term(encoder: PlanEncoder, kind: Kind, reduction: Reduction = "mean") -> Tensor:
    """() float32, of K skills (K,) by "none", differentiable; works within ``vmap`` over the encoder's parameters."""
    latents = normalize(encoder.latents(), dim=-1)
    near = latents @ latents.mT
    if kind == "contrastive":
        apart = (near / _TEMPERATURE).logsumexp(-1)
        if reduction == "mean":
            return apart.mean() - 1.0 / _TEMPERATURE
        each = apart - 1.0 / _TEMPERATURE
    else:
        texts = normalize(encoder.text_vectors, dim=-1)
        off, others = (near - texts @ texts.mT).square(), len(texts) - 1  # the diagonal is 1 in both
        if reduction == "mean":
            return off.sum() / (len(texts) * others)
        each = off.sum(-1) / others
    return each if reduction == "none" else each.sum()
