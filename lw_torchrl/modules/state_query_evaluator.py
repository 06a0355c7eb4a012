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
from lw_torchrl.modules.observation_features import check_observation

MOST = 30.0
"""The size of the largest logit of a clause: a probability of 1e-13."""
_SCALES = (0.005, 0.02, 0.1, 0.5)  # metres: where the squashed copies of d bend


class ClauseNetwork(nn.Module):
    """The logit of a clause: a trunk on the difference d of two positions, times a learned vector of the predicate.

    The two positions are those of the subject and the object, where the tasks' table says that they stand; "not" turns
    the sign. ``width`` and ``depth`` are of the trunk; ``predicates`` is their number.
    """

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
        """Observations (B, 39) and clauses (B, C) to logits (B, C) of size 30 at most."""
        numbers = torch.cat((observation, torch.zeros_like(observation[..., :1])), -1)
        first, second = (numbers.gather(-1, index.flatten(-2)) for index in (clauses.first, clauses.second))
        d = (first - second).unflatten(-1, (-1, 3)) + clauses.shift  # metres, where the tasks' table has the two
        return self.judge(d, clauses)

    def judge(self, d: Tensor, clauses: Clauses) -> Tensor:
        """The logits (B, C) of differences d (B, C, 3)."""
        asked = self.predicates.weight[clauses.predicate]
        features = torch.cat([torch.tanh(d / scale) for scale in _SCALES], -1)
        logits = (self.trunk(features.to(asked.dtype)) * asked[..., :-1]).sum(-1) / sqrt(self.width) + asked[..., -1]
        return torch.where(clauses.negated, -logits, logits).clamp(-MOST, MOST)


class StateQueryEvaluator(ClauseEvaluator):
    """Answers conditions from the observation, by a network that was trained on the query answering function's answers.

    Reads ``observation`` (B, 39) float32 and ``task_id`` (B,) int64; writes ``qaf_logits`` (B, S) float32, positive
    where a condition of the row's plan holds, -1e4 beyond its last step. Objects' positions are read where the tasks'
    table says that they stand in the observation: only what the predicates mean is learned.

    Args:
        plans, predicates: as for :class:`~lw_torchrl.modules.clause_evaluator.ClauseEvaluator`, whose errors and
            source it has.
        width, depth: hidden layers.

    Example:
        >>> import lw_torchrl as lw
        >>> plans = lw.load_plans("MT10")
        >>> actor = lw.PlanConditionedActor(plans, evaluator=StateQueryEvaluator(plans), answers="tanh")
        >>> actor(lw.LanguageWorldEnv("reach").reset())["action"].shape
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
        predicates: Sequence[str] | None = None,
    ) -> None:
        super().__init__(plans, predicates=predicates)
        self.network = ClauseNetwork(width, depth, predicates=len(self.predicates))
        self.config |= {"width": width, "depth": depth}

    def check_seen(self, seen: Tensor) -> None:
        check_observation(seen, self.plans.layout)
