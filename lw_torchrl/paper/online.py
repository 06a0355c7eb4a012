"""Online runs: weak policies, cloned from few demonstrations, that methods improve, as a whole or in one plan step."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from typing import Any

import torch

from lw_torchrl._checks import Count, check_choice, check_fields, check_int, unknown_name
from lw_torchrl._files import held
from lw_torchrl.data import CoLearningSampler, LanguageWorldExperienceReplay
from lw_torchrl.data.co_learning_sampler import GROWN
from lw_torchrl.data.rewards import RewardName
from lw_torchrl.envs.episodes import FinishedEpisode, policy_of
from lw_torchrl.evaluation import EvaluationResult, PlanUse, evaluate, stuck_steps, weakest_step
from lw_torchrl.language.plans import Plans
from lw_torchrl.modules.policy import Policy
from lw_torchrl.modules.registry import find_method, make_policy
from lw_torchrl.modules.residual_actor import ResidualActor
from lw_torchrl.paper.imitation import ExpertDataset
from lw_torchrl.paper.recipes import TARGET
from lw_torchrl.paper.runs import Run, Work, execute_run, kept_policy, own_tasks, plain
from lw_torchrl.training import LEARNERS, BehavioralCloningConfig, BehavioralCloningTrainer, OnlineConfig, OnlineTrainer
from lw_torchrl.training.algorithms import ResidualConfig, method_config
from lw_torchrl.training.files import load_actor, read_description

START = "start"  # the policy that is begun with: a run beside those of :data:`~lw_torchrl.training.LEARNERS`
WEAKEST = "weakest"  # the step that failed episodes came to and not beyond
ONLINE_SEED = 20_000
"""The training episodes of seed k have seed 20000 + k, which no demonstration and no evaluation has."""
DIAGNOSIS_SEED = 30_000  # of the episodes in which a policy's weakest step is looked for
_DIAGNOSED = 20  # episodes


@dataclass(frozen=True)
class OnlineRecipe:
    """How weak policies are made and improved, the same for every task; the configurations get the run's seed."""

    demonstrations: Count = 1  # of the task, without noise, all successful
    feature_noise: float = 0.1  # of the policy cloned from them
    cloning: BehavioralCloningConfig = field(default_factory=lambda: BehavioralCloningConfig(1_500, 200))
    reward: RewardName = "dense_cost"  # of the buffer
    n_steps: Count = 5  # of the buffer
    config: OnlineConfig = field(default_factory=OnlineConfig)  # of the training: of all methods, or the run's own

    def __post_init__(self) -> None:
        check_fields(self)


@dataclass(frozen=True)
class OnlineRun(Run):
    """A policy of one task, method and seed, and its evaluation.

    With ``step``, method "residual" corrects that step of the task's plan alone, counted from 0, to any action at all
    where the recipe says no scale; "weakest" is the one that the start's failed episodes reached and did not pass.
    """

    task: str  # its name
    method: str  # a name of :data:`~lw_torchrl.training.LEARNERS`, or "start"
    seed: int  # of demonstrations, weights, episodes and minibatches
    recipe: OnlineRecipe = field(default_factory=OnlineRecipe)  # the numbers
    condition: str = "pcbc"  # what the policy is conditioned on, a name of :data:`METHODS`; without ``start``
    start: Path | None = None  # a policy file to begin with; None to clone one from the demonstrations
    episodes: int = 40  # evaluated
    step: int | str | None = None  # None for all steps

    def __post_init__(self) -> None:
        if self.method != START and self.method not in LEARNERS:
            raise unknown_name("method", self.method, [*LEARNERS, START])
        if self.step is not None and self.method != "residual":
            raise ValueError(f"step is of the method 'residual', got it with {self.method!r}")
        if isinstance(self.step, str):
            check_choice("step", self.step, (WEAKEST,))
        elif self.step is not None:
            check_int("step", self.step, minimum=0)
        find_method(self.condition, "condition")
        if self.method != START:
            method_config(self.method, self.recipe.config)

    @property
    def config(self) -> OnlineConfig:
        """Of the method."""
        given = self.recipe.config
        if self.step is not None and type(given) is OnlineConfig:
            given = ResidualConfig(**vars(given), residual_scale=1.0)
        return method_config(self.method, given)

    @property
    def group(self) -> Path:
        """The folder of what begins alike: what methods are compared in."""
        return Path(self.condition if self.start is None else f"from-{self.start.stem}")

    @property
    def scope(self) -> tuple[str, ...]:
        return (self.task,)

    @property
    def folder(self) -> Path:
        step = f"step{self.step + 1}" if isinstance(self.step, int) else self.step
        return self.group / self.task / "-".join(filter(None, (self.method, step))) / f"seed{self.seed}"

    @property
    def datasets(self) -> tuple[ExpertDataset, ...]:
        return (ExpertDataset(self.task, self.recipe.demonstrations, TARGET, self.seed),)

    @property
    def begin(self) -> OnlineRun:
        return replace(self, method=START, step=None)

    @cached_property
    def _start_digest(self) -> str | None:
        return None if self.start is None else sha256(self.start.read_bytes()).hexdigest()

    def own_plans(self, plans: Plans) -> Plans:
        return Plans([plans[self.task]])

    def describe(self, plans: Plans) -> dict[str, Any]:
        recipe = asdict(self.recipe)
        if self.method == START:
            del recipe["config"], recipe["reward"], recipe["n_steps"]
        else:
            recipe["config"] = asdict(self.config)
        found = {"task": self.task, "method": self.method, "seed": self.seed, "recipe": recipe}
        if self.step is not None:
            found["step"] = self.step
        if self.start is not None:
            return plain(found | {"start": self._start_digest})
        own = self.own_plans(plans)
        return plain(found | {"condition": self.condition, "plans": own.fingerprint} | own_tasks(own))

    def learn(self, work: Work) -> tuple[Policy, dict[str, Any]]:
        if self.method == START:
            return self.load_start(work), {}
        file = work.out / self.folder / "policy.zip"

        def train(checkpoint: Path) -> dict[str, Any]:
            trainer, tuned = self._make_trainer(work, file, checkpoint)
            trainer.train()
            if trainer.logger is not None:
                trainer.logger.shutdown()  # a worker's process ends without
            return {"actor": trainer.policy, "replay": trainer.replay, "history": trainer.history, **tuned}

        policy, description = kept_policy(file, {"run": self.describe(work.plans)}, train), read_description(file)
        return policy, {name: description[name] for name in ("history", "tuned") if name in description}

    def evaluate(self, policy: Policy, work: Work) -> tuple[EvaluationResult, dict[str, Any]]:
        if self.step is None:
            return super().evaluate(policy, work)
        assert isinstance(policy, ResidualActor)
        before = execute_run(self.begin, work.plans, work.out, progress=work.progress).mean_success
        watch = Elsewhere(self.load_start(work), policy)
        result = self.rollouts(policy, work, also_record=policy.in_keys, on_episode=watch)
        return result, {"before": before, "elsewhere": watch.to_json()}

    def load_start(self, work: Work) -> Policy:
        """The policy that it begins with: the one given, or the one cloned, which is kept for all methods."""
        if self.start is not None:
            policy = load_actor(self.start)
            if self.task not in policy.tasks:
                raise ValueError(f"start: the policy of {str(self.start)!r} does not know the task {self.task!r}")
            return policy

        def train(checkpoint: Path) -> dict[str, Any]:
            torch.manual_seed(self.seed)
            noise: dict[str, Any] = {"feature_noise": self.recipe.feature_noise}
            options = noise if find_method(self.condition).takes("feature_noise") else {}
            actor = make_policy(self.condition, self.own_plans(work.plans), **options)
            replay, config = self._replay(work, actor), replace(self.recipe.cloning, seed=self.seed)
            BehavioralCloningTrainer(actor, replay, config, checkpoint=checkpoint, progress=work.progress).train()
            return {"actor": actor, "replay": replay}

        file = work.out / self.begin.folder / "policy.zip"
        with held(file, "out", wait=True):
            return kept_policy(file, {"run": self.begin.describe(work.plans)}, train)

    def _replay(self, work: Work, actor: Policy, **options: Any) -> LanguageWorldExperienceReplay:
        options |= {"label": "executed", "terminate_on_success": True, "transform": actor.transform()}
        return LanguageWorldExperienceReplay(work.out / self.datasets[0].folder, **options)

    def _make_trainer(self, work: Work, file: Path, checkpoint: Path) -> tuple[OnlineTrainer, dict[str, Any]]:
        """A trainer of the start, and "tuned", the step of a plan if the run is of one."""
        actor: Policy = self.load_start(work)
        config, tuned = replace(self.config, seed=ONLINE_SEED + self.seed), {}
        if self.step is not None:
            assert isinstance(config, ResidualConfig)
            options: dict[str, Any] = {"scale": config.residual_scale, "seed": DIAGNOSIS_SEED + self.seed}
            with torch.random.fork_rng(devices=[]):
                torch.manual_seed(config.seed)
                actor, told = tune_step(actor, self.task, self.step, progress=work.progress, **options)
            tuned = {"tuned": told}
        rewards = {"reward": self.recipe.reward, "n_steps": self.recipe.n_steps, "gamma": config.gamma}
        replay = self._replay(work, actor, **rewards, grow=config.frames, sampler=CoLearningSampler(GROWN))
        logger = None if work.make_logger is None else work.make_logger(file)
        options = {"checkpoint": checkpoint, "logger": logger, "progress": work.progress}
        return OnlineTrainer(actor, replay, config, method=self.method, tasks=self.task, **options), tuned


def tune_step(
    start: Policy, task: str, step: int | str, *, scale: float, seed: int, progress: bool = True
) -> tuple[ResidualActor, dict[str, Any]]:
    """A residual of one step of a task's plan, and what the result says of it, as JSON.

    Args:
        start: the policy, conditioned on plans; else :class:`TypeError`.
        task: one of its tasks.
        step: of its plan, counted from 0; or "weakest", of 20 episodes with ``seed``, some of which must fail.
        scale: how far an action can be corrected.
    """
    told: dict[str, Any] = {}
    if isinstance(step, str):
        check_choice("step", step, (WEAKEST,))
        if start.plans is None:
            raise TypeError(f"step: {type(start).__name__} is not conditioned on plans, whose steps can be tuned")
        use = PlanUse(start.plans)
        watching: dict[str, Any] = {"also_record": ["qaf", "skill_weights"], "on_episode": use, "progress": progress}
        evaluate(start, tasks=task, episodes_per_task=_DIAGNOSED, seed=seed, stop_at_success=True, **watching)
        step = weakest_step(use, task).step
        told["stuck"] = [asdict(found) for found in stuck_steps(use)]
    actor = ResidualActor(start, scale=scale, steps={task: [step]})
    assert actor.plans is not None
    chosen = actor.plans[task].steps[step]
    return actor, {"step": step, "condition": str(chosen.condition), "skill": chosen.skill, **told}


class Elsewhere:
    """Compares a residual of some steps with its start in the states of episodes.

    Pass it to ``evaluate`` as ``on_episode``, and the policy's ``in_keys`` as ``also_record``. Of all ``states`` it
    counts those ``outside`` of the steps, and of these the ``changed`` ones, where the actions differ in any bit.
    """

    def __init__(self, start: Policy, policy: ResidualActor) -> None:
        self._start, self._policy = policy_of(start.eval()), policy_of(policy.eval())
        self._action, self._weight = policy.out_keys_source[0], policy.out_keys_source[2]
        self.states = self.outside = self.changed = 0

    @torch.no_grad()
    def __call__(self, episode: FinishedEpisode) -> None:
        seen = episode.steps.exclude("action", "next")
        was, now = self._start(seen.copy()), self._policy(seen.copy())
        outside = now.get(self._weight).squeeze(-1) == 0
        same = (was.get(self._action) == now.get(self._action)).all(-1)
        self.states += len(outside)
        self.outside += int(outside.sum())
        self.changed += int((outside & ~same).sum())

    def to_json(self) -> dict[str, int]:
        return {"states": self.states, "outside": self.outside, "changed": self.changed}
