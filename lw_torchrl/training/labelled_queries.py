"""LabelledQueries: the base queries of tasks in a dataset's states, with the query answering function's answers."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import TensorDictReplayBuffer

from lw_torchrl._checks import Count, Probability, Scale, check_choice, check_fields, check_int, check_text, checked
from lw_torchrl.language.layout import Layout
from lw_torchrl.language.queries import Clause, Query, base_clauses
from lw_torchrl.language.query_program import QueryProgram
from lw_torchrl.language.relations import PREDICATES
from lw_torchrl.language.tasks import Task, task_id
from lw_torchrl.suites.suite import find_suite

_FAR = 0.02  # metres that a hand does not move unseen


@dataclass(frozen=True)
class QueryEvaluatorConfig:
    """How a query evaluator is trained, by AdamW, and what is held out; else as :class:`BehavioralCloningConfig`.

    Attributes:
        batch_size: pairs of a state and a clause in a minibatch.
        learning_rate: at the start; a cosine brings it to 0.
        states_per_task: at most so many of each task are labelled to train on, drawn from its rows.
        every: of each episode, only each so-many-th state is asked: as many steps as pictures are apart.
        held_out_states: the share of a task's episodes, by their numbers, whose states are not trained on.
        held_out_pairs: the share of pairs of objects of which nothing is trained, by their names, in all tasks alike.
        held_out_tasks: of which nothing is trained: names, or a number of tasks to draw.
        seed: of what is held out, the states and the minibatches.
    """

    steps: Count = 4000
    batch_size: Count = 1024
    learning_rate: Scale = 3e-3
    weight_decay: Scale = 1e-4
    states_per_task: Count = 2000
    every: Count = 1
    held_out_states: Probability = 0.2
    held_out_pairs: Probability = 0.1
    held_out_tasks: int | tuple[str, ...] = 0
    seed: int = 0
    checkpoint_every: Count = 500

    def __post_init__(self) -> None:
        check_fields(self)
        for name in ("held_out_states", "held_out_pairs"):
            if getattr(self, name) > 0.9:
                raise ValueError(f"{name} must leave a tenth to train on, got {getattr(self, name)}")
        given = self.held_out_tasks
        if isinstance(given, str) or not isinstance(given, Iterable):
            check_int("held_out_tasks", given, minimum=0)
            return
        object.__setattr__(self, "held_out_tasks", tuple(given))
        for task in self.held_out_tasks:  # type: ignore[union-attr]
            check_text("held_out_tasks", task)


@dataclass(frozen=True)
class ImageQueryEvaluatorConfig(QueryEvaluatorConfig):
    """How an evaluator of pictures is trained, as :class:`QueryEvaluatorConfig`, but that a minibatch is of states.

    Attributes:
        batch_size: states in a minibatch, each asked all clauses of its task.
        position_weight: of the error in the things' positions, in units of 5 cm, and in how far the gripper is open, in
            the loss: the simulator knows them. 0 to learn only from answers.
    """

    batch_size: Count = 48
    learning_rate: Scale = 1e-3
    every: Count = 5
    position_weight: Scale = 1.0


@dataclass(frozen=True)
class Asked:
    """Q clauses, none negated, that are asked of R states of a task: ``observation`` (R, 39) float32, ``truth`` (R, Q)
    bool, and ``pixels`` (R, H, W, 3) uint8 where the rows have pictures."""

    task: Task
    clauses: tuple[Clause, ...]
    observation: Tensor
    truth: Tensor
    pixels: Tensor | None = None

    def seen(self, key: str) -> Tensor:
        """What an evaluator sees of the states, by the key that it reads."""
        if key == "observation":
            return self.observation
        if key != "pixels" or self.pixels is None:
            raise ValueError(
                f"data must have the column {key!r}, which the evaluator reads, as lw.data.add_pictures(root, ...) and "
                "replay.add_column('pixels', lw.data.load_pictures(replay, ...)) give it"
            )
        return self.pixels


class LabelledQueries:
    """All base queries of a dataset's tasks, not only those of plans, and which of them are trained.

    Attributes:
        tasks: those that are trained.
        held_out_tasks: those that are not.
        held_out_pairs: pairs of names, each sorted, of which nothing is trained.
        parts: what is asked, by name: "training"; "states", the same clauses in held-out states; "queries", clauses on
            held-out pairs, in these states; "tasks", all clauses of held-out tasks. One may be empty.

    Args:
        replay: its rows hold ``observation`` (R, 39) float32, ``task_id`` and ``episode`` (R,) int64, and, for an
            evaluator of pictures, ``pixels`` (R, H, W, 3) uint8.
        config: what is held out.
        tasks: what is known of its tasks; the shipped ones by default.

    Raises:
        ValueError: a row or held-out tasks of none of ``tasks``, or all held out; pictures held while the hand moves.
    """

    @checked
    def __init__(
        self, replay: TensorDictReplayBuffer, config: QueryEvaluatorConfig, tasks: Iterable[Task] | None = None
    ) -> None:
        shipped = find_suite(getattr(replay, "tasks", ())).tasks
        known = {task_id(task.name): task for task in (shipped.values() if tasks is None else tasks)}
        rows = replay[:]
        if config.every > 1:
            _, lengths = torch.unique_consecutive(rows.get(("collector", "traj_ids")), return_counts=True)
            first = (lengths.cumsum(0) - lengths).repeat_interleave(lengths)
            rows = rows[(torch.arange(len(rows)) - first) % config.every == 0]
        ids = rows.get("task_id")
        if other := sorted({*ids.unique().tolist()} - {*known}):
            raise ValueError(f"tasks must have all tasks of the rows, they lack those of the ids {other[:8]}")
        found = [known[number] for number in ids.unique().tolist()]
        _check_pictures(rows, found[0].layout)
        generator = torch.Generator().manual_seed(config.seed)
        self.held_out_tasks = _drawn_tasks(config.held_out_tasks, [task.name for task in found], generator)
        trained = [task for task in found if task.name not in self.held_out_tasks]
        self.tasks = tuple(task.name for task in trained)
        self.held_out_pairs = _drawn_pairs(config.held_out_pairs, trained, generator)
        kept = _held_out_rows(rows.get("episode"), ids, config.held_out_states)
        self.parts: dict[str, list[Asked]] = {"training": [], "states": [], "queries": [], "tasks": []}
        for task in found:
            own = ids == task_id(task.name)
            clauses = [clause for clause in base_clauses(task, tuple(PREDICATES)) if not clause.negated]
            train = _some((own & ~kept).nonzero().flatten(), config.states_per_task, generator)
            test = _some((own & kept).nonzero().flatten(), config.states_per_task, generator)
            if task.name in self.held_out_tasks:
                self._ask("tasks", task, clauses, rows[torch.cat((train, test))])
                continue
            new = [clause for clause in clauses if _pair(clause) in self.held_out_pairs]
            old = [clause for clause in clauses if _pair(clause) not in self.held_out_pairs]
            self._ask("training", task, old, rows[train])
            self._ask("states", task, old, rows[test])
            self._ask("queries", task, new, rows[test])

    def _ask(self, part: str, task: Task, clauses: Sequence[Clause], rows: TensorDictBase) -> None:
        if clauses and len(rows):
            observation = rows.get("observation").float()
            program = QueryProgram({task: [Query((clause,)) for clause in clauses]})
            truth = program(observation, torch.full((len(rows),), task_id(task.name)))
            self.parts[part].append(Asked(task, tuple(clauses), observation, truth, rows.get("pixels", None)))

    def describe(self) -> dict[str, Any]:
        """What is trained and what is held out, as JSON."""
        return {
            "tasks": list(self.tasks),
            "held_out_tasks": list(self.held_out_tasks),
            "held_out_pairs": [list(pair) for pair in self.held_out_pairs],
            "states": {part: sum(len(asked.observation) for asked in found) for part, found in self.parts.items()},
            "queries": {part: sum(len(asked.clauses) for asked in found) for part, found in self.parts.items()},
        }


def _pair(clause: Clause) -> tuple[str, str]:
    pair = clause.subject, clause.object or ""
    return min(pair), max(pair)


def _some(rows: Tensor, most: int, generator: torch.Generator) -> Tensor:
    if len(rows) <= most:
        return rows
    return rows[torch.randperm(len(rows), generator=generator)[:most].sort().values]


def _check_pictures(rows: TensorDictBase, layout: Layout) -> None:
    """Raise where a picture stays while the hand moves on: it is of an earlier state, whose answers are others."""
    pixels, hand = rows.get("pixels", None), rows.get("observation")[:, layout.positions[0]]
    if pixels is None or len(rows) < 2:
        return
    far = (hand[1:] - hand[:-1]).norm(dim=-1) > _FAR
    same = rows.get(("collector", "traj_ids"))[1:] == rows.get(("collector", "traj_ids"))[:-1]
    for row in (far & same).nonzero().flatten().tolist():
        if torch.equal(pixels[row], pixels[row + 1]):
            raise ValueError("every must be as many steps as the pictures are apart: one stays while the hand moves")


def _drawn_tasks(asked: int | tuple[str, ...], names: Sequence[str], generator: torch.Generator) -> tuple[str, ...]:
    number = asked if isinstance(asked, int) else len(asked)
    if number >= len(names):
        raise ValueError(f"held_out_tasks must leave tasks to train on, got {number} of {len(names)}")
    if isinstance(asked, int):
        drawn = torch.randperm(len(names), generator=generator)[:number].tolist()
        return tuple(sorted(names[place] for place in drawn))
    return tuple(sorted({check_choice("held_out_tasks", name, names) for name in asked}))


def _drawn_pairs(share: float, tasks: Sequence[Task], generator: torch.Generator) -> tuple[tuple[str, str], ...]:
    """Of the pairs of different objects so large a share, and at least one if any are asked for."""
    clauses = chain.from_iterable(base_clauses(task, ("near",)) for task in tasks)
    pairs = sorted({_pair(clause) for clause in clauses if clause.object is not None})
    number = min(len(pairs) - 1, max(1, round(share * len(pairs)))) if share else 0
    return tuple(sorted(pairs[place] for place in torch.randperm(len(pairs), generator=generator)[:number].tolist()))


def _held_out_rows(episode: Tensor, ids: Tensor, share: float) -> Tensor:
    """(R,) bool, the rows of a share of each task's episodes, spread over all of them: at least one, unless ``share``
    is 0 or no other is left. Episodes of one number begin alike, whoever acts: they go together."""
    held = torch.zeros_like(ids, dtype=torch.bool)
    for number in ids.unique().tolist():
        own = episode[ids == number].unique()
        many = min(len(own) - 1, max(1, round(share * len(own)))) if share else 0
        places = ((torch.arange(many) + 0.5) * len(own) / max(1, many)).long()
        held |= torch.isin(episode, own[places]) & (ids == number)
    return held
