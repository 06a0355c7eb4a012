"""The paper's runs: policies cloned from demonstrations (one for all tasks or one per target), and scripted plans."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch
from tensordict.nn import TensorDictModuleBase

from benchmarks.paper.actors import Parts, ensemble, reads_plans
from benchmarks.paper.recipes import DataSetting, Execution, Member, Preset
from benchmarks.paper.runs import Dataset, Run, Work, load_result, own_tasks, plain
from benchmarks.paper.stacked import StackedBehavioralCloning
from lw_torchrl._util.checks import check_choice
from lw_torchrl._util.progress import Progress
from lw_torchrl.data import CoLearningSampler, LanguageWorldExperienceReplay, TaskBalancedSampler
from lw_torchrl.evaluation import EvaluationResult
from lw_torchrl.language.plans import Plans
from lw_torchrl.language.tasks import resolve_tasks
from lw_torchrl.modules import METHODS, DemonstratedActor, ScriptedSkillActor
from lw_torchrl.training import BehavioralCloningTrainer
from lw_torchrl.training.checkpoint import check_description, load_actor, save_actor
from lw_torchrl.training.minibatches import describe_data

SCRIPTED = "scripted"
"""The method "plans with scripted skills", which is not in :data:`lw_torchrl.modules.METHODS` and needs no training."""


@dataclass(frozen=True)
class ExpertDataset(Dataset):
    """Demonstrations of the scripted experts."""

    tasks: str  # "MT10" or another argument of :func:`resolve_tasks`
    episodes: int  # demonstrations of each task
    execution: Execution  # how the experts are executed
    seed: int  # seed of the initial states and the noise

    @property
    def folder(self) -> Path:
        return Path("demonstrations") / f"{self.tasks}x{self.episodes}-{self.execution.name}-seed{self.seed}"

    @property
    def options(self) -> dict[str, Any]:
        noise = {name: value for name, value in asdict(self.execution).items() if name != "name"}
        return {"tasks": self.tasks, "episodes_per_task": self.episodes, "seed": self.seed, **noise}


@dataclass(frozen=True)
class ImitationRun(Run):
    """A run that trains one policy, or one for each target, or that evaluates plans with scripted skills."""

    setting: DataSetting  # the training data; scripted plans use none, and are the same in every setting
    method: str  # one of :data:`~lw_torchrl.modules.METHODS`, or "scripted"
    seed: int  # seed of demonstrations, initial weights and minibatches
    preset: Preset  # the training recipe
    episodes: int = 20  # evaluation episodes per task
    plans_name: str = ""  # part of the folder's name, if the plans are not the shipped ones
    any_device = True

    def __post_init__(self) -> None:
        check_choice("method", self.method, [*METHODS, SCRIPTED])

    @property
    def group(self) -> Path:
        """The folder of the setting, the preset and the plans, within which methods are compared."""
        return Path(self.setting.name) / "-".join(filter(None, (self.preset.name, self.plans_name)))

    @property
    def folder(self) -> Path:
        if self.method == SCRIPTED:
            return Path("-".join(filter(None, ("scripted", self.plans_name)))) / f"seed{self.seed}"
        return self.group / self.method / f"seed{self.seed}"

    @property
    def datasets(self) -> tuple[ExpertDataset, ...]:
        if self.method == SCRIPTED:
            return ()
        base = ExpertDataset(self.setting.base, self.setting.episodes, self.preset.base, self.seed)
        if self.setting.targets is None:
            return (base,)
        assert self.preset.target is not None
        return base, ExpertDataset(self.setting.targets, 1, self.preset.target, self.seed)

    @property
    def scope(self) -> str:
        return "MT50" if self.method == SCRIPTED else self.setting.targets or "MT50"

    @property
    def reads_plans(self) -> bool:
        return self.method == SCRIPTED or reads_plans(self.method)

    @property
    def skills(self) -> Literal["own", "MT10"]:
        """The skills in the run's plans: only MT10's for a policy trained only on MT10, otherwise each task's own."""
        return "MT10" if self.setting.name == "zero-shot" and self.method != SCRIPTED else "own"

    @property
    def demonstrated(self) -> tuple[Member, ...]:
        """The description-conditioned actors that act instead of plan-conditioned ones on demonstrated tasks."""
        return self.preset.demonstrated if self.reads_plans else ()

    def describe(self, plans: Plans) -> dict[str, Any]:
        described: dict[str, Any] = {"method": self.method, "seed": self.seed}
        described["plans"] = plans.fingerprint if self.reads_plans else None
        if self.method != SCRIPTED:
            described |= {"setting": self.setting.name, "preset": self.preset.name}
            described["datasets"] = [asdict(dataset) for dataset in self.datasets]
            described["members"] = [one.of(self.method).describe() for one in self.preset.members]
            if self.demonstrated:
                described["demonstrated"] = [one.of("dc").describe() for one in self.demonstrated]
            described["training"] = asdict(self.preset.training)
            described |= {name: getattr(self.preset, name) for name in ("label", "after_success", "passes")}
            if self.preset.evaluations > 1:
                described["evaluations"] = self.preset.evaluations
        if not self.reads_plans:
            described |= own_tasks(plans)
        return plain(described)

    def learn(self, work: Work) -> tuple[Any, dict[str, Any]]:
        if self.method == SCRIPTED:
            return ScriptedSkillActor(work.plans), {}
        targets = None if self.setting.targets is None else resolve_tasks(self.setting.targets)
        folder, described = work.out / self.folder, {"run": self.describe(work.plans)}
        files = [folder / "models" / f"{target}.safetensors" for target in targets or ()] or [
            folder / "policy.safetensors"
        ]
        policies = []
        if all(file.is_file() for file in files):
            for file in files:
                check_description(file, described)
                policies.append(load_actor(file))
        else:
            members, replays = self._train(work, targets or ())
            for file, replay, *actors in zip(files, replays, *members, strict=True):
                number = len(self.preset.members)
                others, demonstrated = ensemble(actors[:number]), ensemble(actors[number:])
                assert others is not None
                policies.append(others if demonstrated is None else DemonstratedActor(demonstrated, others))
                save_actor(policies[-1], file, data=describe_data(replay), **described)
        for checkpoint in folder.glob("checkpoint-*.safetensors"):
            checkpoint.unlink()
        return policies[0] if targets is None else dict(zip(targets, policies, strict=True)), {}

    def evaluate(self, policy: Any, work: Work) -> tuple[EvaluationResult, dict[str, Any]]:
        result = self._rollouts(policy, work)
        if self.preset.evaluations == 1 or self.method == SCRIPTED:
            return result, {}
        files = sorted(file.name for file in (work.out / self.folder / "evaluations").glob("*.json"))
        earlier = [load_result(self, work.plans, work.out, work.tasks, f"evaluations/{file}") for file in files]
        every = [result, *filter(None, earlier)]
        rates = {task: max(one.success_once[task] or 0.0 for one in every) for task in result.success_once}
        return result, {"best": {"of": len(every), "rates": rates}}

    def _rollouts(self, policy: Any, work: Work) -> EvaluationResult:
        options = {} if self.method == SCRIPTED else {"device": work.device}
        if not isinstance(policy, Mapping):
            return self.rollouts(policy, work, **options)
        each = []
        with Progress("evaluating", len(work.tasks), "model", show=work.progress) as bar:
            for task in work.tasks:
                each.append(self.rollouts(policy[task], work, tasks=task, progress=False, **options))
                bar.update()
        return joined(each)

    def _train(
        self, work: Work, targets: Sequence[str]
    ) -> tuple[list[list[TensorDictModuleBase]], list[LanguageWorldExperienceReplay]]:
        """Train the members of the policies, one policy for all tasks or one per target.

        Member k, counted from 0, has the run's seed plus 1000·k. With T targets, member k of target i has the seed
        1000·seed + T·k + i.
        """
        preset, roots = self.preset, [work.out / dataset.folder for dataset in self.datasets]
        steps = preset.training.steps
        if preset.passes is not None:  # over the base tasks, half of each minibatch if there are targets
            rows = len(LanguageWorldExperienceReplay(roots[0], after_success=preset.after_success))
            steps = max(1, preset.passes * (2 if targets else 1) * rows // preset.training.batch_size)
        members: list[list[TensorDictModuleBase]] = []
        known = Plans({task: work.plans[task] for task in resolve_tasks(self.setting.base)})
        trained = [(self.method, one.of(self.method), work.plans) for one in preset.members]
        trained += [("dc", one.of("dc"), known) for one in self.demonstrated]
        for number, (method, parts, plans) in enumerate(trained):
            first = 1_000 * self.seed + len(targets) * number if targets else self.seed + 1_000 * number
            config = replace(preset.training, steps=steps, seed=first)
            plans, actors = parts.seen(plans), []
            for i in range(len(targets) or 1):
                torch.manual_seed(first + i)
                actors.append(parts.actor(method, plans))
            checkpoint = work.out / self.folder / f"checkpoint-{number}.safetensors"
            options: dict[str, Any] = {"checkpoint": checkpoint, "progress": work.progress, "device": work.device}
            trainer: BehavioralCloningTrainer | StackedBehavioralCloning
            if targets:
                replays = [
                    self._replay(
                        parts, work, actor, roots, CoLearningSampler(target, exact=True), episodes=[None, {target: 1}]
                    )
                    for target, actor in zip(targets, actors, strict=True)
                ]
                trainer = StackedBehavioralCloning(actors, replays, config, **options)
            else:
                replays = [self._replay(parts, work, actors[0], roots[0], TaskBalancedSampler(exact=True))]
                trainer = BehavioralCloningTrainer(actors[0], replays[0], config, **options)
            policy = dict(zip(targets, actors, strict=True)) if targets else actors[0]
            for step in preset.evaluated_before(steps):
                if trainer.steps > step:
                    continue
                trainer.train(until=step)
                if load_result(self, work.plans, work.out, work.tasks, f"evaluations/{step}.json") is None:
                    result = self._rollouts(policy, work)
                    result = replace(result, config=result.config | {"run": self.describe(work.plans)})
                    result.save(work.out / self.folder / "evaluations" / f"{step}.json")
            trainer.train()
            members.append(actors)
        return members, replays

    def _replay(
        self, parts: Parts, work: Work, actor: TensorDictModuleBase, roots: Any, sampler: Any, **options: Any
    ) -> LanguageWorldExperienceReplay:
        options |= {"label": self.preset.label, "after_success": self.preset.after_success, "device": work.device}
        return LanguageWorldExperienceReplay(roots, sampler=sampler, transform=parts.transform(actor), **options)


def joined(results: Sequence[EvaluationResult]) -> EvaluationResult:
    """Join results of different tasks, from evaluations with the same settings, into one result."""
    tasks = [task for one in results for task in one.config["tasks"]]
    return EvaluationResult(results[0].config | {"tasks": tasks}, tuple(e for one in results for e in one.episodes))
