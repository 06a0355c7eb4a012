"""``lw-torchrl collect`` makes datasets; ``lw-torchrl data show`` says what they hold, and whether they are whole."""

from __future__ import annotations

from collections.abc import Callable
from itertools import groupby
from pathlib import Path
from statistics import median, quantiles
from textwrap import TextWrapper
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

from tyro.conf import Positional, arg

import lw_torchrl as lw
from lw_torchrl._checks import counted
from lw_torchrl.cli import options
from lw_torchrl.cli.output import Columns, Output, Row

if TYPE_CHECKING:
    from lw_torchrl.data.behaviours import Behaviour
    from lw_torchrl.data.dataset import Demonstrations, EpisodeInfo
    from lw_torchrl.language.layout import Layout


class _Episode(NamedTuple):
    behaviour: str
    info: EpisodeInfo
    earned: float  # the dense return


def collect(
    tasks: Positional[Annotated[tuple[str, ...], arg(metavar="TASKS ...")]],  # MT10, MT50, or names of tasks
    /,
    out: Path,  # the dataset's folder
    episodes: int = 10,  # kept for each task
    seed: int = 0,  # evaluate on another one
    noise: tuple[float, ...] = (0.0,),  # standard deviations of the execution noise, used in turn, one per episode
    noise_hold: int = 10,  # steps for which each draw of the noise is kept; a longer one leads further from the path
    gripper_noise: float = 0.2,  # factor of the noise on the gripper, which makes grasps fail
    redraw_failures: bool = False,  # keep successful episodes only
    policy: str = "expert",
    behaviour: str | None = None,  # the label of its episodes; by default the name of who acts, or of the policy's file
    task_file: options.TaskFile = None,
    suite: options.SuiteName = None,
    num_envs: int | None = None,  # environments stepped together; the dataset does not depend on it
    json: options.Json = False,
) -> Output:
    """Collect demonstrations of the scripted experts, or of others. If it is stopped, the same command resumes it.

    Example: lw-torchrl collect MT10 --out demos/mt10 --noise 0 0.1 0.2 --redraw-failures

    Args:
        policy: who acts: expert, Meta-World's scripts or the suite's own; scripted, plans with scripted skills;
            spoilt-60 or spoilt-30, the same in so many of 100 pieces of an episode; wrong, any skill of the plan;
            random; or a policy's file, of `lw-torchrl train`.
    """
    options.check_folder("--out", out)
    there = ", which was there already" if (out / "metadata.json").is_file() else ""
    options.check_actor("policy", policy)
    elsewhere = options.read_suite(suite, tasks)
    chosen = options.simulated("tasks", options.one_or_many(tasks), options.read_tasks(task_file, tasks), elsewhere)
    acts: Any = policy
    if policy not in options.ACTORS:
        options.use_one_thread()
        acts, behaviour = lw.load_actor(policy), behaviour or Path(policy).stem
    how: dict[str, Any] = {"policy": acts, "behaviour": behaviour, "redraw_failures": redraw_failures, "seed": seed}
    how |= {"noise_scale": noise, "noise_hold": noise_hold, "gripper_noise_factor": gripper_noise, "suite": elsewhere}
    made = lw.data.collect_demonstrations(chosen, episodes_per_task=episodes, root=out, num_envs=num_envs, **how)
    rates, runs = made.success_rate, made.attempts
    rows = [{"task": task, "success": rate, "episodes_run": runs[task]} for task, rate in rates.items()]
    columns: Columns = {"task": "task", "success": lambda row: f"{row['success']:.2f}", "episodes run": "episodes_run"}
    output = Output(json).table("tasks", rows, columns).show("dataset", made.root)
    return output.show("steps", made.num_steps, f"{counted(made.num_steps, 'step')} in {made.root}{there}")


def data() -> None:
    """Datasets: what they hold, and how others read them and theirs are read."""


def show(
    folders: Positional[Annotated[tuple[Path, ...], arg(metavar="FOLDERS ...")]],  # of `lw-torchrl collect`
    /,
    check: bool = False,  # also read them through against their checksums
    json: options.Json = False,
) -> Output:
    """Show what datasets hold: who acted, in what, how often it succeeded, what it earned. Several are a mixture.

    Example: lw-torchrl data show demos/mt10 demos/spoilt --check
    """
    if not folders:
        raise ValueError("folders must name at least one dataset")
    for folder in folders:
        options.check_dataset("folders", folder)
    from lw_torchrl.data.dataset import read_metadata
    from lw_torchrl.data.replay_checks import check_behaviours
    from lw_torchrl.data.selection import returns_of

    output = Output(json)
    parts = [read_metadata(folder) for folder in folders]
    check_behaviours(parts)
    told: list[_Episode] = []
    for part in parts:
        earned = returns_of(part, part, "dense", None)[:, 0].tolist()
        told += [_Episode(part.config.behaviour, *pair) for pair in zip(part.episodes, earned, strict=True)]
        if not json:
            print("\n".join(_about(part)) + "\n")
    described = [
        {"folder": part.root, "bytes": _size(part), "behaviour": part.config.behaviour, "config": part.config.to_json()}
        | {"attempts": part.attempts, "versions": part.versions}
        for part in parts
    ]
    output.show("datasets", described)
    every = [] if json else [_row("all", told)]
    _table(output, "task", told, lambda one: one.info.task, [] if len(parts) > 1 else every)
    if len(parts) > 1:
        if not json:
            print()
        _table(output, "behaviour", told, lambda one: one.behaviour, every)
    output.show("all", _row("all", told))
    if check:
        _check(output, parts)
    return output


def _size(part: Demonstrations) -> int:
    return sum(path.stat().st_size for path in part.root.rglob("*") if path.is_file())


def _about(part: Demonstrations) -> list[str]:
    """What a dataset's metadata say of it, in lines."""
    from lw_torchrl.data.dataset import FORMAT_VERSION

    how = part.config
    noise = "none"
    if any(how.noise_scale):
        scales = ", ".join(f"{scale:g}" for scale in how.noise_scale)
        noise = f"{scales}; held for {counted(how.noise_hold, 'step')}, on the gripper x{how.gripper_noise_factor:g}"
    asked = f"{how.episodes_per_task} of each task, of at most {counted(how.max_steps, 'step')}, seed {how.seed}"
    redrawn = sum(part.attempts.values()) - len(part.episodes)
    lines = {
        "dataset": f"{part.root}: {_bytes(_size(part))}, format version {FORMAT_VERSION}",
        "behaviour": f"{how.behaviour}: {_acted(how.policy, how.layout)}",
        "tasks": ", ".join(how.tasks) if len(how.tasks) <= 10 else counted(len(how.tasks), "task"),
        "episodes": asked + (f"; {counted(redrawn, 'failure')} drawn again" if how.redraw_failures else ""),
        "noise": noise,
        "made with": ", ".join(f"{name}\N{NO-BREAK SPACE}{version}" for name, version in part.versions.items()),
    }
    fit = TextWrapper(120, subsequent_indent=" " * 11, break_long_words=False, break_on_hyphens=False)
    return [fit.fill(f"{name:10} {line}").replace("\N{NO-BREAK SPACE}", " ") for name, line in lines.items()]


def _acted(who: Behaviour, layout: Layout) -> str:
    if who.kind == "expert":
        return "Meta-World's scripts" if layout.name == "metaworld" else f"the expert of {layout.name}"
    if who.kind in ("policy", "imported"):
        return f"a policy, fingerprint {who.fingerprint}" if who.kind == "policy" else "others, imported"
    pieces = f"{who.shortest} to {who.longest} steps"
    other = {"skill": "any skill of the plan", "action": "one action"}[who.otherwise]
    if who.right == 0.0:
        return f"{other} for {pieces}, after another"
    plans = f"plans (fingerprint {str(who.fingerprint)[:16]}) with scripted skills"
    return plans if who.right == 1.0 else f"{plans} in {who.right:.3g} of pieces of {pieces}, else {other}"


def _bytes(size: float) -> str:
    for unit in ("B", "kB", "MB"):
        if size < 1000:
            return f"{size:.3g} {unit}"
        size /= 1000
    return f"{size:.3g} GB"


def _table(
    output: Output, name: str, told: list[_Episode], of: Callable[[_Episode], str], ending: list[dict[str, Any]]
) -> None:
    """A row for each task or behaviour, and a last one; each is called ``label``."""

    def first(row: Row) -> str:
        when = row["first_success"]
        return "never" if when is None else f"{when['median']:.0f} ({when['min']}..{when['max']})"

    output.table(
        f"{name}s",
        [_row(label, [*episodes]) for label, episodes in groupby(sorted(told, key=of), of)] + ending,
        {
            name: "label",
            "episodes": "episodes",
            "steps": "steps",
            "success": lambda row: f"{row['success']:.2f}",
            "first success": first,
            "dense return": lambda row: f"{row['dense_return']['mean']:.1f}",
            "quartiles": lambda row: " ".join(f"{one:.1f}" for one in row["dense_return"]["quartiles"]),
        },
    )


def _row(label: str, episodes: list[_Episode]) -> dict[str, Any]:
    first = [one.info.first_success for one in episodes if one.info.first_success is not None]
    earned = [one.earned for one in episodes]
    return {
        "label": label,
        "episodes": len(episodes),
        "steps": sum(one.info.length for one in episodes),
        "success": len(first) / len(episodes),
        "first_success": {"median": median(first), "min": min(first), "max": max(first)} if first else None,
        "dense_return": {
            "mean": sum(earned) / len(earned),
            "quartiles": quantiles(earned, n=4, method="inclusive") if len(earned) > 1 else earned * 3,
        },
    }


def _check(output: Output, parts: list[Demonstrations]) -> None:
    from lw_torchrl.data.memory_map import whole_episodes

    damaged = []
    for part in parts:
        if broken := len(part.episodes) - len(whole_episodes(part, progress=True)):
            damaged.append({"folder": part.root, "episodes": broken})
            share = f"{broken} of {counted(len(part.episodes), 'episode')} differ from their checksums"
            mend = "delete the folder and collect the dataset again"
            output.fault = output.fault or f"{str(part.root)!r} is damaged: {share}; {mend}"
    sound = f"\nchecked: all rows of {counted(len(parts), 'dataset')} are as they were written"
    output.show("damaged", damaged, None if damaged else sound)
