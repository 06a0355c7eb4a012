"""Query answering against the language_world package."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
import torch

import lw_torchrl as lw
from benchmarks.report import Row, Settings, Skipped, compare, take_turns
from lw_torchrl.envs.qaf_transform import plan_program

BATCH = 4096
ASKED = 64  # states that the rival is asked about in one round; it works state by state


@cache
def plans_for_all() -> lw.Plans:
    """A plan for each of the 50 tasks: the shipped one, or else seven supported queries with a skill that is known."""
    try:
        return lw.load_plans("MT50")
    except FileNotFoundError:
        shipped = lw.load_plans("MT10")
    plans = []
    for task in lw.MT50:
        if task in shipped:
            plans.append(shipped[task])
            continue
        queries = lw.supported_queries(task)
        pairs = [(queries[k * len(queries) // 7], shipped.skills[k]) for k in range(7)]
        plans.append(lw.ConditionalPlan.from_pairs(task, pairs))
    return lw.Plans(plans)


def queries(settings: Settings) -> list[Row]:
    """A batch of 4096 states of mixed tasks; the rival is asked about 64 of them, and gives the same answers."""
    try:
        import language_world as rival
    except ImportError as error:
        raise Skipped(f"language-world is not installed ({error}): pip install -e '.[dev]'") from error
    shipped = lw.load_plans("MT10")
    eight: dict[str | lw.Task, list[str | lw.Query]] = {}
    for task in lw.MT50:
        listed = lw.supported_queries(task)
        eight[task] = [listed[k * len(listed) // 8] for k in range(8)]
    programs = {
        f"the {len(shipped)} shipped MT10 plans": plan_program(shipped),
        "8 queries of each MT50 task": lw.QueryProgram(eight),
    }
    return [_against(rival.eval_queries, name, program, settings) for name, program in programs.items()]


def _against(eval_queries: Callable[..., np.ndarray], name: str, program: lw.QueryProgram, settings: Settings) -> Row:
    tasks = [program.tasks[i % len(program.tasks)] for i in range(BATCH)]
    texts = {task: [str(query) for query in listed] for task, listed in program.queries.items()}
    task_id = torch.tensor([lw.task_id(task) for task in tasks])
    states = np.random.default_rng(0).uniform(-0.3, 0.9, (BATCH, 39)).astype(np.float32)
    observation = torch.from_numpy(states)
    asked = [i * BATCH // ASKED + i % 50 for i in range(ASKED)]
    answers = program(observation, task_id)
    for i in asked:
        expected = eval_queries(tasks[i], texts[tasks[i]], states[i]).astype(bool)
        if not np.array_equal(answers[i, : len(expected)].numpy(), expected):
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
    )
