"""The paper's runs: policies that clone demonstrations, one for all tasks or one for each target; plans by scripts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch
from torchrl.envs import Compose, Transform

from lw_torchrl._checks import check_choice
from lw_torchrl._progress import Progress
from lw_torchrl.data import CoLearningSampler, LanguageWorldExperienceReplay, TaskBalancedSampler
from lw_torchrl.evaluation import EvaluationResult
from lw_torchrl.language.plans import Plans
from lw_torchrl.language.tasks import resolve_tasks
from lw_torchrl.modules import ActorEnsemble, ScriptedSkillActor
from lw_torchrl.modules.policy import METHODS, Policy, make_policy, policy_class
from lw_torchrl.paper.recipes import DataSetting, Execution, Member, Preset
from lw_torchrl.paper.runs import Dataset, Run, Work, load_evaluation, own_tasks, plain
from lw_torchrl.training import BehavioralCloningConfig, BehavioralCloningTrainer, StackedBehavioralCloning
from lw_torchrl.training.envelope import check_description
from lw_torchrl.training.files import describe_data, load_actor, save_actor
from lw_torchrl.transforms import RandomYaw

SCRIPTED = "scripted"
"""Plans with scripted skills: a method beside those of :data:`lw_torchrl.modules.policy.METHODS`, without training."""


@dataclass(frozen=True)
class ExpertDataset(Dataset):
    """Demonstrations of the scripted experts."""

    tasks: str  # "MT10" or another argument of :func:`resolve_tasks`
    episodes: int  # demonstrations of each
    execution: Execution  # how the experts are executed
    seed: int  # of the initial states and the noise

    @property
    def folder(self) -> Path:
        return Path("demonstrations") / f"{self.tasks}x{self.episodes}-{self.execution.name}-seed{self.seed}"

    @property
    def options(self) -> dict[str, Any]:
        noise = {name: value for name, value in asdict(self.execution).items() if name != "name"}
        return {"tasks": self.tasks, "episodes_per_task": self.episodes, "seed": self.seed, **noise}


@dataclass(frozen=True)
class ImitationRun(Run):
    """One policy, or one for each target, or plans with scripts."""

    setting: DataSetting  # what data it sees; scripts see none, and are the same in every setting
    method: str  # one of :data:`~lw_torchrl.modules.policy.METHODS`, or "scripted"
    seed: int  # of demonstrations, initial weights and minibatches
    preset: Preset  # how to train
    episodes: int = 20  # evaluated for each task
    plans_name: str = ""  # part of the folder's name, for other plans than ours
    encoder_name: str = ""  # that of the text encoder, for another than ours: "my_texts:encode"
    any_device = True

    def __post_init__(self) -> None:
        check_choice("method", self.method, (*METHODS, SCRIPTED))

    @property
    def label(self) -> str:
        return self.method

    @property
    def group(self) -> Path:
        """The folder of the setting, the preset, the plans and the texts: what methods are compared in."""
        own = self.plans_name, self.encoder_name.replace(":", ".")
        return Path(self.setting.name) / "-".join(filter(None, (self.preset.name, *own)))

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
        return self.method == SCRIPTED or policy_class(METHODS[self.method].policy).plan_options

    @property
    def skills(self) -> Literal["own", "MT10"]:
        """Whose skills its plans speak of: what is trained on MT10 and never saw another task knows MT10's alone."""
        return "MT10" if self.setting.name == "zero-shot" and self.method != SCRIPTED else "own"

    def actor_options(self, member: Member) -> dict[str, Any]:
        return {**member.actor, **(member.plan_actor if self.reads_plans else {})}

    def any_yaw(self, member: Member) -> bool:
        """Whether plans tell which of a member's rows may be turned by any angle."""
        return member.any_yaw and self.reads_plans

    def describe(self, plans: Plans) -> dict[str, Any]:
        described: dict[str, Any] = {"method": self.method, "seed": self.seed}
        described["plans"] = plans.fingerprint if self.reads_plans else None
        if self.method != SCRIPTED:
            described |= {"setting": self.setting.name, "preset": self.preset.name}
            described["datasets"] = [asdict(dataset) for dataset in self.datasets]
            described["members"] = [
                {"actor": self.actor_options(one), "yaw": one.yaw} | ({"any_yaw": True} if self.any_yaw(one) else {})
                for one in self.preset.members
            ]
            described["training"] = self.preset.training.describe()
            described |= {name: getattr(self.preset, name) for name in ("label", "after_success", "passes")}
            if self.preset.evaluations > 1:
                described["evaluations"] = self.preset.evaluations
        if not self.reads_plans:
            described |= own_tasks(plans)
        if self.encoder_name and self.method != SCRIPTED:
            described["text_encoder"] = self.encoder_name
        return plain(described)

    def learn(self, work: Work) -> tuple[Any, dict[str, Any]]:
        if self.method == SCRIPTED:
            return ScriptedSkillActor(work.plans), {}
        targets = None if self.setting.targets is None else resolve_tasks(self.setting.targets)
        folder, described = work.out / self.folder, {"run": self.describe(work.plans)}
        files = [folder / "models" / f"{target}.zip" for target in targets or ()] or [folder / "policy.zip"]
        policies = []
        if all(file.is_file() for file in files):
            for file in files:
                check_description(file, described)
                policies.append(load_actor(file, text_encoder=work.text_encoder))
        else:
            train = _train_one if targets is None else _train_each
            members, replays = train(self, work, targets or ())
            for file, replay, *actors in zip(files, replays, *members, strict=True):
                policies.append(actors[0] if len(actors) == 1 else ActorEnsemble(actors))
                save_actor(policies[-1], file, data=describe_data(replay), **described)
        for checkpoint in folder.glob("checkpoint-*.zip"):
            checkpoint.unlink()
        return policies[0] if targets is None else dict(zip(targets, policies, strict=True)), {}

    def evaluate(self, policy: Any, work: Work) -> tuple[EvaluationResult, dict[str, Any]]:
        result = self._rollouts(policy, work)
        if self.preset.evaluations == 1 or self.method == SCRIPTED:
            return result, {}
        files = sorted((work.out / self.folder / "evaluations").glob("*.json"))
        earlier = [load_evaluation(file, self, work.plans, work.tasks) for file in files]
        every = [result, *filter(None, earlier)]
        rates = {task: max(one.success_once[task] or 0.0 for one in every) for task in result.success_once}
        return result, {"best": {"of": len(every), "rates": rates}}

    def watch(self, policy: Any, step: int, work: Work) -> None:
        """Evaluate what is trained in the midst of training, unless it was done."""
        file = work.out / self.folder / "evaluations" / f"{step}.json"
        if load_evaluation(file, self, work.plans, work.tasks) is None:
            result = self._rollouts(policy, work)
            replace(result, config=result.config | {"run": self.describe(work.plans)}).save(file)

    def _rollouts(self, policy: Any, work: Work) -> EvaluationResult:
        options = {} if self.method == SCRIPTED else {"device": work.device}
        if not isinstance(policy, Mapping):
            return self.rollouts(policy, work, **options)
        each = []
        with Progress("evaluating", len(work.tasks), "model", show=work.progress) as bar:
            for task in work.tasks:
                each.append(self.rollouts(policy[task], work, tasks=task, progress=False, **options))
                bar.update()
        episodes = tuple(episode for one in each for episode in one.episodes)
        return EvaluationResult(each[0].config | {"tasks": [*work.tasks]}, episodes)


Trained = tuple[list[list[Policy]], list[LanguageWorldExperienceReplay]]
"""The members, each a list of one actor for each policy; and the last member's demonstrations of each policy."""


def _train_one(run: ImitationRun, work: Work, targets: Sequence[str]) -> Trained:
    """One policy for all tasks."""
    members: list[list[Policy]] = []
    for number, member in enumerate(run.preset.members):
        replay = _replay(run, work, work.out / run.datasets[0].folder, sampler=TaskBalancedSampler())
        config = _config(run, len(replay), run.seed + 1_000 * number)
        actor = _make_actor(run, member, work, config.seed)
        members.append([actor])
        replay.append_transform(_transform(run, actor, member))
        trainer = BehavioralCloningTrainer(actor, replay, config, **_options(run, number, work))
        _train(trainer, run, actor, work)
    return members, [replay]


def _train_each(run: ImitationRun, work: Work, targets: Sequence[str]) -> Trained:
    """A policy for each target, all trained together; seeds count from 1000 times the run's, member by member."""
    roots = [work.out / dataset.folder for dataset in run.datasets]
    rows = 0
    if run.preset.passes is not None:  # over the base tasks, which have half of each minibatch
        rows = 2 * len(LanguageWorldExperienceReplay(roots[0], after_success=run.preset.after_success))
    members: list[list[Policy]] = []
    for number, member in enumerate(run.preset.members):
        config = _config(run, rows, 1_000 * run.seed + len(targets) * number)
        actors = [_make_actor(run, member, work, config.seed + i) for i in range(len(targets))]
        replays = []
        for target, actor in zip(targets, actors, strict=True):
            rows_of = {"episodes": [None, {target: 1}], "transform": _transform(run, actor, member)}
            replays.append(_replay(run, work, roots, sampler=CoLearningSampler(target), **rows_of))
        members.append(actors)
        trainer = StackedBehavioralCloning(actors, replays, config, **_options(run, number, work))
        _train(trainer, run, dict(zip(targets, actors, strict=True)), work)
    return members, replays


def _make_actor(run: ImitationRun, member: Member, work: Work, seed: int) -> Policy:
    torch.manual_seed(seed)
    return make_policy(run.method, work.plans, text_encoder=work.text_encoder, **run.actor_options(member))


def _replay(run: ImitationRun, work: Work, root: Any, **options: Any) -> LanguageWorldExperienceReplay:
    label, after_success = run.preset.label, run.preset.after_success
    return LanguageWorldExperienceReplay(root, label=label, after_success=after_success, device=work.device, **options)


def _transform(run: ImitationRun, actor: Policy, member: Member) -> Transform:
    queries = actor.transform()
    turned = RandomYaw(member.yaw, plans=actor.plans if run.any_yaw(member) else None)
    return Compose(*([] if queries is None else [queries]), *([turned] if member.yaw else []))


def _config(run: ImitationRun, rows: int, seed: int) -> BehavioralCloningConfig:
    """The preset's; where it counts passes, with as many steps as these take over so many rows."""
    config, passes = run.preset.training, run.preset.passes
    steps = config.steps if passes is None else max(1, passes * rows // config.batch_size)
    return replace(config, steps=steps, seed=seed)


def _options(run: ImitationRun, number: int, work: Work) -> dict[str, Any]:
    checkpoint = work.out / run.folder / f"checkpoint-{number}.zip"
    return {"checkpoint": checkpoint, "progress": work.progress, "device": work.device}


def _train(
    trainer: BehavioralCloningTrainer | StackedBehavioralCloning, run: ImitationRun, policy: Any, work: Work
) -> None:
    for step in run.preset.evaluated_before(trainer.config.steps):
        if trainer.steps <= step:
            trainer.train(until=step)
            run.watch(policy, step, work)
    trainer.train()
