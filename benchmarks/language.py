"""Compare the speed of query answering and scripted skills with the language_world package."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

import lw_torchrl as lw
from benchmarks.report import Row, Settings, Skipped, compare, take_turns, times_as_long
from lw_torchrl.language.expressions import all_of, negate
from lw_torchrl.language.queries import Query
from lw_torchrl.transforms.qaf import plan_program

BATCH = 4096
ASKED = 64  # number of states that language_world evaluates in one round, one state at a time


def _rival() -> Any:
    try:
        import language_world
    except ImportError as error:
        raise Skipped(f"language-world is not installed ({error}): pip install -e '.[dev]'") from error
    return language_world


def _states(tasks: Sequence[str]) -> tuple[list[str], np.ndarray, Tensor]:
    """Return the task of each of 4096 states, the states (B, 39) float32, and the task ids (B,) int64."""
    mixed = [tasks[i % len(tasks)] for i in range(BATCH)]
    states = np.random.default_rng(0).uniform(-0.3, 0.9, (BATCH, 39)).astype(np.float32)
    return mixed, states, torch.tensor([lw.task_id(task) for task in mixed])


def queries(settings: Settings) -> list[Row]:
    """Answer the plans' conditions in 4096 states of mixed tasks; language_world answers 64 of them, identically."""
    rival = _rival()
    mt10, mt50 = lw.load_plans("MT10"), lw.load_plans("MT50")
    asked = {task: lw.supported_queries(task, published_only=True)[: len(plan.steps)] for task, plan in mt50.items()}
    return [
        _against(rival.eval_queries, "the plans of 10 tasks", plan_program(mt10), None, settings),
        _against(rival.eval_queries, "the plans of 50 tasks", plan_program(mt50), asked, settings),
    ]


def branches(settings: Settings) -> list[Row]:
    """Compare the plans of 50 tasks with the same plans as branches, in which each condition excludes earlier ones."""
    plans = lw.load_plans("MT50")
    trees = lw.Plans([as_branches(plan) for plan in plans.values()])
    _, states, task_id = _states(lw.MT50)
    batch = TensorDict(observation=torch.from_numpy(states), task_id=task_id, batch_size=BATCH)
    flat, nested = lw.QAFTransform(plans), lw.QAFTransform(trees)
    contenders = {"trees": lambda: nested(batch), "flat": lambda: flat(batch)}
    seconds = take_turns(contenders, settings.pick(200, 10), warm_up=5)
    name = f"QAFTransform, plans of 50 tasks as trees, batch {BATCH}"
    return [times_as_long(name, seconds["trees"], "the plans", seconds["flat"], unit="µs", scale=1e6, at_most=1.3)]


def as_branches(plan: lw.ConditionalPlan) -> lw.ConditionalPlan:
    """Return a plan whose conditions exclude the conditions of the steps before them, as "elif" does."""
    conditions = [step.condition.expression for step in plan.steps]
    guards = [all_of([*map(negate, conditions[:number]), each]) for number, each in enumerate(conditions)]
    pairs = [(Query(guard), step.skill) for guard, step in zip(guards, plan.steps, strict=True)]
    return lw.ConditionalPlan.from_pairs(plan.definition, pairs)


def skills(settings: Settings) -> list[Row]:
    """Compute the action of every plan step of every row, and compare with as many calls of single skills."""
    rival = _rival()
    actor = lw.ScriptedSkillActor(lw.load_plans("MT50"))
    tasks, states, task_id = _states(lw.MT50)
    observation = torch.from_numpy(states)
    acted = sum(len(actor.plans[task].steps) for task in tasks)
    names = rival.SCRIPTED_SKILL_NAMES

    def theirs() -> None:
        for i in range(ASKED):
            rival.run_scripted_skill(names[i % len(names)], states[i])

    found = take_turns({"ours": lambda: actor.program(observation, task_id), "theirs": theirs}, settings.pick(30, 3))
    return [
        compare(
            f"action of a scripted skill, plans of 50 tasks, batch {BATCH}",
            [seconds / acted for seconds in found["ours"]],
            "language_world.run_scripted_skill",
            [seconds / ASKED for seconds in found["theirs"]],
            unit="µs",
            scale=1e6,
            at_least=300,
        )
    ]


def _against(
    eval_queries: Callable[..., np.ndarray],
    name: str,
    program: lw.QueryProgram,
    texts: Mapping[str, Sequence[str]] | None,
    settings: Settings,
) -> Row:
    """Compare a query program with language_world, which answers ``texts``; None for the queries of the program.

    language_world does not know the points that we named. For plans that use these points, it answers as many published
    queries with one clause each, which is less work than ours.
    """
    same = texts is None
    if texts is None:
        texts = {task: [str(query) for query in listed] for task, listed in program.queries.items()}
    tasks, states, task_id = _states(program.tasks)
    observation = torch.from_numpy(states)
    asked = [i * BATCH // ASKED + i % 50 for i in range(ASKED)]
    answers = program(observation, task_id)
    for i in asked:
        expected = eval_queries(tasks[i], texts[tasks[i]], states[i]).astype(bool)
        if same and not np.array_equal(answers[i, : len(expected)].numpy(), expected):
            raise RuntimeError(f"language_world and ours disagree in task {tasks[i]}")

    def theirs() -> None:
        for i in asked:
            eval_queries(tasks[i], texts[tasks[i]], states[i])

    found = take_turns({"ours": lambda: program(observation, task_id), "theirs": theirs}, settings.pick(30, 3))
    return compare(
        f"queries of a state, {name}, batch {BATCH}",
        [seconds / BATCH for seconds in found["ours"]],
        "language_world.eval_queries",
        [seconds / ASKED for seconds in found["theirs"]],
        unit="µs",
        scale=1e6,
        at_least=1000,
    )
