"""Counterfactuals: failed episodes re-run with one part of the policy, or of its input, replaced by a sound one."""

import warnings
from collections.abc import Collection, Iterable, Sequence
from copy import deepcopy
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import nn
from torchrl.envs import Transform

from lw_torchrl._util.keys import write
from lw_torchrl.envs.episodes import FinishedEpisode
from lw_torchrl.evaluation.diagnose.decision import Decision
from lw_torchrl.evaluation.diagnose.failure import MendedEpisode
from lw_torchrl.evaluation.diagnose.findings import REPLACEMENTS
from lw_torchrl.evaluation.diagnose.rerun import EpisodeId, NullControl, Perception, Rerun
from lw_torchrl.evaluation.diagnose.scripts import ScriptedControl, Scripts
from lw_torchrl.evaluation.diagnose.sentences import replacement_text
from lw_torchrl.evaluation.diagnose.states import (
    EpisodeStates,
    ScriptComparison,
    candidates,
    compare_with_scripts,
    states_of,
)
from lw_torchrl.language.canonical import canonical_like
from lw_torchrl.language.plans import Plans
from lw_torchrl.modules.policy import plans_of, with_plans
from lw_torchrl.modules.query_evaluator import QueryEvaluator
from lw_torchrl.transforms.qaf import plan_program

_TRIED_STEPS = 3  # the number of steps in which a skill is replaced, one at a time


class TrueAnswers(QueryEvaluator):
    """An evaluator whose answers are exact: true or false, with logits of 5 and -5."""

    def __init__(self, plans: Plans) -> None:
        super().__init__(plans)
        self.program = plan_program(plans)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        truth = self.program(tensordict.get("observation"), tensordict.get("task_id"))
        return write(tensordict, self, [truth, 10.0 * truth.to(torch.float32) - 5.0])


def own_evaluators(actor: Any) -> list[QueryEvaluator]:
    """Return the evaluators inside a policy, without those inside another evaluator."""
    if isinstance(actor, QueryEvaluator):
        return [actor]
    children = actor.children() if isinstance(actor, nn.Module) else ()
    return list(dict.fromkeys(evaluator for child in children for evaluator in own_evaluators(child)))


def with_true_answers(actor: Any) -> Any:
    """Return the policy with exact answers instead of its own evaluators; the policy itself if it has none."""
    if not own_evaluators(actor):
        return actor
    other = deepcopy(actor)
    for module in list(other.modules()):
        for name, child in list(module.named_children()):
            if isinstance(child, QueryEvaluator):
                module._modules[name] = TrueAnswers(child.plans)
    return other


class Counterfactuals:
    """Run the counterfactuals that can decide something, and keep the results."""

    def __init__(
        self, actor: Any, evaluator: Any, reference: Plans | None, scripts: Scripts, rerun: Rerun, null: NullControl
    ) -> None:
        self.actor, self.evaluator, self.scripts, self.rerun, self.null = actor, evaluator, scripts, rerun, null
        self.plans = plans = scripts.plans
        # Replacement to the episodes it was tried on: the re-run episode if it succeeds, else None.
        self.results: dict[str, dict[EpisodeId, FinishedEpisode | None]] = {}
        self.step: dict[EpisodeId, int] = {}  # the step in which a scripted skill fixes an episode
        self.comparisons: dict[EpisodeId, ScriptComparison] = {}  # policy and scripts where the episode failed
        # The same, joined with the states of re-runs in which a script controlled a step.
        self.with_script: dict[EpisodeId, dict[int, ScriptComparison]] = {}
        self.reference: Plans | None = None
        self.other = self.other_evaluator = None  # policy and evaluator for the reference
        different = [] if reference is None else [reference[task] for task in reference.differences(plans)]
        if not different:
            return
        reference = Plans(different)
        try:
            other = with_plans(actor, canonical_like(reference, plans_of(actor)))
            reference = plans_of(other) or reference  # a policy may complete its plans
            theirs = evaluator.with_plans(reference) if hasattr(evaluator, "with_plans") else evaluator
            self.other, self.other_evaluator, self.reference = other, theirs, reference
        except (AttributeError, ImportError, RuntimeError, TypeError, ValueError) as error:
            why = f"{type(error).__name__}: {error}"
            warnings.warn(f"reference: the policy cannot carry it out, so no plan is replaced ({why})", stacklevel=4)

    def run(self, seen: Sequence[EpisodeStates], same: Collection[EpisodeId] = ()) -> None:
        """Run the replacements; ``same`` are the episodes in which plan and reference request the same actions."""
        seen = [one for one in seen if not self.null.succeeds(one.which)]
        every = [one.which for one in seen]
        misled = [which for which in every if which in self.null.misled]
        with Perception(self.actor, correct=True):
            self._run("perception", misled, self.actor, self.plans, None if self._is_sensor() else self.evaluator)
        true = with_true_answers(self.actor)
        can_answer = (self.evaluator is not None and not self._is_sensor()) or true is not self.actor
        wrong = [one.which for one in seen if can_answer and bool((one.given != one.truth).any())]
        self._run("query", wrong, true, self.plans)
        left = self._unmended(every, "perception", "query")
        with_reference = [w for w in left if self.reference is not None and w[0] in self.reference]
        self._run("plan", with_reference, self.other, self.reference, self.other_evaluator)
        self._run_scripts([one for one in seen if one.which in left])
        left = self._unmended(left, "skill", "gripper", "actuation", "policy")
        left = [one for one in left if one in same or not self._mends("plan", one)]
        self._run("time", left, self.actor, self.plans, self.evaluator, longer=2)
        left = self._unmended(left, "time")
        pair = [one for one in left if one in wrong]
        with_reference = [one for one in left if one in with_reference]
        self._run("query + skill", pair, true, self.plans, wrap=self._scripted(self.plans))
        both, other = [one for one in pair if one in with_reference], with_true_answers(self.other)
        self._run("query + plan", both, other, self.reference)
        left = self._unmended(with_reference, "query + skill", "query + plan")
        wrap = self._scripted(self.reference)
        self._run("plan + skill", left, self.other, self.reference, self.other_evaluator, wrap=wrap)

    def _is_sensor(self) -> bool:
        """Return whether the evaluator is a transform that changes the observation."""
        return isinstance(self.evaluator, Transform) and "observation" in self.evaluator.out_keys

    def _mends(self, name: str, which: EpisodeId) -> bool:
        return self.results.get(name, {}).get(which) is not None

    def _unmended(self, which: Iterable[EpisodeId], *names: str) -> list[EpisodeId]:
        return [one for one in which if not any(self._mends(name, one) for name in names)]

    def _run(
        self, name: str, which: Sequence[EpisodeId], actor: Any, plans: Any, evaluator: Any = None, **options: Any
    ) -> dict[EpisodeId, FinishedEpisode]:
        again = {}
        if which and actor is not None and plans is not None:
            again = self.rerun(replacement_text(name), which, actor, plans, evaluator, **options)
            kept = {one: None if episode.first_success is None else episode for one, episode in again.items()}
            self.results.setdefault(name, {}).update(kept)
        return again

    def _scripted(self, plans: Plans | None, **where: Any) -> Any:
        """Return the function that puts an actor of ``plans`` under scripted control."""
        if plans is None:
            return None
        scripts = self.scripts if plans is self.plans else Scripts(plans, self.scripts.table)
        return lambda actor: ScriptedControl(actor, plans, scripts, **where)

    def _run_scripts(self, seen: Sequence[EpisodeStates]) -> None:
        """Give scripts control of one step, the likeliest steps in turn; of gripper or motion; of everything."""
        ranked = {}
        for one in seen:
            comparison = compare_with_scripts(self.actor, one, self.scripts)
            unlike = None if comparison is None else comparison.unlike()
            if comparison is not None:
                self.comparisons[one.which] = comparison
            if unlike is None or unlike.any():
                ranked[one.which] = candidates(one, unlike)
        has_steps = plans_of(self.actor) is not None
        for turn in range(_TRIED_STEPS if has_steps else 0):
            which = self._unmended([w for w, steps in ranked.items() if len(steps) > turn], "skill")
            steps = {one: ranked[one][turn] for one in which}
            wrap = self._scripted(self.plans, steps=steps)
            again = self._run("skill", which, self.actor, self.plans, self.evaluator, wrap=wrap)
            self.step.update({one: steps[one] for one in which if self._mends("skill", one)})
            for episode in set(which) & set(self.comparisons):
                there = states_of(*episode, again[episode].steps, self.plans, None)
                both = self.comparisons[episode].followed_by(compare_with_scripts(self.actor, there, self.scripts))
                self.with_script.setdefault(episode, {})[steps[episode]] = both
        left = [one for one in ranked if not (self._mends("skill", one) and self._in_one_step(one))]
        for name, part in (("gripper", "gripper"), ("actuation", "displacement")):
            if self.plans.layout.gripper is not None:
                wrap = self._scripted(self.plans, part=part)
                self._run(name, left, self.actor, self.plans, self.evaluator, wrap=wrap)
        parts = self._unmended(left, "skill", "gripper", "actuation")
        left = [one for one in ranked if one in parts or self._mends("plan", one)]  # can scripts follow this plan?
        self._run("policy", left, self.actor, self.plans, self.evaluator, wrap=self._scripted(self.plans))

    def _parts(self, comparison: ScriptComparison) -> tuple[ScriptComparison, ScriptComparison]:
        """Return the comparison of the hand's motion and that of the gripper."""
        gripper = torch.zeros(comparison.done.shape[-1], dtype=torch.bool)
        if self.plans.layout.gripper is not None:
            gripper[self.plans.layout.gripper] = True
        return comparison.part(~gripper), comparison.part(gripper)

    def _in_one_step(self, which: EpisodeId) -> bool:
        """Return whether the motion is wrong only in the step that a script fixes.

        The policy must equal the scripts in every other step, also in those that it reaches with the script.
        """
        if which not in self.comparisons:
            return False
        comparison = self.with_script[which][self.step[which]]
        in_one = len(comparison.active[comparison.unlike()].unique()) == 1
        return in_one and bool(self._parts(comparison)[0].unlike().any())

    def mending(self, one: EpisodeStates) -> list[str]:
        """Return the replacements that fix an episode and count.

        Of two that help, scripts for a part of the action that is close to the scripts' do not count. A script in one
        step does not count if only the gripper is wrong there, or if the same fault is in other steps, and scripts for
        that part in all steps help too. If it counts, scripts for the motion do not.
        """
        names = [name for name, results in self.results.items() if results.get(one.which) is not None]
        comparison, step = self.comparisons.get(one.which), self.step.get(one.which)
        numbers = range(one.truth.shape[1])
        if comparison is None or self.plans.layout.gripper is None:
            return names
        if "gripper" in names and "actuation" in names:
            motion, fingers = self._parts(comparison)
            if fingers.often_far(numbers) and motion.seldom_far(numbers):
                names.remove("actuation")
            elif motion.often_far(numbers) and fingers.seldom_far(numbers):
                names.remove("gripper")
        if step is None:
            return names
        comparison, others = self.with_script[one.which][step], [other for other in numbers if other != step]
        motion, fingers = self._parts(comparison)
        in_others = motion.in_other_steps(step)
        if in_others is False and "actuation" in names:
            names.remove("actuation")
        in_all = motion.often_far(others) if in_others is None else in_others
        by_gripper = fingers.often_far(others) or (fingers.often_far([step]) and not motion.often_far([step]))
        if ("gripper" in names and by_gripper) or ("actuation" in names and in_all):
            names.remove("skill")
        return names

    def step_of_motion(self, one: EpisodeStates) -> int | None:
        """Return the only step in which the motion is wrong; None if others are wrong too, or that is unknown."""
        numbers = range(one.truth.shape[1])
        for comparison in self.with_script.get(one.which, {}).values():
            motion, _ = self._parts(comparison)
            for step in numbers:
                others = [other for other in numbers if other != step]
                if motion.often_far([step]) and motion.in_other_steps(step) is False and not motion.often_far(others):
                    return step
        return None

    def mended(self, decision: Decision, which: EpisodeId) -> MendedEpisode | None:
        """Return the re-run of an episode that the decision rests on, with the plan that is carried out in it."""
        episode = None if decision.by is None else self.results[decision.by].get(which)
        if episode is None or decision.by is None:
            return None
        plans = self.reference if "plan" in REPLACEMENTS[decision.by] and self.reference is not None else self.plans
        return MendedEpisode(decision.by, plans[which[0]], episode.steps)

    def shares(self) -> dict[str, dict[str, float]]:
        """Return, by task, the share of its failed episodes that each replacement fixes, of those it was tried on."""
        shares: dict[str, dict[str, float]] = {}
        for name, results in self.results.items():
            for task in {task for task, _ in results}:
                fixed = [episode is not None for (of, _), episode in results.items() if of == task]
                shares.setdefault(task, {})[name] = sum(fixed) / len(fixed)
        return shares
