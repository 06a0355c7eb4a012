"""StateQueryEvaluator: a network that answers plans' conditions from the observation."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from lw_torchrl._checks import checked
from lw_torchrl.language.observation import OBSERVATION_SIZE
from lw_torchrl.language.plans import Plans
from lw_torchrl.language.text import TextEncoder
from lw_torchrl.modules.clause_evaluator import ClauseEvaluator
from lw_torchrl.modules.clause_network import ClauseNetwork


class StateQueryEvaluator(ClauseEvaluator):
    """Answers conditions by a network that was trained on the query answering function's answers, and never asks it.

    Reads ``observation`` (B, 39) float32 and ``task_id`` (B,) int64; writes ``qaf_logits`` (B, S) float32, positive
    where a condition of the row's plan holds, -1e4 beyond its last step. A condition's clauses are answered one by one,
    each once in a task, and put together as :func:`~lw_torchrl.modules.clause_network.conjunction` says, so that new
    conjunctions need no training.

    Args:
        plans: whose conditions it answers.
        structure: a clause is read as the query language parses it: its predicate by number, its objects' positions
            where the tasks' table says that they stand in the observation, "not" as the opposite. Only what the
            predicates mean is learned. False: all that is known of a clause is its text's vector.
        width, depth: hidden layers.
        predicates: with ``structure``, the relations and predicates that it can tell; None for all that there are.
        text_encoder: without ``structure``, texts to vectors (n, E) float32; None for the sentence encoder, which
            wants the extra ``[text]``: clauses' vectors are not shipped.

    Raises:
        ValueError: a wrong option; a plan asks for a predicate that is not among ``predicates``; at call time, an
            observation of another shape, or a task_id without a plan.
        ImportError: without ``structure``, the extra ``[text]`` is not installed and there is no ``text_encoder``.

    Example:
        >>> import lw_torchrl as lw
        >>> plans = lw.load_plans("MT10")
        >>> actor = lw.PlanConditionedActor(plans, evaluator=StateQueryEvaluator(plans), answers="tanh")
        >>> env = lw.LanguageWorldEnv("reach")
        >>> actor(env.reset())["action"].shape
        torch.Size([1, 4])
        >>> env.close()

    Source: paper section 'Differentiability and Optimization'.
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
        self.network = ClauseNetwork(width, depth, predicates=len(self.predicates), text_size=self.text_size)
        self.config = {"structure": structure, "width": width, "depth": depth}
        if structure:
            self.config["predicates"] = list(self.predicates)

    def check_seen(self, seen: Tensor) -> None:
        if seen.shape[-1:] != (OBSERVATION_SIZE,) or seen.dtype != torch.float32:
            raise ValueError(
                f"observation must be float32 of shape (..., {OBSERVATION_SIZE}), got {seen.dtype} of shape "
                f"{tuple(seen.shape)}"
            )
