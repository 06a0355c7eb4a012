"""StateQueryEvaluator: a network that answers plans' conditions from the observation."""

from __future__ import annotations

from collections.abc import Sequence
from math import sqrt

import torch
from torch import Tensor, nn
from torchrl.modules import MLP

from lw_torchrl._checks import check_int, checked
from lw_torchrl.language.plans import Plans
from lw_torchrl.modules.clause_evaluator import ClauseEvaluator, Clauses
from lw_torchrl.modules.features import check_observation
from lw_torchrl.modules.query_evaluator import Answers

LARGEST_LOGIT = 30.0
"""The size of the largest logit of a clause, a probability of 1e-13."""
_SCALES = (0.005, 0.02, 0.1, 0.5)  # metres: the scales at which tanh squashes a difference


class ClauseNetwork(nn.Module):
    """The logit of a clause: a trunk reads the difference of two positions, and a learned vector of the predicate
    weighs its output. "not" changes the sign."""

    numbers: int = 3  # of a difference

    def __init__(self, width: int, depth: int, *, predicates: int) -> None:
        super().__init__()
        check_int("width", width, minimum=1)
        check_int("depth", depth, minimum=1)
        self.width = width
        self.trunk = MLP(
            in_features=self.numbers * len(_SCALES),
            out_features=width,
            num_cells=[width] * (depth - 1),
            activation_class=nn.ReLU,
            activate_last_layer=True,
        )
        self.predicates = nn.Embedding(predicates, width + 1)

    def forward(self, observation: Tensor, clauses: Clauses) -> Tensor:
        """Return logits (B, C) of size 30 at most from observations (B, 39) and clauses (B, C)."""
        numbers = torch.cat((observation, torch.zeros_like(observation[..., :1])), -1)
        first, second = (numbers.gather(-1, index.flatten(-2)) for index in (clauses.first, clauses.second))
        d = (first - second).unflatten(-1, (-1, 3)) + clauses.shift
        return self.judge(d, clauses)

    def judge(self, d: Tensor, clauses: Clauses) -> Tensor:
        """Return logits (B, C) from differences d (B, C, 3) in metres."""
        asked = self.predicates.weight[clauses.predicate]
        features = torch.cat([torch.tanh(d / scale) for scale in _SCALES], -1)
        logits = (self.trunk(features.to(asked.dtype)) * asked[..., :-1]).sum(-1) / sqrt(self.width) + asked[..., -1]
        return torch.where(clauses.negated, -logits, logits).clamp(-LARGEST_LOGIT, LARGEST_LOGIT)


class StateQueryEvaluator(ClauseEvaluator):
    """Answers conditions from the observation, by a network that was trained on exact answers.

    Reads ``observation`` (B, 39) float32 and ``task_id`` (B,) int64; writes ``qaf`` and ``qaf_logits`` (B, S) float32
    as :class:`QueryEvaluator` does. It looks objects' positions up in the observation, so it only learns what
    predicates mean.

    Args:
        plans, answers, predicates: as for :class:`~lw_torchrl.modules.clause_evaluator.ClauseEvaluator`, with its
            errors and source.
        width, depth: hidden layers.

    Example:
        >>> import lw_torchrl as lw
        >>> from tensordict.nn import TensorDictSequential
        >>> plans = lw.load_plans("MT10")
        >>> policy = TensorDictSequential(StateQueryEvaluator(plans), lw.PlanConditionedActor(plans))
        >>> policy(lw.LanguageWorldEnv("reach").reset())["action"].shape
        torch.Size([1, 4])
    """

    network: ClauseNetwork

    @checked
    def __init__(
        self,
        plans: Plans,
        *,
        width: int = 128,
        depth: int = 3,
        answers: Answers = "soft",
        predicates: Sequence[str] | None = None,
    ) -> None:
        super().__init__(plans, answers=answers, predicates=predicates)
        self.network = ClauseNetwork(width, depth, predicates=len(self.predicates))
        self.config |= {"width": width, "depth": depth}

    def check_seen(self, seen: Tensor) -> None:
        check_observation(seen, self.plans.layout)
