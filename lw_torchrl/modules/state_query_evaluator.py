"""StateQueryEvaluator: a network that answers plans' conditions from the observation."""

from __future__ import annotations

from collections.abc import Sequence
from math import sqrt

import torch
from torch import Tensor, nn
from torchrl.modules import MLP

from lw_torchrl._checks import check_int, checked
from lw_torchrl.language.layout import METAWORLD, Layout
from lw_torchrl.language.plans import Plans
from lw_torchrl.language.text import TextEncoder
from lw_torchrl.modules.clause_evaluator import ClauseEvaluator, Clauses
from lw_torchrl.modules.networks import text_to_latent
from lw_torchrl.modules.observation_features import check_observation

MOST = 30.0
"""The size of the largest logit of a clause: a probability of 1e-13."""
_SCALES = (0.005, 0.02, 0.1, 0.5)  # metres: where the squashed copies of d bend


class ClauseNetwork(nn.Module):
    """What tells a clause's truth: a trunk on the difference d of two positions, and a vector of what is asked of it,
    by which the trunk's output is multiplied. Both come from a clause's structure or its text.

    From its structure: the two positions are those of the subject and the object, where the tasks' table says that they
    stand; each predicate has a vector of its own; "not" turns the sign. From its text alone: its vector says which of
    the observation's positions (hand, first, second, goal, the gripper's opening or none) the two are, by attention,
    what is added to d, and what is asked of it, "not" too.

    ``width`` and ``depth`` are of the trunk; ``predicates`` their number, or 0, with ``text_size``, to read texts.
    """

    numbers: int = 3  # of a difference
    ends: int = 0  # numbers of a text's vector that say which two things it is about; 0: one for each slot, twice

    def __init__(
        self, width: int, depth: int, *, predicates: int = 0, text_size: int = 0, layout: Layout = METAWORLD
    ) -> None:
        super().__init__()
        self.layout = layout
        self.slots = len(layout.positions) + 2  # the opening, and nothing, beside the positions
        check_int("width", width, minimum=1)
        check_int("depth", depth, minimum=1)
        self.width, self.reads_text = width, not predicates
        self.trunk = MLP(
            in_features=self.numbers * len(_SCALES),
            out_features=width,
            num_cells=[width] * (depth - 1),
            activation_class=nn.ReLU,
            activate_last_layer=True,
        )
        if predicates:
            self.predicates = nn.Embedding(predicates, width + 1)
        else:
            self.texts = text_to_latent(text_size, (self.ends or 2 * self.slots) + self.numbers + width + 1, width, 1)

    def forward(self, observation: Tensor, clauses: Clauses, text_vectors: Tensor | None = None) -> Tensor:
        """Observations (B, 39), clauses (B, C) and texts' vectors (U, E) to logits (B, C) of size 30 at most."""
        if self.reads_text:
            assert text_vectors is not None
            return self.judge(*self._from_text(observation, self.texts(text_vectors)[clauses.text]), None)
        numbers = torch.cat((observation, torch.zeros_like(observation[..., :1])), -1)
        first, second = (numbers.gather(-1, index.flatten(-2)) for index in (clauses.first, clauses.second))
        d = (first - second).unflatten(-1, (-1, 3)) + clauses.shift  # metres, where the tasks' table has the two
        return self.judge(d, self.predicates.weight[clauses.predicate], clauses.negated)

    def judge(self, d: Tensor, asked: Tensor, negated: Tensor | None) -> Tensor:
        """The logits (B, C) of differences d (B, C, 3) and what is asked (B, C, W + 1), opposite where ``negated``."""
        features = torch.cat([torch.tanh(d / scale) for scale in _SCALES], -1)
        logits = (self.trunk(features.to(asked.dtype)) * asked[..., :-1]).sum(-1) / sqrt(self.width) + asked[..., -1]
        if negated is not None:
            logits = torch.where(negated, -logits, logits)
        return logits.clamp(-MOST, MOST)

    def _from_text(self, observation: Tensor, read: Tensor) -> tuple[Tensor, Tensor]:
        """d (B, C, 3), and what is asked of it (B, C, W + 1), of what is read of texts (B, C, ...)."""
        first, second, shift, asked = read.split([self.slots, self.slots, 3, self.width + 1], -1)
        opening = observation[..., self.layout.opening]
        zero = torch.zeros_like(opening)
        positions = [observation[..., place] for place in self.layout.positions]
        gripper, nothing = (torch.stack((zero, zero, last), -1) for last in (opening, zero))
        slots = torch.stack([*positions, gripper, nothing], -2)
        chosen = (first.softmax(-1) - second.softmax(-1)).unsqueeze(-1) * slots.unsqueeze(-3)
        return chosen.sum(-2) + 0.1 * shift, asked


class StateQueryEvaluator(ClauseEvaluator):
    """Answers conditions from the observation, by a network that was trained on the query answering function's answers.

    Reads ``observation`` (B, 39) float32 and ``task_id`` (B,) int64; writes ``qaf_logits`` (B, S) float32, positive
    where a condition of the row's plan holds, -1e4 beyond its last step. With ``structure``, objects' positions are
    read where the tasks' table says that they stand in the observation: only what the predicates mean is learned.

    Args:
        plans, structure, predicates, text_encoder: as for
            :class:`~lw_torchrl.modules.clause_evaluator.ClauseEvaluator`, whose errors and source it has.
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
        structure: bool = True,
        width: int = 128,
        depth: int = 3,
        predicates: Sequence[str] | None = None,
        text_encoder: TextEncoder | None = None,
    ) -> None:
        super().__init__(plans, structure=structure, predicates=predicates, text_encoder=text_encoder)
        sizes = {"predicates": len(self.predicates), "text_size": self.text_size}
        self.network = ClauseNetwork(width, depth, **sizes, layout=self.plans.layout)
        self.config |= {"width": width, "depth": depth}

    def check_seen(self, seen: Tensor) -> None:
        check_observation(seen, self.plans.layout)
