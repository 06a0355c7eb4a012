"""Re-run failed episodes with the same seed and noise, with zero, one or two parts of the policy replaced."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby
from operator import itemgetter
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.envs import RenameTransform, Transform

from lw_torchrl.envs.episodes import FinishedEpisode
from lw_torchrl.envs.rows import action_noise
from lw_torchrl.evaluation.diagnose.failure import Finding, MendedEpisode, replacement_text
from lw_torchrl.evaluation.diagnose.replacements import (
    MEASURED,
    TRUE_OBSERVATION,
    Control,
    EpisodeId,
    Scripts,
    attended,
    gripper_of,
    weights_of,
)
from lw_torchrl.evaluation.diagnose.states import OFTEN_WRONG, OTHER, FailedEpisode, Motion, exact_answers
from lw_torchrl.evaluation.rollout import rollout
from lw_torchrl.language.canonical import canonical_like
from lw_torchrl.language.plans import ConditionalPlan, Plans
from lw_torchrl.language.tasks import Task
from lw_torchrl.modules.policy import plans_of, with_plans
from lw_torchrl.modules.query_evaluator import evaluators_of

_EXACT = 1e-4  # smaller differences between observations or between actions are rounding
_AFTER = 5  # a difference is measured over this number of states, because it may grow at first


def difference(steps: TensorDictBase, again: TensorDictBase) -> Finding | None:
    """Return the first difference between two runs of an episode, or None if they are identical."""
    both = min(len(steps), len(again))
    errors = (steps.get("observation")[:both] - again.get("observation")[:both]).abs().amax(-1)
    if not (errors > 0).any():
        values = {"at": both - 1, "given": len(steps), "again": len(again)}
        return None if len(steps) == len(again) else Finding("other length", values)
    first = int((errors > 0).int().argmax())
    executed = steps.get(("next", "executed_action"), steps.get("action", None))
    if first and executed is None:
        return Finding("unknown actions", {"at": first})
    if first:
        error = (executed[:first] - again.get("action")[:first]).abs().amax(-1)
        if (error > 0).any():
            at = int((error > 0).int().argmax())
            return Finding("other actions", {"at": at, "size": float(error[at])})
    size = float(errors[first : first + _AFTER].max())
    return Finding("other states" if first else "other first state", {"at": first, "before": first - 1, "size": size})


def _unfixed(cases: Iterable[FailedEpisode], *names: str) -> list[FailedEpisode]:
    return [case for case in cases if not case.is_fixed(*names)]


@dataclass(frozen=True)
class Settings:
    """The settings of a re-run; a replacement changes some of them."""

    actor: Any
    evaluator: Any
    scripts: Scripts
    noise_scale: float
    engine: Any
    max_steps: int
    control: Mapping[str, Any] = field(default_factory=dict)  # arguments of Control


@dataclass
class Reruns:
    """Re-runs of failed episodes with the settings of the original run, but with parts of the policy replaced."""

    settings: Settings
    reference: Plans | None
    tasks: Mapping[str, Task]
    env_options: Mapping[str, Any]
    num_envs: int | None
    device: str | torch.device | None
    progress: bool

    def __post_init__(self) -> None:
        self.trusted = self._with_reference()  # settings with the reference plans that differ from the policy's
        self.gripper = gripper_of(self.settings.scripts.plans)

    def run(self, rollouts: Mapping[EpisodeId, TensorDictBase]) -> list[FailedEpisode]:
        """Re-run each episode with the replacements that can still decide the cause of its failure."""
        plain = self._run("nothing replaced", list(rollouts), self.settings)
        cases = [self._measure(steps, plain[which]) for which, steps in rollouts.items()]
        left = self._try_measured([case for case in cases if not case.fails_elsewhere])
        # If wrong answers are certainly a cause, but exact answers do not suffice, only pairs can show the other cause.
        misled = [case for case in left if "query" in case.results and case.answers_wrong >= OFTEN_WRONG]
        left = [case for case in left if case not in misled]
        self._try("no noise", left if self.settings.noise_scale else [], noise_scale=0.0)
        self._try_scripts(left)
        left = _unfixed(left, "skill", "gripper", "actuation", "policy")
        known = () if self.trusted is None else self.trusted.scripts.plans
        self._try("plan", [case for case in left if case.task in known], self.trusted)
        left = _unfixed(left, "plan", "no noise")
        self._try("time", left, max_steps=2 * self.settings.max_steps)
        # Try pairs only on the episodes that no single replacement fixes.
        left = [*_unfixed(left, "time"), *misled]
        pair, referred = [c for c in left if "query" in c.results], [c for c in left if c.task in known]
        self._try("query + skill", pair, evaluator=None, control={"answer": True, "part": "all"})
        both = [case for case in pair if case in referred]
        self._try("query + plan", both, self.trusted, evaluator=None, control={"answer": True})
        left = [case for case in _unfixed(referred, "query + skill", "query + plan") if case not in misled]
        self._try("plan + skill", left, self.trusted, control={"part": "all"})
        return cases

    def _try_measured(self, cases: list[FailedEpisode]) -> list[FailedEpisode]:
        """Re-run episodes with trusted engines, observations, answers or actions; return the cases that still fail."""
        evaluator = self.settings.evaluator
        if callable(self.settings.engine):
            self._try("environment", [c for c in cases if c.task in self.env_options["suite"].tasks], engine=None)
            cases = _unfixed(cases, "environment")
        is_transform = isinstance(evaluator, Transform)
        without_sensor = None if is_transform and "observation" in evaluator.out_keys else evaluator
        misled = [case for case in cases if case.misled]
        self._try("perception", misled, evaluator=without_sensor, control={"correct": True})
        if without_sensor is not None or evaluators_of(self.settings.actor):
            wrong = [case for case in cases if not torch.equal(case.answers, case.truth)]
            self._try("query", wrong, evaluator=None, control={"answer": True})
        acts_on = is_transform and bool(evaluator.in_keys_inv)
        changed = [case for case in cases if case.wrapped or (acts_on and case.executed)]
        undone = self._try("wrapper", changed, evaluator=None if acts_on else evaluator, control={"unwrap": True})
        for case in changed:
            if case.wrapped is not None:
                case.wrapped = case.wrapped.and_also(self._motions(undone[case.which], case.plan)["wrapped"])
        return _unfixed(cases, "perception", "query", "wrapper")

    def _try_scripts(self, cases: list[FailedEpisode]) -> None:
        """Re-run episodes with scripts for all actions and, if they then succeed, with scripts for single parts."""
        hand, every = ~self.gripper, self.gripper | True
        # Skip episodes in which the policy already acts exactly like the scripts.
        cases = [c for c in cases if not c.scripted.wanted.isfinite().all() or c.unlike(every) > 0.0]
        again = self._try("policy", cases, control={"part": "all"})
        cases = [case for case in cases if case.is_fixed("policy")]
        for case in cases:
            case.scripted = case.scripted.and_also(self._motions(again[case.which], case.plan)["scripted"])
            in_all, worst, _ = case.scripted.of(hand).extent()
            by_gripper = case.unlike(self.gripper) > max(OTHER, 2 * case.unlike(hand))
            if plans_of(self.settings.actor) is not None and not in_all and worst >= 0 and not by_gripper:
                case.step = worst
        steps = {case.which: case.step for case in cases if case.step is not None}
        self._try("skill", [c for c in cases if c.which in steps], control={"part": "all", "steps": steps})
        left = _unfixed(cases, "skill") if self.gripper.any() else []
        self._try("gripper", [case for case in left if case.unlike(self.gripper)], control={"part": "gripper"})
        self._try("actuation", [case for case in left if case.unlike(hand)], control={"part": "motion"})

    def _try(
        self, name: str, cases: Sequence[FailedEpisode], settings: Settings | None = None, **changes: Any
    ) -> dict[EpisodeId, FinishedEpisode]:
        """Re-run episodes with a replacement, store the successful re-runs in the cases, and return all re-runs."""
        if not cases:
            return {}
        settings = replace(settings or self.settings, **changes)
        again = self._run(replacement_text(name), [case.which for case in cases], settings)
        for case in cases:
            episode, plan = again[case.which], settings.scripts.plans[case.task]
            mended = MendedEpisode(name, plan, episode.steps.exclude(MEASURED))
            case.results[name] = None if episode.first_success is None else mended
        return again

    def _measure(self, rollout: TensorDictBase, plain: FinishedEpisode) -> FailedEpisode:
        """Compare the policy's observations with the true observations, and its actions with the executed actions."""
        measured, plan = plain.steps.get(MEASURED), self.settings.scripts.plans[plain.task]
        motions: dict[str, Any] = self._motions(plain, plan)
        for name in ("wrapped", "executed"):
            if (motions[name].done - motions[name].wanted).abs().max() <= _EXACT:
                motions[name] = None
        truth, answers = exact_answers(plan, plain.steps), measured.get("answered")[:, : len(plan.steps)] > 0.5
        failed = FailedEpisode(plan, plain, truth, answers, motions["scripted"].active, **motions)
        error = (measured.get("shown") - measured.get("true")).abs().amax(0)
        if error.max() > _EXACT:
            failed.misled = Finding("wrong observation", {"error": float(error.max()), "entry": int(error.argmax())})
        failed.differs = difference(rollout, plain.steps)
        return failed

    def _motions(self, episode: FinishedEpisode, plan: ConditionalPlan) -> dict[str, Motion]:
        """Compare the actions of innermost module and policy, of policy and environment, and of scripts and policy."""
        steps, number, task = episode.steps, len(plan.steps), self.tasks[episode.task]
        measured = steps.get(MEASURED)
        weights = weights_of(steps, measured.get("answered")[:, :number] > 0.5, number)
        active = attended(weights, torch.ones_like(weights, dtype=torch.bool))
        seed, size = self.env_options["seed"], task.layout.action_size
        noise = torch.from_numpy(action_noise(task, seed, episode.episode, len(steps), 1, size))
        commanded = measured.get("commanded")
        expected = (commanded + self.settings.noise_scale * noise).clamp(-1.0, 1.0)
        return {
            "wrapped": Motion(measured.get("decided"), commanded, active),
            "executed": Motion(expected, steps.get("action"), active),
            "scripted": Motion(measured.get("scripted"), commanded, active),
        }

    def _with_reference(self) -> Settings | None:
        """Return settings for reference plans that differ from the policy's; None if none differ or can be followed."""
        reference, settings = self.reference, self.settings
        tasks = [] if reference is None else reference.differences(settings.scripts.plans)
        if reference is None or not (different := [reference[task] for task in tasks if task in self.tasks]):
            return None
        plans, evaluator = Plans(different), settings.evaluator
        try:
            other = with_plans(settings.actor, canonical_like(plans, plans_of(settings.actor)))
            plans = plans_of(other) or plans  # a policy may add plans that the reference lacks
            evaluator = evaluator.with_plans(plans) if hasattr(evaluator, "with_plans") else evaluator
        except (AttributeError, ImportError, RuntimeError, TypeError, ValueError) as error:
            message = "reference: the policy cannot follow the reference, so no plan is replaced"
            warnings.warn(f"{message} ({type(error).__name__}: {error})", stacklevel=6)
            return None
        return replace(settings, actor=other, evaluator=evaluator, scripts=Scripts(plans, settings.scripts.table))

    def _run(self, label: str, which: Sequence[EpisodeId], settings: Settings) -> dict[EpisodeId, FinishedEpisode]:
        """Re-run each episode up to its first success or the time limit."""
        listed = {task: [k for _, k in group] for task, group in groupby(sorted(which), itemgetter(0))}
        episodes: dict[EpisodeId, FinishedEpisode] = {}
        rollout(
            f"re-running with {label}",
            settings.actor,
            {task: self.tasks[task] for task in listed},
            listed,
            lambda episode: episodes.update({(episode.task, episode.episode): episode}),
            plans=settings.scripts.plans,
            evaluator=settings.evaluator,
            num_envs=None if self.num_envs is None else max(len(listed), self.num_envs),
            env_options={**self.env_options, "engine": settings.engine, "max_steps": settings.max_steps},
            keys=["observation", "task_id", "episode", "action", MEASURED, ("next", "success"), ("next", "reward")],
            optional=["qaf", "skill_weights"],
            noise_scale=settings.noise_scale,
            after_success=0,
            first=RenameTransform(["observation"], [TRUE_OBSERVATION], create_copy=True),
            wrap=lambda actor: Control(actor, settings.scripts, **settings.control),
            device=self.device,
            progress=self.progress,
        )
        return episodes


def shares_of(cases: Sequence[FailedEpisode]) -> dict[str, float]:
    """Return, for each replacement, the fraction that succeeds among the failed episodes on which it was tried."""
    tried = {"nothing": [case.plain.first_success is not None for case in cases]}
    for case in cases:
        for name, episode in case.results.items():
            tried.setdefault(name, []).append(episode is not None)
    return {name: sum(fixed) / len(fixed) for name, fixed in tried.items()}
