"""python -m benchmarks.goldens: check that results which a refactoring must not change are still the same.

The golden results are small files in benchmarks/data/goldens. Each check compares the current code with a file and
prints one line.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import Any, Literal

import torch
import tyro
from safetensors.torch import load_file, save_file
from tensordict import TensorDict

import lw_torchrl as lw
from benchmarks.any_plans import DEVELOPMENT, TEST
from lw_torchrl.language.canonical import explain_canonical

DATA = Path(__file__).parent / "data" / "goldens"
OWN_WORDS = Path(__file__).parent / "data" / "own_words.json"
MAX_ACTION_DIFFERENCE = 1e-6
MAX_SUCCESS_DIFFERENCE = 0.01
"""Tolerance of the mean success: other processors round differently, and contact amplifies that."""
MAX_DEMO_DIFFERENCE = 0.05
"""Tolerance of the demo, which trains: training need not be bit-identical, and its seeds spread from 0.960 to 1.000."""
MAX_FAULT_DIFFERENCE = 0.02
STATES_PER_TASK = 40


@dataclass(frozen=True)
class Arguments:
    """Check that the results of plans, queries, policies and diagnoses have not changed; exit with 1 if one has."""

    names: tyro.conf.Positional[tuple[Literal["plans", "queries", "actions", "success", "demo", "faults"], ...]] = (
        "plans", "queries", "actions", "success", "demo", "faults",
    )  # fmt: skip
    """Checks to run. Together they take about 8 minutes on two cores."""
    palm2: Path | None = None
    """PaLM 2's plans, a .json file of (condition, skill) pairs, which is not shipped; by default, they are not
    checked."""
    write: bool = False
    """Write the goldens instead of checking them."""


def canonical_forms(args: Arguments) -> Any:
    """Return the canonical form of every plan: its source and its steps."""
    written: dict[str, lw.Plans] = {
        "natural": lw.load_plans("MT50"),
        "MT10's words": lw.load_plans("MT50", skills="MT10"),
    }
    for style, tasks in json.loads(OWN_WORDS.read_text("utf-8")).items():
        written[f"own words, {style}"] = lw.Plans(
            [lw.ConditionalPlan.from_pairs(task, pairs) for task, pairs in tasks.items()]
        )
    if args.palm2 is not None:
        written["PaLM 2"] = lw.load_plans(args.palm2)
    return {name: {task: _form(plan) for task, plan in plans.items()} for name, plans in written.items()}


def _form(plan: lw.ConditionalPlan) -> list[str]:
    report = explain_canonical(plan)
    steps = []
    for step in report.plan.steps:
        assert step.role is not None
        steps.append(f"{step.condition} -> {step.skill} ({step.role.manner}, {step.role.confidence:g})")
    source = "default" if report.source == "fallback" else report.source  # as the goldens name it
    return [source, *steps]


def check_plans(args: Arguments) -> Iterator[tuple[str, bool]]:
    now = canonical_forms(args)
    path = DATA / "canonical_plans.json"
    if args.write:
        path.write_text(json.dumps(now, indent=0, sort_keys=True) + "\n", "utf-8")
    before = json.loads(path.read_text("utf-8"))
    for name in before:
        if name not in now:
            yield f"{name}: not checked, pass --palm2", True
            continue
        different = [task for task in before[name] if before[name][task] != now[name].get(task)]
        yield f"{name}: {len(before[name])} plans, different: {', '.join(different) or 'none'}", not different


def _collect_states() -> dict[str, torch.Tensor]:
    """Return states of every task, from noisy episodes of the shipped policy and of the scripted skills."""
    observations, tasks = [], []
    actors = (lw.load_actor("few-shot-mt50"), lw.ScriptedSkillActor(lw.load_plans("MT50")))
    for actor, noise in zip(actors, (0.3, 0.6), strict=True):
        for task in lw.MT50:
            env = lw.LanguageWorldEnv([task], num_envs=4, seed=77, max_steps=120)
            with torch.no_grad():
                policy = _noisy(actor, noise, lw.QAFTransform(actor.plans))
                rollout = env.rollout(120, policy, break_when_any_done=False)
            env.close()
            rows = rollout["observation"].reshape(-1, 39)
            chosen = torch.linspace(0, len(rows) - 1, STATES_PER_TASK // 2).long()
            observations.append(rows[chosen])
            tasks.append(torch.full((len(chosen),), lw.task_id(task)))
    return {"observation": torch.cat(observations), "task_id": torch.cat(tasks)}


def _noisy(actor: Any, noise: float, qaf: lw.QAFTransform) -> Callable[[TensorDict], TensorDict]:
    generator = torch.Generator().manual_seed(0)

    def act(tensordict: TensorDict) -> TensorDict:
        acted = actor(qaf(tensordict))
        disturbed = acted["action"] + noise * torch.randn(acted["action"].shape, generator=generator)
        return acted.set("action", disturbed.clamp(-1, 1))

    return act


def check_queries(args: Arguments) -> Iterator[tuple[str, bool]]:
    path, truth_path = DATA / "states.safetensors", DATA / "query_truth.json"
    if args.write:
        save_file(_collect_states(), path)
    states = load_file(path)
    names = [task for task in lw.MT50 for _ in (states["task_id"] == lw.task_id(task)).nonzero()]
    program = lw.QueryProgram({task: list(map(str, lw.supported_queries(task))) for task in lw.MT50})
    answers = {
        "every query": program(states["observation"], states["task_id"]),
        "natural plans": _qaf(states, lw.load_plans("MT50")),
        "plans in MT10's words": _qaf(states, lw.load_plans("MT50", skills="MT10")),
    }
    now = {
        name: {
            task: [int(rows.sum()), sha256(rows.numpy().tobytes()).hexdigest()[:16]]
            for task in lw.MT50
            for rows in [truth[states["task_id"] == lw.task_id(task)]]
        }
        for name, truth in answers.items()
    }
    if args.write:
        truth_path.write_text(json.dumps(now, indent=0) + "\n", "utf-8")
    before = json.loads(truth_path.read_text("utf-8"))
    for name in before:
        different = [task for task in before[name] if before[name][task] != now[name][task]]
        size = f"{len(names)} states, {answers[name].shape[1]} queries a task at most"
        yield f"{name}: {size}, tasks with other answers: {', '.join(different) or 'none'}", not different


def _qaf(states: dict[str, torch.Tensor], plans: lw.Plans) -> torch.Tensor:
    return lw.QAFTransform(plans)(TensorDict(dict(states), [len(states["task_id"])]))["qaf"] > 0.5


def check_actions(args: Arguments) -> Iterator[tuple[str, bool]]:
    path = DATA / "actions.safetensors"
    states = load_file(DATA / "states.safetensors")
    actor = lw.load_actor("few-shot-mt50").eval()
    rows = TensorDict({name: values[::4] for name, values in states.items()}, [len(states["task_id"][::4])])
    with torch.no_grad():
        actions = actor(lw.QAFTransform(actor.plans)(rows))["action"]
    if args.write:
        save_file({"action": actions}, path)
    difference = (actions - load_file(path)["action"]).abs().max().item()
    said = f"few-shot-mt50, {len(actions)} states: actions differ by at most {difference:.1e}"
    yield said, difference <= MAX_ACTION_DIFFERENCE


def _evaluations() -> dict[str, tuple[Any, tuple[str, ...]]]:
    """Return the actors to evaluate by name, with the tasks of each."""
    natural = lw.load_plans("MT50")
    zero_shot = lw.load_actor(DATA / "zero-shot-seed0.safetensors")
    outside = (*DEVELOPMENT, *TEST)
    return {
        "shipped policy few-shot-mt50": (lw.load_actor("few-shot-mt50"), lw.MT50),
        "scripted skills": (lw.ScriptedSkillActor(natural), lw.MT50),
        "zero-shot, natural plans": (
            zero_shot.with_plans(lw.canonical_plans(lw.Plans([natural[task] for task in outside]), fallback=True)),
            outside,
        ),
    }


def check_success(args: Arguments) -> Iterator[tuple[str, bool]]:
    path = DATA / "success.json"
    before: dict[str, dict[str, float]] = json.loads(path.read_text("utf-8")) if path.is_file() else {}
    for name, (actor, tasks) in _evaluations().items():
        result = lw.evaluate(
            actor, tasks=tasks, seed=10_000, noise_scale=0.1, stop_at_success=True, progress=sys.stderr.isatty()
        )
        if args.write:
            before[name] = dict(result.success_once)
            path.write_text(json.dumps(before, indent=0) + "\n", "utf-8")
        mean = sum(before[name].values()) / len(before[name])
        different = [task for task in before[name] if before[name][task] != result.success_once[task]]
        said = f"{name}: {result.mean_success:.4f}, golden {mean:.4f}, other in {', '.join(different) or 'no task'}"
        yield said, abs(result.mean_success - mean) <= MAX_SUCCESS_DIFFERENCE


def check_demo(args: Arguments) -> Iterator[tuple[str, bool]]:
    from lw_torchrl.cli.demo import DemoConfig, run_demo

    path = DATA / "demo.json"
    with TemporaryDirectory() as folder:
        mean = run_demo(Path(folder), DemoConfig()).mean_success
    if args.write:
        path.write_text(json.dumps({"mean": mean}) + "\n", "utf-8")
    before = json.loads(path.read_text("utf-8"))["mean"]
    yield f"demo: {mean:.3f}, golden {before:.3f}", abs(mean - before) <= MAX_DEMO_DIFFERENCE


def check_faults(args: Arguments) -> Iterator[tuple[str, bool]]:
    from benchmarks import faults

    path = DATA / "faults.json"
    with TemporaryDirectory() as folder:
        chosen = faults.Arguments(seed=9000, learned=DATA / "faults-policy.safetensors", out=Path(folder))
        now = {", ".join(key): count for key, count in faults.scores(faults.main(chosen)).items()}
    if args.write:
        path.write_text(json.dumps(now, indent=0) + "\n", "utf-8")
    for name, (right, of, _) in json.loads(path.read_text("utf-8")).items():
        said = f"{name}: right in {now[name][0]} of {now[name][1]}, golden {right} of {of}"
        yield said, abs(now[name][0] / now[name][1] - right / of) <= MAX_FAULT_DIFFERENCE


CHECKS: dict[str, Callable[[Arguments], Iterator[tuple[str, bool]]]] = {
    "plans": check_plans,
    "queries": check_queries,
    "actions": check_actions,
    "success": check_success,
    "demo": check_demo,
    "faults": check_faults,
}


def main(args: Arguments) -> int:
    failed = 0
    for name in args.names:
        start = perf_counter()
        for said, same in CHECKS[name](args):
            failed += not same
            print(f"{'same     ' if same else 'DIFFERENT'} {name}: {said} ({perf_counter() - start:.0f} s)", flush=True)
    return int(failed > 0)


if __name__ == "__main__":
    torch.set_num_threads(1)
    sys.exit(main(tyro.cli(Arguments)))
