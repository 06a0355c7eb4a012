"""python -m benchmarks scaling [--gpu]: every core and the GPU of this machine, measured by one script.

The script needs no network, no rerun and none of the packages of the tests, and prints each row as it is measured. Each
row is measured by itself: an error is printed with its traceback, and the other rows follow.
"""

from __future__ import annotations

import gc
import json
import os
import platform
import shutil
import signal
import subprocess
import sys
import traceback
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import torch
import tyro
from tensordict import TensorDictBase
from torchrl.envs import Compose, TransformedEnv

import lw_torchrl as lw
from benchmarks.paper.actors import Parts
from benchmarks.paper.stacked import StackedBehavioralCloning
from lw_torchrl._util.files import write_json
from lw_torchrl._util.workers import available_cores
from lw_torchrl.training.loop import Training
from lw_torchrl.training.offline import DISTRIBUTIONS, GAMMA, N_STEPS, make_loss

ASTRAY: dict[str, Any] = {"noise_scale": (0.0, 0.1, 0.2, 0.3, 0.4), "noise_hold": 10, "redraw_failures": True}
UNSEEN = Parts(features="none", roles=True, fallback=True, feature_noise=0.05, yaw=10.0, tilt=0.5, jitter=0.03)
TARGET = Parts(features="differences", feature_noise=0.1, focus=True, roles=True, swap_unmentioned=0.5)
STEPS_OF_FEW_SHOT = 12_000
Row = dict[str, Any]


@dataclass(frozen=True)
class Work:
    """Where the rows find their data, and how long they may measure."""

    folder: Path
    quick: bool
    device: str

    @property
    def demos(self) -> Path:
        """Demonstrations of MT50, which the first row that needs them collects."""
        root = self.folder / "demonstrations"
        if not (root / "done").exists():
            tasks, episodes, steps = (lw.MT50, 1, 20) if self.quick else (lw.MT50, 10, 500)
            options: dict[str, Any] = {} if self.quick else ASTRAY
            lw.collect_demonstrations(
                tasks, episodes_per_task=episodes, root=root / "mt50", max_steps=steps, progress=False, **options
            )
            (root / "done").touch()
        return root / "mt50"

    def pick(self, full: int, quick: int) -> int:
        return quick if self.quick else full

    def wait(self) -> None:
        if self.device != "cpu":
            torch.accelerator.synchronize()

    def each(self, step: Callable[[], Any], number: int) -> float:
        """Return the milliseconds of a call: the mean of ``number`` calls, waiting for the device at the end only."""
        self.wait()
        start = perf_counter()
        for _ in range(number):
            step()
        self.wait()
        return 1e3 * (perf_counter() - start) / number


def _replay(work: Work, transform: Any, sampler: Any = None, **options: Any) -> Any:
    options = {"after_success": 20, "device": work.device} | options
    sampler = lw.TaskBalancedSampler() if sampler is None else sampler
    return lw.LanguageWorldExperienceReplay(work.demos, sampler=sampler, transform=transform, **options)


def _cloning(
    work: Work, parts: Parts, plans: Any, size: int, steps: int, **options: Any
) -> lw.BehavioralCloningTrainer:
    torch.manual_seed(0)
    actor = parts.actor("pcbc", parts.seen(plans))
    config = lw.BehavioralCloningConfig(steps=steps, batch_size=size)
    return lw.BehavioralCloningTrainer(
        actor, _replay(work, parts.transform(actor)), config, device=work.device, progress=False, **options
    )


def _measured(work: Work, name: str, trainer: Training, number: int, **more: Any) -> Row:
    """Measure a trainer's step after its warm-up, and what of it the host and the graph take."""
    losses = [trainer.step() for _ in range(5)]
    milliseconds = work.each(trainer.step, number)
    captured = trainer._captured
    row: Row = {"row": name, "ms": round(milliseconds, 3), "captured": captured is not None and captured.is_captured}
    if row["captured"]:
        assert captured is not None
        row["ms graph"] = round(work.each(captured._graph.replay, number), 3)
        row["ms draw"] = round(work.each(lambda: [_draw(each, trainer) for each in trainer.minibatches], number), 3)
    row["losses"] = [round(float(loss.mean()), 6) for loss in losses]
    return row | more


def _draw(minibatches: Any, trainer: Training) -> None:
    with minibatches.drawing(trainer.device):
        minibatches.draw()


def machine(work: Work) -> Iterator[Row]:
    """The machine, and the versions of the packages."""
    from importlib.metadata import version

    row: Row = {"row": "machine", "cores": available_cores(), "python": platform.python_version()}
    row |= {package: version(package) for package in ("torch", "torchrl", "tensordict", "mujoco", "numpy")}
    if torch.cuda.is_available():
        row["gpu"] = torch.cuda.get_device_name()
    yield row


def cloning_step(work: Work) -> Iterator[Row]:
    """A step of behavioral cloning, MT50, batch 500: eager and captured."""
    plans, parts = lw.load_plans("MT50"), Parts()
    for capture in (True, False):
        trainer = _cloning(work, parts, plans, 500, 10_000, capture=capture)
        name = f"cloning step, {'captured' if capture else 'eager'}"
        asked = {"asked": "0.8 ms"} if capture else {}
        yield _measured(work, name, trainer, work.pick(500 if capture else 50, 3), **asked)
        if capture and work.device != "cpu":
            yield _kernels(trainer)


def _kernels(trainer: Training) -> Row:
    """Count the kernels of a captured step, and the time that they take."""
    from torch.profiler import ProfilerActivity, profile

    with profile(activities=[ProfilerActivity.CUDA, ProfilerActivity.CPU]) as profiled:
        trainer.step()
        torch.cuda.synchronize()
    kernels = [each for each in profiled.events() if each.device_type == torch.autograd.DeviceType.CUDA]
    kinds: dict[str, list[float]] = {}
    for each in kernels:
        kinds.setdefault(each.name[:60], []).append(each.self_device_time_total)
    most = sorted(kinds.items(), key=lambda item: -sum(item[1]))[:12]
    row: Row = {"row": "kernels of the step", "kernels": len(kernels)}
    row["us"] = round(sum(each.self_device_time_total for each in kernels))
    return row | {"most": {name: [len(times), round(sum(times))] for name, times in most}}


def few_shot(work: Work) -> Iterator[Row]:
    """The few-shot experiment's network, 12,000 steps: seconds, then its success beside the CPU's."""
    steps, files = work.pick(STEPS_OF_FEW_SHOT, 5), {}
    torch.manual_seed(0)
    start = perf_counter()
    trainer = _cloning(work, Parts(), lw.load_plans("MT50"), 500, steps)
    made = perf_counter() - start
    start = perf_counter()
    loss = trainer.train()
    seconds = perf_counter() - start
    files[work.device] = work.folder / "few-shot.safetensors"
    lw.save_actor(trainer.actor, files[work.device])
    row: Row = {"row": "few-shot, one network", "steps": steps, "seconds": round(seconds, 2), "asked": "15 s"}
    yield row | {"loss": round(loss, 6), "seconds to open the data": round(made, 2)}


def few_shot_success(work: Work) -> Iterator[Row]:
    """The success of few-shot's network, trained on the GPU, and of the one trained on the CPU from the same data."""
    for name in ("few-shot", "few-shot-cpu"):
        path = work.folder / f"{name}.safetensors"
        if not path.exists():
            yield {"row": f"success of {name}", "error": "not trained"}
            continue
        options: dict[str, Any] = {"tasks": "MT50", "episodes_per_task": work.pick(10, 1), "seed": 10_000}
        options |= {"noise_scale": 0.1, "stop_at_success": True, "max_steps": work.pick(500, 5), "progress": False}
        start = perf_counter()
        result = lw.evaluate(lw.load_actor(path), **options)
        rates = [rate or 0.0 for rate in result.success_once.values()]
        row: Row = {"row": f"success of {name}", "success": round(sum(rates) / len(rates), 3)}
        yield row | {"seconds": round(perf_counter() - start, 2), "episodes": len(result.episodes), "asked": "8 s"}


def stacked_step(work: Work) -> Iterator[Row]:
    """Twenty one-shot models in one step, with conditions only, and with the recipe's augmentations."""
    plans, number = lw.load_plans("MT50"), work.pick(20, 2)
    for name, parts, size in (("conditions", Parts(), 200), ("one-shot recipe", TARGET, 180)):
        for capture in (True, False):
            torch.manual_seed(0)
            actors = [parts.actor("pcbc", parts.seen(plans)) for _ in range(number)]
            replays = []
            for target, actor in zip([task for task in lw.MT50 if task not in lw.MT10], actors, strict=False):
                one_shot = {"episodes": dict.fromkeys(lw.MT10, work.pick(10, 1)) | {target: 1}}
                options = one_shot if size == 180 else {}
                sampler = lw.CoLearningSampler(target, exact=True) if options else lw.TaskBalancedSampler()
                replays.append(_replay(work, parts.transform(actor), sampler, **options))
            config = lw.BehavioralCloningConfig(steps=10_000, batch_size=size)
            how: dict[str, Any] = {"device": work.device, "progress": False, "capture": capture}
            trainer = StackedBehavioralCloning(actors, replays, config, **how)
            title = f"{number} stacked models, {name}, {'captured' if capture else 'eager'}"
            asked = {"asked": "4 ms"} if capture else {}
            yield _measured(work, title, trainer, work.pick(50 if capture else 5, 2), **asked)
            del trainer, replays, actors


def turned_step(work: Work) -> Iterator[Row]:
    """The zero-shot recipe, whose rows are turned, and few-shot's turned member."""
    plans = lw.load_plans("MT50")
    for name, parts in (("zero-shot", UNSEEN), ("few-shot", Parts(yaw=0.3, focus=True, any_yaw=True))):
        for capture in (True, False):
            trainer = _cloning(work, parts, plans, 200, 10_000, capture=capture)
            title = f"turned scenes, {name} recipe, {'captured' if capture else 'eager'}"
            yield _measured(work, title, trainer, work.pick(200 if capture else 50, 2))


def offline_steps(work: Work) -> Iterator[Row]:
    """The offline losses, batch 250."""
    plans = lw.load_plans("MT50")
    for name, distribution in DISTRIBUTIONS.items():
        try:
            torch.manual_seed(0)
            actor = lw.PlanConditionedActor(plans)
            actor = actor if distribution is None else actor.stochastic(distribution)
            transform = lw.QAFTransform(plans)
            replay = _replay(work, transform, label="executed", n_steps=N_STEPS, gamma=GAMMA)
            replay.add_column("advantage", torch.zeros(len(replay), 1))
            loss = make_loss(name, actor, plans, replay).to(work.device)
            config = lw.OfflineConfig(steps=10_000)
            trainer = lw.OfflineTrainer(loss, replay, config, progress=False)
            yield _measured(work, f"offline loss {name}", trainer, work.pick(200, 2))
        except Exception:
            traceback.print_exc()
            yield {"row": f"offline loss {name}", "error": traceback.format_exc().splitlines()[-1][:300]}


def evaluator_steps(work: Work) -> Iterator[Row]:
    """Query evaluators of states and of pictures (random ones, since only the time is measured)."""
    plans = lw.load_plans("MT50")
    training = lw.training
    replay = _replay(work, None, label="executed", device=None)
    config = training.QueryEvaluatorConfig(steps=10_000)
    evaluator: Any = lw.modules.StateQueryEvaluator(plans)
    data = training.LabelledQueries(replay, config)
    trainer = training.QueryEvaluatorTrainer(evaluator, data, config, device=work.device, progress=False)
    yield _measured(work, "evaluator of states", trainer, work.pick(200, 2))
    chosen = {task: 2 for task in lw.MT50[:: work.pick(5, 25)]}
    replay = _replay(work, None, label="executed", device=None, episodes=None if work.quick else chosen)
    replay.add_column("pixels", torch.randint(256, (len(replay), 64, 128, 3), dtype=torch.uint8))
    images = training.ImageQueryEvaluatorConfig(steps=10_000)
    evaluator = lw.modules.ImageQueryEvaluator(plans)
    data = training.LabelledQueries(replay, images)
    trainer = training.QueryEvaluatorTrainer(evaluator, data, images, device=work.device, progress=False)
    yield _measured(work, "evaluator of pictures", trainer, work.pick(50, 2))


def env_on_device(work: Work) -> Iterator[Row]:
    """A rollout of an environment on the device with a policy there, and the same on the CPU."""
    plans = lw.canonical_plans(lw.load_plans("MT50"), fallback=True)
    for device in dict.fromkeys((work.device, "cpu")):
        torch.manual_seed(0)
        actor = lw.PlanConditionedActor(plans).to(device).eval()
        parts = Compose(lw.QAFTransform(plans), lw.transforms.FallbackTurns())
        env = TransformedEnv(lw.LanguageWorldEnv("MT50", device=device), parts)
        steps = work.pick(100, 3)
        with torch.no_grad():
            env.rollout(3, actor)
            start = perf_counter()
            rollout = env.rollout(steps, actor, break_when_any_done=False)
            work.wait()
        milliseconds = 1e3 * (perf_counter() - start) / steps
        devices = sorted({str(value.device) for value in rollout.values(True, True)})
        row: Row = {"row": f"rollout, N = 50, {device}", "ms": round(milliseconds, 2), "tensors on": devices}
        env.close()
        yield row | {"hand": [round(value, 5) for value in rollout["observation"][0, -1, :3].cpu().tolist()]}


def _same(tensors: list[torch.Tensor], others: list[torch.Tensor]) -> bool | float:
    """Return True, or the largest difference."""
    if all(map(torch.equal, tensors, others)):
        return True
    return max(float((one - other).abs().max()) for one, other in zip(tensors, others, strict=True))


def exactness(work: Work) -> Iterator[Row]:
    """Whether a repeated training, and a resumed one, has the same bits on the device; and the CPU's losses."""
    plans, steps = lw.load_plans("MT50"), work.pick(60, 8)

    def trained(path: Path | None, until: int, capture: bool = True) -> list[torch.Tensor]:
        parts = Parts(yaw=0.3, focus=True)
        trainer = _cloning(work, parts, plans, 500, steps, checkpoint=path, capture=capture)
        trainer.train(until=until)
        return [parameter.detach().cpu().clone() for parameter in trainer.actor.parameters()]

    def resumed(capture: bool) -> list[torch.Tensor]:
        path = work.folder / f"resumed-{capture}.safetensors"
        trained(path, steps // 2, capture)
        return trained(path, steps, capture)

    whole = trained(None, steps)
    row: Row = {
        "row": "same bits",
        "repeated": _same(whole, trained(None, steps)),
        "resumed": _same(whole, resumed(True)),
    }
    eager = trained(None, steps, capture=False)
    yield row | {"eager": _same(whole, eager), "resumed eager": _same(eager, resumed(False))}
    for device in dict.fromkeys((work.device, "cpu")):
        trainer = _cloning(replace(work, device=device), Parts(feature_noise=0.0), plans, 500, 10_000)
        yield {"row": f"losses without noise, {device}", "losses": [trainer.step().item() for _ in range(8)]}


def memory(work: Work) -> Iterator[Row]:
    """GPU memory of a training: rows, weights, graph."""
    if work.device == "cpu":
        return
    torch.cuda.empty_cache()
    before = torch.cuda.memory_allocated()
    torch.cuda.reset_peak_memory_stats()
    trainer = _cloning(work, Parts(), lw.load_plans("MT50"), 500, 10_000)
    rows = torch.cuda.memory_allocated() - before
    for _ in range(10):
        trainer.step()
    torch.cuda.synchronize()
    found = {"rows": rows, "peak": torch.cuda.max_memory_allocated(), "reserved": torch.cuda.memory_reserved()}
    row: Row = {"row": "GPU memory, MB", "number of rows": len(trainer.replay)}
    yield row | {name: round(number / 1e6, 1) for name, number in found.items()}


def fallback(work: Work) -> Iterator[Row]:
    """Steps that cannot be captured: one waits for the device, two fail only while they are captured."""
    plans = lw.load_plans("MT50")

    def waits(batch: TensorDictBase) -> TensorDictBase:
        return batch.set("largest", torch.full(batch.shape, float(batch["action"].max()), device=batch.device))

    def fails(batch: TensorDictBase) -> TensorDictBase:
        if work.device != "cpu" and torch.cuda.is_current_stream_capturing():
            raise RuntimeError("this transform is not captured")
        return batch

    def breaks(batch: TensorDictBase) -> TensorDictBase:
        if work.device != "cpu" and torch.cuda.is_current_stream_capturing():
            batch["action"].max().item()
        return batch

    for function in (waits, fails, breaks):
        torch.manual_seed(0)
        actor = Parts().actor("pcbc", plans)
        replay = _replay(work, Compose(lw.QAFTransform(plans)))
        replay.append_transform(function)
        config = lw.BehavioralCloningConfig(steps=1_000, batch_size=100)
        options: dict[str, Any] = {"device": work.device, "progress": False, "capture": True}
        trainer = lw.BehavioralCloningTrainer(actor, replay, config, **options)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            row = _measured(work, f"falls back where a transform {function.__name__}", trainer, 5)
        yield row | {"warnings": [str(each.message)[:200] for each in caught]}
    yield {"row": "random numbers after a failed capture", "drawn": torch.rand(2, device=work.device).tolist()}


def train_on_the_cpu(work: Work) -> Iterator[Row]:
    """Start few-shot's training on one core, in the background; ``few_shot_success`` compares the two."""
    if work.device == "cpu":
        return
    command = [sys.executable, "-m", "benchmarks.scaling", "--rows", "few-shot-on-one-core"]
    command += ["--folder", str(work.folder), "--no-restart", *(["--quick"] if work.quick else [])]
    work.demos  # noqa: B018 - collect the data first
    with (work.folder / "cpu.log").open("w") as log:
        process = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT, start_new_session=True)
    (work.folder / "cpu.pid").write_text(str(process.pid))
    yield {"row": "few-shot's training on one core begins"}


def few_shot_on_one_core(work: Work) -> Iterator[Row]:
    """Few-shot's network on one core of the CPU."""
    torch.set_num_threads(1)
    steps = work.pick(STEPS_OF_FEW_SHOT, 5)
    trainer = _cloning(replace(work, device="cpu"), Parts(), lw.load_plans("MT50"), 500, steps)
    start = perf_counter()
    loss = trainer.train()
    lw.save_actor(trainer.actor, work.folder / "few-shot-cpu.safetensors")
    yield {"row": "few-shot, one core", "seconds": round(perf_counter() - start, 1), "loss": round(loss, 6)}


def wait_for_the_cpu(work: Work) -> Iterator[Row]:
    """Wait for the training in the background, which would disturb the rows of the cores."""
    pid = work.folder / "cpu.pid"
    if pid.exists():
        start = perf_counter()
        while perf_counter() - start < 60 and not (work.folder / "few-shot-cpu.safetensors").exists():
            signal.sigtimedwait([], 0.5)
        yield {"row": "waited for one core", "seconds": round(perf_counter() - start, 1)}
        print((work.folder / "cpu.log").read_text()[-600:], flush=True)


def workers(work: Work) -> Iterator[Row]:
    """Collection and evaluation over processes."""
    from benchmarks.scaling_workers import rows

    asked = {"collection": "12 s", "evaluation": "8 s"}
    for row in rows(episodes=work.pick(500, 50), max_steps=work.pick(500, 5)):
        yield {"row": row["name"]} | row | {"asked": asked[row["name"]]}


def threads(work: Work) -> Iterator[Row]:
    """Steps a second of the engine and the environment by threads, beside as many processes."""
    from benchmarks.scaling_threads import rows

    most = available_cores()
    for number in dict.fromkeys((most, 1, 4, 8, 2)):  # the most important first, in case that the time ends
        if number <= most:
            for row in rows([number], seconds=0.02 if work.quick else 0.12):
                yield {"row": "threads"} | row


def gpu_tests(work: Work) -> Iterator[Row]:
    """The tests that wait for a GPU, if pytest and Hypothesis are installed."""
    paths = ["tests/devices/test_devices.py", "tests/objectives/test_losses.py"]
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *paths, "-k", "gpu", "-m", "not slow"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=90)
    print(done.stdout[-3000:], done.stderr[-1500:], flush=True)
    yield {"row": "tests of a GPU", "rc": done.returncode, "last": (done.stdout.splitlines() or [""])[-1]}


ROWS: dict[str, Callable[[Work], Iterator[Row]]] = {
    "machine": machine,
    "cloning-step": cloning_step,
    "cpu-training": train_on_the_cpu,
    "few-shot": few_shot,
    "stacked-step": stacked_step,
    "exactness": exactness,
    "turned-step": turned_step,
    "env-on-device": env_on_device,
    "offline-steps": offline_steps,
    "evaluator-steps": evaluator_steps,
    "memory": memory,
    "gpu-tests": gpu_tests,
    "wait-for-cpu": wait_for_the_cpu,
    "few-shot-success": few_shot_success,
    "workers": workers,
    "threads": threads,
    "fallback": fallback,
}
ON_REQUEST = {"few-shot-on-one-core": few_shot_on_one_core}
ON_THE_CPU = ("machine", "workers", "threads")


@dataclass(frozen=True)
class Arguments:
    """Measure how the library scales over the cores and on the GPU of this machine."""

    gpu: bool = False
    """Also measure the GPU."""
    rows: tuple[str, ...] = ()
    """Names of the rows to measure; all of this machine by default."""
    quick: bool = False
    """Run a small version to see that it works; the numbers mean nothing."""
    seconds: float = 460.0
    """Start no row after this many seconds."""
    folder: Path = Path("runs/scaling")
    """Folder for demonstrations, policies and results.json; results are also written to $OUT, if it is set."""
    no_restart: bool = False
    """Measure in this process, instead of in another that is restarted where the GPU fails."""


def _measure(args: Arguments, work: Work, names: list[str], deadline: float) -> bool:
    """Measure rows and append them to a file; return whether the GPU still works."""
    for name in names:
        if perf_counter() > deadline:
            _write(work, {"row": name, "error": "no time left"})
            continue
        start, function = perf_counter(), {**ROWS, **ON_REQUEST}[name]
        _write(work, {"begins": name})
        gc.collect()
        signal.alarm(0 if args.no_restart else max(1, min(100, int(deadline + 20 - start))))
        try:
            for row in function(work):
                _write(work, row)
        except BaseException as error:  # a row may fail in any way, without ending the others
            if isinstance(error, KeyboardInterrupt):
                raise
            traceback.print_exc(file=sys.stdout)
            _write(work, {"row": name, "error": f"{type(error).__name__}: {error}"[:500]})
        finally:
            signal.alarm(0)
        print(f"  {name}: {perf_counter() - start:.1f} s", flush=True)
        if work.device != "cpu" and not _works(work.device):
            return False
    return True


def _works(device: str) -> bool:
    try:
        return bool(torch.ones(1, device=device).item() == 1 and torch.rand(1, device=device).item() >= 0)
    except Exception as error:
        print(f"the GPU no longer works in this process: {error}", flush=True)
        return False


def _write(work: Work, row: Row) -> None:
    with (work.folder / "rows.jsonl").open("a") as file:
        file.write(json.dumps(row) + "\n")
    if "begins" not in row:
        print(json.dumps(row), flush=True)


def _rows(work: Work) -> list[Row]:
    path = work.folder / "rows.jsonl"
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def _expire(number: int, frame: Any) -> None:
    raise TimeoutError("the row took too long")


def main(arguments: list[str] | None = None) -> int:
    """Measure the rows; return 1 if one failed."""
    args = tyro.cli(Arguments, args=arguments, prog="python -m benchmarks scaling")
    if unknown := [name for name in args.rows if name not in {**ROWS, **ON_REQUEST}]:
        print(f"no row {', '.join(unknown)}; there are {', '.join(ROWS)}", file=sys.stderr)
        return 2
    if args.gpu and not torch.cuda.is_available() and not args.quick:
        print("--gpu: this machine, or this build of PyTorch, has no CUDA", file=sys.stderr)
        return 2
    work = Work(args.folder, args.quick, "cuda:0" if args.gpu and torch.cuda.is_available() else "cpu")
    names = list(args.rows or (ROWS if args.gpu else ON_THE_CPU))
    warnings.filterwarnings("ignore", message="Constant\\(s\\) may be too high")
    signal.signal(signal.SIGALRM, _expire)
    if args.no_restart:
        _measure(args, replace(work, device="cpu" if "few-shot-on-one-core" in names else work.device), names, 1e18)
        return 0
    shutil.rmtree(args.folder, ignore_errors=True)
    args.folder.mkdir(parents=True)
    start = perf_counter()
    while names:
        left = args.seconds - (perf_counter() - start)
        command = [sys.executable, "-c", "from benchmarks.scaling import _child; _child()", json.dumps(names)]
        options = json.dumps({"folder": str(args.folder), "quick": args.quick, "device": work.device, "left": left})
        before = len(_rows(work))
        subprocess.run([*command, options], check=False)
        begun = [row["begins"] for row in _rows(work)[before:] if row.get("begins") in names]
        skipped = {row["row"] for row in _rows(work)[before:] if row.get("error") == "no time left"}
        names = [name for name in names[names.index(begun[-1]) + 1 :] if name not in skipped] if begun else []
    rows = [row for row in _rows(work) if "begins" not in row]
    for folder in filter(None, (str(args.folder), os.environ.get("OUT"))):
        write_json(Path(folder) / "scaling.json", {"rows": rows, "seconds": round(perf_counter() - start, 1)})
    failed = [row["row"] for row in rows if "error" in row]
    print(f"{len(rows)} rows in {perf_counter() - start:.0f} s; failed: {', '.join(failed) or 'none'}", flush=True)
    return int(bool(failed))


def _child() -> None:
    names, options = (json.loads(argument) for argument in sys.argv[1:])
    signal.signal(signal.SIGALRM, _expire)
    warnings.filterwarnings("ignore", message="Constant\\(s\\) may be too high")
    work = Work(Path(options["folder"]), options["quick"], options["device"])
    if not _measure(Arguments(), work, names, perf_counter() + options["left"]):
        os._exit(3)  # the GPU's context is broken, and would fail again at exit


if __name__ == "__main__":
    sys.exit(main())
