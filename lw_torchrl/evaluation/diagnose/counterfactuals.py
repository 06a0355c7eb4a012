"""Re-run failed episodes with the same seed and noise, with zero, one or two parts of the policy replaced."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from operator import itemgetter
from typing import Any, NamedTuple

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torchrl.envs import RenameTransform, Transform

from lw_torchrl.envs.episodes import FinishedEpisode
from lw_torchrl.evaluation.diagnose.failure import REPLACEMENTS, Difference, MendedEpisode, Misled
from lw_torchrl.evaluation.diagnose.replacements import (
    TRUE_OBSERVATION,
    EpisodeId,
    Perception,
    ScriptedControl,
    Scripts,
    with_true_answers,
)
from lw_torchrl.evaluation.diagnose.sentences import replacement_text
from lw_torchrl.evaluation.diagnose.states import (
    EpisodeStates,
    ScriptComparison,
    candidates,
    compare_with_scripts,
    states_of,
)
from lw_torchrl.evaluation.rollout import rollout
from lw_torchrl.language.canonical import canonical_like
from lw_torchrl.language.plans import Plans
from lw_torchrl.language.tasks import Task, task_id
from lw_torchrl.modules.policy import plans_of, with_plans

_KEYS: list[NestedKey] = ["observation", "task_id", "episode", "action", ("next", "success"), ("next", "reward")]
_TRIED_STEPS = 3  # maximum number of plan steps whose skill is replaced, one at a time


@dataclass(frozen=True)
class Rerun:
    """A callable that re-runs episodes with the settings of the original run."""

    tasks: Mapping[str, Task]
    env_options: Mapping[str, Any]
    noise_scale: float
    num_envs: int | None
    device: str | torch.device | None
    progress: bool

    def __call__(
        self,
        label: str,
        which: Sequence[EpisodeId],
        actor: Any,
        plans: Plans,
        evaluator: Any = None,
        longer: int = 1,
        wrap: Callable[[Any], Any] | None = None,
    ) -> dict[EpisodeId, FinishedEpisode]:
        """Re-run episodes, each up to its first success, with ``longer`` times the original time limit."""
        listed = {task: [k for _, k in group] for task, group in groupby(sorted(which), itemgetter(0))}
        episodes: dict[EpisodeId, FinishedEpisode] = {}

        def keep(episode: FinishedEpisode) -> None:
            episodes[episode.task, episode.episode] = episode

        rollout(
            f"re-running with {label}",
            actor,
            {task: self.tasks[task] for task in listed},
            listed,
            keep,
            plans=plans,
            evaluator=evaluator,
            num_envs=None if self.num_envs is None else max(len(listed), self.num_envs),
            env_options={**self.env_options, "max_steps": self.env_options["max_steps"] * longer},
            keys=_KEYS,
            optional=["qaf", "skill_weights"],
            noise_scale=self.noise_scale,
            after_success=0,
            first=RenameTransform(["observation"], [TRUE_OBSERVATION], create_copy=True),
            wrap=wrap,
            device=self.device,
            progress=self.progress,
        )
        return episodes


class NullControl(NamedTuple):
    """The results of re-running the failed episodes with nothing replaced."""

    episodes: Mapping[EpisodeId, FinishedEpisode]
    misled: Mapping[EpisodeId, Misled]  # episodes in which the policy received a wrong observation
    differs: Mapping[EpisodeId, Difference]  # the first difference, for episodes whose re-run was not identical

    def succeeds(self, which: EpisodeId) -> bool:
        return self.episodes[which].first_success is not None

    def share(self, task: str) -> float:
        """Return the fraction of a task's failed episodes that succeed in the plain re-run."""
        succeeded = [episode.first_success is not None for (of, _), episode in self.episodes.items() if of == task]
        return sum(succeeded) / len(succeeded)


def null_control(
    rerun: Rerun, failed: Mapping[EpisodeId, TensorDictBase], actor: Any, plans: Plans, evaluator: Any
) -> NullControl:
    """Re-run the failed episodes with nothing replaced; raise ValueError if an initial state differs."""
    with Perception(actor) as seen:
        episodes = rerun("nothing replaced", list(failed), actor, plans, evaluator)
    differs = {}
    for which, steps in failed.items():
        again = episodes[which].steps
        if not torch.equal(again.get("observation")[0], steps.get("observation")[0]):
            raise ValueError(
                f"rollouts: the first state of episode {which[1]} of {which[0]!r} differs from its re-run with "
                f"seed={rerun.env_options['seed']}; pass the seed and engine of the rollouts, and whole episodes"
            )
        if (first := difference(steps, again)) is not None:
            differs[which] = first
    numbers = {(task_id(task), k): (task, k) for task, k in failed}
    return NullControl(episodes, {numbers[which]: misled for which, misled in seen.misled.items()}, differs)


def difference(steps: TensorDictBase, again: TensorDictBase) -> Difference | None:
    """Return the first difference between two runs of an episode, or None if they are identical."""
    both = min(len(steps), len(again))
    states = (steps.get("observation")[:both] != again.get("observation")[:both]).any(-1)
    if not states.any():
        return None if len(steps) == len(again) else Difference("length", both - 1, len(steps), len(again))
    first = int(states.int().argmax())
    executed = steps.get(("next", "executed_action"), steps.get("action", None))
    if executed is None:
        return Difference("states", first)
    error = (executed[:first] - again.get("action")[:first]).abs().amax(-1)
    if not (error > 0).any():
        return Difference("environment", first)
    at = int((error > 0).int().argmax())
    return Difference("actions", at, size=float(error[at]))


class Counterfactuals:
    """The counterfactual re-runs that can decide the cause of each failed episode, and their results."""

    def __init__(
        self, actor: Any, evaluator: Any, reference: Plans | None, scripts: Scripts, rerun: Rerun, null: NullControl
    ) -> None:
        self.actor, self.evaluator, self.scripts, self.rerun, self.null = actor, evaluator, scripts, rerun, null
        self.plans = plans = scripts.plans
        # For each replacement and each episode it was tried on: the re-run if it succeeded, otherwise None.
        self.results: dict[str, dict[EpisodeId, FinishedEpisode | None]] = {}
        self.step: dict[EpisodeId, int] = {}  # the plan step in which a scripted skill fixes the episode
        self.comparisons: dict[EpisodeId, ScriptComparison] = {}  # policy and scripts in the failed episode's states
        # The same comparison by scripted plan step, extended with the states of the re-run with that script.
        self.with_script: dict[EpisodeId, dict[int, ScriptComparison]] = {}
        self.reference: Plans | None = None
        self.other = self.other_evaluator = None  # the policy and the evaluator with the reference plans
        different = [] if reference is None else [reference[task] for task in reference.differences(plans)]
        if not different:
            return
        reference = Plans(different)
        try:
            other = with_plans(actor, canonical_like(reference, plans_of(actor)))
            reference = plans_of(other) or reference  # a policy may add plans that the reference lacks
            other_evaluator = evaluator.with_plans(reference) if hasattr(evaluator, "with_plans") else evaluator
            self.other, self.other_evaluator, self.reference = other, other_evaluator, reference
        except (AttributeError, ImportError, RuntimeError, TypeError, ValueError) as error:
            reason = f"{type(error).__name__}: {error}"
            message = f"reference: the policy cannot follow the reference, so no plan is replaced ({reason})"
            warnings.warn(message, stacklevel=4)

    def run(self, seen: Sequence[EpisodeStates], same: Collection[EpisodeId] = ()) -> None:
        """Re-run the episodes with each replacement that can still decide the cause of the episode.

        ``same`` lists the episodes in which the plan and the reference request the same actions.
        """
        seen = [states for states in seen if not self.null.succeeds(states.which)]
        every = [states.which for states in seen]
        misled = [which for which in every if which in self.null.misled]
        is_sensor = isinstance(self.evaluator, Transform) and "observation" in self.evaluator.out_keys
        evaluator = None if is_sensor else self.evaluator
        with Perception(self.actor, correct=True):
            self._run("perception", misled, self.actor, self.plans, evaluator)
        true = with_true_answers(self.actor)
        can_answer = evaluator is not None or true is not self.actor
        wrong = [states.which for states in seen if can_answer and bool((states.answers != states.truth).any())]
        self._run("query", wrong, true, self.plans)
        left = self._unfixed(every, "perception", "query")
        with_reference = [which for which in left if self.reference is not None and which[0] in self.reference]
        self._run("plan", with_reference, self.other, self.reference, self.other_evaluator)
        self._run_scripts([states for states in seen if states.which in left])
        left = self._unfixed(left, "skill", "gripper", "actuation", "policy")
        left = [which for which in left if which in same or not self._fixes("plan", which)]
        self._run("time", left, self.actor, self.plans, self.evaluator, longer=2)
        # Try pairs only on the episodes that no single replacement fixes.
        left = self._unfixed(left, "time")
        pair = [which for which in left if which in wrong]
        with_reference = [which for which in left if which in with_reference]
        self._run("query + skill", pair, true, self.plans, wrap=self._scripted(self.plans))
        both, other = [which for which in pair if which in with_reference], with_true_answers(self.other)
        self._run("query + plan", both, other, self.reference)
        left = self._unfixed(with_reference, "query + skill", "query + plan")
        wrap = self._scripted(self.reference)
        self._run("plan + skill", left, self.other, self.reference, self.other_evaluator, wrap=wrap)

    def _fixes(self, name: str, which: EpisodeId) -> bool:
        return self.results.get(name, {}).get(which) is not None

    def _unfixed(self, episodes: Iterable[EpisodeId], *names: str) -> list[EpisodeId]:
        return [which for which in episodes if not any(self._fixes(name, which) for name in names)]

    def _run(
        self, name: str, which: Sequence[EpisodeId], actor: Any, plans: Any, evaluator: Any = None, **options: Any
    ) -> dict[EpisodeId, FinishedEpisode]:
        again = {}
        if which and actor is not None and plans is not None:
            again = self.rerun(replacement_text(name), which, actor, plans, evaluator, **options)
            kept = {w: None if episode.first_success is None else episode for w, episode in again.items()}
            self.results.setdefault(name, {}).update(kept)
        return again

    def _scripted(self, plans: Plans | None, **where: Any) -> Any:
        """Return a function that wraps an actor for ``plans`` in :class:`ScriptedControl`; None without plans."""
        if plans is None:
            return None
        scripts = self.scripts if plans is self.plans else Scripts(plans, self.scripts.table)
        return lambda actor: ScriptedControl(actor, plans, scripts, **where)

    def _run_scripts(self, seen: Sequence[EpisodeStates]) -> None:
        """Re-run with scripts in control of one plan step (likeliest first), of gripper or motion, or of everything."""
        ranked: dict[EpisodeId, list[int]] = {}  # the plan steps to try in each episode, the likeliest first
        for states in seen:
            comparison = compare_with_scripts(self.actor, states, self.scripts)
            unlike = None if comparison is None else comparison.unlike()
            if comparison is not None:
                self.comparisons[states.which] = comparison
            if unlike is None or unlike.any():  # if the policy acts as the scripts do, they would change nothing
                ranked[states.which] = candidates(states, unlike)
        has_steps = plans_of(self.actor) is not None
        for turn in range(_TRIED_STEPS if has_steps else 0):
            episodes = self._unfixed([which for which, steps in ranked.items() if len(steps) > turn], "skill")
            steps = {which: ranked[which][turn] for which in episodes}
            wrap = self._scripted(self.plans, steps=steps)
            again = self._run("skill", episodes, self.actor, self.plans, self.evaluator, wrap=wrap)
            self.step.update({which: steps[which] for which in episodes if self._fixes("skill", which)})
            for which in set(episodes) & set(self.comparisons):
                states = states_of(*which, again[which].steps, self.plans, None)
                both = self.comparisons[which].followed_by(compare_with_scripts(self.actor, states, self.scripts))
                self.with_script.setdefault(which, {})[steps[which]] = both
        left = [which for which in ranked if not (self._fixes("skill", which) and self._in_one_step(which))]
        for name, part in (("gripper", "gripper"), ("actuation", "displacement")):
            if self.plans.layout.gripper is not None:
                wrap = self._scripted(self.plans, part=part)
                self._run(name, left, self.actor, self.plans, self.evaluator, wrap=wrap)
        parts = self._unfixed(left, "skill", "gripper", "actuation")
        # If the reference helps, "policy" shows whether scripts succeed with the plan that the policy followed.
        left = [which for which in ranked if which in parts or self._fixes("plan", which)]
        self._run("policy", left, self.actor, self.plans, self.evaluator, wrap=self._scripted(self.plans))

    def _parts(self, comparison: ScriptComparison) -> tuple[ScriptComparison, ScriptComparison]:
        """Split a comparison into a comparison of the hand's motion and a comparison of the gripper."""
        gripper = torch.zeros(comparison.done.shape[-1], dtype=torch.bool)
        if self.plans.layout.gripper is not None:
            gripper[self.plans.layout.gripper] = True
        return comparison.part(~gripper), comparison.part(gripper)

    def _in_one_step(self, which: EpisodeId) -> bool:
        """Return whether the motion is wrong only in the plan step whose scripted skill fixes the episode.

        In every other plan step, including those reached only with the script, the policy must act as the scripts do.
        """
        if which not in self.comparisons:
            return False
        comparison = self.with_script[which][self.step[which]]
        in_one = len(comparison.active[comparison.unlike()].unique()) == 1
        return in_one and bool(self._parts(comparison)[0].unlike().any())

    def mending(self, states: EpisodeStates) -> list[str]:
        """Return the replacements that fix an episode and count as evidence for a cause.

        If scripts help for the gripper and for the motion, scripts for a part in which the policy already acts like the
        scripts do not count. If scripts for one part in all plan steps help, a script in one plan step does not count
        if only the gripper is wrong there or other plan steps have the same fault. If that script counts because other
        plan steps do not have the fault, scripts for the motion do not count.
        """
        names = [name for name in self.results if self._fixes(name, states.which)]
        comparison, step = self.comparisons.get(states.which), self.step.get(states.which)
        steps = range(states.truth.shape[1])
        if comparison is None or self.plans.layout.gripper is None:
            return names
        if "gripper" in names and "actuation" in names:
            motion, gripper = self._parts(comparison)
            if gripper.often_far(steps) and motion.seldom_far(steps):
                names.remove("actuation")
            elif motion.often_far(steps) and gripper.seldom_far(steps):
                names.remove("gripper")
        if step is None:
            return names
        comparison, others = self.with_script[states.which][step], [other for other in steps if other != step]
        motion, gripper = self._parts(comparison)
        in_others = motion.in_other_steps(step)
        if in_others is False and "actuation" in names:
            names.remove("actuation")
        in_all = motion.often_far(others) if in_others is None else in_others
        by_gripper = gripper.often_far(others) or (gripper.often_far([step]) and not motion.often_far([step]))
        if ("gripper" in names and by_gripper) or ("actuation" in names and in_all):
            names.remove("skill")
        return names

    def step_of_motion(self, states: EpisodeStates) -> int | None:
        """Return the only plan step in which the motion is wrong; None if there are several or if this is unknown."""
        steps = range(states.truth.shape[1])
        for comparison in self.with_script.get(states.which, {}).values():
            motion, _ = self._parts(comparison)
            for step in steps:
                others = [other for other in steps if other != step]
                if motion.often_far([step]) and motion.in_other_steps(step) is False and not motion.often_far(others):
                    return step
        return None

    def mended(self, by: str | None, which: EpisodeId) -> MendedEpisode | None:
        """Return the successful re-run of an episode with replacement ``by``; None if there is none."""
        episode = None if by is None else self.results[by].get(which)
        if episode is None or by is None:
            return None
        plans = self.reference if "plan" in REPLACEMENTS[by] and self.reference is not None else self.plans
        return MendedEpisode(by, plans[which[0]], episode.steps)

    def shares(self) -> dict[str, dict[str, float]]:
        """Return, by task and replacement, the fraction of the failed episodes it was tried on that it fixes."""
        shares: dict[str, dict[str, float]] = {}
        for name, results in self.results.items():
            for task in {task for task, _ in results}:
                fixed = [episode is not None for (of, _), episode in results.items() if of == task]
                shares.setdefault(task, {})[name] = sum(fixed) / len(fixed)
        return shares
