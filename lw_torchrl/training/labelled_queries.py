"""LabelledQueries: the exact answers to all base queries of the tasks, in each state of a dataset."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import TensorDictReplayBuffer

from lw_torchrl._util.checks import Count, Natural, Probability, Scale, check_choice, typed, typed_fields
from lw_torchrl.language.queries import Clause, Query, base_clauses
from lw_torchrl.language.query_program import QueryProgram
from lw_torchrl.language.relations import PREDICATES
from lw_torchrl.language.tasks import Task, task_id
from lw_torchrl.suites.suite import find_suite

_MOVED = 0.02  # meters; if the hand moves further than this between two pictures, the pictures must differ


@typed_fields
@dataclass(frozen=True)
class QueryEvaluatorConfig:
    """Hyperparameters for training a query evaluator with AdamW, and the held-out splits.

    Attributes:
        steps, weight_decay, checkpoint_every: see :class:`BehavioralCloningConfig`.
        batch_size: number of (state, clause) pairs per minibatch.
        learning_rate: initial learning rate, which decays to 0 on a cosine schedule.
        states_per_task: maximum number of training states per task, drawn from the rows of the task.
        every: use every N-th state of an episode; with pictures, N is the number of time steps between pictures.
        held_out_states: fraction of each task's episodes whose states are held out, at most all episodes but one.
        held_out_pairs: fraction of the pairs of object names that are held out in all tasks, at most all pairs but one.
        held_out_tasks: names of the held-out tasks, or the number of held-out tasks to draw.
        seed: seed for drawing the held-out splits, the training states and the minibatches.
    """

    steps: Count = 4000
    batch_size: Count = 1024
    learning_rate: Scale = 3e-3
    weight_decay: Scale = 1e-4
    states_per_task: Count = 2000
    every: Count = 1
    held_out_states: Probability = 0.2
    held_out_pairs: Probability = 0.1
    held_out_tasks: Natural | tuple[str, ...] = 0
    seed: int = 0
    checkpoint_every: Count = 500


@typed_fields
@dataclass(frozen=True)
class ImageQueryEvaluatorConfig(QueryEvaluatorConfig):
    """Hyperparameters for training an :class:`ImageQueryEvaluator`, in addition to those of
    :class:`QueryEvaluatorConfig`.

    Attributes:
        batch_size: number of states per minibatch, each with all clauses of its task.
        position_weight: weight of the loss on the objects' positions and openings, whose targets come from the
            simulator; 0 to learn only from answers.
    """

    batch_size: Count = 48
    learning_rate: Scale = 1e-3
    every: Count = 5
    position_weight: Scale = 1.0


@dataclass(frozen=True)
class TaskQueries:
    """The exact answers to Q clauses, none of which is negated, in R states of a task.

    Attributes:
        observation: the states, (R, 39) float32.
        truth: the answers, (R, Q) bool.
        pixels: pictures of the states, (R, H, W, 3) uint8; None without pictures.
    """

    task: Task
    clauses: tuple[Clause, ...]
    observation: Tensor
    truth: Tensor
    pixels: Tensor | None = None

    def view(self, key: str) -> Tensor:
        """Return the input for an evaluator that reads ``key`` ("observation" or "pixels")."""
        view = self.observation if key == "observation" else self.pixels
        if view is None:
            advice = "call replay.add_column('pixels', lw.data.load_pictures(replay, ...))"
            raise ValueError(f"data must have the column {key!r}, which the evaluator reads; {advice}")
        return view


class LabelledQueries:
    """The exact answers to all base queries of a dataset's tasks, split into training data and held-out data.

    A base query is a single clause, such as "the gripper is near the puck". Queries that no plan uses are included.

    Attributes:
        tasks, held_out_tasks: the names of the training tasks and of the held-out tasks.
        held_out_pairs: held-out pairs of object names, each pair sorted.
        parts: the splits by name: "training"; "states" (the training clauses in held-out states); "queries" (clauses
            about held-out pairs in held-out states); "tasks" (all clauses of held-out tasks). Any split may be empty.

    Args:
        replay: a replay buffer whose rows hold ``observation`` (R, 39) float32, ``task_id`` and ``episode`` (R,) int64,
            and, for an evaluator of pictures, ``pixels`` (R, H, W, 3) uint8.
        config: the config that defines the held-out splits.
        tasks: definitions of the buffer's tasks; None for the shipped definitions.

    Raises:
        ValueError: a task of the rows or a held-out task has no definition; all tasks are held out; or two pictures are
            equal although the hand moved between them.
    """

    @typed
    def __init__(
        self, replay: TensorDictReplayBuffer, config: QueryEvaluatorConfig, tasks: Iterable[Task] | None = None
    ) -> None:
        shipped = find_suite(getattr(replay, "tasks", ())).tasks
        known = {task_id(task.name): task for task in (shipped.values() if tasks is None else tasks)}
        rows = replay[:]
        if config.every > 1:  # counted from the first row of each episode, which has the first picture
            _, lengths = torch.unique_consecutive(rows.get(("collector", "traj_ids")), return_counts=True)
            first = (lengths.cumsum(0) - lengths).repeat_interleave(lengths)
            rows = rows[(torch.arange(len(rows)) - first) % config.every == 0]
        ids = rows.get("task_id")
        if other := sorted({*ids.unique().tolist()} - {*known}):
            raise ValueError(f"tasks must include all tasks of the rows, but the task ids {other[:8]} are missing")
        present = [known[number] for number in ids.unique().tolist()]
        if (pixels := rows.get("pixels", None)) is not None:  # check that all pictures show the current state
            hand, episode = (rows.get(key) for key in ("observation", ("collector", "traj_ids")))
            moved = hand[:, present[0].layout.positions[0]].diff(dim=0).norm(dim=-1) > _MOVED
            if any(torch.equal(pixels[row], pixels[row + 1]) for row in (moved & (episode.diff() == 0)).nonzero()):
                raise ValueError("every must equal that of add_pictures: some pictures repeat although the hand moved")
        generator = torch.Generator().manual_seed(config.seed)
        self.held_out_tasks = _draw_tasks(config.held_out_tasks, [task.name for task in present], generator)
        trained = [task for task in present if task.name not in self.held_out_tasks]
        self.tasks = tuple(task.name for task in trained)
        self.held_out_pairs = _draw_pairs(config.held_out_pairs, trained, generator)
        held_out = _held_out_rows(rows.get("episode"), ids, config.held_out_states)
        self.parts: dict[str, list[TaskQueries]] = {"training": [], "states": [], "queries": [], "tasks": []}
        for task in present:
            own, most = ids == task_id(task.name), config.states_per_task
            # Skip negated clauses: their answers are the opposite of other answers, so they teach nothing more.
            clauses = [clause for clause in base_clauses(task, tuple(PREDICATES)) if not clause.negated]
            train = _at_most(most, (own & ~held_out).nonzero().flatten(), generator)
            test = _at_most(most, (own & held_out).nonzero().flatten(), generator)
            if task.name in self.held_out_tasks:
                self._add("tasks", task, clauses, rows[torch.cat((train, test))])
                continue
            new = [clause for clause in clauses if _pair(clause) in self.held_out_pairs]
            old = [clause for clause in clauses if _pair(clause) not in self.held_out_pairs]
            self._add("training", task, old, rows[train])
            self._add("states", task, old, rows[test])
            self._add("queries", task, new, rows[test])

    def _add(self, part: str, task: Task, clauses: Sequence[Clause], rows: TensorDictBase) -> None:
        if clauses and len(rows):
            observation = rows.get("observation").float()
            program = QueryProgram({task: [Query((clause,)) for clause in clauses]})
            truth = program(observation, torch.full((len(rows),), task_id(task.name)))
            self.parts[part].append(TaskQueries(task, tuple(clauses), observation, truth, rows.get("pixels", None)))

    def describe(self) -> dict[str, Any]:
        """Return a JSON description of the training and held-out splits."""
        return {
            "tasks": list(self.tasks),
            "held_out_tasks": list(self.held_out_tasks),
            "held_out_pairs": [list(pair) for pair in self.held_out_pairs],
            "states": {part: sum(len(task.observation) for task in tasks) for part, tasks in self.parts.items()},
            "queries": {part: sum(len(task.clauses) for task in tasks) for part, tasks in self.parts.items()},
        }


def _pair(clause: Clause) -> tuple[str, str]:
    pair = clause.subject, clause.object or ""
    return min(pair), max(pair)


def _at_most(number: int, rows: Tensor, generator: torch.Generator) -> Tensor:
    """Draw ``number`` rows without replacement; return all rows if there are fewer."""
    if len(rows) <= number:
        return rows
    return rows[torch.randperm(len(rows), generator=generator)[:number].sort().values]


def _draw_tasks(held_out: int | tuple[str, ...], names: Sequence[str], generator: torch.Generator) -> tuple[str, ...]:
    number = held_out if isinstance(held_out, int) else len(held_out)
    if number >= len(names):
        raise ValueError(f"held_out_tasks must leave tasks to train on, got {number} of {len(names)}")
    if isinstance(held_out, int):
        drawn = torch.randperm(len(names), generator=generator)[:number].tolist()
        return tuple(sorted(names[place] for place in drawn))
    return tuple(sorted({check_choice("held_out_tasks", name, names) for name in held_out}))


def _draw_pairs(fraction: float, tasks: Sequence[Task], generator: torch.Generator) -> tuple[tuple[str, str], ...]:
    """Draw a fraction of the pairs of distinct objects: at least one pair unless the fraction is 0, but never all
    pairs."""
    clauses = chain.from_iterable(base_clauses(task, ("near",)) for task in tasks)
    pairs = sorted({_pair(clause) for clause in clauses if clause.object is not None})
    number = min(len(pairs) - 1, max(1, round(fraction * len(pairs)))) if fraction else 0
    return tuple(sorted(pairs[place] for place in torch.randperm(len(pairs), generator=generator)[:number].tolist()))


def _held_out_rows(episode: Tensor, ids: Tensor, fraction: float) -> Tensor:
    """Return a bool mask (R,) of the rows in held-out episodes: an evenly spaced fraction of each task's episodes.

    Episodes with the same index start in the same state in every dataset, so they are held out together.
    """
    held_out = torch.zeros_like(ids, dtype=torch.bool)
    for number in ids.unique().tolist():
        own = episode[ids == number].unique()
        count = min(len(own) - 1, max(1, round(fraction * len(own)))) if fraction else 0
        places = ((torch.arange(count) + 0.5) * len(own) / max(1, count)).long()
        held_out |= torch.isin(episode, own[places]) & (ids == number)
    return held_out
