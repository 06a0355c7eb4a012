"""Online experiments as runs of work: weak policies cloned from few demonstrations, and what methods make of them."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from hashlib import file_digest
from pathlib import Path
from typing import Any

import torch
from torchrl.record.loggers import Logger

from lw_torchrl._checks import check_choice, check_int
from lw_torchrl._files import held
from lw_torchrl.data.co_learning_sampler import GROWN, CoLearningSampler
from lw_torchrl.data.replay import LanguageWorldExperienceReplay
from lw_torchrl.data.rewards import RewardName
from lw_torchrl.evaluation import EvaluationResult, evaluate
from lw_torchrl.language.plans import Plans
from lw_torchrl.modules.policy import METHODS, Policy, make_policy
from lw_torchrl.modules.residual_actor import ResidualActor
from lw_torchrl.paper.execution import EVALUATION_SEED, RESULTS, load_result
from lw_torchrl.paper.recipes import TARGET
from lw_torchrl.paper.runs import Dataset, own_tasks, plain
from lw_torchrl.paper.tuning import WEAKEST, Elsewhere, tune_step
from lw_torchrl.training.algorithms import LEARNERS, OnlineConfig
from lw_torchrl.training.behavioral_cloning import BehavioralCloningConfig, BehavioralCloningTrainer
from lw_torchrl.training.envelope import check_description
from lw_torchrl.training.files import describe_data, load_actor, read_description, save_actor
from lw_torchrl.training.online import OnlineTrainer

START = "start"
"""The policy that is begun with: a run beside those of :data:`~lw_torchrl.training.LEARNERS`."""
ONLINE_SEED = 20_000
"""The episodes of training seed k have seed 20000 + k: neither those of its demonstrations nor of its evaluation."""
DIAGNOSIS_SEED = 30_000
"""Those in which a policy's weakest step is looked for."""


@dataclass(frozen=True)
class OnlineRecipe:
    """How weak policies are made and trained on, the same for every task.

    Attributes:
        demonstrations: clean ones of the task, which succeed.
        feature_noise: of the policy cloned from them.
        cloning: how it is cloned; the run's seed takes the place of its own.
        reward, n_steps: of the buffer.
        config: of the training; the run's seed takes the place of its own.
    """

    demonstrations: int = 1
    feature_noise: float = 0.1
    cloning: BehavioralCloningConfig = field(
        default_factory=lambda: BehavioralCloningConfig(steps=1_500, batch_size=200)
    )
    reward: RewardName = "dense_cost"
    n_steps: int = 5
    config: OnlineConfig = field(default_factory=OnlineConfig)

    def __post_init__(self) -> None:
        check_int("demonstrations", self.demonstrations, minimum=1)


@dataclass(frozen=True)
class OnlineRun:
    """A policy of one task, method and seed, and its evaluation: what a scheduler runs.

    Attributes:
        task: its name.
        method: a name of :data:`~lw_torchrl.training.LEARNERS`, or "start".
        seed: of demonstrations, weights, episodes and minibatches.
        recipe: the numbers.
        condition: what the policy is conditioned on, a name of :data:`METHODS`; of a start that is given, its own.
        start: a policy file to begin with; None to clone one from the demonstrations.
        episodes: evaluated.
        step: of method "residual", the step of the task's plan that alone is corrected, counted from 0, or "weakest",
            the one that the start's failed episodes came to and not beyond; None for everywhere.
    """

    task: str
    method: str
    seed: int
    recipe: OnlineRecipe = field(default_factory=OnlineRecipe)
    condition: str = "pcbc"
    start: Path | None = None
    episodes: int = 40
    step: int | str | None = None

    def __post_init__(self) -> None:
        check_choice("method", self.method, (*LEARNERS, START))
        if self.step is not None and self.method != "residual":
            raise ValueError(f"step is of the method 'residual', got it with {self.method!r}")
        if isinstance(self.step, str):
            check_choice("step", self.step, (WEAKEST,))
        elif self.step is not None:
            check_int("step", self.step, minimum=0)
        check_choice("condition", self.condition, METHODS)

    @property
    def group(self) -> Path:
        """The folder of what begins alike: what methods are compared in."""
        return Path(self.condition if self.start is None else f"from-{self.start.stem}")

    @property
    def folder(self) -> Path:
        """Where its files go, below the experiments' folder."""
        step = f"step{self.step + 1}" if isinstance(self.step, int) else self.step
        method = self.method if step is None else f"{self.method}-{step}"
        return self.group / self.task / method / f"seed{self.seed}"

    @property
    def dataset(self) -> Dataset:
        """Its demonstrations."""
        return Dataset(self.task, self.recipe.demonstrations, TARGET, self.seed)

    @property
    def begin(self) -> OnlineRun:
        """The run of the policy that it begins with."""
        return replace(self, method=START, step=None)

    @cached_property
    def _start_digest(self) -> str | None:
        if self.start is None:
            return None
        with open(self.start, "rb") as file:
            return file_digest(file, "sha256").hexdigest()

    def own_plans(self, plans: Plans) -> Plans:
        """The plan of its task."""
        return Plans([plans[self.task]])

    def describe(self, plans: Plans) -> dict[str, Any]:
        """Everything that its result hangs on, as JSON."""
        recipe = asdict(self.recipe)
        if self.method == START:
            del recipe["config"], recipe["reward"], recipe["n_steps"]
        found = {"task": self.task, "method": self.method, "seed": self.seed, "recipe": recipe}
        if self.step is not None:
            found["step"] = self.step
        if self.start is not None:
            return plain(found | {"start": self._start_digest})
        own = self.own_plans(plans)
        return plain(found | {"condition": self.condition, "plans": own.fingerprint} | own_tasks(own))


def _load_start(run: OnlineRun, plans: Plans, out: Path, progress: bool) -> Policy:
    """The policy that a run begins with: the one given, or the one cloned, which is kept for all methods."""
    if run.start is not None:
        policy = load_actor(run.start)
        if run.task not in policy.tasks:
            raise ValueError(f"start: the policy of {str(run.start)!r} does not know the task {run.task!r}")
        return policy
    folder, described = out / run.begin.folder, {"run": run.begin.describe(plans)}
    file, checkpoint = folder / "policy.zip", folder / "checkpoint.zip"
    with held(file, "out", wait=True):
        if not file.is_file():
            torch.manual_seed(run.seed)
            actor = make_policy(run.condition, run.own_plans(plans), feature_noise=run.recipe.feature_noise)
            replay = LanguageWorldExperienceReplay(
                out / run.dataset.folder, label="executed", terminate_on_success=True, transform=actor.transform()
            )
            config = replace(run.recipe.cloning, seed=run.seed)
            BehavioralCloningTrainer(actor, replay, config, checkpoint=checkpoint, progress=progress).train()
            save_actor(actor, file, data=describe_data(replay), **described)
        checkpoint.unlink(missing_ok=True)
    check_description(file, described)
    return load_actor(file)


def _train(
    run: OnlineRun, plans: Plans, out: Path, progress: bool, make_logger: Callable[[Path], Logger] | None
) -> tuple[Policy, dict[str, Any]]:
    """What a run makes of its start, kept in ``policy.zip``; its "history", what became of each round, and "tuned", the
    step of a plan if it is of one."""
    folder, described = out / run.folder, {"run": run.describe(plans)}
    file, checkpoint = folder / "policy.zip", folder / "checkpoint.zip"
    if not file.is_file():
        actor = _load_start(run, plans, out, progress)
        recipe, config = run.recipe, replace(run.recipe.config, seed=ONLINE_SEED + run.seed)
        told: dict[str, Any] = {}
        if run.step is not None:
            with torch.random.fork_rng(devices=[]):
                torch.manual_seed(config.seed)
                actor, told["tuned"] = tune_step(
                    actor,
                    run.task,
                    run.step,
                    scale=config.residual_scale,
                    seed=DIAGNOSIS_SEED + run.seed,
                    progress=progress,
                )
        replay = LanguageWorldExperienceReplay(
            out / run.dataset.folder,
            label="executed",
            reward=recipe.reward,
            terminate_on_success=True,
            n_steps=recipe.n_steps,
            gamma=config.gamma,
            grow=config.frames,
            sampler=CoLearningSampler(GROWN),
            transform=actor.transform(),
        )
        trainer = OnlineTrainer(
            actor,
            replay,
            config,
            method=run.method,
            tasks=run.task,
            checkpoint=checkpoint,
            logger=None if make_logger is None else make_logger(file),
            progress=progress,
        )
        trainer.train()
        save_actor(trainer.policy, file, data=describe_data(replay), history=trainer.history, **told, **described)
    checkpoint.unlink(missing_ok=True)
    check_description(file, described)
    description = read_description(file)
    return load_actor(file), {name: description[name] for name in ("history", "tuned") if name in description}


def execute_online(
    run: OnlineRun,
    plans: Plans,
    out: Path,
    *,
    progress: bool = True,
    make_logger: Callable[[Path], Logger] | None = None,
) -> EvaluationResult:
    """Do a run, or what is left of it; its result is written last, to ``out/run.folder/results.json``.

    Args:
        run: what to do.
        plans: a plan for its task.
        out: the experiments' folder.
        progress: show progress bars.
        make_logger: a TorchRL logger for a policy's file, for the training.

    Returns:
        The evaluation, action noise 0.1; ``config["run"]`` says what was done, ``config["history"]`` what became of
        each round, and ``config["seconds"]`` how long this call took. Of a run of one step, ``config["tuned"]`` says
        which, ``config["before"]`` the start's success in the same episodes, and ``config["elsewhere"]`` in how many
        "states" of them the step was not in force ("outside"), and in how many of these the action is not the start's.

    Raises:
        ValueError: ``out`` holds the same run of another configuration; the start does not know the task.
    """
    if (done := load_result(run, plans, out)) is not None:
        return done
    with held(out / run.folder, "out", folder=True, wait=True):
        return load_result(run, plans, out) or _execute(run, plans, out, progress, make_logger)


def _execute(
    run: OnlineRun, plans: Plans, out: Path, progress: bool, make_logger: Callable[[Path], Logger] | None
) -> EvaluationResult:
    started = time.perf_counter()
    run.dataset.collect(out, progress)
    more: dict[str, Any] = {"run": run.describe(plans)}
    watching: dict[str, Any] = {}
    if run.method == START:
        policy = _load_start(run, plans, out, progress)
    else:
        policy, told = _train(run, plans, out, progress, make_logger)
        more |= told
    if run.step is not None:
        assert isinstance(policy, ResidualActor)
        more["before"] = execute_online(run.begin, plans, out, progress=progress).mean_success
        watch = Elsewhere(_load_start(run, plans, out, progress), policy)
        watching = {"also_record": policy.in_keys, "on_episode": watch}
    result = evaluate(
        policy,
        tasks=run.task,
        episodes_per_task=run.episodes,
        seed=EVALUATION_SEED + run.seed,
        noise_scale=0.1,
        stop_at_success=True,
        progress=progress,
        **watching,
    )
    if run.step is not None:
        more["elsewhere"] = watch.to_json()
    more["seconds"] = round(time.perf_counter() - started, 1)
    result = replace(result, config=result.config | more)
    result.save(out / run.folder / RESULTS)
    return result


def joined(results: Sequence[EvaluationResult]) -> EvaluationResult:
    """One result of those of several tasks, evaluated alike."""
    tasks = [task for one in results for task in one.config["tasks"]]
    return EvaluationResult(results[0].config | {"tasks": tasks}, tuple(e for one in results for e in one.episodes))
