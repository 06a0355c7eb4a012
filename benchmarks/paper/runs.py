"""Base classes of the datasets and runs of an experiment, and the function that executes a run."""

import json
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase

from lw_torchrl._util.devices import CPU, check_device
from lw_torchrl._util.files import locked
from lw_torchrl._util.reproducibility import differences
from lw_torchrl.data import collect_demonstrations
from lw_torchrl.evaluation import EvaluationResult, evaluate
from lw_torchrl.language.plans import Plans
from lw_torchrl.language.tasks import TASKS
from lw_torchrl.suites.suite import find_suite
from lw_torchrl.training import load_actor, save_actor
from lw_torchrl.training.checkpoint import check_description, training_file
from lw_torchrl.training.minibatches import describe_data

EVALUATION_SEED = 10_000  # the policy of training seed k is evaluated with seed 10000 + k
RESULTS = "results.json"


@dataclass(frozen=True)
class Work:
    """The checked arguments of :func:`execute_run`."""

    plans: Plans
    out: Path
    tasks: tuple[str, ...] = ()
    progress: bool = True
    device: torch.device = CPU


class Dataset(ABC):
    """A base class of datasets that several runs share."""

    @property
    @abstractmethod
    def folder(self) -> Path:
        """The dataset's folder, relative to the experiments' folder."""

    @property
    @abstractmethod
    def options(self) -> dict[str, Any]:
        """Return the arguments of :func:`~lw_torchrl.collect_demonstrations`."""

    def collect(self, out: Path, progress: bool) -> None:
        """Collect the dataset, or the missing part of it. If several processes call this, one collects, others wait."""
        root = out / self.folder
        with locked(root, "out", wait=True):
            collect_demonstrations(**self.options, root=root, progress=progress)


class Run(ABC):
    """A base class of runs: the training of policies with one seed, and their evaluation."""

    method: str
    seed: int  # seed of data, initial weights and minibatches
    episodes: int  # evaluation episodes per task
    any_device = False  # whether networks can be trained and evaluated on a GPU

    @property
    @abstractmethod
    def folder(self) -> Path:
        """The run's folder, relative to the experiments' folder."""

    @property
    def label(self) -> str:
        """The run's name in tables."""
        return self.method

    @property
    @abstractmethod
    def datasets(self) -> tuple[Dataset, ...]:
        """The datasets from which the run learns."""

    @property
    @abstractmethod
    def scope(self) -> str | tuple[str, ...]:
        """The tasks on which the run can be evaluated, as for :func:`resolve_tasks`."""

    @abstractmethod
    def describe(self, plans: Plans) -> dict[str, Any]:
        """Return everything on which the result depends, as JSON."""

    @abstractmethod
    def learn(self, work: Work) -> tuple[Any, dict[str, Any]]:
        """Train the policy, or load it from existing files; return it with an entry for the result's config."""

    def evaluate(self, policy: Any, work: Work) -> tuple[EvaluationResult, dict[str, Any]]:
        """Evaluate the policy; return the result with an entry for its config."""
        return self.rollouts(policy, work), {}

    def evaluated(self, tasks: str | Sequence[str] | None) -> tuple[str, ...]:
        """Return the run's tasks that are among ``tasks``, or all for None; raise ValueError if there are none."""
        own = tuple(find_suite(self.scope).named_tasks(self.scope))
        names = own if tasks is None else tuple(find_suite(tasks).named_tasks(tasks))
        if not (shown := tuple(name for name in names if name in own)):
            raise ValueError(f"tasks must name some of the run's, {', '.join(own)}, got {', '.join(names)}")
        return shown

    def rollouts(self, policy: Any, work: Work, **options: Any) -> EvaluationResult:
        """Evaluate a policy as in all runs, with fresh seeds and action noise 0.1."""
        given: dict[str, Any] = {"tasks": work.tasks, "episodes_per_task": self.episodes, "progress": work.progress}
        given |= {"seed": EVALUATION_SEED + self.seed, "noise_scale": 0.1, "stop_at_success": True}
        return evaluate(policy, **given | options)


def load_result(
    run: Run, plans: Plans, out: Path, tasks: Sequence[str] | None = None, file: str = RESULTS
) -> EvaluationResult | None:
    """Return the result of a run, or None if it does not exist; raise ValueError if its config or tasks differ."""
    path = out / run.folder / file
    if not path.is_file():
        return None
    result = EvaluationResult.load(path)
    found = (result.config.get("run") or {}) | {"episodes": result.config["episodes_per_task"]}
    ours = run.describe(plans) | {"episodes": run.episodes}
    if tasks is not None:
        found, ours = found | {"tasks": result.config["tasks"]}, ours | {"tasks": [*tasks]}
    if different := differences(found, ours):
        mend = f"choose another folder, or delete {run.folder} in it to repeat the run"
        how = f"which differs in {', '.join(different)}"
        raise ValueError(f"out: {str(path)!r} has a different configuration, {how}; {mend}")
    return result


def execute_run(
    run: Run,
    plans: Plans,
    out: Path,
    *,
    tasks: str | Sequence[str] | None = None,
    progress: bool = True,
    device: str | torch.device = "cpu",
) -> EvaluationResult:
    """Execute a run, or the remaining part of it, and return the evaluation, which is also written to results.json.

    Args:
        run: the run.
        plans: a plan for each of the run's tasks.
        out: the experiments' folder.
        tasks: the tasks to evaluate; None for all of the run.
        progress: show progress bars.
        device: device of the networks; some runs support only the CPU.

    Returns:
        The evaluation of the last step's policy on seeds that no training used, with action noise 0.1.
        ``config["run"]`` describes the run, ``config["seconds"]`` is the duration of this call, and with several
        evaluations ``config["best"]`` holds their number and each task's best success rate among them.

    Raises:
        ValueError: ``out`` holds the same run with another configuration, or evaluated on other tasks.

    Source: paper section 'Conditional Plan Experiments'.
    """
    work = Work(plans, out, run.evaluated(tasks), progress, check_device("device", device))
    if work.device.type != "cpu" and not run.any_device:
        raise ValueError(f"device must be the CPU for {type(run).__name__}, got {device}")
    if (done := load_result(run, plans, out, work.tasks)) is not None:
        return done
    with locked(out / run.folder, "out", folder=True, wait=True):
        if (done := load_result(run, plans, out, work.tasks)) is not None:
            return done
        started = time.perf_counter()
        for dataset in run.datasets:
            dataset.collect(out, progress)
        policy, trained = run.learn(work)
        result, evaluated = run.evaluate(policy, work)
        seconds = round(time.perf_counter() - started, 1)
        described = {"run": run.describe(plans), **trained, **evaluated, "seconds": seconds}
        result = replace(result, config=result.config | described)
        result.save(out / run.folder / RESULTS)
        return result


def kept_policy(
    file: Path, described: dict[str, Any], train: Callable[[Path], Mapping[str, Any]]
) -> TensorDictModuleBase:
    """Load a policy from a file whose description must equal ``described``; train and save it first if needed.

    ``train`` gets the path of a checkpoint for the training, and returns arguments of :func:`~lw_torchrl.save_actor`.
    """
    checkpoint = file.with_name("checkpoint.safetensors")
    if not file.is_file():
        trained = dict(train(checkpoint))
        save_actor(trained.pop("actor"), file, data=describe_data(trained.pop("replay")), **trained, **described)
    for written in (checkpoint, training_file(checkpoint)):
        written.unlink(missing_ok=True)  # without file locks, another process may have removed it
    check_description(file, described)
    return load_actor(file)


def own_tasks(plans: Plans) -> dict[str, Any]:
    """Return the tasks that differ from the shipped ones, because fingerprints of plans do not cover descriptions."""
    own = {task: plan.definition.to_json() for task, plan in plans.items() if plan.definition != TASKS.get(task)}
    return {"own_tasks": own} if own else {}


def plain(value: Any) -> Any:
    """Convert a value to JSON and back, which turns tuples into lists."""
    return json.loads(json.dumps(value))
