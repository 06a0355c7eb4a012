"""python -m benchmarks.truth: measure success with rare or wrong answers to conditions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
import tyro

import lw_torchrl as lw
from benchmarks.figures import Panel, markdown_table, plot_panels
from benchmarks.statistics import Estimate, count_solved
from lw_torchrl._util.files import write_text
from lw_torchrl.evaluation import EvaluationResult
from lw_torchrl.evaluation.result import wilson_interval

if TYPE_CHECKING:
    from matplotlib.figure import Figure

CLOSE = 0.05
"""Maximum loss of success with which an evaluator still counts as useful."""


class Cell(NamedTuple):
    """A way to answer conditions: exactly, every few steps, or with errors."""

    kind: str
    """"every" (steps between answers) or "flip" (probability that an answer is wrong)."""
    value: float

    @property
    def exact(self) -> bool:
        """Whether all answers are exact."""
        return self == ("every", 1) or self == ("flip", 0)

    @property
    def name(self) -> str:
        if self.exact:
            return "exact"
        return f"every {self.value:g} steps" if self.kind == "every" else f"{100 * self.value:g}% flipped"

    def evaluator(self, plans: lw.Plans, seed: int) -> Any:
        """Return the transform that corrupts the answers; None for exact answers."""
        if self.exact:
            return None
        if self.kind == "every":
            return lw.transforms.CorruptQAF(plans, every=int(self.value))
        return lw.transforms.CorruptQAF(plans, flip=self.value, seed=seed)


@dataclass(frozen=True)
class Arguments:
    """Evaluate policies with rare or wrong answers to conditions, all in the same episodes with the same noise.

    If the command is stopped, run it again to resume.
    """

    policy: tuple[Path, ...] = ()
    """Policy files; policies of the same kind, such as several training seeds, are drawn as one curve."""
    scripted: bool = True
    """Also evaluate scripted skills."""
    plans: str = "MT50"
    """Plans of the scripted skills: MT10, MT50, a file or a folder."""
    tasks: tuple[str, ...] = lw.MT10
    """Tasks; by default those of the policy."""
    every: tuple[int, ...] = (1, 2, 5, 10, 25, 50)
    """Numbers of steps between answers."""
    flip: tuple[float, ...] = (0.0, 0.01, 0.05, 0.1, 0.2)
    """Probabilities that an answer is wrong, drawn at each step."""
    episodes: int = 20
    """Number of episodes per task and seed."""
    seeds: tuple[int, ...] = (2000,)
    """Random seed of the episodes (use a different one than for demonstrations)."""
    max_steps: int = 500
    """Number of steps per episode."""
    noise: float = 0.1
    """Standard deviation of the action noise."""
    quick: bool = False
    """Run two tasks, two short episodes and two points as a test; the numbers are meaningless."""
    out: Path = Path("runs/truth")
    """Folder for the results, table.md and truth.png."""

    @property
    def cells(self) -> list[Cell]:
        """Return all ways to answer conditions, with exact answers first."""
        found = [Cell("every", k) for k in self.every] + [Cell("flip", p) for p in self.flip]
        return sorted({cell.name: cell for cell in found}.values(), key=lambda cell: not cell.exact)


class Acting(NamedTuple):
    """An actor to evaluate, with the name of its curve and a unique name."""

    curve: str
    name: str
    actor: Any


def acting(args: Arguments) -> list[Acting]:
    """Return the policies from their files, and scripted skills."""
    found = []
    for file in args.policy:
        actor = lw.load_actor(file)
        if "qaf" not in actor.in_keys:
            raise SystemExit(f"--policy: {file} must read qaf to depend on answers, but reads {actor.in_keys}")
        name = f"{file.stem}-{sha256(file.read_bytes()).hexdigest()[:8]}"
        found.append(Acting(type(actor).__name__, name, actor))
    if args.scripted:
        loaded = lw.load_plans(args.plans)
        loaded.require(args.tasks)
        plans = lw.Plans({task: loaded[task] for task in args.tasks})
        found.append(Acting("scripted skills", f"scripted-{plans.fingerprint[:8]}", lw.ScriptedSkillActor(plans)))
    return found


def run_unit(one: Acting, cell: Cell, seed: int, args: Arguments) -> EvaluationResult:
    """Evaluate an actor with one way to answer conditions, or read the result if it exists."""
    folder = f"seed-{seed}-{args.episodes}-episodes-{args.max_steps}-steps-noise-{args.noise:g}"
    file = args.out / folder / f"{one.name}, {cell.name}.json"
    tasks = [task for task in args.tasks if task in one.actor.tasks]
    if file.is_file() and (found := EvaluationResult.load(file)).config["tasks"] == tasks:
        return found
    result = lw.evaluate(
        one.actor,
        tasks=tasks,
        episodes_per_task=args.episodes,
        seed=seed,
        noise_scale=args.noise,
        max_steps=args.max_steps,
        stop_at_success=True,
        evaluator=cell.evaluator(one.actor.plans, seed),
        progress=False,
    )
    file.parent.mkdir(parents=True, exist_ok=True)
    result.save(file)
    return result


class Found:
    """The results of each curve and cell, all on the same tasks."""

    def __init__(self) -> None:
        self._by: dict[str, dict[str, list[EvaluationResult]]] = {}

    def add(self, curve: str, cell: Cell, result: EvaluationResult) -> None:
        self._by.setdefault(curve, {}).setdefault(cell.name, []).append(result)

    @property
    def curves(self) -> list[str]:
        return list(self._by)

    def hits(self, curve: str, cell: Cell) -> np.ndarray | None:
        """Return the success (episodes, tasks) as 0 or 1 for all policies and seeds, or None without results."""
        results = self._by[curve].get(cell.name)
        return None if results is None else np.concatenate([_hits(result) for result in results])

    def tasks(self, curve: str) -> list[str]:
        return list(next(iter(self._by[curve].values()))[0].config["tasks"])


def _hits(result: EvaluationResult) -> np.ndarray:
    by_task = {task: [e.success for e in result.episodes if e.task == task] for task in result.config["tasks"]}
    return np.array(list(by_task.values()), dtype=np.float64).T


def _rate(hits: np.ndarray) -> Estimate:
    """Return the mean over tasks with the Wilson interval over all episodes.

    The interval is slightly too wide, because tasks differ, but has a positive width even if all episodes succeed. It
    applies to these policies only, not to others trained in the same way.
    """
    return Estimate(float(hits.mean()), *wilson_interval(int(hits.sum()), hits.size))


def table(found: Found, cells: Sequence[Cell]) -> str:
    """Return tables of mean success with intervals and of each task, and the accuracy that an evaluator needs."""
    head, rows = ["answers", *found.curves, *(f"tasks >= 0.8, {curve}" for curve in found.curves)], []
    for cell in cells:
        hits = [found.hits(curve, cell) for curve in found.curves]
        means = ["" if one is None else str(_rate(one)) for one in hits]
        solved = ["" if one is None else str(count_solved(one)) for one in hits]
        rows.append([cell.name, *means, *solved])
    text = markdown_table(head, rows) + "\n\n"
    for curve in found.curves:
        text += f"{curve}: {within(found, curve, cells)}  \n"
    for curve in found.curves:
        done = [(cell, hits) for cell in cells if (hits := found.hits(curve, cell)) is not None]
        rates = [
            [task, *(f"{hits[:, place].mean():.2f}" for _, hits in done)]
            for place, task in enumerate(found.tasks(curve))
        ]
        text += "\n" + markdown_table([curve, *(cell.name for cell, _ in done)], rates) + "\n"
    return text


def within(found: Found, curve: str, cells: Sequence[Cell]) -> str:
    """Return a sentence on how rare and how wrong answers may be without much loss of success."""
    exact = next((found.hits(curve, cell) for cell in cells if cell.exact), None)
    if exact is None:
        return "exact answers were not evaluated"
    least = exact.mean() - CLOSE
    told = []
    for kind, words in (("every", "answers every {:g} steps"), ("flip", "{:g}% flipped")):
        far: float | None = None
        for cell in sorted((cell for cell in cells if cell.kind == kind or cell.exact), key=lambda cell: cell.value):
            hits = found.hits(curve, cell)
            if hits is None or hits.mean() < least - 1e-9:
                break
            far = cell.value if cell.kind == kind and not cell.exact else far
        told.append("only exact answers" if far is None else words.format(100 * far if kind == "flip" else far))
    return f"within {CLOSE:g} of exact answers up to {told[0]}; up to {told[1]}"


def figure(found: Found, args: Arguments, path: Path | None = None) -> Figure:
    """Draw success with late and with wrong answers: a point for each rate, with its 95 % interval."""
    columns = {
        "Late answers: steps between answers": [Cell("every", k) for k in args.every],
        "Wrong answers: flipped in each step": [Cell("flip", p) for p in args.flip],
    }
    panels: list[Panel] = []
    for title, cells in columns.items():
        places = [f"{cell.value:g}" if cell.kind == "every" else f"{100 * cell.value:g} %" for cell in cells]
        rates = {curve: [_ends(found.hits(curve, cell)) for cell in cells] for curve in found.curves}
        panels.append((title, places, rates))
    return plot_panels(panels, path)


def _ends(hits: np.ndarray | None) -> tuple[float, float, float] | None:
    if hits is None:
        return None
    return float(hits.mean()), *wilson_interval(int(hits.sum()), hits.size)


def main(args: Arguments) -> None:
    if args.quick:
        args = replace(
            args, tasks=args.tasks[:2], every=(1, 5), flip=(0.0, 0.2), episodes=2, seeds=args.seeds[:1], max_steps=150,
        )  # fmt: skip
    everyone, found = acting(args), Found()
    if not everyone:
        raise SystemExit("there is no policy to evaluate: add --policy FILE, or remove --no-scripted")
    total, done = len(args.cells) * len(everyone) * len(args.seeds), 0
    for cell in args.cells:
        for one in everyone:
            for seed in args.seeds:
                result = run_unit(one, cell, seed, args)
                found.add(one.curve, cell, result)
                done += 1
                print(f"[{done}/{total}] {one.name}, {cell.name}, seed {seed}: {result.mean_success:.3f}", flush=True)
        write_text(args.out / "table.md", table(found, args.cells))
    figure(found, args, args.out / "truth.png")
    print(f"\n{table(found, args.cells)}\nwritten to {args.out / 'table.md'} and {args.out / 'truth.png'}")


if __name__ == "__main__":
    torch.set_num_threads(1)
    main(tyro.cli(Arguments))
