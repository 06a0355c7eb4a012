"""ClauseEvaluator: a network that answers conditions clause by clause, whatever it sees of a state."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar, Self

import torch
from torch import Tensor, nn

from lw_torchrl._checks import shown
from lw_torchrl.language.plans import Plans
from lw_torchrl.language.queries import Clause
from lw_torchrl.language.relations import PREDICATES
from lw_torchrl.language.task_index import TaskIndex, TaskTables
from lw_torchrl.language.tasks import Task
from lw_torchrl.language.text import TextEncoder, encoded
from lw_torchrl.modules.clause_network import conjunction
from lw_torchrl.modules.clauses import Clauses, PlanClauses, clauses_of, code_clauses, code_plans, texts_of
from lw_torchrl.modules.networks import unit_scale
from lw_torchrl.modules.query_evaluator import QueryEvaluator

_PADDING = -1e4  # as QueryProgram.logits has it


class ClauseEvaluator(QueryEvaluator):
    """Answers conditions by a network that was trained on the query answering function's answers, and never asks it.

    A condition's clauses are answered one by one, each once in a task, and put together as
    :func:`~lw_torchrl.modules.clause_network.conjunction` says, so that new conjunctions need no training. The logits
    are -1e4 beyond a plan's last step. A subclass gives ``network``, whose call takes what is seen of B states, their
    clauses (B, C) and the texts' vectors, to logits (B, C), and says in ``seen_dims`` how many dimensions a state has.

    Args:
        plans: whose conditions it answers.
        structure: a clause is read as the query language parses it; False: all that is known of it is its text's
            vector.
        predicates: with ``structure``, the relations and predicates that it can tell; None for all that there are.
        names: with ``structure``, the things that it can tell; empty where they are not told apart by name.
        text_encoder: without ``structure``, texts to vectors (n, E) float32; None for the sentence encoder.

    Raises:
        ValueError: a wrong option; a plan asks for a predicate or a thing that it cannot tell.
        ImportError: without ``structure``, the extra ``[text]`` is not installed and there is no ``text_encoder``.
    """

    network: nn.Module
    text_vectors: Tensor | None
    seen_dims: ClassVar[int] = 1

    def __init__(
        self,
        plans: Plans,
        *,
        structure: bool,
        predicates: Sequence[str] | None,
        names: Sequence[str] = (),
        text_encoder: TextEncoder | None,
    ) -> None:
        super().__init__(plans)
        if not isinstance(structure, bool):
            raise TypeError(f"structure must be True or False, got {shown(structure)}")
        if not structure and predicates is not None:
            raise ValueError("predicates is for structure=True; without, an evaluator reads texts alone")
        self.predicates = _checked("predicates", sorted(PREDICATES) if predicates is None else predicates, structure)
        self.names = _checked("names", names, structure and bool(names))
        self.text_encoder = text_encoder
        index = TaskIndex(plans)
        texts = None if structure else texts_of(clauses_of(plans))
        tables = code_plans(plans, index.tasks, self.predicates, texts, self.names)
        vectors = None if texts is None else unit_scale(_vectors(texts, text_encoder))
        self.register_buffer("text_vectors", vectors, persistent=False)
        self.tables: TaskTables[PlanClauses] = TaskTables(index, tables, f"tasks without a plan in {plans!r}")

    @property
    def text_size(self) -> int:
        """E, the numbers of a text's vector; 0 where none is read."""
        return 0 if self.text_vectors is None else self.text_vectors.shape[1]

    def check_seen(self, seen: Tensor) -> None:
        """Raise :class:`ValueError` unless it is what the network was made for."""
        raise NotImplementedError(f"{type(self).__name__} must override check_seen")

    def logits(self, *read: Tensor) -> Tensor:
        """What is seen (..., ...) and task_id (...) int64 to (..., S) float32."""
        seen, task_id = read
        self.check_seen(seen)
        if task_id.shape != seen.shape[: -self.seen_dims]:
            raise ValueError(
                f"task_id must be of shape {tuple(seen.shape[: -self.seen_dims])}, one for each row of "
                f"{self.in_keys[0]!r}, got {tuple(task_id.shape)}"
            )
        rows = seen.reshape(-1, *seen.shape[-self.seen_dims :])
        tables = self.tables.select(task_id.reshape(-1), rows)
        clauses = self.network(rows, tables.clauses, self.text_vectors)
        parts = clauses.gather(-1, tables.parts.flatten(1)).reshape(tables.parts.shape)
        found = torch.where(tables.said.any(-1), conjunction(parts, tables.said), _PADDING)
        return found.reshape(*task_id.shape, self.plans.num_steps)

    def code(self, clauses: Sequence[tuple[Task, Clause]]) -> tuple[Clauses, Tensor | None]:
        """Any clauses of tasks, for the network: (G,) of them, and the vectors of their texts, if it reads texts; the
        second half are then the negations of the first.

        Raises:
            ValueError: one has a predicate or a thing that it cannot tell.
        """
        if self.predicates:
            return code_clauses(clauses, self.predicates, None, self.names), None
        both = [*clauses, *((task, replace(clause, negated=not clause.negated)) for task, clause in clauses)]
        texts = texts_of(both)
        return code_clauses(both, (), texts), unit_scale(_vectors(texts, self.text_encoder))

    def made_for(self, plans: Plans) -> Self:
        return type(self)(plans, text_encoder=self.text_encoder, **self.config)

    @classmethod
    def from_options(cls, plans: Plans, options: Mapping[str, Any], text_encoder: TextEncoder | None) -> Self:
        return cls(plans, text_encoder=text_encoder, **options)


def _checked(argument: str, given: Sequence[str], wanted: bool) -> tuple[str, ...]:
    if not wanted:
        return ()
    named = not isinstance(given, str) and all(isinstance(name, str) for name in given)
    if not named or not given or len({*given}) < len(given):
        raise ValueError(f"{argument} must be different names, at least one, got {shown(given)}")
    return tuple(given)


def _vectors(texts: Sequence[str], encoder: TextEncoder | None) -> Tensor:
    try:
        return encoded(texts, encoder)
    except ImportError as error:
        raise ImportError(
            f"structure=False reads the vectors of clauses' texts, which are not shipped: {error}; or give a "
            "text_encoder of yours, or take structure=True, which reads no texts"
        ) from error
