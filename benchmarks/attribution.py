"""python -m benchmarks.attribution: how often attribute_failures finds the faults that were planted."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from random import Random
from time import perf_counter
from typing import Any, NamedTuple

import torch
import tyro

import lw_torchrl as lw
from benchmarks.faults import Clumsy, Liar, denied, spoilt_skills, without
from lw_torchrl._checks import check_choice
from lw_torchrl._files import write_json, write_text
from lw_torchrl.data import collect_demonstrations
from lw_torchrl.evaluation import CAUSES, attribute_failures, plot_failures
from lw_torchrl.evaluation.summary import markdown_table

REFERENCE = Path(__file__).parent / "data" / "attribution_plans.json"
SINGLE = {"wrong condition": "plan", "missing step": "plan", "wrong offset": "skill", "lying evaluator": "query"}
"""What is planted, and its cause."""
PLANTED = ("button-press-topdown", "drawer-open", "handle-press", "plate-slide", "push")
PAIRS = (
    ("lying evaluator", "wrong condition"),
    ("lying evaluator", "wrong offset"),
    ("wrong condition", "wrong offset"),
)
RECORDED = ("observation", "task_id", "qaf", "skill_weights")


class Unit(NamedTuple):
    """What is done at once: a fault in one step, or two in two, in all tasks whose plans have the step."""

    policy: str
    faults: tuple[str, ...]
    step: int

    @property
    def name(self) -> str:
        return f"{self.policy}, {' and '.join(self.faults)}, step {self.step + 1}"


@dataclass(frozen=True)
class Arguments:
    """Plant faults and see whether they are found; the reference is never the plan that was spoilt. Stopped and started
    again it carries on.

    With --policy it plants nothing: it prints the causes of a policy's own failures, and some of them to look at.
    """

    tasks: tuple[str, ...] = ()
    """Tasks, of those that benchmarks/data/attribution_plans.json has: five if none is named for planted
    faults. With --policy of the policy's, all of them if none is named."""
    episodes: int = 20
    """Of each task, fault and step."""
    seed: int = 2000
    """Of the episodes."""
    max_steps: int = 200
    """Steps of an episode; with --policy 500 is usual."""
    policies: tuple[str, ...] = ("scripted", "learned")
    """Who acts: the scripted skills, and a policy trained on what they did."""
    quick: bool = False
    """Two tasks, two episodes, one step: it runs, its figures mean nothing."""
    out: Path = Path("runs/attribution")
    """Folder for the results of each unit, the policy and the tables."""
    policy: Path | None = None
    """A policy's file, whose own failures are attributed."""
    reference: str = "MT50"
    """With --policy: trusted plans, MT10, MT50, a file or a folder."""
    look_at: int = 10
    """With --policy: so many failures are listed for the eye."""


def units(args: Arguments, plans: lw.Plans) -> Iterator[Unit]:
    """All that is to be done, the single faults first."""
    most = 1 if args.quick else max(len(plan.steps) for plan in plans.values())
    for faults in (*((name,) for name in SINGLE), *PAIRS):
        for policy in args.policies:
            for step in range(most):
                yield Unit(policy, faults, step)


def plant(unit: Unit, plans: lw.Plans, learned: lw.Policy | None) -> tuple[lw.Plans, Any, Any]:
    """The plans, the actor and the evaluator with the unit's faults; a second fault is in the step that follows."""
    skills = evaluator = clumsy = None
    changed = dict(plans)
    for place, fault in enumerate(unit.faults):
        steps = {task: (unit.step + place) % len(plan.steps) for task, plan in plans.items()}
        if fault in ("wrong condition", "missing step"):
            spoil = denied if fault == "wrong condition" else without
            changed = {task: spoil(plan, steps[task]) for task, plan in plans.items()}
        elif fault == "wrong offset":
            skills = spoilt_skills(plans, steps)
            clumsy = {task: plan.steps[steps[task]].skill for task, plan in plans.items()}
        else:
            evaluator = steps
    spoilt = lw.Plans(changed)
    evaluator = None if evaluator is None else Liar(spoilt, evaluator)
    if learned is None:
        return spoilt, lw.ScriptedSkillActor(spoilt, skills=skills), evaluator
    actor = learned.with_plans(spoilt)
    return spoilt, actor if clumsy is None else Clumsy(actor, clumsy), evaluator


def run_unit(unit: Unit, args: Arguments, plans: lw.Plans, reference: lw.Plans, learned: Any) -> dict[str, Any]:
    """The failures of a unit, and what the rule alone says of them."""
    start = perf_counter()
    chosen = lw.Plans({task: plan for task, plan in plans.items() if unit.step < len(plan.steps)})
    spoilt, actor, evaluator = plant(unit, chosen, learned if unit.policy == "learned" else None)
    seen: list[Any] = []
    result = lw.evaluate(
        actor,
        tasks=list(chosen),
        episodes_per_task=args.episodes,
        seed=args.seed,
        max_steps=args.max_steps,
        stop_at_success=True,
        also_record=RECORDED,
        on_episode=seen.append,
        evaluator=evaluator,
        attribute=True,
        reference=reference,
        progress=False,
    )
    ruled = attribute_failures(seen, spoilt, reference=reference, seed=args.seed)
    by_rule = {(one.task, one.episode): one.cause for one in ruled}
    return {
        "unit": list(unit),
        "episodes": len(seen),
        "failures": [
            {
                "task": one.task,
                "episode": one.episode,
                "cause": one.cause,
                "also": one.also,
                "step": one.step,
                "rule": by_rule[one.task, one.episode],
                "counterfactuals": dict(one.counterfactuals),
                "evidence": dict(one.evidence),
            }
            for one in result.failures or ()
        ],
        "seconds": perf_counter() - start,
    }


def train(args: Arguments, plans: lw.Plans) -> lw.Policy:
    """A policy that imitates the scripted skills under the plans, trained once."""
    file = args.out / "learned.zip"
    data = args.out / "demonstrations"
    collect_demonstrations(
        list(plans),
        episodes_per_task=2 if args.quick else 10,
        root=data,
        policy="scripted",
        seed=0,
        noise_scale=(0.05, 0.1, 0.2),
        max_steps=150,
        progress=False,
    )
    sampler = lw.TaskBalancedSampler()
    replay = lw.LanguageWorldExperienceReplay(data, label="executed", sampler=sampler, after_success=20)
    torch.manual_seed(0)
    actor = lw.PlanConditionedActor(plans, features="both", width=192)
    transform = actor.transform()
    assert transform is not None
    replay.append_transform(transform)
    config = lw.BehavioralCloningConfig(steps=20 if args.quick else 1500, batch_size=50 * len(plans))
    lw.BehavioralCloningTrainer(actor, replay, config, checkpoint=file).train()
    return lw.load_actor(file)


def summary(found: list[dict[str, Any]]) -> str:
    """The confusion tables: what was planted down, what was found across."""
    single: list[tuple[str, ...]] = []
    pairs: list[tuple[str, ...]] = []
    for policy in dict.fromkeys(one["unit"][0] for one in found):
        for faults in dict.fromkeys(tuple(one["unit"][1]) for one in found if one["unit"][0] == policy):
            mine = [one for one in found if (one["unit"][0], tuple(one["unit"][1])) == (policy, faults)]
            failures = [failure for one in mine for failure in one["failures"]]
            planted = {SINGLE[fault] for fault in faults}
            right = sum(failure["cause"] in planted for failure in failures)
            ruled = sum(failure["rule"] in planted for failure in failures)
            both = sum({failure["cause"], failure["also"]} == planted for failure in failures)
            row = (
                f"{' and '.join(faults)} ({policy})",
                f"{len(failures)} of {sum(one['episodes'] for one in mine)}",
                *(str(sum(failure["cause"] == cause for failure in failures)) for cause in CAUSES),
                f"{right / max(1, len(failures)):.2f}",
                *([f"{both / max(1, len(failures)):.2f}"] if len(faults) > 1 else []),
                f"{ruled / max(1, len(failures)):.2f}",
                f"{sum(one['seconds'] for one in mine) / 60:.1f}",
            )
            (single if len(faults) == 1 else pairs).append(row)
    text = markdown_table(("planted", "failed", *CAUSES, "right", "by the rule alone", "minutes"), single)
    if pairs:
        head = ("planted", "failed", *CAUSES, "one of the two named", "both", "by the rule alone", "minutes")
        text += "\n\n" + markdown_table(head, pairs)
    for name, wanted in (("single faults", 1), ("two faults", 2)):
        every = [
            (failure["cause"], {SINGLE[fault] for fault in one["unit"][1]})
            for one in found
            if len(one["unit"][1]) == wanted
            for failure in one["failures"]
        ]
        if every:
            right = sum(cause in planted for cause, planted in every) / len(every)
            undecided = sum(cause == "undecided" for cause, _ in every) / len(every)
            text += f"\n\n{name}: {len(every)} failures, right {right:.3f}, undecided {undecided:.3f}"
    return f"{text}\n"


def planted(args: Arguments) -> None:
    """Do the units that are not done, and print the tables."""
    reference = lw.load_plans(REFERENCE)
    reference.require(args.tasks)
    plans = lw.Plans({task: lw.load_plans("MT50")[task] for task in args.tasks})
    learned = train(args, plans) if "learned" in args.policies else None
    found = []
    listed = list(units(args, plans))
    for number, unit in enumerate(listed, 1):
        file = args.out / f"seed-{args.seed}-{args.episodes}-episodes" / f"{unit.name}.json"
        if not file.is_file():
            write_json(file, run_unit(unit, args, plans, reference, learned))
        found.append(json.loads(file.read_text("utf-8")))
        causes = [failure["cause"] for failure in found[-1]["failures"]]
        counts = ", ".join(f"{causes.count(cause)} {cause}" for cause in CAUSES if cause in causes)
        print(f"[{number}/{len(listed)}] {unit.name}: {counts or 'none failed'}", flush=True)
        write_text(args.out / "table.md", summary(found))
    print(f"\n{summary(found)}written to {args.out / 'table.md'}")


def own_failures(args: Arguments) -> None:
    """The causes of a policy's failures that nobody planted."""
    assert args.policy is not None
    actor = lw.load_actor(args.policy)
    tasks = [check_choice("tasks", task, actor.tasks) for task in args.tasks] or list(actor.tasks)
    start = perf_counter()
    result = lw.evaluate(
        actor,
        tasks=tasks,
        episodes_per_task=args.episodes,
        seed=args.seed,
        max_steps=args.max_steps,
        stop_at_success=True,
        attribute=True,
        reference=lw.load_plans(args.reference),
    )
    result.save(args.out / "results.json", checkpoint=args.policy)
    plot_failures(result, args.out / "failures.png", title=str(args.policy))
    failures = list(result.failures or ())
    print(result.failure_table())
    undecided = sum(failure.cause == "undecided" for failure in failures) / max(1, len(failures))
    print(
        f"\nundecided: {undecided:.2f} of {len(failures)}; {(perf_counter() - start) / 60:.1f} minutes\n\nto look at:"
    )
    for failure in Random(args.seed).sample(failures, min(args.look_at, len(failures))):
        print(f"{failure.task}, episode {failure.episode}, at {failure.at}: {failure.cause}. {failure.why}")


def main(args: Arguments) -> None:
    if args.policy is None and not args.tasks:
        args = replace(args, tasks=PLANTED)
    if args.quick:
        args = replace(args, tasks=args.tasks[:2], episodes=2, max_steps=100)
    planted(args) if args.policy is None else own_failures(args)


if __name__ == "__main__":
    torch.set_num_threads(1)
    main(tyro.cli(Arguments))
