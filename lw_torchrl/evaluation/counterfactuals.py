"""Counterfactuals: failed episodes run again with one part of what acted replaced by a sound one."""

import warnings
from collections.abc import Collection, Iterable, Sequence
from copy import deepcopy
from typing import Any

import torch
from torch import Tensor, nn
from torchrl.envs import Transform

from lw_torchrl.envs.episodes import FinishedEpisode
from lw_torchrl.evaluation.beside_scripts import BesideScripts, beside_scripts
from lw_torchrl.evaluation.deciding import PAIR_WORDS, REPLACEMENTS, Decision
from lw_torchrl.evaluation.explanation import EpisodeStates, Scripts, candidates, states_of
from lw_torchrl.evaluation.failure_records import MendedEpisode
from lw_torchrl.evaluation.repeating import EpisodeId, EpisodeRepeater, NullControl, Perception
from lw_torchrl.evaluation.scripts_in_charge import WithScripts
from lw_torchrl.language.canonical import canonical_like
from lw_torchrl.language.plans import Plans
from lw_torchrl.modules.policy import plans_of, with_plans
from lw_torchrl.modules.query_evaluator import QueryEvaluator
from lw_torchrl.transforms.qaf import plan_program

_TRIED_STEPS = 3  # in which a skill is replaced, one at a time


class TrueAnswers(QueryEvaluator):
    """The query answering function in an evaluator's place: 5 where a condition holds, else -5."""

    def __init__(self, plans: Plans) -> None:
        super().__init__(plans)
        self.program = plan_program(plans)

    def logits(self, *read: Tensor) -> Tensor:
        observation, task = read
        return 10.0 * self.program(observation, task).to(torch.float32) - 5.0


def own_evaluators(actor: Any) -> list[QueryEvaluator]:
    """The evaluators that a policy asks itself; not those that these ask in their turn."""
    if isinstance(actor, QueryEvaluator):
        return [actor]
    children = actor.children() if isinstance(actor, nn.Module) else ()
    return list(dict.fromkeys(found for child in children for found in own_evaluators(child)))


def with_true_answers(actor: Any) -> Any:
    """The policy with the query answering function in the place of its own evaluators; itself if it has none."""
    if not own_evaluators(actor):
        return actor
    other = deepcopy(actor)
    read = {key for evaluator in own_evaluators(actor) for key in evaluator.in_keys} - {"observation", "task_id"}
    for module in list(other.modules()):
        if hasattr(module, "in_keys"):
            module.in_keys = [key for key in module.in_keys if key not in read]  # pictures, say
        if isinstance(module, QueryEvaluator):  # what it asks in its turn goes with it
            continue
        for name, child in list(module.named_children()):
            if isinstance(child, QueryEvaluator):
                setattr(module, name, TrueAnswers(child.plans))
                if "answers" in (config := getattr(module, "config", {})):
                    module.config = {**config, "answers": "logit"}  # exact truth is worth what it is
    return other


class Counterfactuals:
    """Runs the counterfactuals that are worth it, and keeps what each gave."""

    def __init__(
        self,
        actor: Any,
        evaluator: Any,
        reference: Plans | None,
        scripts: Scripts,
        repeat: EpisodeRepeater,
        null: NullControl,
    ) -> None:
        self.actor, self.evaluator, self.scripts, self.repeat, self.null = actor, evaluator, scripts, repeat, null
        self.plans = plans = scripts.plans
        self.found: dict[str, dict[EpisodeId, FinishedEpisode | None]] = {}  # counterfactual to episodes that it mends
        self.step: dict[EpisodeId, int] = {}  # in which a script mends the episode
        self.beside: dict[EpisodeId, BesideScripts] = {}  # where it failed
        self.with_script: dict[EpisodeId, dict[int, BesideScripts]] = {}  # and where a script was in charge of a step
        self.reference: Plans | None = None
        self.other = self.other_evaluator = None  # that carry out the reference
        different = [] if reference is None else [reference[task] for task in reference.differences(plans)]
        if not different:
            return
        reference = Plans(different)
        try:
            other = with_plans(actor, canonical_like(reference, plans_of(actor)))
            reference = plans_of(other) or reference  # a policy may complete what it is given
            theirs = evaluator.with_plans(reference) if hasattr(evaluator, "with_plans") else evaluator
            self.other, self.other_evaluator, self.reference = other, theirs, reference
        except (AttributeError, ImportError, RuntimeError, TypeError, ValueError) as error:
            why = f"{type(error).__name__}: {error}"
            warnings.warn(f"reference: the policy cannot carry it out, so no plan is replaced ({why})", stacklevel=4)

    def run(self, seen: Sequence[EpisodeStates], same: Collection[EpisodeId] = ()) -> None:
        """Run all that are worth it; ``same`` are those in which the reference asks for nothing else."""
        seen = [one for one in seen if not self.null.succeeds(one.which)]
        every = [one.which for one in seen]
        misled = [which for which in every if which in self.null.misled]
        with Perception(self.actor, put_right=True):
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
        self._run("time", left, self.actor, self.plans, self.evaluator, 2)
        left = self._unmended(left, "time")
        pair = [one for one in left if one in wrong]
        with_reference = [one for one in left if one in with_reference]
        self._run("query + skill", pair, self._scripted(true, self.plans), self.plans)
        both, other = [one for one in pair if one in with_reference], with_true_answers(self.other)
        self._run("query + plan", both, other, self.reference)
        left = self._unmended(with_reference, "query + skill", "query + plan")
        other = self._scripted(self.other, self.reference)
        self._run("plan + skill", left, other, self.reference, self.other_evaluator)

    def _is_sensor(self) -> bool:
        """Whether what stands between environment and policy changes the state that it is shown."""
        return isinstance(self.evaluator, Transform) and "observation" in self.evaluator.out_keys

    def _mends(self, name: str, which: EpisodeId) -> bool:
        return self.found.get(name, {}).get(which) is not None

    def _unmended(self, which: Iterable[EpisodeId], *names: str) -> list[EpisodeId]:
        return [one for one in which if not any(self._mends(name, one) for name in names)]

    def _run(
        self, name: str, which: Sequence[EpisodeId], actor: Any, plans: Any, *options: Any
    ) -> dict[EpisodeId, FinishedEpisode]:
        again = {}
        if which and actor is not None and plans is not None:
            single = REPLACEMENTS.get(name)
            what = " and ".join(PAIR_WORDS[one] for one in name.split(" + ")) if single is None else single.words
            again = self.repeat(what, which, actor, plans, *options)
            kept = {one: None if episode.first_success is None else episode for one, episode in again.items()}
            self.found.setdefault(name, {}).update(kept)
        return again

    def _scripted(self, actor: Any, plans: Plans | None, **where: Any) -> Any:
        if actor is None or plans is None:
            return None
        scripts = self.scripts if plans is self.plans else Scripts(plans, self.scripts.table)
        return WithScripts(actor, plans, scripts, **where)

    def _run_scripts(self, seen: Sequence[EpisodeStates]) -> None:
        """Scripts in one step, for the likeliest steps in turn; for the gripper or the motion alone; for all."""
        ranked = {}
        for one in seen:
            beside = beside_scripts(self.actor, one, self.scripts)
            unlike = None if beside is None else beside.unlike()
            if beside is not None:
                self.beside[one.which] = beside
            if unlike is None or unlike.any():
                ranked[one.which] = candidates(one, unlike)
        told_of_steps = plans_of(self.actor) is not None
        for turn in range(_TRIED_STEPS if told_of_steps else 0):
            which = self._unmended([w for w, steps in ranked.items() if len(steps) > turn], "skill")
            steps = {one: ranked[one][turn] for one in which}
            scripted = self._scripted(self.actor, self.plans, steps=steps)
            again = self._run("skill", which, scripted, self.plans, self.evaluator)
            self.step.update({one: steps[one] for one in which if self._mends("skill", one)})
            for episode in set(which) & set(self.beside):
                there = states_of(*episode, again[episode].steps, self.plans, None)
                both = self.beside[episode].followed_by(beside_scripts(self.actor, there, self.scripts))
                self.with_script.setdefault(episode, {})[steps[episode]] = both
        left = [one for one in ranked if not (self._mends("skill", one) and self._in_one_step(one))]
        for name, part in (("gripper", "gripper"), ("actuation", "displacement")):
            if self.plans.layout.gripper is not None:
                scripted = self._scripted(self.actor, self.plans, part=part)
                self._run(name, left, scripted, self.plans, self.evaluator)
        parts = self._unmended(left, "skill", "gripper", "actuation")
        left = [one for one in ranked if one in parts or self._mends("plan", one)]  # can scripts follow this plan?
        self._run("policy", left, self._scripted(self.actor, self.plans), self.plans, self.evaluator)

    def _motion(self, beside: BesideScripts) -> BesideScripts:
        return beside.part(torch.arange(beside.done.shape[-1]) != self._gripper_number)

    def _gripper(self, beside: BesideScripts) -> BesideScripts:
        return beside.part(torch.arange(beside.done.shape[-1]) == self._gripper_number)

    @property
    def _gripper_number(self) -> int:
        gripper = self.plans.layout.gripper
        return -1 if gripper is None else gripper

    def _in_one_step(self, which: EpisodeId) -> bool:
        """Whether the motion differs from the scripts' in the step that a script mends, and the policy is their equal
        elsewhere, also in the steps that it then gets to."""
        if which not in self.beside:
            return False
        beside = self.with_script[which][self.step[which]]
        return len(beside.in_force[beside.unlike()].unique()) == 1 and bool(self._motion(beside).unlike().any())

    def mending(self, one: EpisodeStates) -> list[str]:
        """What mends an episode, without what does not count: scripts for a part of the action that is not far from
        theirs, where another part is that mends too; a script in one step, where only the gripper is wrong in it, or
        what is wrong there is as wrong in other steps, and scripts for that part in all steps mend too; where it is
        not, scripts for the motion."""
        found = [name for name, results in self.found.items() if results.get(one.which) is not None]
        beside, step, numbers = self.beside.get(one.which), self.step.get(one.which), range(one.truth.shape[1])
        if beside is None or self.plans.layout.gripper is None:
            return found
        if "gripper" in found and "actuation" in found:
            motion, fingers = self._motion(beside), self._gripper(beside)
            if fingers.often_far(numbers) and motion.seldom_far(numbers):
                found.remove("actuation")
            elif motion.often_far(numbers) and fingers.seldom_far(numbers):
                found.remove("gripper")
        if step is None:
            return found
        beside, others = self.with_script[one.which][step], [other for other in numbers if other != step]
        motion, fingers = self._motion(beside), self._gripper(beside)
        in_others = motion.in_other_steps(step)
        if in_others is False and "actuation" in found:
            found.remove("actuation")
        in_all = motion.often_far(others) if in_others is None else in_others
        by_gripper = fingers.often_far(others) or (fingers.often_far([step]) and not motion.often_far([step]))
        if ("gripper" in found and by_gripper) or ("actuation" in found and in_all):
            found.remove("skill")
        return found

    def step_of_motion(self, one: EpisodeStates) -> int | None:
        """The one step in which the motion is wrong, as far as is seen where the episode failed and where a script was
        in charge of a step; None where other steps are wrong as well, or that cannot be told."""
        numbers = range(one.truth.shape[1])
        for motion in map(self._motion, self.with_script.get(one.which, {}).values()):
            for step in numbers:
                others = [other for other in numbers if other != step]
                if motion.often_far([step]) and motion.in_other_steps(step) is False and not motion.often_far(others):
                    return step
        return None

    def mended(self, decision: Decision, which: EpisodeId) -> MendedEpisode | None:
        """The episode as it goes with what counts replaced, under the plan that is then carried out."""
        episode = None if decision.by is None else self.found[decision.by].get(which)
        if episode is None or decision.by is None:
            return None
        plans = self.reference if "plan" in decision.by.split(" + ") and self.reference is not None else self.plans
        return MendedEpisode(decision.words, plans[which[0]], episode.steps)

    def shares(self) -> dict[str, dict[str, float]]:
        """Task to the share of its failed episodes that each mends, of those it was tried in."""
        found: dict[str, dict[str, float]] = {}
        for name, results in self.found.items():
            for task in {task for task, _ in results}:
                bits = [hit is not None for (of, _), hit in results.items() if of == task]
                found.setdefault(task, {})[name] = sum(bits) / len(bits)
        return found
