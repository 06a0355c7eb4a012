"""python -m benchmarks.any_plans POLICIES: evaluate zero-shot policies with plans by different authors, and without
plans."""

from __future__ import annotations

import json
import random
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Any, Literal

import numpy as np
import torch
import tyro
from numpy.typing import NDArray
from tensordict.nn import TensorDictModuleBase

import lw_torchrl as lw
from benchmarks.blind_plans import BLIND, blind_plans
from benchmarks.figures import markdown_table
from benchmarks.finding_points import find_points
from benchmarks.statistics import mean_over_tasks
from lw_torchrl._util.files import read_json, write_json, write_text
from lw_torchrl.evaluation.result import wilson_interval
from lw_torchrl.language.canonical import canonical_like, fallback_plan
from lw_torchrl.language.plans import ConditionalPlan, Plans
from lw_torchrl.modules import plans_of, with_plans
from lw_torchrl.training import load_evaluator

DEVELOPMENT = (
    "assembly", "bin-picking", "button-press", "button-press-wall", "coffee-pull", "dial-turn", "door-close",
    "door-unlock", "faucet-open", "hand-insert", "handle-press-side", "handle-pull-side", "peg-unplug-side",
    "pick-place-wall", "plate-slide-back", "plate-slide-side", "push-wall", "shelf-place", "stick-pull", "sweep",
)  # fmt: skip
"""Development tasks outside MT10, on which rules and hyperparameters were tuned."""
TEST = tuple(task for task in lw.MT50 if task not in DEVELOPMENT and task not in lw.MT10)
"""Test tasks: the other twenty tasks outside MT10."""
PARAPHRASES = 10  # number of paraphrases of each plan
OURS, NATURAL = lw.load_plans("MT50", skills="MT10"), lw.load_plans("MT50")
Rows = Literal[
    "default", "carried", "chooser", "ours", "natural", "own-words", "palm2", "no-points", "dc", "one-hot",
    "no-roles", "plans-alone", "models", "programs", "robustness", "evaluator",
]  # fmt: skip


@dataclass(frozen=True)
class Arguments:
    """Evaluate the zero-shot policies of each training seed with plans by different authors.

    Each row of the table evaluates the same policies, except that "dc", "one-hot" and "no-roles" are separate policies.
    "plans-alone" evaluates the demonstrated tasks, MT10, with the networks that read plans instead of the two networks
    that read descriptions.
    The plans "default", "carried" and "chooser" are made without reading any text: grasp the first object and slide it
    to the goal, lift it first, or select a motion by geometry (see benchmarks.blind_plans). Success rates are reported
    for the development tasks, on which everything was tuned, and for the test tasks, with intervals over tasks and
    seeds.
    """

    policies: tyro.conf.Positional[Path]
    """Folder `strong` of `python -m benchmarks.paper zero-shot`; the folder `no-roles` must be next to it."""
    rows: tuple[Rows, ...] = (*BLIND, "ours", "natural", "palm2", "dc", "one-hot")
    """Plans to evaluate."""
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    """Seeds of the trained policies."""
    episodes: int = 20
    """Number of episodes per task; the episodes' seed is 10000 + the training seed."""
    palm2: Path | None = None
    """PaLM 2's plans, a .json file of pairs; required for "palm2"."""
    answers: Path | None = None
    """Answers of language models, a .jsonl file; required for "models"."""
    programs: Path | None = None
    """Programs by style and task, a .json file; required for "programs"."""
    evaluator: Path | None = None
    """Learned query evaluator, from `lw-torchrl train-evaluator`; required for "evaluator"."""
    tasks: tuple[str, ...] = (*DEVELOPMENT, *TEST)
    """Tasks to evaluate, among the 40 tasks outside MT10."""
    out: Path = Path("runs/any_plans")
    """Folder for results.json and table.md; existing results are not computed again."""


def main(arguments: Arguments) -> None:
    file = arguments.out / "results.json"
    found: dict[str, dict[str, Any]] = read_json(file, "out") if file.is_file() else {}
    for seed in arguments.seeds:
        for name, method, plans in rows_of(arguments, seed):
            key = f"{name}, seed {seed}"
            if key in found:
                continue
            policy = lw.load_actor(folder_of(arguments, method) / f"seed{seed}" / "policy.safetensors").eval()
            actor = policy if plans is None else following(policy, plans)
            tasks = [task for task in arguments.tasks if plans is None or task in plans]
            if name == "plans-alone":
                actor, tasks = policy.others, [*lw.MT10]
            row, _, number = name.partition(", number ")
            # Run fewer episodes for each of the ten paraphrases, with different initial states.
            episodes = max(1, 2 * arguments.episodes // PARAPHRASES) if number else arguments.episodes
            how: dict[str, Any] = {"episodes_per_task": episodes, "noise_scale": 0.1, "progress": False}
            fixes = 10_000 + seed + 100 * int(number or 0)
            if row == "evaluator" and plans is not None:
                actor = following(policy, Plans([plans[task] for task in tasks]))
                how["evaluator"] = load_evaluator(required(arguments.evaluator, "evaluator"), plans_of(actor)).eval()
            result = lw.evaluate(actor, tasks=tasks, seed=fixes, stop_at_success=True, **how)
            found[key] = {"row": row, "seed": seed, "success": result.success_once}
            write_json(file, found)
            print(f"{key}: {result.mean_success:.3f}", flush=True)
    table = report(list(found.values()), arguments.episodes)
    write_text(arguments.out / "table.md", table)
    print(table)


def following(policy: TensorDictModuleBase, plans: Plans) -> TensorDictModuleBase:
    """Return the policy with other plans, converted to the form of the plans with which it was trained."""
    actor: TensorDictModuleBase = with_plans(policy, canonical_like(plans, plans_of(policy)))
    return actor


def folder_of(arguments: Arguments, method: str) -> Path:
    return arguments.policies.parent / method / "pcbc" if method == "no-roles" else arguments.policies / method


def rows_of(arguments: Arguments, seed: int) -> Iterator[tuple[str, str, Plans | None]]:
    """Yield the name, the policy's method and the plans of each row of the table."""
    outside = (*DEVELOPMENT, *TEST)
    for row in arguments.rows:
        if row in ("dc", "one-hot"):
            yield row, row, None
        elif row == "no-roles":
            yield row, row, Plans([OURS[task] for task in outside])
        elif row == "plans-alone":
            yield row, "pcbc", None
        elif row in BLIND:
            yield row, "pcbc", blind_plans(row, outside)
        elif row in ("ours", "natural", "evaluator"):
            yield row, "pcbc", Plans([(OURS if row == "ours" else NATURAL)[task] for task in outside])
        elif row == "own-words":  # plans by writers who saw the tasks, the names of objects and the query language
            for style, written in read_json(Path(__file__).parent / "data" / "own_words.json", "plans").items():
                plans = [ConditionalPlan.from_pairs(task, written[task]) for task in outside]
                yield f"own words, {style}", "pcbc", Plans(plans)
        elif row == "palm2":
            written = lw.load_plans(required(arguments.palm2, "palm2"))
            yield row, "pcbc", Plans([written[task] for task in outside])
        elif row == "no-points":  # tasks without our named points, or with points found from the objects' shapes
            bare = {task: lw.TASKS[task].published for task in outside}
            for points, tasks in {"no points": bare, "points of shapes": find_points(outside)}.items():
                written = lw.load_plans(required(arguments.palm2, "palm2"), tasks=lw.TASKS | tasks)
                yield f"palm2, {points}", "pcbc", Plans([written[task] for task in outside])
                yield (
                    f"default, {points}",
                    "pcbc",
                    blind_plans("default", [written[task].definition for task in outside]),
                )
        elif row == "programs":  # if a text cannot be parsed, the policy follows the default plan
            for style, texts in read_json(required(arguments.programs, "programs"), "programs").items():
                plans = [lw.decode_plan(text, task).plan or fallback_plan(task) for task, text in texts.items()]
                yield f"programs, {style}", "pcbc", Plans(plans)
        elif row == "models":
            for name, plans in of_models(required(arguments.answers, "answers"), seed):
                yield name, "pcbc", plans
        else:
            for name, change in CHANGES.items():
                drawn = random.Random(f"{name} {seed}")
                if name.startswith("paraphrased"):
                    for number in range(PARAPHRASES):
                        plans = Plans([change(NATURAL[task], drawn) for task in outside])
                        yield f"{name}, number {number}", "pcbc", plans
                else:
                    yield name, "pcbc", Plans([change(NATURAL[task], drawn) for task in outside])


def required(path: Path | None, name: str) -> Path:
    if path is None:
        raise ValueError(f"--{name} must name a file for the rows of {name}")
    return path


def of_models(file: Path, seed: int) -> Iterator[tuple[str, Plans]]:
    """Yield the plans of each model and format, from one randomly chosen answer per task."""
    listed: dict[tuple[str, str], dict[str, list[ConditionalPlan | None]]] = {}
    for line in file.read_text("utf-8").splitlines():
        one = json.loads(line)
        if one["task"] in DEVELOPMENT:
            plan = lw.decode_plan(one["completion"], one["task"], one["format"]).plan
            listed.setdefault((one["llm"], one["format"]), {}).setdefault(one["task"], []).append(plan)
    for (model, form), tasks in sorted(listed.items()):
        drawn = random.Random(f"{model} {form} {seed}")
        blind = {task: drawn.choice(plans) for task, plans in sorted(tasks.items())}
        # If the answer cannot be parsed, the policy follows the default plan.
        yield f"{model}, {form}", Plans([plan or fallback_plan(task) for task, plan in blind.items()])


WORDS = {
    "place the gripper": ["put the gripper", "position the gripper", "move the hand", "bring the gripper"],
    "above": ["over", "above", "on top of"],
    "lower the gripper": ["drop the gripper", "put the gripper", "bring the hand down"],
    "around": ["around", "onto", "down on"],
    "beside": ["next to", "to the side of", "beside"],
    "close the gripper around": ["grab", "grasp", "grip", "squeeze", "seize", "pick up"],
    "target location": ["goal", "target", "goal location", "destination"],
    "move": ["move", "bring", "carry", "take"],
    "turn": ["rotate", "spin", "twist", "turn"],
    "push": ["push", "shove", "press", "nudge"],
    "pull": ["drag", "pull", "tug"],
    "lift": ["raise", "lift", "pick up"],
    "toward": ["towards", "toward"],
    "the ": ["", "the ", "a "],
}
"""Words of the shipped plans and their synonyms."""


def reworded(plan: ConditionalPlan, drawn: random.Random) -> ConditionalPlan:
    """Return the plan with synonyms in each step, by rules."""
    steps = []
    for step in plan.steps:
        text = step.skill
        for words, others in WORDS.items():
            text = text.replace(words, drawn.choice(others))
        steps.append((step.condition, text))
    return ConditionalPlan.from_pairs(plan.definition, steps)


def by_small_model(plan: ConditionalPlan, drawn: random.Random) -> ConditionalPlan:
    """Return the plan with a paraphrase from `benchmarks.paraphrases` for each step, even if its meaning is wrong."""
    others = read_json(Path(__file__).parent / "data" / "paraphrases.json", "paraphrases")
    said = [
        re.sub(r"[^a-z0-9' -]", "", drawn.choice(others[step.skill])) for step in plan.steps
    ]  # a skill has no commas
    steps = [(step.condition, skill) for step, skill in zip(plan.steps, said, strict=True)]
    return ConditionalPlan.from_pairs(plan.definition, steps)


def shuffled(plan: ConditionalPlan, drawn: random.Random) -> ConditionalPlan:
    """Return the plan with the steps, and the clauses of each condition, in random order."""
    steps = [
        (" and ".join(map(str, drawn.sample(step.condition.clauses, len(step.condition.clauses)))), step.skill)
        for step in plan.steps
    ]
    return ConditionalPlan.from_pairs(plan.definition, drawn.sample(steps, len(steps)))


def one_dropped(plan: ConditionalPlan, drawn: random.Random) -> ConditionalPlan:
    steps = [(step.condition, step.skill) for step in plan.steps]
    if len(steps) > 1:
        del steps[drawn.randrange(len(steps))]
    return ConditionalPlan.from_pairs(plan.definition, steps)


def two_swapped(plan: ConditionalPlan, drawn: random.Random) -> ConditionalPlan:
    """Return the plan with the skills of two steps swapped."""
    skills = [step.skill for step in plan.steps]
    if len(skills) > 1:
        first, second = drawn.sample(range(len(skills)), 2)
        skills[first], skills[second] = skills[second], skills[first]
    return ConditionalPlan.from_pairs(
        plan.definition, [(step.condition, skill) for step, skill in zip(plan.steps, skills, strict=True)]
    )


def one_wrong(plan: ConditionalPlan, drawn: random.Random) -> ConditionalPlan:
    """Return the plan with one skill replaced by a skill of another task."""
    skills = [step.skill for step in plan.steps]
    skills[drawn.randrange(len(skills))] = drawn.choice(NATURAL.skills)
    return ConditionalPlan.from_pairs(
        plan.definition, [(step.condition, skill) for step, skill in zip(plan.steps, skills, strict=True)]
    )


def of_another(plan: ConditionalPlan, drawn: random.Random) -> ConditionalPlan:
    """Return the skills of another task's plan with the conditions of this plan's first steps."""
    other = NATURAL[drawn.choice([task for task in NATURAL if task != plan.task])]
    conditions = [step.condition for step in plan.steps]
    pairs = [(conditions[number % len(conditions)], step.skill) for number, step in enumerate(other.steps)]
    return ConditionalPlan.from_pairs(plan.definition, pairs)


CHANGES: dict[str, Callable[[ConditionalPlan, random.Random], ConditionalPlan]] = {
    "paraphrased by rules": reworded,
    "order shuffled": shuffled,
    "one step dropped": one_dropped,
    "two skills swapped": two_swapped,
    "one skill wrong": one_wrong,
    "another task's skills": of_another,
    "paraphrased by the small model": by_small_model,
}
"""Changes to the natural plans, each with its own random generator."""


def report(found: list[dict[str, Any]], episodes: int) -> str:
    """Return a Markdown table of success rates, and their differences from the best plans that read no text."""
    several: dict[str, dict[int, list[dict[str, float]]]] = {}
    for one in found:
        several.setdefault(one["row"], {}).setdefault(one["seed"], []).append(one["success"])
    rows = {
        name: {seed: {task: fmean(one[task] for one in each) for task in each[0]} for seed, each in seeds.items()}
        for name, seeds in several.items()
    }
    head, lines = ["plans", "seeds"], [[name, str(len(seeds))] for name, seeds in rows.items()]
    for kind, tasks in (("demonstrated", lw.MT10), ("development", DEVELOPMENT), ("test", TEST)):
        rated = {name: _rates(rows[name], tasks) for name in BLIND if name in rows}
        blind = {name: rates.mean() for name, rates in rated.items() if rates.size}
        best = max(blind, key=blind.__getitem__, default="")
        head += [f"{len(tasks)} {kind} tasks", f"minus {best}" if best else "", "better, worse"]
        for line, seeds in zip(lines, rows.values(), strict=True):
            line.append(str(mean_over_tasks(rates)) if (rates := _rates(seeds, tasks)).size else "")
            both = {seed: rows[best][seed] for seed in seeds if seed in rows[best]} if best not in ("", line[0]) else {}
            ours, theirs = _rates({seed: seeds[seed] for seed in both}, tasks), _rates(both, tasks)
            known = bool(both) and ours.size == theirs.size > 0
            line += [str(mean_over_tasks(ours - theirs)), beyond_chance(ours, theirs, episodes)] if known else ["", ""]
    return markdown_table(head, lines)


def _rates(seeds: dict[int, dict[str, float]], tasks: tuple[str, ...]) -> NDArray[np.float64]:
    """Return the success rates (seeds, tasks) of the tasks that were evaluated for all seeds."""
    known = [task for task in tasks if all(task in rates for rates in seeds.values())]
    return np.array([[rates[task] for task in known] for rates in seeds.values()])


def beyond_chance(ours: NDArray[np.float64], theirs: NDArray[np.float64], episodes: int) -> str:
    """Return the numbers of tasks that are significantly better and worse: those with disjoint Wilson intervals."""
    trials = episodes * len(ours)
    intervals = [[wilson_interval(round(sum(rates) * episodes), trials) for rates in both.T] for both in (ours, theirs)]
    pairs = list(zip(*intervals, strict=True))
    return f"{sum(mine[0] > blind[1] for mine, blind in pairs)}, {sum(mine[1] < blind[0] for mine, blind in pairs)}"


if __name__ == "__main__":
    torch.set_num_threads(1)
    main(tyro.cli(Arguments))
