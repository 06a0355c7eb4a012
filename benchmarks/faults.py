"""python -m benchmarks.faults: what attribute_failures says of faults that were planted."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from itertools import chain, zip_longest
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import torch
import tyro
from torchrl.envs import Transform

import lw_torchrl as lw
from benchmarks import planted
from benchmarks.figures import markdown_table
from benchmarks.planted import Altered, Done, InStep, Liar, Sensor, Shown
from lw_torchrl._util.files import write_json, write_text
from lw_torchrl.data import collect_demonstrations
from lw_torchrl.envs.episodes import FinishedEpisode
from lw_torchrl.evaluation import CAUSES, attribute_failures

REFERENCE = Path(__file__).parent / "data" / "attribution_plans.json"
BUILT_ON = (
    *("button-press-topdown", "drawer-open", "push", "plate-slide-back", "plate-slide-side", "handle-press-side"),
    *("door-close", "button-press-wall", "peg-unplug-side", "sweep", "hand-insert"),
)
"""Tasks on which causes and margins were chosen."""
TASKS = ("pick-place", "coffee-pull", "window-open", "faucet-open", "dial-turn")
RECORDED = ("observation", "task_id", "qaf", "skill_weights")
HARMLESS = ("not reproducible", "perception", "policy", "undecided")
"""Causes that blame neither the policy nor its plan nor its answers."""


@dataclass
class Cast:
    """What acts and where, with faults."""

    sound: lw.Plans
    scripted: bool
    plans: lw.Plans
    skills: Any = None
    shown: Shown | None = None
    done: Done | None = None
    evaluator: Any = None
    simulator: Transform | None = None  # between the policy and the environment, which attribution is not told of
    noise: float = 0.1
    told_steps: int | None = None  # what attribution is given of each episode

    def steps(self, step: int) -> dict[str, int]:
        """In each task's plan another step."""
        return {task: (step + place) % len(plan.steps) for place, (task, plan) in enumerate(self.sound.items())}

    def texts(self, step: int) -> dict[str, str]:
        return {task: self.sound[task].steps[number].skill for task, number in self.steps(step).items()}

    def actor(self, learned: Any) -> Any:
        actor = (
            lw.ScriptedSkillActor(self.plans, skills=self.skills) if self.scripted else learned.with_plans(self.plans)
        )
        return actor if self.shown is None and self.done is None else Altered(actor, self.shown, self.done)


_ENOUGH, _MOST_TURNS = 12, 3
Plant = Callable[[Cast, int], None]


def in_plan(spoil: Callable[[lw.ConditionalPlan, int], lw.ConditionalPlan]) -> Plant:
    def plant(cast: Cast, step: int) -> None:
        cast.plans = lw.Plans({task: spoil(cast.sound[task], number) for task, number in cast.steps(step).items()})

    return plant


def in_skill(change: Callable[[torch.Tensor], torch.Tensor]) -> Plant:
    return lambda cast, step: setattr(cast, "done", InStep(cast.plans, cast.texts(step), change))


def offset_skill(cast: Cast, step: int) -> None:
    """In the script's table, or, of a network, as much added to its action."""
    if cast.scripted:
        cast.skills = planted.perturbed_skills(cast.sound, cast.steps(step))
    else:
        in_skill(lambda action: (action + torch.tensor([1.0, 0.0, 0.0, 0.0])).clamp(-1.0, 1.0))(cast, step)


def lie(never: bool = False) -> Plant:
    return lambda cast, step: setattr(cast, "evaluator", Liar(cast.plans, cast.steps(step), never))


def flipped(cast: Cast, step: int) -> None:
    cast.evaluator = lw.transforms.CorruptQAF(cast.plans, flip=0.4, seed=step)


def sensor(cast: Cast, step: int) -> None:
    cast.evaluator = Sensor(cast.plans, 0.1)


def setting(**values: Any) -> Plant:
    def plant(cast: Cast, step: int) -> None:
        for name, value in values.items():
            setattr(cast, name, value)

    return plant


def both(*plants: Plant) -> Plant:
    def plant(cast: Cast, step: int) -> None:
        for place, one in enumerate(plants):
            one(cast, step + place)

    return plant


class Fault(NamedTuple):
    """What is planted, and the causes that are right: in the list, outside of it, two at once, or other faults of the
    motion, in one step or in all."""

    kind: str
    causes: tuple[str, ...]
    plant: Plant


INSIDE: dict[str, Fault] = {
    "wrong condition": Fault("inside", ("plan",), in_plan(planted.denied)),
    "missing step": Fault("inside", ("plan",), in_plan(planted.without)),
    "exchanged skills": Fault("inside", ("plan",), in_plan(planted.swapped)),
    "a step too many": Fault("inside", ("plan",), in_plan(planted.with_extra)),
    "a skill 10 cm off": Fault("inside", ("skill",), offset_skill),
    "a skill without force": Fault("inside", ("skill",), in_skill(planted.scaled(0.05, 0.05, 0.05, 1.0))),
    "a skill to the wrong side": Fault("inside", ("skill",), in_skill(planted.scaled(-1.0, 1.0, 1.0, 1.0))),
    "opposite answers": Fault("inside", ("query",), lie()),
    "answers always no": Fault("inside", ("query",), lie(never=True)),
    "random answers": Fault("inside", ("query",), flipped),
    "gripper stays open": Fault("inside", ("gripper",), setting(done=planted.fingers(-1.0))),
    "gripper reversed": Fault("inside", ("gripper",), setting(done=planted.scaled(1.0, 1.0, 1.0, -1.0))),
    "hand hardly rises or sinks": Fault("inside", ("actuation",), setting(done=planted.scaled(1.0, 1.0, 0.05, 1.0))),
    "hand mirrored": Fault("inside", ("actuation",), setting(done=planted.scaled(-1.0, 1.0, 1.0, 1.0))),
}
OUTSIDE: dict[str, Fault] = {
    "view 15 steps late": Fault("outside", ("perception",), setting(shown=planted.late_view(15.0))),
    "thing seen 10 cm aside": Fault("outside", ("perception",), setting(shown=planted.moved_thing(0.1, 0.0))),
    "goal seen 15 cm aside": Fault("outside", ("perception",), setting(shown=planted.moved_goal(0.15, 0.0))),
    "camera 10 cm aside, answers too": Fault("outside", ("perception",), sensor),
    "simulator scales z by 0.1": Fault(
        "outside", ("not reproducible",), setting(simulator=planted.Jammed(1.0, 1.0, 0.1, 1.0))
    ),
    "simulator mirrors x": Fault(
        "outside", ("not reproducible",), setting(simulator=planted.Jammed(-1.0, 1.0, 1.0, 1.0))
    ),
    "rollouts cut at 40 steps": Fault("outside", ("not reproducible",), setting(told_steps=40)),
    "other noise than told": Fault("outside", ("not reproducible",), setting(noise=1.0)),
    "all actions a tenth, fingers too": Fault(
        "outside", ("policy", "actuation"), setting(done=planted.scaled(0.1, 0.1, 0.1, 0.0))
    ),
}
TWO: dict[str, Fault] = {
    "opposite answers, wrong condition": Fault("two", ("query", "plan"), both(in_plan(planted.denied), lie())),
    "opposite answers, skill 10 cm off": Fault("two", ("query", "skill"), both(lie(), offset_skill)),
    "wrong condition, skill 10 cm off": Fault("two", ("plan", "skill"), both(in_plan(planted.denied), offset_skill)),
    "missing step, opposite answers": Fault("two", ("plan", "query"), both(in_plan(planted.without), lie())),
}
MOTION: dict[str, Fault] = {
    "hand with x and y exchanged": Fault("motion", ("actuation",), setting(done=planted.exchanged)),
    "a skill with x and y exchanged": Fault("motion", ("skill",), in_skill(planted.exchanged)),
    "hand that drifts aside": Fault("motion", ("actuation",), setting(done=planted.drifting(0.6))),
    "a skill that drifts aside": Fault("motion", ("skill",), in_skill(planted.drifting(0.6))),
    "hand timid in small motions": Fault("motion", ("actuation",), setting(done=planted.timid)),
    "a skill timid in small motions": Fault("motion", ("skill",), in_skill(planted.timid)),
}
KINDS = {
    "inside": "named right",
    "outside": "no sound part named",
    "two": "a planted one named",
    "motion": "named right",
}
"""Kinds of faults and the causes that count as right."""
FAULTS: Mapping[str, Fault] = {**INSIDE, **OUTSIDE, **TWO, **MOTION}


@dataclass(frozen=True)
class Arguments:
    """Plant faults and see what is said of them. Stopped and started again it carries on."""

    seed: int = 6000
    """Random seed of the episodes."""
    tasks: tuple[str, ...] = TASKS
    faults: tuple[str, ...] = tuple(FAULTS)
    policies: tuple[str, ...] = ("scripted", "learned")
    """Actors: scripted skills, and a policy trained on their episodes."""
    episodes: int = 4
    """Number of episodes per task and fault, and per faulty step."""
    at_most: int = 16
    """Number of failures of each fault to diagnose, spread over the tasks."""
    max_steps: int = 150
    learned: Path | None = None
    """File of the learned policy; by default it is trained once, in the folder --out."""
    out: Path = Path("runs/faults")
    """Folder for the results, the policy and the tables."""


def failures_of(fault: Fault, policy: str, args: Arguments, learned: Any, reference: lw.Plans) -> Iterator[Any]:
    """What is said of the failures of a fault, in one step of the plans and in the next, and how."""
    found = 0
    for step in range(_MOST_TURNS):
        if found >= _ENOUGH:
            return
        start = perf_counter()
        sound = lw.Plans({task: lw.load_plans("MT50")[task] for task in args.tasks})
        cast = Cast(sound, policy == "scripted", sound)
        fault.plant(cast, step)
        actor, failed = cast.actor(learned), []
        run: dict[str, Any] = {
            "seed": args.seed + step,
            "max_steps": args.max_steps,
            "num_threads": 1,
            "progress": False,
        }

        def keep(one: FinishedEpisode, told: int | None = cast.told_steps, failed: list[Any] = failed) -> None:
            steps = one.steps if told is None else one.steps[:told]
            if not steps["next", "success"].any():
                failed.append(one._replace(steps=steps))

        lw.evaluate(
            actor, tasks=args.tasks, episodes_per_task=args.episodes, stop_at_success=True, also_record=RECORDED,
            on_episode=keep, evaluator=cast.simulator or cast.evaluator, noise_scale=cast.noise, **run,
        )  # fmt: skip
        of_task = [[one for one in failed if one.task == task] for task in args.tasks]
        turns = [one for one in chain(*zip_longest(*of_task)) if one is not None]
        chosen = turns[: args.at_most - found]
        found += len(chosen)
        told = {"actor": actor, "reference": reference, "evaluator": cast.evaluator, **run}
        yield from attribute_failures(chosen, cast.plans, **told)
        print(f"    {policy}, step {step + 1}: {len(failed)} failed, {perf_counter() - start:.0f} s", flush=True)


def train(args: Arguments) -> Any:
    """A policy that imitates the scripted skills under the plans, trained once."""
    file, data = args.learned or args.out / "learned.safetensors", args.out / "demonstrations"
    if file.is_file():
        return lw.load_actor(file)
    tasks = dict.fromkeys((*BUILT_ON, *TASKS, *args.tasks))
    plans = lw.Plans({task: lw.load_plans("MT50")[task] for task in tasks})
    how: dict[str, Any] = {"policy": "scripted", "seed": 0, "noise_scale": (0.05, 0.1, 0.2), "max_steps": 150}
    collect_demonstrations(list(plans), episodes_per_task=10, root=data, progress=False, **how)
    sampler = lw.TaskBalancedSampler(exact=True)
    replay = lw.LanguageWorldExperienceReplay(data, label="executed", sampler=sampler, after_success=20)
    torch.manual_seed(0)
    features, decoder = lw.modules.ObservationFeatures("both", 0.05), lw.modules.MLPDecoder(width=192)
    actor = lw.PlanConditionedActor(plans, features=features, decoder=decoder)
    replay.append_transform(lw.QAFTransform(plans))
    config = lw.BehavioralCloningConfig(steps=1500, batch_size=50 * len(plans))
    lw.BehavioralCloningTrainer(actor, replay, config, checkpoint=file).train()
    return lw.load_actor(file)


def table(found: Mapping[str, Mapping[str, list[dict[str, Any]]]]) -> str:
    """What was planted down, what was said across, and below what it comes to."""
    rows, told = [], []
    for name, by_policy in found.items():
        fault = FAULTS[name]
        for policy, failures in by_policy.items():
            counts = [sum(one["cause"] == cause for one in failures) for cause in CAUSES]
            right = sum(is_right(fault, one) for one in failures)
            cells = [str(count) if count else "" for count in counts]
            rows.append((name, policy, *cells, f"{right} of {len(failures)}"))
    for (kind, policy), (right, count) in scores(found).items():
        said = f"{kind}, {policy}: {KINDS[kind]} {right} of {count}, {right / count:.3f}"
        some = [(FAULTS[name], one) for name, of in found.items() for one in of.get(policy, ())]
        some = [(fault, one) for fault, one in some if fault.kind == kind]
        if kind == "outside":
            exact = sum(one["cause"] in fault.causes for fault, one in some)
            said += f"; the fault itself {exact / len(some):.3f}"
        if kind == "two":
            exact = sum({one["cause"], one["also"]} == set(fault.causes) for fault, one in some)
            said += f"; both {exact / len(some):.3f}"
        told.append(said)
    return markdown_table(("planted", "policy", *CAUSES, "right"), rows) + "\n\n" + "\n".join(told) + "\n"


def scores(found: Mapping[str, Mapping[str, list[dict[str, Any]]]]) -> dict[tuple[str, str], tuple[int, int]]:
    """Kind of fault and policy to the number of failures whose cause was named right, and of all."""
    counts: dict[tuple[str, str], tuple[int, int]] = {}
    for kind in KINDS:
        for policy in ("scripted", "learned"):
            right = [
                is_right(FAULTS[name], failure)
                for name, by_policy in found.items()
                if FAULTS[name].kind == kind
                for failure in by_policy.get(policy, ())
            ]
            if right:
                counts[kind, policy] = sum(right), len(right)
    return counts


def is_right(fault: Fault, failure: Mapping[str, Any]) -> bool:
    return failure["cause"] in (*fault.causes, *(HARMLESS if fault.kind == "outside" else ()))


def main(args: Arguments) -> dict[str, dict[str, list[dict[str, Any]]]]:
    reference = lw.load_plans(REFERENCE)
    reference.require(args.tasks)
    learned = train(args) if "learned" in args.policies else None
    found: dict[str, dict[str, list[dict[str, Any]]]] = {}
    start = perf_counter()
    for name in args.faults:
        for policy in args.policies:
            file = args.out / f"seed-{args.seed}" / f"{name}, {policy}.json"
            if not file.is_file():
                said = [one.to_json() for one in failures_of(FAULTS[name], policy, args, learned, reference)]
                write_json(file, said)
            found.setdefault(name, {})[policy] = failures = json.loads(file.read_text("utf-8"))
            causes = [one["cause"] for one in failures]
            counts = ", ".join(f"{causes.count(cause)} {cause}" for cause in CAUSES if cause in causes)
            print(f"{name}, {policy}: {counts}; {(perf_counter() - start) / 60:.1f} minutes", flush=True)
            write_text(args.out / f"seed-{args.seed}.md", table(found))
    print(table(found))
    return found


if __name__ == "__main__":
    torch.set_num_threads(1)
    main(tyro.cli(Arguments))
