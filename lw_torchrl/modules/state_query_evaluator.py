"""StateQueryEvaluator: a network that answers plans' conditions from the observation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from lw_torchrl._checks import shown
from lw_torchrl.language.observation import OBSERVATION_SIZE
from lw_torchrl.language.plans import Plans
from lw_torchrl.language.queries import Clause
from lw_torchrl.language.relations import PREDICATES
from lw_torchrl.language.task_index import TaskIndex, TaskTables
from lw_torchrl.language.tasks import Task
from lw_torchrl.language.text import TextEncoder, encoded
from lw_torchrl.modules.clause_network import ClauseNetwork, conjunction
from lw_torchrl.modules.clauses import Clauses, PlanClauses, clauses_of, code_clauses, code_plans, texts_of
from lw_torchrl.modules.networks import unit_scale
from lw_torchrl.modules.query_evaluator import QueryEvaluator

_PADDING = -1e4  # as QueryProgram.logits has it


class StateQueryEvaluator(QueryEvaluator):
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

    text_vectors: Tensor | None

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
        super().__init__(plans)
        if not isinstance(structure, bool):
            raise TypeError(f"structure must be True or False, got {shown(structure)}")
        self.predicates = _names(predicates) if structure else ()
        if not structure and predicates is not None:
            raise ValueError("predicates is for structure=True; without, an evaluator reads texts alone")
        self.text_encoder = text_encoder
        index = TaskIndex(plans)
        texts = None if structure else texts_of(clauses_of(plans))
        tables = code_plans(plans, index.tasks, self.predicates, texts)
        vectors = None if texts is None else unit_scale(_vectors(texts, text_encoder))
        self.register_buffer("text_vectors", vectors, persistent=False)
        self.tables: TaskTables[PlanClauses] = TaskTables(index, tables, f"tasks without a plan in {plans!r}")
        self.network = ClauseNetwork(
            width, depth, predicates=len(self.predicates), text_size=0 if vectors is None else vectors.shape[1]
        )
        self.config = {"structure": structure, "width": width, "depth": depth}
        if structure:
            self.config["predicates"] = list(self.predicates)

    def logits(self, *read: Tensor) -> Tensor:
        """Observation (..., 39) float32 and task_id (...) int64 to (..., S) float32."""
        observation, task_id = read
        if observation.shape[-1:] != (OBSERVATION_SIZE,) or observation.dtype != torch.float32:
            raise ValueError(
                f"observation must be float32 of shape (..., {OBSERVATION_SIZE}), got {observation.dtype} of shape "
                f"{tuple(observation.shape)}"
            )
        if task_id.shape != observation.shape[:-1]:
            raise ValueError(
                f"task_id must be of shape {tuple(observation.shape[:-1])}, one per observation, got "
                f"{tuple(task_id.shape)}"
            )
        rows = observation.reshape(-1, OBSERVATION_SIZE)
        tables = self.tables.select(task_id.reshape(-1), rows)
        clauses = self.network(rows, tables.clauses, self.text_vectors)
        parts = clauses.gather(-1, tables.parts.flatten(1)).reshape(tables.parts.shape)
        found = torch.where(tables.said.any(-1), conjunction(parts, tables.said), _PADDING)
        return found.reshape(*task_id.shape, self.plans.num_steps)

    def code(self, clauses: Sequence[tuple[Task, Clause]]) -> tuple[Clauses, Tensor | None]:
        """Any clauses of tasks, for the network: (G,) of them, and the vectors of their texts, if it reads texts; the
        second half are then the negations of the first.

        Raises:
            ValueError: one has a predicate that is not among ``predicates``.
        """
        if self.predicates:
            return code_clauses(clauses, self.predicates, None), None
        both = [*clauses, *((task, replace(clause, negated=not clause.negated)) for task, clause in clauses)]
        texts = texts_of(both)
        return code_clauses(both, (), texts), unit_scale(_vectors(texts, self.text_encoder))

    def made_for(self, plans: Plans) -> StateQueryEvaluator:
        return StateQueryEvaluator(plans, text_encoder=self.text_encoder, **self.config)

    @classmethod
    def from_options(
        cls, plans: Plans, options: Mapping[str, Any], text_encoder: TextEncoder | None
    ) -> StateQueryEvaluator:
        return cls(plans, text_encoder=text_encoder, **options)


def _names(given: Sequence[str] | None) -> tuple[str, ...]:
    if given is None:
        return tuple(sorted(PREDICATES))
    named = not isinstance(given, str) and all(isinstance(name, str) for name in given)
    if not named or not given or len({*given}) < len(given):
        raise ValueError(f"predicates must be different names, at least one, got {shown(given)}")
    return tuple(given)


def _vectors(texts: Sequence[str], encoder: TextEncoder | None) -> Tensor:
    try:
        return encoded(texts, encoder)
    except ImportError as error:
        raise ImportError(
            f"structure=False reads the vectors of clauses' texts, which are not shipped: {error}; or give a "
            "text_encoder of yours, or take structure=True, which reads no texts"
        ) from error
