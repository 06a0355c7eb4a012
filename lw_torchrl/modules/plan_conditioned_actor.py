"""PlanConditionedActor: a policy that follows a conditional plan, with four replaceable parts."""

from __future__ import annotations

from collections import OrderedDict
from typing import TYPE_CHECKING, Any, Self

from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import nn
from torchrl.data import Composite

from lw_torchrl._util.checks import typed
from lw_torchrl._util.keys import Keys
from lw_torchrl.language.task_index import as_plans
from lw_torchrl.language.text import TextEncoder
from lw_torchrl.modules.attention import PlanAttention
from lw_torchrl.modules.decoder import MLPDecoder, as_decoder
from lw_torchrl.modules.features import as_features
from lw_torchrl.modules.mixer import SkillMixer
from lw_torchrl.modules.parts import NamedParts, action_spec, check_same_plans, follow, in_mode_of, trunk_attributes

if TYPE_CHECKING:
    from lw_torchrl.language.plans import AnyPlans
    from lw_torchrl.modules.stochastic import DistributionName, StochasticActor


def plan_trunk(
    plans: AnyPlans,
    *,
    skill_encoder: nn.Module | None = None,
    features: nn.Module | None = None,
    text_encoder: TextEncoder | None = None,
) -> TensorDictSequential:
    """Build a trunk of attention, mixer and features, which writes the latent of the active skills and the features.

    Reads ``qaf`` (B, S) bool, ``task_id`` (B,) int64 and ``observation`` (B, 39) float32; writes ``skill_weights``
    (B, S), ``skill_latent`` (B, D) and ``features`` (B, F) float32. See :class:`PlanConditionedActor` for the
    arguments; here the default features have no noise.
    """
    attention, mixer = PlanAttention(plans), SkillMixer(plans, skill_encoder, text_encoder=text_encoder)
    features = as_features(features, mixer.plans.layout)
    return TensorDictSequential(OrderedDict(attention=attention, mixer=mixer, features=features))


class ConditionedActor(NamedParts):
    """A policy made of a trunk, which writes a latent and features, and a decoder, which maps both to the action.

    Reads the trunk's input keys; writes the output keys of trunk and decoder, ``action`` (B, A) float32 last. Each part
    is an attribute and can be replaced: ``actor.decoder = network``.

    Args:
        trunk: a sequence of named parts; the last two keys that the trunk writes are a latent (B, D) and
            features (B, F).
        decoder: a module that maps latent and features (B, D + F) float32 to the action (B, A), or a TensorDict module;
            None for :class:`MLPDecoder`.
        in_keys: replacements for the keys that the policy reads, in the order of ``in_keys``; nested keys are allowed.
        out_keys: the keys for the outputs of a plain decoder; None for ``action``.

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
        """Build an actor from a trunk and a decoder."""
        actor = cls.__new__(cls)
        ConditionedActor.__init__(actor, trunk, decoder)  # the arguments of subclasses differ
        return actor

    @property
    def config(self) -> dict[str, Any]:
        """The arguments of :meth:`rebuild`, from which a saved actor is reconstructed."""
        return {"trunk": self.trunk, "decoder": self.decoder}

    @property
    def trunk(self) -> TensorDictSequential:
        """The policy without its decoder. The trunk shares the policy's weights; critics can be built on the trunk."""
        return TensorDictSequential(OrderedDict([*self.module.items()][:-1]))

    @property
    def spec(self) -> Composite:
        """The spec of the action, (A,) float32 in [-1, 1], which TorchRL's losses read."""
        written = self.decoder.out_keys_source
        return action_spec(written[0] if len(written) == 1 else "action", self.layout)

    def with_plans(self, plans: AnyPlans) -> Self:
        """Return an actor that follows different plans but shares the networks: training one also trains the other."""
        parts = {name: follow(part, plans) for name, part in self.module.items()}
        decoder = parts.pop("decoder")
        return in_mode_of(self, self.rebuild(TensorDictSequential(OrderedDict(parts)), decoder))

    def stochastic(self, distribution: DistributionName = "tanh_normal", init_std: float = 0.3) -> StochasticActor:
        """Return a copy that samples its actions, for RL; see :class:`~lw_torchrl.modules.StochasticActor`."""
        from lw_torchrl.modules.stochastic import StochasticActor

        return StochasticActor.of(self, distribution, init_std)


class PlanConditionedActor(ConditionedActor):
    """The policy of Plan Conditioned Behavioral Cloning.

    The policy attends to the skills whose conditions are true (to all equally if none is), mixes their latents, and
    decodes the mixture and the observation's features into an action. The parts, for B rows, S steps in the
    longest plan and latents of size D:

    ====================  ============================================  =================================
    part                  reads                                         writes
    ====================  ============================================  =================================
    ``attention``         ``qaf`` (B, S), ``task_id`` (B,)              ``skill_weights`` (B, S) float32
    ``mixer``             ``skill_weights``, ``task_id``                ``skill_latent`` (B, D) float32
    ``features``          ``observation`` (B, 39), ...                  ``features`` (B, F) float32
    ``decoder``           ``skill_latent``, ``features``                ``action`` (B, 4) float32
    ====================  ============================================  =================================

    Each part is an attribute and can be replaced: ``actor.decoder = network``. Features add noise only in training;
    a trainer or :func:`~lw_torchrl.training.fit_normalization` fits the statistics of the features.

    Args:
        plans: a plan for each task that the policy will see.
        skill_encoder: a module that maps skill vectors (K, E) to latents (K, D); None for :class:`SkillEncoder`.
        features: a module that maps an observation to features (B, F), or a TensorDict module with any input keys; None
            for :class:`ObservationFeatures` with noise 0.05. :class:`Concat` joins several feature modules.
        decoder: a module that maps (B, D + F) to the action (B, A), or a TensorDict module; None for
            :class:`MLPDecoder`.
        text_encoder: a function that maps n texts to vectors (n, E) float32; None for the shipped sentence encoder.
        in_keys: replacements for the keys ``qaf``, ``task_id`` and ``observation``; nested keys are allowed. For plans
            with fallback steps (see :func:`~lw_torchrl.canonical_plans`), ``turn`` comes before ``observation``.
        out_keys: the keys for the outputs of a plain decoder; None for ``action``.

    Raises:
        ValueError: at call time, a task has no plan, or ``qaf`` belongs to other plans.
        ImportError: a skill text has no precomputed embedding, and the extra ``[text]`` is not installed.

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
