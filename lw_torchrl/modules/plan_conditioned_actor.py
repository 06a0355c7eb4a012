"""Policies that follow conditional plans and have replaceable parts: PlanConditionedActor and StochasticActor."""

from __future__ import annotations

import copy
from collections import OrderedDict
from typing import TYPE_CHECKING, Any, Literal, Self

import torch
from tensordict.nn import (
    InteractionType,
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModuleBase,
    TensorDictSequential,
)
from torch import nn
from torchrl.data import Composite
from torchrl.modules import IndependentNormal, TanhNormal

from lw_torchrl._util.checks import typed
from lw_torchrl._util.keys import Keys, key_beside
from lw_torchrl.language.task_index import as_plans
from lw_torchrl.language.text import TextEncoder
from lw_torchrl.modules.attention import PlanAttention
from lw_torchrl.modules.decoder import Decode, GaussianDecoder, MLPDecoder, as_decoder
from lw_torchrl.modules.features import Features, as_features
from lw_torchrl.modules.mixer import SkillMixer
from lw_torchrl.modules.parts import (
    NamedParts,
    action_spec,
    check_same_plans,
    encoding_width,
    follow,
    in_mode_of,
    materialize,
    trunk_attributes,
)

if TYPE_CHECKING:
    from lw_torchrl.language.plans import AnyPlans

DistributionName = Literal["tanh_normal", "normal"]
DISTRIBUTIONS: dict[str, Any] = {"tanh_normal": TanhNormal, "normal": IndependentNormal}


def plan_trunk(
    plans: AnyPlans,
    *,
    skill_encoder: nn.Module | None = None,
    features: nn.Module | None = None,
    text_encoder: TextEncoder | None = None,
) -> TensorDictSequential:
    """Build a trunk from attention, mixer and features. It writes the latent of the active skills and the features.

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
        in_keys: replacements for the keys that the policy reads, in the same order; nested keys are allowed.
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
        """Return an actor for another set of plans that shares the networks: training one also trains the other."""
        parts = {name: follow(part, plans) for name, part in self.module.items()}
        decoder = parts.pop("decoder")
        return in_mode_of(self, self.rebuild(TensorDictSequential(OrderedDict(parts)), decoder))

    def stochastic(self, distribution: DistributionName = "tanh_normal", init_std: float = 0.3) -> StochasticActor:
        """Return a copy that samples its actions, for RL; see :class:`~lw_torchrl.modules.StochasticActor`."""
        return StochasticActor.of(self, distribution, init_std)


class PlanConditionedActor(ConditionedActor):
    """The policy of Plan Conditioned Behavioral Cloning.

    The policy attends to the skills whose conditions are true (to all skills equally if no condition is true), mixes
    the latents of these skills, and decodes the mixture and the observation's features into an action. The table
    lists the parts for B rows, S steps in the longest plan and latents of size D:

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


class StochasticActor(NamedParts, ProbabilisticTensorDictSequential):
    """A policy that samples its actions from a Normal distribution, like TorchRL's ``ProbabilisticActor``.

    Reads the trunk's input keys; writes the trunk's output keys, ``loc``, ``scale`` and ``action`` (B, A) float32, and
    ``action_log_prob`` (B,) float32. The action is a sample under ``set_exploration_type(ExplorationType.RANDOM)`` and
    the mode otherwise.

    Args:
        trunk: a sequence of named parts, see :class:`ConditionedActor`.
        decoder: a TensorDict module that writes the Normal's mean and standard deviation.
        distribution: "tanh_normal", a Normal squashed by tanh; "normal", a Normal whose samples the environment clips.
        action: the key of the action.

    Example:
        >>> import lw_torchrl as lw
        >>> actor = lw.PlanConditionedActor(lw.load_plans("MT10")).stochastic("tanh_normal", init_std=0.2)
        >>> actor.out_keys[-4:]
        ['loc', 'scale', 'action', 'action_log_prob']

    Source: ``torchrl.modules.ProbabilisticActor``.
    """

    @typed
    def __init__(
        self,
        trunk: TensorDictSequential,
        decoder: TensorDictModuleBase,
        distribution: DistributionName = "tanh_normal",
        *,
        action: Any = "action",
    ) -> None:
        action = tuple(action) if isinstance(action, list) else action  # JSON has no tuples
        loc, scale = decoder.out_keys
        if isinstance(decoder, Decode) and (width := encoding_width(trunk)) is not None:
            materialize(decoder.network, torch.zeros(1, width, dtype=torch.float32))
        sampler = ProbabilisticTensorDictModule(
            in_keys={"loc": loc, "scale": scale},
            out_keys=[action],
            distribution_class=DISTRIBUTIONS[distribution],
            default_interaction_type=InteractionType.DETERMINISTIC,
            return_log_prob=True,
            log_prob_key=key_beside(action, "_log_prob"),
        )
        super().__init__(OrderedDict(**dict(trunk.module.items()), decoder=decoder, sampler=sampler))
        self.plans, self.tasks, self.layout = trunk_attributes(trunk)
        self.distribution, self.action = distribution, action

    @classmethod
    def of(cls, actor: Any, distribution: DistributionName, init_std: float) -> StochasticActor:
        """Make a stochastic copy of an actor, with the actor's action as the mode and without noise in the features.

        Raises:
            TypeError: the actor's decoder is not an :class:`MLPDecoder`.
            ValueError: ``distribution`` is "tanh_normal", but the actor does not squash its actions.
        """
        old = getattr(actor.decoder, "network", None)
        if not isinstance(old, MLPDecoder):
            kind = type(old or actor.decoder).__name__
            raise TypeError(f"stochastic() needs an MLPDecoder, got {kind}; or use torchrl.modules.ProbabilisticActor")
        if distribution == "tanh_normal" and not old.squash:
            raise ValueError("distribution 'tanh_normal' squashes actions, but this actor does not; use 'normal'")
        options = {**old.config, "squash": distribution == "normal" and old.squash, "init_std": init_std}
        with torch.random.fork_rng(devices=[]):  # the new weights are overwritten: keep the global random state
            decoder = GaussianDecoder(**options)
            materialize(decoder, torch.zeros(1, old[0].weight.shape[-1], dtype=old[0].weight.dtype))
        decoder.to(next(old.parameters())).copy_from(old)
        trunk = copy.deepcopy(actor.trunk)
        for part in trunk.modules():
            if isinstance(part, Features):
                part.noise = 0.0
        action = actor.decoder.out_keys_source[0]
        keys = ["loc", "scale"] if isinstance(action, str) else [(*action[:-1], name) for name in ("loc", "scale")]
        decode = Decode(decoder, in_keys=actor.decoder.in_keys, out_keys=keys)
        return cls(trunk, decode, distribution, action=action).train(actor.training)

    @property
    def config(self) -> dict[str, Any]:
        """The keyword arguments that reconstruct this module."""
        options = {"distribution": self.distribution, "action": self.action}
        return {"trunk": self.trunk, "decoder": self.module["decoder"], **options}

    def as_part(self, name: str, module: nn.Module) -> TensorDictModuleBase:
        raise TypeError(f"{name} of a StochasticActor cannot be replaced; replace it in the actor before you wrap it")

    @property
    def spec(self) -> Composite:
        """The spec that TorchRL's losses read: ``action`` (A,) float32 in [-1, 1]."""
        return action_spec(self.action, self.layout)

    @property
    def trunk(self) -> TensorDictSequential:
        """The policy without its decoder and sampler. It shares the policy's weights; critics can be built on it."""
        return TensorDictSequential(OrderedDict([*self.module.items()][:-2]))

    def with_plans(self, plans: Any) -> StochasticActor:
        """Return a policy for another set of plans that shares the networks: training one also trains the other."""
        options: dict[str, Any] = {**self.config, "trunk": follow(self.trunk, plans)}
        return in_mode_of(self, StochasticActor(**options))
