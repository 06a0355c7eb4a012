"""ClauseNetwork: a state and a clause to the logit of the clause's truth, from its structure or from its text."""

from __future__ import annotations

from math import sqrt

import torch
from torch import Tensor, nn
from torchrl.modules import MLP

from lw_torchrl._checks import check_int
from lw_torchrl.language.observation import OPENING, POSITIONS
from lw_torchrl.modules.clauses import Clauses
from lw_torchrl.modules.networks import text_to_latent

MOST = 30.0
"""The size of the largest logit of a clause: a probability of 1e-13."""
_SCALES = (0.005, 0.02, 0.1, 0.5)  # metres: where the squashed copies of d bend
_SLOTS = len(POSITIONS) + 2  # the opening, and nothing, beside the positions


def conjunction(logits: Tensor, said: Tensor) -> Tensor:
    """The logit of all of some statements, whose errors are taken to be independent of one another.

    Each statement has the probability sigmoid(l), all of them their product p, whose logit log(p / (1 - p)) is
    -log(expm1(sum(softplus(-l)))). Of one statement that is its own logit; of several sure ones nearly the least. Two
    of 0.6 each make 0.36: where all are barely true, the conjunction is not.

    Args:
        logits: (..., K) float32, of size 30 at most.
        said: (..., K) bool, the statements that there are; of none at all the logit is 30.

    Returns:
        (...) float32.

    Example:
        >>> import torch
        >>> conjunction(torch.tensor([8.0, -3.0]), torch.tensor([True, True])).round(decimals=2)
        tensor(-3.)
    """
    doubt = torch.where(said, nn.functional.softplus(-logits), 0.0).sum(-1).clamp(min=1e-13)
    return -(doubt + torch.log(-torch.expm1(-doubt)))


class ClauseNetwork(nn.Module):
    """What tells a clause's truth: a trunk on the difference d of two positions, and a vector of what is asked of it.

    The logit is the product of the trunk's output and that vector. Both parts of a clause come

    - from its structure: the two positions are those of the subject and the object, read where the tasks' table says
      that they stand; each predicate has a vector of its own; "not" turns the sign. What is learned is the predicates,
      as classes of d, whatever the objects are called;
    - or from its text alone: its vector says which of the observation's positions (hand, first, second, goal, the
      gripper's opening or none) the two are, by attention, what is added to d, and what is asked of it, "not" too. A
      network then has to find out from examples what every name stands for.

    Args:
        width, depth: hidden layers of the trunk, and the width of the text's.
        predicates: P, how many there are; 0 for a network that reads texts.
        text_size: E, the numbers of a text's vector, where it reads texts.
    """

    numbers: int = 3  # of a difference
    ends: int = 2 * _SLOTS  # numbers of a text's vector that say which two things it is about

    def __init__(self, width: int, depth: int, *, predicates: int = 0, text_size: int = 0) -> None:
        super().__init__()
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
            self.texts = text_to_latent(text_size, self.ends + self.numbers + width + 1, width, 1)

    def forward(self, observation: Tensor, clauses: Clauses, text_vectors: Tensor | None = None) -> Tensor:
        """Answer.

        Args:
            observation: (B, 39) float32.
            clauses: (B, C), those that are asked of each row.
            text_vectors: (U, E) float32, of the texts that ``clauses.text`` numbers, where it reads texts.

        Returns:
            (B, C) float32, logits of size 30 at most, positive where the clause holds.
        """
        if self.reads_text:
            assert text_vectors is not None
            d, asked = self._from_text(observation, self.texts(text_vectors)[clauses.text])
        else:
            d, asked = _difference(observation, clauses), self.predicates.weight[clauses.predicate]
        return self.judge(d, asked, None if self.reads_text else clauses.negated)

    def judge(self, d: Tensor, asked: Tensor, negated: Tensor | None) -> Tensor:
        """The logits (B, C) of differences d (B, C, 3) and what is asked of them (B, C, W + 1); ``negated`` (B, C) bool
        turns some around."""
        features = torch.cat([torch.tanh(d / scale) for scale in _SCALES], -1)
        logits = (self.trunk(features.to(asked.dtype)) * asked[..., :-1]).sum(-1) / sqrt(self.width) + asked[..., -1]
        if negated is not None:
            logits = torch.where(negated, -logits, logits)
        return logits.clamp(-MOST, MOST)

    def _from_text(self, observation: Tensor, told: Tensor) -> tuple[Tensor, Tensor]:
        """d (B, C, 3), and what is asked of it (B, C, W + 1), of what texts told (B, C, ...)."""
        first, second, shift, asked = told.split([_SLOTS, _SLOTS, 3, self.width + 1], -1)
        opening = observation[..., OPENING]
        zero = torch.zeros_like(opening)
        slots = torch.stack(
            [
                *(observation[..., place] for place in POSITIONS),
                torch.stack((zero, zero, opening), -1),
                torch.stack((zero, zero, zero), -1),
            ],
            -2,
        )
        chosen = (first.softmax(-1) - second.softmax(-1)).unsqueeze(-1) * slots.unsqueeze(-3)
        return chosen.sum(-2) + 0.1 * shift, asked


def _difference(observation: Tensor, clauses: Clauses) -> Tensor:
    """d (B, C, 3), metres, where the tasks' table says that the two things stand."""
    numbers = torch.cat((observation, torch.zeros_like(observation[..., :1])), -1)
    first, second = (numbers.gather(-1, index.flatten(-2)) for index in (clauses.first, clauses.second))
    return (first - second).unflatten(-1, (-1, 3)) + clauses.shift
