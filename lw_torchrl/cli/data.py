"""The commands ``collect``, ``data`` and ``info``: collect, summarize and convert datasets, and describe files."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from itertools import groupby
from operator import attrgetter
from pathlib import Path
from statistics import median, quantiles
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

from tyro.conf import Positional, arg

import lw_torchrl as lw
from lw_torchrl._util.checks import Count, Natural, Scale
from lw_torchrl._util.text import counted
from lw_torchrl.cli import options
from lw_torchrl.cli.options import Columns, Flag, Maybe, Output, Row
from lw_torchrl.language.tasks import TASKS

if TYPE_CHECKING:
    from lw_torchrl.data.dataset import Demonstrations


class _Episode(NamedTuple):
    task: str
    behaviour: str
    length: int
    first_success: int | None
    dense_return: float


@dataclass(kw_only=True)
class Collect:
    """Collect demonstrations of each task. To resume an interrupted collection, run the same command again.

    Example: lw-torchrl collect MT10 --out demos/mt10 --noise 0 0.1 0.2 --redraw-failures
    """

    tasks: options.TaskNames
    out: Path  # folder to which the dataset is written
    episodes: Count = 10  # number of episodes to keep for each task
    seed: Natural = 0  # random seed (use a different one for evaluation)
    noise: tuple[Scale, ...] = (0.0,)  # standard deviations of the execution noise; episodes use the values in turn
    noise_hold: Count = 10  # number of time steps that each noise sample is held; larger values perturb the path more
    redraw_failures: Flag = False  # replace failed episodes with new ones, so that all kept episodes succeed
    policy: options.Who = "expert"
    behaviour: Maybe[str] = None  # label of the episodes (default: the policy's name)
    task_file: options.TaskFile = None
    suite: options.SuiteName = None
    device: options.Device = "cpu"
    workers: options.Workers = None
    json: options.Json = False

    def run(self) -> Output:
        suite = options.read_suite(self.suite, self.tasks)
        tasks = options.select_tasks(self.tasks, options.read_tasks(self.task_file, self.tasks), suite)
        policy: Any = self.policy
        behaviour = self.behaviour
        options.start_workers(policy, self.device, self.workers, len(tasks) * self.episodes)
        # Import these slow modules only here, while the worker processes start.
        from lw_torchrl._util.devices import place
        from lw_torchrl.data.collection_policy import BEHAVIOURS

        if policy not in BEHAVIOURS:
            options.use_one_thread()
            policy = options.read_object(policy) if options.is_object(policy) else lw.load_actor(policy)
            place(policy, self.device)
            behaviour = behaviour or options.policy_name(self.policy)
        run: dict[str, Any] = {"seed": self.seed, "noise_scale": self.noise, "noise_hold": self.noise_hold}
        run |= {"policy": policy, "behaviour": behaviour, "suite": suite, "redraw_failures": self.redraw_failures}
        run["workers"] = self.workers
        dataset = lw.collect_demonstrations(tasks, episodes_per_task=self.episodes, root=self.out, **run)
        runs = dataset.attempts
        rates = dataset.success_rate.items()
        rows = [{"task": task, "success": rate, "episodes_run": runs[task]} for task, rate in rates]
        output = Output(self.json).table("tasks", rows, {**_SUCCESS, "episodes run": "episodes_run"})
        return _show_dataset(output, dataset)


_SUCCESS: Columns = {"task": "task", "success": lambda row: f"{row['success']:.2f}"}


def _show_dataset(output: Output, dataset: Demonstrations) -> Output:
    output.show("dataset", dataset.root)
    return output.show("steps", dataset.num_steps, f"{counted(dataset.num_steps, 'step')} in {dataset.root}")


@dataclass(kw_only=True)
class Show:
    """Summarize datasets: collection policy, success rate, return. For several datasets, also print a joint summary.

    Example: lw-torchrl data show demos/mt10 demos/noisy --check
    """

    folders: Positional[Annotated[tuple[Path, ...], options.REQUIRED, arg(metavar="FOLDERS")]]
    """datasets written by `lw-torchrl collect`"""
    check: Flag = False  # also verify the checksums of all episodes
    json: options.Json = False

    def run(self) -> Output:
        from lw_torchrl.data.dataset import damaged_episodes, read_metadata
        from lw_torchrl.data.selection import check_behaviours, returns_of

        parts = [read_metadata(folder) for folder in self.folders]
        check_behaviours(parts)
        output, episodes = Output(self.json), []
        for part in parts:
            returns = returns_of(part, part, "dense", None)[:, 0].tolist()
            for info, total in zip(part.episodes, returns, strict=True):
                episodes.append(_Episode(info.task, part.config.behaviour, info.length, info.first_success, total))
            print(_describe(part))
        described = [{"folder": part.root, "bytes": _size(part), "config": part.config.to_json()} for part in parts]
        output.show("datasets", described)
        for group in ("task", "behaviour")[: len(parts)]:
            key = attrgetter(group)
            rows = [_summary(label, [*members]) for label, members in groupby(sorted(episodes, key=key), key)]
            last = group == "behaviour" or len(parts) == 1
            output.table(f"{group}s", rows + [_summary("all", episodes)] * (last and not self.json), _columns(group))
        output.show("all", _summary("all", episodes))
        damaged = []
        for part in parts if self.check else ():
            if number := len(damaged_episodes(part, part.episodes, progress=True)):
                damaged.append({"folder": part.root, "episodes": number})
                fault = f"checksum mismatch in {number} of {counted(len(part.episodes), 'episode')}"
                output.fault = f"{str(part.root)!r} is corrupted: {fault}; delete the folder and collect again"
        if self.check:
            output.show("damaged", damaged, None if damaged else "\nall checksums match")
        return output


def _describe(part: Demonstrations) -> str:
    config = part.config
    noise = ", ".join(f"{scale:g}" for scale in config.noise_scale)
    if any(config.noise_scale):
        noise += f"; held for {counted(config.noise_hold, 'step')}, on the gripper x{config.gripper_noise_factor:g}"
    redrawn = sum(part.attempts.values()) - len(part.episodes)
    episodes = f"{config.episodes_per_task} of each task, seed {config.seed}, at most {config.max_steps} steps"
    lines = {
        "dataset": f"{part.root}: {_size(part) / 1e6:.3g} MB",
        "behaviour": f"{config.behaviour} ({config.policy.kind}), in {config.layout.name}",
        "tasks": ", ".join(config.tasks) if len(config.tasks) <= 10 else counted(len(config.tasks), "task"),
        "episodes": episodes + (f"; {counted(redrawn, 'failure')} replaced" if config.redraw_failures else ""),
        "noise": noise,
        "made with": ", ".join(f"{name} {version}" for name, version in part.versions.items()),
    }
    return "".join(f"{name:10} {line}\n" for name, line in lines.items())


def _size(part: Demonstrations) -> int:
    return sum(path.stat().st_size for path in part.root.rglob("*") if path.is_file())


def _columns(label: str) -> Columns:
    def first(row: Row) -> str:
        steps = row["first_success"]
        return "never" if steps is None else f"{steps['median']:.0f} ({steps['min']}..{steps['max']})"

    return {
        label: "label",
        "episodes": "episodes",
        "steps": "steps",
        "success": lambda row: f"{row['success']:.2f}",
        "first success": first,
        "dense return": lambda row: f"{row['dense_return']['mean']:.1f}",
        "quartiles": lambda row: " ".join(f"{quartile:.1f}" for quartile in row["dense_return"]["quartiles"]),
    }


def _summary(label: str, episodes: list[_Episode]) -> dict[str, Any]:
    first = [episode.first_success for episode in episodes if episode.first_success is not None]
    returns = [episode.dense_return for episode in episodes]
    return {
        "label": label,
        "episodes": len(episodes),
        "steps": sum(episode.length for episode in episodes),
        "success": len(first) / len(episodes),
        "first_success": {"median": median(first), "min": min(first), "max": max(first)} if first else None,
        "dense_return": {
            "mean": sum(returns) / len(returns),
            "quartiles": quantiles(returns, n=4, method="inclusive") if len(returns) > 1 else returns * 3,
        },
    }


@dataclass(kw_only=True)
class Export:
    """Convert a dataset to another library's format. `lw-torchrl data import` restores a bit-identical dataset.

    Example: lw-torchrl data export demos/mt10 --to lerobot --out lerobot/mt10
    """

    folder: Positional[Annotated[Path, arg(metavar="FOLDER")]]  # dataset written by `lw-torchrl collect`
    to: str  # target format: lerobot (version 3) or minari
    out: Path  # output folder, new or empty
    plans: Annotated[tuple[str, ...], options.OPTIONAL] = ()
    """store with each row which conditions of these plans hold (default: the suite's plans)"""
    suite: options.SuiteName = None
    json: options.Json = False

    def run(self) -> Output:
        suite = options.read_suite(self.suite)
        plans = options.read_plans(self.plans, TASKS if suite is None else suite.tasks) if self.plans else None
        out = lw.export_dataset(self.folder, self.to, self.out, suite=suite, plans=plans)  # type: ignore[arg-type]
        files = [path for path in out.rglob("*") if path.is_file()]
        size = sum(path.stat().st_size for path in files)
        output = Output(self.json).show("out", out).show("format", self.to).show("files", len(files))
        return output.show("bytes", size, f"{counted(len(files), 'file')}, {size / 1e6:.1f} MB, in {out}")


@dataclass(kw_only=True)
class Import:
    """Convert another library's dataset to this library's format, and print which columns the source lacks.

    The tasks of the dataset must belong to an installed suite.

    Example: lw-torchrl data import lerobot/mt10 --out demos/mt10
    """

    source: Positional[Annotated[Path, arg(metavar="SOURCE")]]  # LeRobot or Minari folder, parquet or HDF5 file
    out: Path  # output folder, new or empty
    format: Maybe[str] = None  # format of the source (default: detected from the files)
    task: Maybe[str] = None  # task of all episodes, if the source does not name one
    task_map: Annotated[Maybe[Path], arg(metavar="FILE")] = None
    """JSON file that maps the source's task names or numbers to tasks, such as {"0": "push"}"""
    suite: options.SuiteName = None
    behaviour: str = "imported"  # label of the episodes
    episodes: Maybe[Count] = None  # import only the first N episodes of each task
    episode_length: Maybe[Count] = None  # steps of each episode, if the source does not state where episodes end
    json: options.Json = False

    def run(self) -> Output:
        from lw_torchrl._util.files import read_json
        from lw_torchrl.data.exchange import MissingDataWarning

        if self.task is not None and self.task_map is not None:
            raise ValueError("--task cannot be combined with --task-map; use only --task-map for several tasks")
        task = self.task if self.task_map is None else read_json(self.task_map, "--task-map:")
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            about: dict[str, Any] = {"format": self.format, "task": task, "behaviour": self.behaviour}
            about["episode_length"] = self.episode_length
            suite = options.read_suite(self.suite) or "metaworld"
            dataset = lw.import_dataset(self.source, self.out, suite=suite, episodes_per_task=self.episodes, **about)
        rows = [{"task": task, "success": rate} for task, rate in dataset.success_rate.items()]
        output = Output(self.json).table("tasks", rows, _SUCCESS)
        lacking = [str(item.message) for item in caught if issubclass(item.category, MissingDataWarning)]
        output.show("lacking", lacking, "\n".join(lacking) or None)
        return _show_dataset(output, dataset)


@dataclass(kw_only=True)
class Info:
    """Print a policy's model card, the summary of a dataset, or the episodes of a recording.

    Without a path, describe this installation for a bug report: versions, cores, GPU, extras, cache folders, and
    reasons why the library is slow on this machine.

    Example: lw-torchrl info few-shot-mt50
    """

    path: Positional[Annotated[Maybe[Path], arg(metavar="[PATH]")]] = None
    """policy file or name, dataset folder or .rrd file"""
    json: options.Json = False

    def run(self) -> Output:
        if self.path is None:
            from lw_torchrl.cli.machine import describe_machine

            return describe_machine(Output(self.json))
        if (self.path / "metadata.json").is_file():
            return Show(folders=(self.path,), json=self.json).run()
        output = Output(self.json)
        if self.path.suffix == ".rrd":
            return _show_recording(output, self.path)
        card = lw.evaluation.describe_policy(self.path)
        return output.show("card", card, card)


def _show_recording(output: Output, path: Path) -> Output:
    """List the episodes of a recording and the number of time steps of each."""
    from rerun.chunk import RrdReader

    from lw_torchrl.record.viewer import damaged, readable

    steps: dict[str, int] = {}
    with readable(path) as file, damaged(path):
        for chunk in RrdReader(file).stream():
            episode, _, entity = str(chunk.entity_path).strip("/").partition("/")
            if entity == "action" and not chunk.is_static:
                steps[episode] = steps.get(episode, 0) + len(chunk)
    output.show("recording", path, f"{path}: {path.stat().st_size / 1e6:.1f} MB")
    rows = [{"episode": episode, "steps": number} for episode, number in sorted(steps.items())]
    return output.table("episodes", rows, {"episode": "episode", "steps": "steps"})
