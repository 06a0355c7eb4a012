"""The paper's experiments as units of work: datasets, and policies trained on them and evaluated."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import Any

from filelock import FileLock
from tqdm.auto import tqdm

from lw_torchrl._checks import check_choice
from lw_torchrl.data.collect import collect_demonstrations
from lw_torchrl.evaluation import EvaluationResult, evaluate
from lw_torchrl.language.plans import Plans, format_plan
from lw_torchrl.language.tasks import resolve_tasks
from lw_torchrl.modules import ScriptedSkillActor
from lw_torchrl.trainers.recipes import DataSetting, Execution, Member, Preset
from lw_torchrl.trainers.unit_training import train_each, train_one

METHODS = ("pcbc", "dc", "one-hot", "scripted")
EVALUATION_SEED = 10_000
"""Training seeds count from 0; the evaluation of training seed k has seed 10000 + k."""
RESULTS = "results.json"


@dataclass(frozen=True)
class Dataset:
    """Demonstrations that units share: a unit of work itself.

    Attributes:
        tasks: "MT10" or another argument of :func:`resolve_tasks`.
        episodes: demonstrations of each.
        execution: how the experts are executed.
        seed: of the initial states and the noise.
    """

    tasks: str
    episodes: int
    execution: Execution
    seed: int

    @property
    def folder(self) -> Path:
        """Where it goes, below the experiments' folder."""
        return Path("demonstrations") / f"{self.tasks}x{self.episodes}-{self.execution.name}-seed{self.seed}"

    def collect(self, out: Path, progress: bool) -> None:
        """Collect it, or what is left; of several processes one does, and the others wait."""
        root = out / self.folder
        root.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(root.with_name(f".{root.name}.lock")):
            collect_demonstrations(
                self.tasks,
                episodes_per_task=self.episodes,
                root=root,
                seed=self.seed,
                noise_scale=self.execution.noise_scale,
                noise_hold=self.execution.noise_hold,
                redraw_failures=self.execution.redraw_failures,
                progress=progress,
            )


@dataclass(frozen=True)
class Unit:
    """One policy, or one for each target, or plans with scripts, of one training seed: what a scheduler runs.

    Attributes:
        setting: what data it sees; scripts see none, and are the same in every setting.
        method: one of :data:`METHODS`.
        seed: of demonstrations, initial weights and minibatches.
        preset: how to train.
        episodes: evaluated for each task.
        plans_name: part of the folder's name, for other plans than ours.
    """

    setting: DataSetting
    method: str
    seed: int
    preset: Preset
    episodes: int = 20
    plans_name: str = ""

    def __post_init__(self) -> None:
        check_choice("method", self.method, METHODS)

    @property
    def group(self) -> Path:
        """The folder of the setting, the preset and the plans: what methods are compared in."""
        return Path(self.setting.name) / "-".join(filter(None, (self.preset.name, self.plans_name)))

    @property
    def folder(self) -> Path:
        """Where its files go, below the experiments' folder."""
        if self.method == "scripted":
            return Path("-".join(filter(None, ("scripted", self.plans_name)))) / f"seed{self.seed}"
        return self.group / self.method / f"seed{self.seed}"

    @property
    def datasets(self) -> tuple[Dataset, ...]:
        """What it is trained on: the base tasks' demonstrations, and the targets'."""
        if self.method == "scripted":
            return ()
        base = Dataset(self.setting.base, self.setting.episodes, self.preset.base, self.seed)
        if self.setting.targets is None:
            return (base,)
        assert self.preset.target is not None
        return base, Dataset(self.setting.targets, 1, self.preset.target, self.seed)

    def actor_options(self, member: Member) -> dict[str, Any]:
        """Of one of its policy's actors."""
        return {**member.actor, **(member.plan_actor if self.method == "pcbc" else {})}

    def describe(self, plans: Plans) -> dict[str, Any]:
        """Everything that its result hangs on, as JSON."""
        text = "".join(map(format_plan, plans.values()))
        plans_used = sha256(text.encode()).hexdigest()[:16] if self.method in ("pcbc", "scripted") else None
        described: dict[str, Any] = {"method": self.method, "seed": self.seed, "plans": plans_used}
        if self.method != "scripted":
            described |= {
                "setting": self.setting.name,
                "preset": self.preset.name,
                "datasets": [asdict(dataset) for dataset in self.datasets],
                "members": [{"actor": self.actor_options(one), "yaw": one.yaw} for one in self.preset.members],
                "training": asdict(self.preset.training),
                "after_success": self.preset.after_success,
                "passes": self.preset.passes,
            }
        return _plain(described)


def _plain(value: Any) -> Any:
    """As JSON gives it back: lists for tuples."""
    if isinstance(value, dict):
        return {key: _plain(one) for key, one in value.items()}
    return [_plain(one) for one in value] if isinstance(value, (list, tuple)) else value


def _evaluate(unit: Unit, plans: Plans, out: Path, tasks: tuple[str, ...], progress: bool) -> EvaluationResult:
    options: dict[str, Any] = {
        "episodes_per_task": unit.episodes,
        "seed": EVALUATION_SEED + unit.seed,
        "noise_scale": 0.1,
        "stop_at_success": True,
    }
    if unit.method == "scripted":
        return evaluate(ScriptedSkillActor(plans), tasks=tasks, progress=progress, **options)
    if unit.setting.targets is None:
        return evaluate(train_one(unit, plans, out, progress), tasks=tasks, progress=progress, **options)
    actors = train_each(unit, plans, out, progress)
    each = [
        evaluate(actors[task], tasks=task, progress=False, **options)
        for task in tqdm(sorted({*tasks} & {*actors}), desc="evaluating", unit="model", delay=1, disable=not progress)
    ]
    shown = [task for one in each for task in one.config["tasks"]]
    return EvaluationResult(each[0].config | {"tasks": shown}, tuple(e for one in each for e in one.episodes))


def load_result(unit: Unit, plans: Plans, out: Path) -> EvaluationResult | None:
    """The result of a unit, if it is there.

    Raises:
        ValueError: it is of another configuration.
    """
    path = out / unit.folder / RESULTS
    if not path.is_file():
        return None
    result = EvaluationResult.load(path)
    found, ours = result.config.get("unit") or {}, unit.describe(plans)
    different = [key for key in ours if found.get(key) != ours[key]]
    if result.config.get("episodes_per_task") != unit.episodes:
        different.append("episodes")
    if different:
        raise ValueError(
            f"out: {str(path)!r} is of another configuration, it differs in {', '.join(different)}; choose another "
            f"folder, or delete {str(path.parent)!r} to do the unit again"
        )
    return result


def run_unit(
    unit: Unit,
    plans: Plans,
    out: Path,
    *,
    tasks: str | Sequence[str] = "MT50",
    progress: bool = True,
) -> EvaluationResult:
    """Do a unit, or what is left of it; its result is written last, to ``out/unit.folder/results.json``.

    Args:
        unit: what to do.
        plans: a plan for each of the 50 tasks.
        out: the experiments' folder.
        tasks: to evaluate.
        progress: show progress bars.

    Returns:
        The evaluation of the last checkpoint, action noise 0.1; ``config["unit"]`` says what was done, and
        ``config["seconds"]`` how long this call took.

    Raises:
        ValueError: ``out`` holds the same unit of another configuration.

    Source: paper section 'Conditional Plan Experiments'.
    """
    if (done := load_result(unit, plans, out)) is not None:
        return done
    started = time.perf_counter()
    for dataset in unit.datasets:
        dataset.collect(out, progress)
    result = _evaluate(unit, plans, out, resolve_tasks(tasks), progress)
    spent = {"unit": unit.describe(plans), "seconds": round(time.perf_counter() - started, 1)}
    result = replace(result, config=result.config | spent)
    result.save(out / unit.folder / RESULTS)
    return result
