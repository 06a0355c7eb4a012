"""ConditionedActor: an encoder and a head, with or without a distribution, as a policy."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Self

import torch
from tensordict import TensorDictBase
from tensordict.nn import (
    InteractionType,
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModuleBase,
)
from tensordict.nn.probabilistic import interaction_type
from tensordict.utils import NestedKey
from torch import Tensor
from torch.distributions import Distribution
from torchrl.envs import Transform

from lw_torchrl._keys import as_keys, check_apart, dispatched, key_beside, read, write
from lw_torchrl.language.tasks import Task
from lw_torchrl.modules.encoder import Encoder, Encoding
from lw_torchrl.modules.networks import DISTRIBUTIONS, ActionHead, DistributionName
from lw_torchrl.modules.policy import Policy

_ALTERING = ("jitter", "swap_unmentioned", "hide_opening")


def noise_of_features(asked: float | None, distribution: str | None) -> float:
    """The noise asked for; by default none with a distribution, whose likelihoods it would change from call to call."""
    if asked is not None:
        return asked
    return 0.05 if distribution is None else 0.0


class ConditionedActor(Policy):
    """What all our actors share, whatever they are conditioned on; a subclass makes the encoder.

    Reads what the encoder reads; writes ``action`` (B, 4) float32 and what the encoder gives. With a distribution it
    writes ``loc`` and ``scale`` (B, 4) float32 and ``action_log_prob`` (B,) float32 too, and ``action`` is drawn from
    it under ``set_exploration_type(ExplorationType.RANDOM)``, as collectors do, and its mode otherwise.

    Args:
        encoder: what it is conditioned on.
        extras: the keys of what the encoder gives beside the action, of ("skill_weights", "skill_latent").
        out_keys: other names for what it writes, in the order above; nested ones too.
        **head: of :class:`ActionHead`.

    Source: ``torchrl.modules.ProbabilisticActor``, without its wrapping.
    """

    # What V-trace asks of an actor, as of TorchRL's own.
    default_interaction_type = InteractionType.DETERMINISTIC
    num_samples = None
    _dist_sample = ProbabilisticTensorDictModule._dist_sample

    def __init__(
        self, encoder: Encoder, extras: Sequence[str], *, out_keys: Sequence[NestedKey] | None, **head: Any
    ) -> None:
        super().__init__()
        distribution = head["distribution"]
        if distribution is not None and any(encoder.config.get(name) for name in _ALTERING):
            raise ValueError(
                f"{', '.join(_ALTERING[:-1])} and {_ALTERING[-1]} must be 0 with a distribution: in training mode they "
                "would change its likelihoods from call to call; train an actor without one, and take "
                "actor.stochastic()"
            )
        self.encoder = encoder
        self.head = ActionHead(encoder.width, **head)
        self.plans, self.tasks, self.in_keys = encoder.plans, encoder.tasks, encoder.in_keys
        drawn = () if distribution is None else ("loc", "scale", "action_log_prob")
        self._written = ("action", *extras, *drawn)
        self.config = {**encoder.config, **head}
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
        if self.head.distribution is not None:  # where KLPENPPOLoss looks for it
            action, *_, loc, scale, log_prob = named
            self.sampler = ProbabilisticTensorDictModule(
                in_keys={"loc": loc, "scale": scale},
                out_keys=[action],
                distribution_class=DISTRIBUTIONS[self.head.distribution],
                default_interaction_type=InteractionType.DETERMINISTIC,
                return_log_prob=True,
                log_prob_key=log_prob,
            )

    def definition(self, task: str) -> Task | None:
        return self.encoder.definition(task)

    def transform(self) -> Transform | None:
        return self.encoder.transform()

    def prepare(self, tensordict: TensorDictBase) -> tuple[Tensor, ...]:
        """What no trained parameter touches, see the encoder's."""
        return self.encoder.prepare(tensordict)

    def extras(self, encoding: Encoding) -> tuple[Tensor, ...]:
        """What is written of an encoding beside the action."""
        return ()

    def act(self, *prepared: Tensor) -> tuple[Tensor, ...]:
        """From what :meth:`prepare` gives to a tensor for each of ``out_keys``."""
        if self.head.distribution is None:
            encoding = self.encoder.encode(*prepared)
            return self.head(encoding.joined), *self.extras(encoding)
        *extras, loc, scale = self.before_sampling(*prepared)
        dist = self.head.dist(loc, scale)
        action = dist.rsample() if interaction_type() is InteractionType.RANDOM else self.head.mode(loc)
        # PyTorch's log_prob raises for no rows.
        return action, *extras, loc, scale, dist.log_prob(action) if action.numel() else action.sum(-1)

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
        """The same actor as a ProbabilisticTensorDictSequential, on the same weights; :class:`TypeError` without a
        distribution.

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
            raise TypeError(
                f"{type(self).__name__} has no distribution; make it with distribution='tanh_normal', or make a "
                "stochastic one of a trained one by actor.stochastic()"
            )

    def _loc_scale(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        self._require_distribution()
        return self.head.loc_scale(self.encoder.encode(*self.prepare(tensordict)).joined)

    @property
    def _sampling_keys(self) -> list[NestedKey]:
        return [] if self.head.distribution is None else self.out_keys_source[-3:]

    @property
    def dist_params_keys(self) -> list[NestedKey]:
        """Where ``loc`` and ``scale`` are written; none without a distribution."""
        return self._sampling_keys[:2]

    @property
    def log_prob_keys(self) -> list[NestedKey]:
        """Where the action's log-probability is written; none without a distribution."""
        return self._sampling_keys[2:]

    @property
    def dist_sample_keys(self) -> list[NestedKey]:
        """Where the action is written, if it is drawn."""
        return self.out_keys_source[:1] if self._sampling_keys else []

    def stochastic(self, distribution: DistributionName = "tanh_normal", init_std: float = 0.3) -> Self:
        """A copy with a distribution, whose mode is what this actor does, to be trained by RL.

        Its features have no noise, jitter, swaps nor hidden opening, which would change its likelihoods from call to
        call.

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
        found["options"] = self.config | {
            "distribution": distribution,
            "init_std": init_std,
            **{name: 0.0 for name in ("feature_noise", *_ALTERING) if name in self.config},
            "out_keys": [*self.out_keys_source, "loc", "scale", key_beside(self.out_keys_source[0], "_log_prob")],
        }
        with torch.random.fork_rng(devices=[]):
            other = type(self).from_description(found, self.encoder.text_encoder)
        other.encoder.load_state_dict(self.encoder.state_dict())
        other.head.copy_from(self.head)
        return other.train(self.training)

    def describe(self) -> dict[str, Any]:
        return super().describe() | self.encoder.describe()

    def fit_normalization(self, observation: Tensor, weights: Tensor | None = None) -> None:
        self.encoder.features.fit(observation, weights)

    def fit_contacts(self, observation: Tensor, task_id: Tensor) -> None:
        self.encoder.fit_contacts(observation, task_id)


class _BeforeSampling(TensorDictModuleBase):
    """All of an actor but the draw of its action, which reads ``loc`` and ``scale``."""

    def __init__(self, actor: ConditionedActor) -> None:
        super().__init__()
        self.actor = actor
        self.in_keys, self.out_keys = actor.in_keys, actor.out_keys_source[1:-1]

    @dispatched
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return write(tensordict, self, self.actor.before_sampling(*self.actor.prepare(tensordict)))
