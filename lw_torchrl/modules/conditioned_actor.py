"""ConditionedActor: an encoder and a head, with or without a distribution, as a policy."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Self

import torch
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictModule, ProbabilisticTensorDictSequential, TensorDictModuleBase
from tensordict.nn.probabilistic import InteractionType, interaction_type
from tensordict.utils import NestedKey
from torch import Tensor
from torch.distributions import Distribution
from torchrl.envs import Transform

from lw_torchrl._checks import check_choice, check_flag, check_int, checked, shown
from lw_torchrl._keys import as_keys, check_apart, dispatched, key_beside, read, write
from lw_torchrl.language.plans import AnyPlans, Plans
from lw_torchrl.language.tasks import Task
from lw_torchrl.language.text import TextEncoder
from lw_torchrl.modules.networks import DISTRIBUTIONS, ActionHead, DistributionName
from lw_torchrl.modules.policy import Encoder, Encoding, Policy, decided, kind_of
from lw_torchrl.modules.registry import ENCODERS, class_of

_OF_HEAD = ("width", "depth", "squash", "distribution", "init_std", "decided_gripper", "action_size", "out_keys")
_ALTERING = ("jitter", "swap_unmentioned")


class ConditionedActor(Policy):
    """A policy on any encoder: what all our actors are, whatever they are conditioned on.

    Reads what the encoder reads; writes ``action`` (B, 4) float32 and, of an encoder with plans, ``skill_weights``
    (B, S) and ``skill_latent`` (B, D) float32. With a distribution also ``loc`` and ``scale`` (B, 4) float32, those of
    the Normal, and ``action_log_prob`` (B,) float32; ``action`` is then drawn from it under
    ``set_exploration_type(ExplorationType.RANDOM)``, as collectors do, and its mode otherwise.

    Args:
        about: the encoder; of a subclass, which names the encoder's class, what that is conditioned on.
        feature_noise: standard deviation of the noise on the normalised features while training; None for 0.05, or 0
            with a distribution, whose likelihoods must not change from call to call. An encoder that is given has its
            own.
        width, depth: hidden layers of the action decoder; a tuple of widths says both.
        squash: keep each number of the action in (-1, 1) by tanh; without, as in the paper, the environment clips.
        distribution: None for a deterministic actor; for RL "tanh_normal", a Normal through tanh, or "normal", about
            the action, clipped by the environment.
        init_std: the Normal's initial standard deviation, in every state: before tanh for "tanh_normal".
        decided_gripper: when not training, open or close the gripper fully: half open fingers push things over, and
            half closed ones lose them. The effort above which it closes is the layout's ``closes_above``.
        action_size: A, the numbers of an action; None for those of the tasks' layout. A policy that was trained with
            another robot, see :class:`~lw_torchrl.modules.TransferredActor`, has that robot's.
        out_keys: other names for what it writes, in the order above; nested ones too.
        **options: of the encoder, where it is made here.

    Raises:
        TypeError: an encoder is given, and options of it too; or nothing says what the encoder is.

    Example:
        >>> import lw_torchrl as lw
        >>> from lw_torchrl.modules import ConditionedActor, DescriptorEncoder
        >>> actor = ConditionedActor(DescriptorEncoder("MT10"), width=64)
        >>> actor(lw.LanguageWorldEnv("reach").reset())["action"].shape
        torch.Size([1, 4])

    Attributes:
        dist_params_keys, log_prob_keys, dist_sample_keys: where it writes ``loc`` and ``scale``, the action's
            log-probability, and the action that is drawn; empty without a distribution.

    Source: ``torchrl.modules.ProbabilisticActor``, without its wrapping.
    """

    encoder_class: ClassVar[type[Encoder] | None] = None

    # What V-trace asks of an actor, as of TorchRL's own.
    default_interaction_type = InteractionType.DETERMINISTIC
    num_samples = None
    _dist_sample = ProbabilisticTensorDictModule._dist_sample

    @checked
    def __init__(
        self,
        about: Any,
        *,
        feature_noise: float | None = None,
        width: int | tuple[int, ...] = 256,
        depth: int = 3,
        squash: bool = True,
        distribution: DistributionName | None = None,
        init_std: float = 0.3,
        decided_gripper: bool = False,
        action_size: int | None = None,
        out_keys: Sequence[NestedKey] | None = None,
        **options: Any,
    ) -> None:
        super().__init__()
        if self.encoder_class is None:
            _check_encoder(about, options if feature_noise is None else {"feature_noise": feature_noise, **options})
            self.encoder = about
        else:
            if feature_noise is None:
                feature_noise = 0.05 if distribution is None else 0.0
            self.encoder = self.encoder_class(about, feature_noise=feature_noise, **options)
        if distribution is not None and any(self.encoder.config.get(name) for name in _ALTERING):
            raise ValueError(
                f"{' and '.join(_ALTERING)} must be 0 with a distribution, whose likelihood they "
                "would change from call to call; train an actor without one, and take actor.stochastic()"
            )
        head: Any = dict(width=width, depth=depth, squash=squash, distribution=distribution, init_std=init_std)
        self.layout = self.encoder.layout
        actions = self.layout.action_size if action_size is None else check_int("action_size", action_size, minimum=1)
        self.head = ActionHead(self.encoder.width, actions=actions, **head)
        self.plans, self.tasks, self.in_keys = self.encoder.plans, self.encoder.tasks, self.encoder.in_keys
        extras = () if self.plans is None else ("skill_weights", "skill_latent")
        drawn = () if distribution is None else ("loc", "scale", "action_log_prob")
        self._written = ("action", *extras, *drawn)
        self.decided_gripper = check_flag("decided_gripper", decided_gripper)
        if decided_gripper and distribution is not None:
            raise ValueError("decided_gripper must be false with a distribution, which draws any effort")
        own = {} if self.encoder_class is None else self.encoder.config
        self.config = {**own, **head, "decided_gripper": decided_gripper}
        if action_size is not None:
            self.config["action_size"] = action_size
        self.out_keys = as_keys("out_keys", out_keys, self._written)

    @property
    def out_keys(self) -> list[NestedKey]:
        """What is written, in this order; other names may be given."""
        return self._out_keys_apparent

    @out_keys.setter
    def out_keys(self, keys: Sequence[NestedKey]) -> None:
        named = as_keys("out_keys", keys, self._written)
        check_apart(self.in_keys, named)
        self._out_keys = self._out_keys_apparent = self.config["out_keys"] = named
        drawn = named if self.head.distribution is not None else []
        self.dist_params_keys, self.log_prob_keys, self.dist_sample_keys = drawn[-3:-1], drawn[-1:], drawn[:1]
        if self.head.distribution is not None:
            # KLPENPPOLoss looks for it here.
            self.sampler = ProbabilisticTensorDictModule(
                in_keys=dict(zip(("loc", "scale"), self.dist_params_keys, strict=True)),
                out_keys=self.dist_sample_keys,
                distribution_class=DISTRIBUTIONS[self.head.distribution],
                default_interaction_type=InteractionType.DETERMINISTIC,
                return_log_prob=True,
                log_prob_key=named[-1],
            )

    def definition(self, task: str) -> Task | None:
        return self.encoder.definition(task)

    def transform(self) -> Transform | None:
        return self.encoder.transform()

    def prepare(self, tensordict: TensorDictBase) -> tuple[Tensor, ...]:
        return self.encoder.prepare(tensordict)

    def extras(self, encoding: Encoding) -> tuple[Tensor, ...]:
        """What is written of an encoding beside the action: with plans attention (B, S) and the mixed latent (B, D)."""
        return () if encoding.weights is None else (encoding.weights, encoding.latent)

    def act(self, *prepared: Tensor) -> tuple[Tensor, ...]:
        if self.head.distribution is None:
            encoding = self.encoder.encode(*prepared)
            return self.decide(self.head(encoding.joined)), *self.extras(encoding)
        *extras, loc, scale = self.before_sampling(*prepared)
        dist = self.head.dist(loc, scale)
        action = dist.rsample() if interaction_type() is InteractionType.RANDOM else self.head.mode(loc)
        # PyTorch's log_prob raises for no rows.
        return action, *extras, loc, scale, dist.log_prob(action) if action.numel() else action.sum(-1)

    def decide(self, action: Tensor) -> Tensor:
        """The action; with ``decided_gripper``, and when not training, its effort is -1 or 1."""
        return decided(action, self.acts_in or self.layout) if self.decided_gripper and not self.training else action

    def before_sampling(self, *prepared: Tensor) -> tuple[Tensor, ...]:
        """From what :meth:`prepare` gives to the extras, ``loc`` and ``scale``."""
        encoding = self.encoder.encode(*prepared)
        return *self.extras(encoding), *self.head.loc_scale(encoding.joined)

    def get_dist(self, tensordict: TensorDictBase) -> Distribution:
        """The distribution of actions in these states, as losses ask for it; :class:`TypeError` without one."""
        return self.head.dist(*self._loc_scale(tensordict))

    def get_dist_params(self, tensordict: TensorDictBase) -> TensorDictBase:
        """``loc`` and ``scale`` in these states, written; what :meth:`get_dist` makes its distribution of."""
        for key, value in zip(self.dist_params_keys, self._loc_scale(tensordict), strict=True):
            tensordict.set(key, value)
        return tensordict

    def build_dist_from_params(self, tensordict: TensorDictBase) -> Distribution:
        """The distribution of ``loc`` and ``scale`` that were written before."""
        return self.head.dist(*read(tensordict, self.dist_params_keys))

    def log_prob(self, tensordict: TensorDictBase, *, dist: Distribution | None = None) -> Tensor:
        """The log-probability (B,) float32 of the ``action`` there, in these states or in ``dist``."""
        dist = self.get_dist(tensordict) if dist is None else dist
        (action,) = read(tensordict, self.dist_sample_keys)
        return dist.log_prob(action)

    def as_sequential(self) -> ProbabilisticTensorDictSequential:
        """The same actor and weights as a ProbabilisticTensorDictSequential; :class:`TypeError` without a distribution.

        Example:
            >>> import lw_torchrl as lw
            >>> actor = lw.PlanConditionedActor(lw.load_plans("MT10"), distribution="normal")
            >>> actor.as_sequential().dist_params_keys
            ['loc', 'scale']
        """
        self._require_distribution()
        made = ProbabilisticTensorDictSequential(_BeforeSampling(self), self.sampler)
        made.spec = self.spec
        return made

    def _require_distribution(self) -> None:
        if self.head.distribution is None:
            make = "make it with distribution='tanh_normal', or of a trained one by actor.stochastic()"
            raise TypeError(f"{type(self).__name__} has no distribution; {make}")

    def _loc_scale(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        self._require_distribution()
        return self.head.loc_scale(self.encoder.encode(*self.prepare(tensordict)).joined)

    def stochastic(self, distribution: DistributionName = "tanh_normal", init_std: float = 0.3) -> Self:
        """Return a copy with a distribution, whose mode is this actor's action, for RL.

        Its features have no noise, jitter or swaps.

        Args:
            distribution: "tanh_normal", or "normal", whose actions the environment clips.
            init_std: the initial standard deviation, as for :class:`PlanConditionedActor`.

        Raises:
            ValueError: it has a distribution already.

        Example:
            >>> import lw_torchrl as lw
            >>> trained = lw.PlanConditionedActor(lw.load_plans("MT10"))
            >>> trained.stochastic(init_std=0.2).out_keys
            ['action', 'skill_weights', 'skill_latent', 'loc', 'scale', 'action_log_prob']
        """
        if self.head.distribution is not None:
            raise ValueError(f"distribution: this actor has one already, {self.head.distribution!r}")
        found = self.describe()
        options = found["options"] = self.config | {
            "distribution": distribution,
            "init_std": init_std,
            "decided_gripper": False,
            "out_keys": [*self.out_keys_source, "loc", "scale", key_beside(self.out_keys_source[0], "_log_prob")],
        }
        if self.encoder_class is None:
            options = found["encoder"]["options"] = dict(self.encoder.config)
        options.update({name: 0.0 for name in ("feature_noise", *_ALTERING) if name in options})
        with torch.random.fork_rng(devices=[]):
            other = type(self).from_description(found, self.encoder.text_encoder)
        other.encoder.load_state_dict(self.encoder.state_dict())
        other.head.copy_from(self.head)
        return other.train(self.training)

    @classmethod
    def for_plans(
        cls, plans: Plans, *, text_encoder: TextEncoder | None = None, encoder: str = "PlanEncoder", **options: Any
    ) -> Self:
        """One on an encoder of a class in :data:`~lw_torchrl.modules.ENCODERS`, which gets the options it knows."""
        head = {name: options.pop(name) for name in _OF_HEAD if name in options}
        made = ENCODERS[check_choice("encoder", encoder, ENCODERS)]
        return cls(made.for_plans(plans, text_encoder=text_encoder, **options), **head)

    def with_plans(self, plans: AnyPlans) -> ConditionedActor:
        """An actor that carries out other plans with the same weights: training either trains both."""
        if self.plans is None:
            return super().with_plans(plans)
        encoder, options = self.encoder.with_plans(plans), dict(self.config)
        if self.head.actions != encoder.layout.action_size:
            options["action_size"] = self.head.actions
        other = ConditionedActor(encoder, **options)
        other.head = self.head
        return other.train(self.training)

    def describe(self) -> dict[str, Any]:
        told = self.encoder.describe()
        if self.encoder_class is None:
            told = {"encoder": {**kind_of(self.encoder), "options": self.encoder.config, **told}}
        return super().describe() | told

    @classmethod
    def from_description(cls, found: Mapping[str, Any], text_encoder: TextEncoder | None = None) -> Self:
        return cls(encoder_from_description(found["encoder"], text_encoder), **found["options"])

    def fit_normalization(self, observation: Tensor, weights: Tensor | None = None) -> None:
        self.encoder.features.fit(observation, weights)

    def fit_contacts(self, observation: Tensor, task_id: Tensor) -> None:
        self.encoder.fit_contacts(observation, task_id)


def encoder_from_description(found: Any, text_encoder: TextEncoder | None = None) -> Encoder:
    """The encoder that was described, with fresh weights; :class:`ValueError` if it is no known one."""
    if not isinstance(found, Mapping) or not isinstance(found.get("options"), Mapping):
        raise ValueError(f"an encoder's description must have kind and options, got {found!r:.80}")
    made: Encoder = class_of("kind of encoder", ENCODERS, found).from_description(found, text_encoder)
    return made


def _check_encoder(given: Any, options: Mapping[str, Any]) -> None:
    if not isinstance(given, Encoder):
        raise TypeError(f"about must be an Encoder, got {shown(given)}; one for plans is PlanEncoder(plans)")
    if options:
        raise TypeError(
            f"{', '.join(options)}: give it to the encoder, {type(given).__name__}(..., {next(iter(options))}=)"
        )


class _BeforeSampling(TensorDictModuleBase):
    """All of an actor but the draw of its action, which reads ``loc`` and ``scale``."""

    def __init__(self, actor: ConditionedActor) -> None:
        super().__init__()
        self.actor = actor
        self.in_keys, self.out_keys = actor.in_keys, actor.out_keys_source[1:-1]

    @dispatched
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return write(tensordict, self, self.actor.before_sampling(*self.actor.prepare(tensordict)))
