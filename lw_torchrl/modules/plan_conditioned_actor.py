"""PlanConditionedActor: a conditional plan as a policy, in four parts that can be replaced."""

from __future__ import annotations

from collections import OrderedDict
from typing import TYPE_CHECKING, Any, Self

from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import nn
from torchrl.data import Composite

from lw_torchrl._util.checks import typed
from lw_torchrl._util.keys import Keys
from lw_torchrl.language.plans import AnyPlans, as_plans
from lw_torchrl.language.text import TextEncoder
from lw_torchrl.modules.attention import PlanAttention
from lw_torchrl.modules.decoder import MLPDecoder, as_decoder
from lw_torchrl.modules.features import as_features
from lw_torchrl.modules.mixer import SkillMixer
from lw_torchrl.modules.parts import NamedParts, action_spec, check_same_plans, follow, in_mode_of, trunk_attributes

if TYPE_CHECKING:
    from lw_torchrl.modules.stochastic import DistributionName, StochasticActor


def plan_trunk(
    plans: AnyPlans,
    *,
    skill_encoder: nn.Module | None = None,
    features: nn.Module | None = None,
    text_encoder: TextEncoder | None = None,
) -> TensorDictSequential:
    """Return attention, mixer and features as one sequence: the latent of the active skills, and the features.

    Reads ``qaf`` (B, S) bool, ``task_id`` (B,) int64 and ``observation`` (B, 39) float32; writes ``skill_weights``
    (B, S), ``skill_latent`` (B, D) and ``features`` (B, F) float32. The arguments are :class:`PlanConditionedActor`'s,
    but the default features have no noise.
    """
    attention, mixer = PlanAttention(plans), SkillMixer(plans, skill_encoder, text_encoder=text_encoder)
    features = as_features(features, mixer.plans.layout)
    return TensorDictSequential(OrderedDict(attention=attention, mixer=mixer, features=features))


class ConditionedActor(NamedParts):
    """A policy made of a trunk, which writes a latent and features, and a decoder, which maps them to the action.

    Reads what the trunk reads; writes what the trunk and the decoder write, ``action`` (B, A) float32 last. Each part
    is an attribute of its name, and can be replaced: ``actor.decoder = network``.

    Args:
        trunk: a sequence of named parts; the last two keys that it writes are a latent (B, D) and features (B, F).
        decoder: any module from latent and features, (B, D + F) float32, to the action (B, A), or a TensorDict module;
            None for :class:`MLPDecoder`.
        in_keys: other names for what the policy reads, in the order of ``in_keys``; nested keys are allowed.
        out_keys: the names of what a plain decoder returns; None for ``action``.

    Example:
        >>> import torch, lw_torchrl as lw
        >>> trunk = lw.modules.plan_trunk(lw.load_plans("MT10"))
        >>> lw.modules.ConditionedActor(trunk, torch.nn.LazyLinear(4)).out_keys
        ['skill_weights', 'skill_latent', 'features', 'action']
    """

    @typed
    def __init__(
        self,
        trunk: TensorDictSequential,
        decoder: nn.Module | None = None,
        *,
        in_keys: Keys | None = None,
        out_keys: Keys | None = None,
    ) -> None:
        plans, tasks, layout = trunk_attributes(trunk)
        decoder = MLPDecoder(actions=layout.action_size) if decoder is None else decoder
        super().__init__(OrderedDict(**trunk.module, decoder=as_decoder(decoder, trunk, out_keys)))
        check_same_plans(dict(self.module.items()))
        self.plans, self.tasks, self.layout = plans, tasks, layout
        if in_keys is not None:
            self.in_keys = in_keys

    def as_part(self, name: str, module: nn.Module) -> TensorDictModuleBase:
        if name == "decoder":
            has_keys = isinstance(module, TensorDictModuleBase)
            return as_decoder(module, self.trunk, None if has_keys else self.decoder.out_keys_source)
        return super().as_part(name, module)

    @classmethod
    def rebuild(cls, trunk: TensorDictSequential, decoder: TensorDictModuleBase) -> Self:
        """Return an actor of these parts."""
        actor = cls.__new__(cls)
        ConditionedActor.__init__(actor, trunk, decoder)  # subclasses have other arguments
        return actor

    @property
    def config(self) -> dict[str, Any]:
        """The arguments of :meth:`rebuild`, from which a file builds the actor again."""
        return {"trunk": self.trunk, "decoder": self.decoder}

    @property
    def trunk(self) -> TensorDictSequential:
        """All parts but the decoder, with the same weights; critics can be built on it."""
        return TensorDictSequential(OrderedDict([*self.module.items()][:-1]))

    @property
    def spec(self) -> Composite:
        """The specification of the action, (A,) float32 in [-1, 1], which TorchRL's losses read."""
        written = self.decoder.out_keys_source
        return action_spec(written[0] if len(written) == 1 else "action", self.layout)

    def with_plans(self, plans: AnyPlans) -> Self:
        """Return an actor with the same networks that follows other plans: training either trains both."""
        parts = {name: follow(part, plans) for name, part in self.module.items()}
        decoder = parts.pop("decoder")
        return in_mode_of(self, self.rebuild(TensorDictSequential(OrderedDict(parts)), decoder))

    def stochastic(self, distribution: DistributionName = "tanh_normal", init_std: float = 0.3) -> StochasticActor:
        """Return a copy that draws its actions, for RL, see :class:`~lw_torchrl.modules.StochasticActor`."""
        from lw_torchrl.modules.stochastic import StochasticActor

        return StochasticActor.of(self, distribution, init_std)


class PlanConditionedActor(ConditionedActor):
    """Plan Conditioned Behavioral Cloning's policy.

    The policy attends to the skills whose conditions are true (to all alike if none is), mixes their latents, and
    decodes the mixture and the observation's features into an action. With B rows, S steps of the longest plan and
    latents of size D:

    ====================  ============================================  =================================
    part                  reads                                         writes
    ====================  ============================================  =================================
    ``attention``         ``qaf`` (B, S), ``task_id`` (B,)              ``skill_weights`` (B, S) float32
    ``mixer``             ``skill_weights``, ``task_id``                ``skill_latent`` (B, D) float32
    ``features``          ``observation`` (B, 39), ...                  ``features`` (B, F) float32
    ``decoder``           ``skill_latent``, ``features``                ``action`` (B, 4) float32
    ====================  ============================================  =================================

    Each part is an attribute and can be replaced: ``actor.decoder = network``. Features draw noise only in training;
    a trainer, or :func:`~lw_torchrl.training.fit_normalization`, fits their statistics.

    Args:
        plans: a plan for each task that the policy will see.
        skill_encoder: any module from skill vectors (K, E) to latents (K, D); None for :class:`SkillEncoder`.
        features: any module from an observation to features (B, F), or a TensorDict module with other inputs; None for
            :class:`ObservationFeatures` with noise 0.05. Several are joined by :class:`Concat`.
        decoder: any module from (B, D + F) to the action (B, A), or a TensorDict module; None for :class:`MLPDecoder`.
        text_encoder: a function from n texts to vectors (n, E) float32; None for the shipped sentence encoder.
        in_keys: other names for ``qaf``, ``task_id`` and ``observation``; nested keys are allowed. With fallback steps,
            see :func:`~lw_torchrl.canonical_plans`, ``turn`` stands before ``observation``.
        out_keys: the names of what a plain decoder returns; None for ``action``.

    Raises:
        ValueError: at call time, a task without a plan, or ``qaf`` of other plans.
        ImportError: a skill's text is not shipped, and the extra ``[text]`` is not installed.

    Example:
        >>> import lw_torchrl as lw
        >>> from torch import nn
        >>> from torchrl.envs import TransformedEnv
        >>> plans = lw.load_plans("MT10")
        >>> actor = lw.PlanConditionedActor(plans, decoder=nn.Sequential(nn.LazyLinear(4), nn.Tanh()))
        >>> actor(TransformedEnv(lw.LanguageWorldEnv("reach"), lw.QAFTransform(plans)).reset())["action"].shape
        torch.Size([1, 4])

    Source: paper section 'Plan Conditioning' and its figure of the architecture.
    """

    @typed
    def __init__(
        self,
        plans: AnyPlans,
        *,
        skill_encoder: nn.Module | None = None,
        features: nn.Module | None = None,
        decoder: nn.Module | None = None,
        text_encoder: TextEncoder | None = None,
        in_keys: Keys | None = None,
        out_keys: Keys | None = None,
    ) -> None:
        features = as_features(features, as_plans(plans).layout, noise=0.05)
        trunk = plan_trunk(plans, skill_encoder=skill_encoder, features=features, text_encoder=text_encoder)
        super().__init__(trunk, decoder, in_keys=in_keys, out_keys=out_keys)
