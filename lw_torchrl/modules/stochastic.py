"""StochasticActor: a policy with a distribution of actions, for RL."""

from __future__ import annotations

import copy
from collections import OrderedDict
from typing import Any, Literal

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
from lw_torchrl._util.keys import any_arguments, key_beside
from lw_torchrl.modules.decoder import Decode, GaussianDecoder, MLPDecoder
from lw_torchrl.modules.features import Features
from lw_torchrl.modules.parts import (
    NamedParts,
    action_spec,
    encoding_width,
    follow,
    in_mode_of,
    materialize,
    trunk_attributes,
)

DistributionName = Literal["tanh_normal", "normal"]
DISTRIBUTIONS: dict[str, Any] = {"tanh_normal": TanhNormal, "normal": IndependentNormal}


class StochasticActor(NamedParts, ProbabilisticTensorDictSequential):
    """A policy that samples its actions from a Normal distribution, like TorchRL's ``ProbabilisticActor``.

    Reads the trunk's input keys; writes the trunk's output keys, ``loc``, ``scale`` and ``action`` (B, A) float32, and
    ``action_log_prob`` (B,) float32. The action is a sample under ``set_exploration_type(ExplorationType.RANDOM)`` and
    the mode otherwise.

    Args:
        trunk: a sequence of named parts, see :class:`ConditionedActor`.
        decoder: a TensorDict module that writes the Normal's mean and standard deviation.
        distribution: "tanh_normal", a Normal squashed by tanh; "normal", whose actions the environment clips.
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

    @any_arguments
    def forward(self, *args: Any, **kwargs: Any) -> Any:
        return super().forward(*args, **kwargs)

    @classmethod
    def of(cls, actor: Any, distribution: DistributionName, init_std: float) -> StochasticActor:
        """Make a stochastic copy of a deterministic actor; the mode of the copy is the actor's action.

        The copy's features have no noise, because noise would change the likelihoods from call to call.

        Raises:
            TypeError: the actor's decoder is not an :class:`MLPDecoder`.
            ValueError: ``distribution`` is "tanh_normal", but the actor does not squash its actions.
        """
        old = getattr(actor.decoder, "network", None)
        if not isinstance(old, MLPDecoder):
            raise TypeError(
                f"stochastic() needs an actor with an MLPDecoder, got {type(old or actor.decoder).__name__}; otherwise "
                "use a decoder that returns mean and standard deviation, with out_keys=['loc', 'scale'], and wrap "
                "the actor in torchrl.modules.ProbabilisticActor"
            )
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
        """The spec of the action, (A,) float32 in [-1, 1], which TorchRL's losses read."""
        return action_spec(self.action, self.layout)

    @property
    def trunk(self) -> TensorDictSequential:
        """The policy without its decoder and sampler. It shares the policy's weights; critics can be built on it."""
        return TensorDictSequential(OrderedDict([*self.module.items()][:-2]))

    def with_plans(self, plans: Any) -> StochasticActor:
        """Return a policy that follows different plans but shares the networks: training one also trains the other."""
        options: dict[str, Any] = {**self.config, "trunk": follow(self.trunk, plans)}
        return in_mode_of(self, StochasticActor(**options))
