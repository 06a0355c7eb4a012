"""python -m benchmarks scaling [--gpu]: measure the speed on all cores and on the GPU of this machine.

The script needs neither a network nor the packages for tests. Each benchmark runs in a separate process and prints
rows as it measures them, so that the next benchmark runs even after an error or a failure of the GPU.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import torch
import tyro
from torchrl.envs import Compose, TransformedEnv

import lw_torchrl as lw
from benchmarks.paper.actors import Parts
from benchmarks.paper.stacked import StackedBehavioralCloning
from benchmarks.report import timed
from lw_torchrl._util.files import write_json
from lw_torchrl._util.workers import available_cores
from lw_torchrl.training.loop import Training
from lw_torchrl.training.offline import DISTRIBUTIONS, GAMMA, N_STEPS, make_loss

NOISY: dict[str, Any] = {"noise_scale": (0.0, 0.1, 0.2, 0.3, 0.4), "noise_hold": 10, "redraw_failures": True}
UNSEEN = Parts(features="none", roles=True, fallback=True, feature_noise=0.05, yaw=10.0, tilt=0.5, jitter=0.03)
TURNED = Parts(yaw=0.3, focus=True, any_yaw=True)
RECIPES = {"few-shot": (Parts(), 500), "few-shot, turned scenes": (TURNED, 200), "zero-shot": (UNSEEN, 200)}
ONE_SHOT = Parts(features="differences", feature_noise=0.1, focus=True, roles=True, swap_unmentioned=0.5)
Row = dict[str, Any]


@dataclass(frozen=True)
class Arguments:
    """Measure the speed of the library on several cores and on the GPU of this machine."""

    gpu: bool = False
    """Also measure the GPU."""
    rows: tuple[str, ...] = ()
    """Names of the benchmarks to run; by default all that this machine supports."""
    quick: bool = False
    """Run a small version as a test; its numbers are meaningless."""
    seconds: float = 460.0
    """Start no benchmark after this many seconds."""
    folder: Path = Path("runs/scaling")
    """Folder for demonstrations, policies and scaling.json; results are also written to $OUT, if it is set."""
    here: bool = False
    """Run the benchmarks in this process."""

    @property
    def device(self) -> str:
        return "cuda:0" if self.gpu and torch.cuda.is_available() else "cpu"

    @property
    def demos(self) -> Path:
        """The folder of demonstrations of MT50. The first benchmark that needs them collects them."""
        root = self.folder / "mt50"
        if not (self.folder / "done").exists():
            size: Row = {"episodes_per_task": self.pick(10, 1), "max_steps": self.pick(500, 20), "progress": False}
            lw.collect_demonstrations(lw.MT50, root=root, **size, **({} if self.quick else NOISY))
            (self.folder / "done").touch()
        return root

    def pick(self, full: int, quick: int) -> int:
        return quick if self.quick else full

    def each(self, step: Callable[[], Any], number: int) -> float:
        """Return the mean milliseconds of ``number`` calls, with a single synchronization at the end."""

        def steps() -> None:
            for _ in range(number):
                step()
            if self.device != "cpu":
                torch.accelerator.synchronize()

        return round(1e3 * timed(steps) / number, 3)

    def replay(self, transform: Any, sampler: Any = None, **options: Any) -> Any:
        options = {"after_success": 20, "device": self.device} | options
        sampler = lw.TaskBalancedSampler() if sampler is None else sampler
        return lw.LanguageWorldExperienceReplay(self.demos, sampler=sampler, transform=transform, **options)

    def cloning(self, recipe: str, steps: int = 10_000, **options: Any) -> lw.BehavioralCloningTrainer:
        torch.manual_seed(0)
        parts, size = RECIPES[recipe]
        actor = parts.actor("pcbc", parts.seen(lw.load_plans("MT50")))
        config = lw.BehavioralCloningConfig(steps=steps, batch_size=size)
        replay = self.replay(parts.transform(actor))
        return lw.BehavioralCloningTrainer(actor, replay, config, device=self.device, progress=False, **options)

    def measured(self, name: str, trainer: Training, number: int, **more: Any) -> Row:
        """Measure a trainer's step after the warm-up, and the share of the captured graph."""
        losses = [trainer.step() for _ in range(5)]
        row: Row = {"row": name, "ms": self.each(trainer.step, self.pick(number, 2))}
        captured = trainer._captured
        if captured is not None and captured.is_captured:
            row["ms graph"] = self.each(captured._graph.replay, number)
        return row | {"loss": round(float(losses[-1].mean()), 6)} | more


def machine(args: Arguments) -> Iterator[Row]:
    """Yield the machine and the package versions."""
    from importlib.metadata import version

    row: Row = {"row": "machine", "cores": available_cores(), "python": sys.version.split()[0]}
    row |= {package: version(package) for package in ("torch", "torchrl", "tensordict", "mujoco", "numpy")}
    yield row | ({"gpu": torch.cuda.get_device_name()} if args.device != "cpu" else {})


def cloning(args: Arguments) -> Iterator[Row]:
    """Measure a step of behavioral cloning, without and with a CUDA graph, and the GPU memory."""
    for recipe, (_, size) in RECIPES.items():
        for capture in (False, True):
            trainer = args.cloning(recipe, capture=capture)
            name = f"cloning, {recipe} recipe, batch {size}, {'captured' if capture else 'eager'}"
            asked = {"asked": "0.8 ms"} if capture and recipe == "few-shot" else {}
            yield args.measured(name, trainer, 500 if capture else 50, **asked)
    if args.device != "cpu":
        yield {"row": "GPU memory of the three recipes, MB", "most": round(torch.cuda.max_memory_allocated() / 1e6)}


def few_shot(args: Arguments) -> Iterator[Row]:
    """Measure the training time, evaluation time and success of the few-shot experiment's network."""
    steps = args.pick(12_000, 5)
    trainer = args.cloning("few-shot", steps)
    seconds = timed(trainer.train)
    yield {"row": "few-shot, one network", "steps": steps, "seconds": round(seconds, 2), "asked": "15 s"}
    options: dict[str, Any] = {"tasks": "MT50", "episodes_per_task": args.pick(10, 1), "seed": 10_000}
    options |= {"noise_scale": 0.1, "stop_at_success": True, "max_steps": args.pick(500, 5), "progress": False}
    results: list[lw.EvaluationResult] = []
    seconds = timed(lambda: results.append(lw.evaluate(trainer.actor.cpu(), **options)))
    rates = [rate or 0.0 for rate in results[0].success_once.values()]
    yield {"row": "few-shot, evaluation", "success": round(sum(rates) / len(rates), 3), "seconds": round(seconds, 2)}


def stacked(args: Arguments) -> Iterator[Row]:
    """Measure a training step of twenty stacked one-shot models."""
    plans, number = lw.load_plans("MT50"), args.pick(20, 2)
    for capture in (False, True):
        torch.manual_seed(0)
        actors = [ONE_SHOT.actor("pcbc", ONE_SHOT.seen(plans)) for _ in range(number)]
        replays = []
        for target, actor in zip([task for task in lw.MT50 if task not in lw.MT10], actors, strict=False):
            episodes = dict.fromkeys(lw.MT10, args.pick(10, 1)) | {target: 1}
            sampler = lw.CoLearningSampler(target, exact=True)
            replays.append(args.replay(ONE_SHOT.transform(actor), sampler, episodes=episodes))
        config = lw.BehavioralCloningConfig(steps=10_000, batch_size=180)
        how: dict[str, Any] = {"device": args.device, "progress": False, "capture": capture}
        name = f"{number} stacked models, one-shot recipe, {'captured' if capture else 'eager'}"
        trainer = StackedBehavioralCloning(actors, replays, config, **how)
        yield args.measured(name, trainer, 50, **({"asked": "4 ms"} if capture else {}))


def offline(args: Arguments) -> Iterator[Row]:
    """Measure training steps of the offline losses with batch size 250."""
    plans = lw.load_plans("MT50")
    for name, distribution in DISTRIBUTIONS.items():
        torch.manual_seed(0)
        actor = lw.PlanConditionedActor(plans)
        actor = actor if distribution is None else actor.stochastic(distribution)
        replay = args.replay(lw.QAFTransform(plans), label="executed", n_steps=N_STEPS, gamma=GAMMA)
        replay.add_column("advantage", torch.zeros(len(replay), 1))
        loss = make_loss(name, actor, plans, replay).to(args.device)
        trainer = lw.OfflineTrainer(loss, replay, lw.OfflineConfig(steps=10_000), progress=False)
        yield args.measured(f"offline loss {name}", trainer, 200)


def evaluators(args: Arguments) -> Iterator[Row]:
    """Measure training steps of query evaluators on states and on pictures, which are random."""
    plans, training, modules = lw.load_plans("MT50"), lw.training, lw.modules
    kinds: Any = {
        "states": (modules.StateQueryEvaluator, training.QueryEvaluatorConfig),
        "pictures": (modules.ImageQueryEvaluator, training.ImageQueryEvaluatorConfig),
    }
    replay = args.replay(None, label="executed", device=None, episodes={task: args.pick(2, 1) for task in lw.MT50[::5]})
    replay.add_column("pixels", torch.randint(256, (len(replay), 64, 128, 3), dtype=torch.uint8))
    for kind, (make, configure) in kinds.items():
        config = configure(steps=10_000)
        data = training.LabelledQueries(replay, config)
        options: Any = {"device": args.device, "progress": False}
        yield args.measured(
            f"evaluator of {kind}", training.QueryEvaluatorTrainer(make(plans), data, config, **options), 50
        )


def rollout(args: Arguments) -> Iterator[Row]:
    """Measure a rollout of environment and policy on the device, and on the CPU."""
    plans = lw.canonical_plans(lw.load_plans("MT50"), fallback=True)
    for device in dict.fromkeys((args.device, "cpu")):
        torch.manual_seed(0)
        actor = lw.PlanConditionedActor(plans).to(device).eval()
        parts = Compose(lw.QAFTransform(plans), lw.transforms.FallbackTurns())
        env, steps = TransformedEnv(lw.LanguageWorldEnv("MT50", device=device), parts), args.pick(100, 3)
        with torch.no_grad():
            env.rollout(3, actor)
            start = perf_counter()
            env.rollout(steps, actor, break_when_any_done=False)
            seconds = perf_counter() - start
        env.close()
        yield {"row": f"rollout, N = 50, {device}", "ms": round(1e3 * seconds / steps, 2)}


def workers(args: Arguments) -> Iterator[Row]:
    """Measure the collection of expert demonstrations of MT50, and an evaluation, with several worker processes."""
    size = {"episodes_per_task": args.pick(10, 1), "max_steps": args.pick(500, 5)}
    run: dict[str, Any] = {"workers": available_cores(), "progress": False} | size
    torch.manual_seed(0)
    actor = lw.PlanConditionedActor(lw.load_plans("MT50"))
    with TemporaryDirectory() as folder:
        seconds = timed(lambda: lw.collect_demonstrations("MT50", root=f"{folder}/demos", **run))
    yield {"row": "collection", "seconds": round(seconds, 2), "asked": "12 s"} | run
    seconds = timed(lambda: lw.evaluate(actor, tasks="MT50", seed=1_000, **run))
    yield {"row": "evaluation", "seconds": round(seconds, 2), "asked": "8 s"} | run


def threads(args: Arguments) -> Iterator[Row]:
    """Measure steps per second of engine and environment by number of threads, and of as many processes."""
    from benchmarks.scaling_threads import rows

    most = available_cores()
    for number in dict.fromkeys((most, 1, 4, 8, 2)):  # the most important first, in case the time runs out
        if number <= most:
            for row in rows([number], seconds=0.02 if args.quick else 0.12):
                yield {"row": "threads"} | row


ON_THE_CPU = (machine, workers, threads)
BENCHMARKS: dict[str, Callable[[Arguments], Iterator[Row]]] = {
    each.__name__.replace("_", "-"): each
    for each in (machine, cloning, few_shot, stacked, rollout, offline, evaluators, workers, threads)
}


def _run(name: str, args: Arguments, seconds: float) -> list[Row]:
    """Run a benchmark in a separate process, print its rows and return them."""
    command = [sys.executable, "-m", "benchmarks.scaling", "--here", "--rows", name, "--folder", str(args.folder)]
    command += [f"--{flag}" for flag in ("gpu", "quick") if getattr(args, flag)]
    rows, error = [], ""
    try:
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True, timeout=max(seconds, 1.0))
        printed = done.stdout
        error = f"exit status {done.returncode}" if done.returncode else ""
    except subprocess.TimeoutExpired as late:
        printed, error = (late.stdout or b"").decode(), "no time left"
    rows = [json.loads(line) for line in printed.splitlines() if line.startswith('{"row"')]
    rows += [{"row": name, "error": error}] if error else []
    for row in rows:
        print(json.dumps(row), flush=True)
    return rows


def main(arguments: list[str] | None = None) -> int:
    """Run the benchmarks; return 1 if one failed."""
    args = tyro.cli(Arguments, args=arguments, prog="python -m benchmarks scaling")
    if unknown := [name for name in args.rows if name not in BENCHMARKS]:
        print(f"no row {', '.join(unknown)}; there are {', '.join(BENCHMARKS)}", file=sys.stderr)
        return 2
    if args.gpu and not torch.cuda.is_available() and not args.quick:
        print("--gpu: this machine, or this build of PyTorch, has no CUDA", file=sys.stderr)
        return 2
    names = args.rows or tuple(name for name, each in BENCHMARKS.items() if args.gpu or each in ON_THE_CPU)
    args.folder.mkdir(parents=True, exist_ok=True)
    if args.here:
        torch.set_num_threads(1)
        warnings.filterwarnings("ignore", message="Constant\\(s\\) may be too high")
        for row in (row for name in names for row in BENCHMARKS[name](args)):
            print(json.dumps(row), flush=True)
        return 0
    start = perf_counter()
    rows = [row for name in names for row in _run(name, args, args.seconds - perf_counter() + start)]
    for folder in filter(None, (str(args.folder), os.environ.get("OUT"))):
        write_json(Path(folder) / "scaling.json", {"rows": rows, "seconds": round(perf_counter() - start, 1)})
    failed = [row["row"] for row in rows if "error" in row]
    print(f"{len(rows)} rows in {perf_counter() - start:.0f} s; failed: {', '.join(failed) or 'none'}", flush=True)
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(main())
