"""python -m benchmarks.faults: test whether attribute_failures finds planted faults."""

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

NATURAL = lw.load_plans("MT50")
REFERENCE = Path(__file__).parent / "data" / "attribution_plans.json"
BUILT_ON = (
    *("button-press-topdown", "drawer-open", "push", "plate-slide-back", "plate-slide-side", "handle-press-side"),
    *("door-close", "button-press-wall", "peg-unplug-side", "sweep", "hand-insert"),
)
"""Tasks on which the causes and thresholds of the diagnosis were tuned."""
TASKS = ("pick-place", "coffee-pull", "window-open", "faucet-open", "dial-turn")
RECORDED = ("observation", "task_id", "qaf", "skill_weights")


@dataclass
class Cast:
    """The parts of an episode, some of which are faulty: plans, skills, policy, answers, simulator and engine."""

    sound: lw.Plans
    scripted: bool
    plans: lw.Plans
    skills: Any = None
    shown: Shown | None = None
    done: Done | None = None
    evaluator: Any = None
    simulator: Transform | None = None  # between the policy and the environment
    engine: Any = None  # the simulator of the episodes
    told: bool = True  # whether attribution gets the simulator transform and the engine
    hidden: bool = False  # whether hooks on modules cannot observe the change of the action
    noise: float = 0.1
    told_noise: float | None = None  # the noise that attribution assumes; None for the actual noise
    told_steps: int | None = None  # number of steps of each episode that attribution gets; None for all

    def steps(self, step: int) -> dict[str, int]:
        """Return the index of the faulty plan step of each task, which differs between tasks."""
        return {task: (step + place) % len(plan.steps) for place, (task, plan) in enumerate(self.sound.items())}

    def texts(self, step: int) -> dict[str, str]:
        return {task: self.sound[task].steps[number].skill for task, number in self.steps(step).items()}

    def actor(self, learned: Any) -> Any:
        actor = (
            lw.ScriptedSkillActor(self.plans, skills=self.skills) if self.scripted else learned.with_plans(self.plans)
        )
        return actor if self.shown is None and self.done is None else Altered(actor, self.shown, self.done, self.hidden)


_ENOUGH, _MOST_TURNS = 12, 3
Plant = Callable[[Cast, int], None]


def in_plan(spoil: Callable[[lw.ConditionalPlan, int], lw.ConditionalPlan]) -> Plant:
    def plant(cast: Cast, step: int) -> None:
        cast.plans = lw.Plans({task: spoil(cast.sound[task], number) for task, number in cast.steps(step).items()})

    return plant


def in_skill(change: Callable[[torch.Tensor], torch.Tensor]) -> Plant:
    return lambda cast, step: setattr(cast, "done", InStep(cast.plans, cast.texts(step), change))


def offset_skill(cast: Cast, step: int) -> None:
    """Add an offset to a scripted skill's target or, for a learned policy, to its action."""
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
    """A fault, and the causes that count as correct diagnoses."""

    kind: str
    causes: tuple[str, ...]
    plant: Plant


_PARTS = ("perception", "query", "plan", "skill", "gripper", "actuation")
_HAND, _GRIPPER = ("actuation",), ("gripper",)
_ELSEWHERE = ("environment differs", "not reproducible")


def done(change: Any, hidden: bool = False) -> Plant:
    return setting(done=change, hidden=hidden)


def simulated(*factors: float, **change: Any) -> Plant:
    return setting(simulator=planted.Jammed(*factors, **change))


def physics(change: Callable[[Any], None], told: bool = False) -> Plant:
    return setting(engine=planted.OtherPhysics(change), told=told)


FAULTS: Mapping[str, Fault] = {
    "wrong condition": Fault("plan", ("plan",), in_plan(planted.denied)),
    "missing step": Fault("plan", ("plan",), in_plan(planted.without)),
    "exchanged skills": Fault("plan", ("plan",), in_plan(planted.swapped)),
    "a step too many": Fault("plan", ("plan",), in_plan(planted.with_extra)),
    "a skill 10 cm off": Fault("skill", ("skill",), offset_skill),
    "a skill to the wrong side": Fault("skill", ("skill",), in_skill(planted.scaled(-1.0, 1.0, 1.0, 1.0))),
    "a skill with x and y exchanged": Fault("skill", ("skill",), in_skill(planted.exchanged)),
    "a skill that drifts aside": Fault("skill", ("skill",), in_skill(planted.drifting(0.6))),
    "opposite answers": Fault("answers", ("query",), lie()),
    "answers always no": Fault("answers", ("query",), lie(never=True)),
    "random answers": Fault("answers", ("query",), flipped),
    "opposite answers, skill 10 cm off": Fault("answers", ("query", "skill"), both(lie(), offset_skill)),
    "view 15 steps late": Fault("perception", ("perception",), setting(shown=planted.late_view(15.0))),
    "thing seen 10 cm aside": Fault("perception", ("perception",), setting(shown=planted.moved_thing(0.1, 0.0))),
    "camera 10 cm aside, answers too": Fault("perception", ("perception",), sensor),
    "rollouts cut at 40 steps": Fault("noise", ("not reproducible",), setting(told_steps=40)),
    "hand at a quarter": Fault("motion", _HAND, done(planted.scaled(0.25, 0.25, 0.25, 1.0))),
    "hand hardly rises or sinks": Fault("motion", _HAND, done(planted.scaled(1.0, 1.0, 0.05, 1.0))),
    "hand mirrored": Fault("motion", _HAND, done(planted.scaled(-1.0, 1.0, 1.0, 1.0))),
    "hand turned by 60 degrees": Fault("motion", _HAND, done(planted.turned(60.0))),
    "hand 15 steps late": Fault("motion", _HAND, done(planted.Delayed(15, 0, 1, 2))),
    "fingers 40 steps late": Fault("motion", _GRIPPER, done(planted.Delayed(40, 3))),
    "gripper stays open": Fault("motion", _GRIPPER, done(planted.fingers(-1.0))),
    "hand that drifts aside": Fault("motion", _HAND, done(planted.drifting(0.6), hidden=True)),
    "hand with x and y exchanged": Fault("motion", _HAND, done(planted.exchanged, hidden=True)),
    "hand timid in small motions": Fault("motion", _HAND, done(planted.timid, hidden=True)),
    "simulator scales y by 0.1": Fault("motion", _HAND, simulated(1.0, 0.1, 1.0, 1.0)),
    "simulator turns by 45 degrees": Fault("motion", _HAND, simulated(change=planted.turned(45.0))),
    "slippery": Fault("physics", _ELSEWHERE, physics(planted.slippery)),
    "heavy": Fault("physics", _ELSEWHERE, physics(planted.heavy)),
    "stiff joints": Fault("physics", _ELSEWHERE, physics(planted.stiff)),
    "slack hand": Fault("physics", _ELSEWHERE, physics(planted.slack, told=True)),
    "weak fingers": Fault("physics", _ELSEWHERE, physics(planted.weak_fingers, told=True)),
    "upside down": Fault("physics", _ELSEWHERE, physics(planted.upside_down)),
    "noise of 0.6": Fault("noise", ("noise",), setting(noise=0.6)),
    "noise of 0.7": Fault("noise", ("noise",), setting(noise=0.7)),
    "noise of 0.8": Fault("noise", ("noise",), setting(noise=0.8)),
    "noise of 0.9": Fault("noise", ("noise",), setting(noise=0.9)),
    "noise of 1": Fault("noise", ("noise",), setting(noise=1.0)),
    "other noise than told": Fault("noise", ("not reproducible", "noise"), setting(noise=1.0, told_noise=0.1)),
}
"""Faults by name. A motion fault affects all plan steps. For noise, no part is faulty."""
KINDS = tuple(dict.fromkeys(fault.kind for fault in FAULTS.values()))


@dataclass(frozen=True)
class Arguments:
    """Plant faults and diagnose the failures. If the command is stopped, run it again to resume."""

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
    """File of the learned policy; by default, it is trained once and saved in the folder --out."""
    out: Path = Path("runs/faults")
    """Folder for the results, the policy and the tables."""


def failures_of(fault: Fault, policy: str, args: Arguments, learned: Any, reference: lw.Plans) -> Iterator[Any]:
    """Yield the diagnoses of a fault's failures, with the fault in one plan step after another."""
    found = 0
    for step in range(_MOST_TURNS):
        if found >= min(_ENOUGH, args.at_most):
            return
        start = perf_counter()
        sound = lw.Plans({task: NATURAL[task] for task in args.tasks})
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
            on_episode=keep, evaluator=cast.simulator or cast.evaluator, noise_scale=cast.noise, engine=cast.engine,
            **run,
        )  # fmt: skip
        of_task = [[one for one in failed if one.task == task] for task in args.tasks]
        turns = [one for one in chain(*zip_longest(*of_task)) if one is not None]
        chosen = turns[: args.at_most - found]
        found += len(chosen)
        evaluator = (cast.simulator if cast.told else None) or cast.evaluator
        noise = cast.noise if cast.told_noise is None else cast.told_noise
        told = {"actor": actor, "reference": reference, "evaluator": evaluator, "noise_scale": noise, **run}
        told["engine"] = cast.engine if cast.told else None
        yield from attribute_failures(chosen, cast.plans, **told)
        print(f"    {policy}, step {step + 1}: {len(failed)} failed, {perf_counter() - start:.0f} s", flush=True)


def train(args: Arguments) -> Any:
    """Return a policy that imitates the scripted skills with the plans; train it unless its file exists."""
    file, data = args.learned or args.out / "learned.safetensors", args.out / "demonstrations"
    if file.is_file():
        return lw.load_actor(file)
    tasks = dict.fromkeys((*BUILT_ON, *TASKS, *args.tasks))
    plans = lw.Plans({task: NATURAL[task] for task in tasks})
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
    """Return a table with a row per planted fault and a column per diagnosed cause, followed by a summary."""
    rows, told = [], []
    for name, by_policy in found.items():
        fault = FAULTS[name]
        for policy, failures in by_policy.items():
            counts = [sum(one["cause"] == cause for one in failures) for cause in CAUSES]
            right = sum(is_right(fault, one) for one in failures)
            cells = [str(count) if count else "" for count in counts]
            rows.append((name, policy, *cells, f"{right} of {len(failures)}"))
    for (kind, policy), (right, count, sound) in scores(found).items():
        told.append(
            f"{kind}, {policy}: named right {right} of {count}, {right / count:.3f}; a sound part blamed {sound}"
        )
    totals = [sum(numbers) for numbers in zip(*scores(found).values(), strict=True)]
    told.append(f"all: named right {totals[0]} of {totals[1]}; a sound part blamed {totals[2] / totals[1]:.3f}")
    return markdown_table(("planted", "policy", *CAUSES, "right"), rows) + "\n\n" + "\n".join(told) + "\n"


def scores(found: Mapping[str, Mapping[str, list[dict[str, Any]]]]) -> dict[tuple[str, str], tuple[int, int, int]]:
    """Return, for each kind of fault and policy, the number of failures with a correct cause, of all failures, and of
    failures for which a part without a fault was blamed."""
    counts: dict[tuple[str, str], tuple[int, int, int]] = {}
    for kind in KINDS:
        for policy in ("scripted", "learned"):
            faults = [(FAULTS[name], one) for name, of in found.items() for one in of.get(policy, ())]
            faults = [(fault, one) for fault, one in faults if fault.kind == kind]
            if faults:
                right = [is_right(*each) for each in faults]
                sound = [one["cause"] in _PARTS and not is_right(fault, one) for fault, one in faults]
                counts[kind, policy] = sum(right), len(faults), sum(sound)
    return counts


def is_right(fault: Fault, failure: Mapping[str, Any]) -> bool:
    return failure["cause"] in fault.causes


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
