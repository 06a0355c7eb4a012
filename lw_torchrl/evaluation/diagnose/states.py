"""Analyze the states of a failed episode: wrong answers, deviations from a reference plan, and the final plan step."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.nn.functional import one_hot

from lw_torchrl.evaluation.diagnose.failure import ActiveStep, Cause, Finding, NoCondition, PlanDeparts, WrongAnswers
from lw_torchrl.evaluation.diagnose.replacements import Scripts, attended
from lw_torchrl.language.layout import METAWORLD, Layout
from lw_torchrl.language.plans import ConditionalPlan, Plans
from lw_torchrl.transforms.qaf import truth_of_episode

_BRIEF = 5  # with fewer states, a plan step's error is not measured
_SAME = 0.02  # actions that differ by less than this count as equal
_HALF = 0.5  # the fraction of an error that a fault may leave unexplained
_DELAYS = 26  # delays up to this number of time steps are tried
_LATE = 100  # number of last states of a failed episode, in which the episode made no progress
_AHEAD, _STILL = 10, 0.01  # the hand stands still if it moves less than 1 cm in 10 states
_AWAY = 25  # longest interruption (in states) of a visit to a plan step, so that two alternating steps are one visit
_WRONG = 0.01  # the smallest fraction of states with wrong answers that counts
OTHER = 0.3  # actions that differ by more than this on any axis serve different purposes


class Motion(NamedTuple):
    """What was done in T states, what should have been done, and the active plan step."""

    wanted: Tensor  # (T, A) float32, NaN where unknown
    done: Tensor  # (T, A) float32
    active: Tensor  # (T,) int64, -1 for none

    def and_also(self, other: Motion) -> Motion:
        """Return the motion with another episode's states appended."""
        return Motion(*(torch.cat(both) for both in zip(self, other, strict=True)))

    def of(self, entries: Tensor) -> Motion:
        """Return the motion of the action's entries selected by ``entries`` (A,) bool, where it is known."""
        known = (self.active >= 0) & self.wanted.isfinite().all(-1)
        return Motion(self.wanted[known][:, entries], self.done[known][:, entries], self.active[known])

    def error(self) -> float:
        """Return the largest error (root mean square) among the plan steps that were active in 5 states or more."""
        return max(self.errors().values(), default=0.0)

    def errors(self) -> dict[int, float]:
        found = {}
        for step in self.active.unique().tolist():
            here = self.active == step
            if here.sum() >= _BRIEF and self.done.shape[-1]:
                found[step] = _rms(self.done - self.wanted, here)
        return found

    def predicted(self, where: Tensor) -> tuple[str, Tensor]:
        """Return the simplest fault that explains the error in the states ``where`` (T,) bool, and its actions (T, A).

        Each fault is fitted to these states by least squares: a constant, a factor for each axis, a shift, a delay of
        whole steps, or a linear map of all axes. "irregular" explains too little.
        """
        wanted, done = self.wanted, self.done
        square = wanted[where].square().sum(0).clamp(min=1e-6)
        factor = (done * wanted)[where].sum(0) / square
        ones = torch.cat((wanted, wanted * wanted.abs(), torch.ones_like(wanted[:, :1])), -1)
        ridge = 1e-4 * torch.eye(ones.shape[-1])
        linear = torch.linalg.solve(ones[where].mT @ ones[where] + ridge, ones[where].mT @ done[where])
        faults = {"constant": done[where].mean(0).expand_as(done), "scaled": factor * wanted}
        faults["shifted"] = wanted + (done - wanted)[where].mean(0)
        for delay in range(1, min(_DELAYS, len(wanted) - 1)):
            faults[f"delayed by {delay}"] = torch.cat((wanted[:1].expand(delay, -1), wanted[:-delay]))
        faults["turned"] = ones @ linear
        left = {name: _rms(done - fault, where) for name, fault in faults.items()}
        best = min(left.values())
        name = next(name for name in left if left[name] <= 1.25 * best + 0.25 * _SAME)
        return name if left[name] < _HALF * _rms(done - wanted, where) else "irregular", faults[name]

    def extent(self, exact: bool = False) -> tuple[bool | None, int, str]:
        """Return whether the fault is in all plan steps, the plan step with the largest error, and the fault's shape.

        The fault of the plan step with the largest error predicts what would be done in the other plan steps. It is in
        all plan steps if it explains their errors, or if they have other errors about as large. It is in one plan step
        if the others lack an error that the fault predicts. None if neither can be decided. If ``exact``, there are no
        other errors, so that any error in other plan steps shows the fault.
        """
        errors = self.errors()
        if not errors:
            return None, -1, "irregular"
        worst = max(errors, key=errors.__getitem__)
        here = self.active == worst
        name, fault = self.predicted(here)
        others = ~here & torch.isin(self.active, torch.tensor(list(errors)))
        if not others.any():
            return None, worst, name
        measured, expected = _rms(self.done - self.wanted, others), _rms(fault - self.wanted, others)
        # A policy that equals the scripts in many states has no other errors either.
        equal = float(((self.done - self.wanted).abs().amax(-1) < 1e-5).float().mean()) > 0.1
        if (exact and measured > 1e-3) or (equal and measured > _SAME):
            return True, worst, name
        unexplained = _rms(self.done - fault, others)
        if min(errors.values()) > _SAME and name == "irregular" and min(errors.values()) > _HALF * errors[worst]:
            return True, worst, name
        if measured <= _SAME:  # the other plan steps are executed exactly
            shows = expected > 2 * measured + 0.25 * _SAME
            return (False if shows else None if measured == 0.0 else unexplained < measured), worst, name
        if unexplained < _HALF * measured or (name != "irregular" and unexplained < 0.8 * measured):
            return True, worst, name
        sound = [step for step, error in errors.items() if error <= _SAME]
        if measured < _HALF * errors[worst] and (expected > 2 * measured or sound):
            return False, worst, name
        return (True if measured > _HALF * errors[worst] else None), worst, name


def _rms(values: Tensor, where: Tensor) -> float:
    return float(values[where].square().sum(-1).mean().sqrt())


class EpisodeStates(NamedTuple):
    """The T states of a failed episode under a plan with S steps."""

    task: str
    episode: int
    steps: TensorDictBase  # the recorded time steps, of batch (T,)
    truth: Tensor  # (T, S) bool, the exact answers
    answers: Tensor  # (T, S) bool, the answers that the policy acted on
    weights: Tensor  # (T, S) float32, the policy's attention over the plan steps
    active: Tensor  # (T,) int64, the plan step with the largest weight; -1 where all weights are equal

    @property
    def which(self) -> tuple[str, int]:
        return self.task, self.episode

    def active_time(self, plan: ConditionalPlan, step: int, distance: float | None = None) -> ActiveStep:
        """Return a finding that counts in how many of the last 100 states a plan step was active."""
        late = min(_LATE, len(self.active))
        states = int((self.active == step)[-late:].sum())
        return ActiveStep(step, plan.steps[step].skill, states, late, distance)


class Blame(NamedTuple):
    """The plan step and the state (``at``) at which a cause becomes visible, and the finding for that state."""

    step: int
    at: int
    finding: Finding


class Explanation(NamedTuple):
    """The cause that follows from the states alone, without re-runs."""

    cause: Cause  # "undecided" if the states do not show the cause
    blames: Mapping[str, Blame]  # for each possible cause, where it shows
    evidence: Mapping[str, float]  # measured numbers by name


def chosen(truth: Tensor, steps: int) -> Tensor:
    """Return (T,) int64: the first of ``steps`` plan steps whose condition holds in ``truth`` (T, S), or the last."""
    here = truth[..., :steps]
    return torch.where(here.any(-1), here.int().argmax(-1), steps - 1)


def exact_answers(plan: ConditionalPlan, steps: TensorDictBase) -> Tensor:
    """Return the exact answers (T, S) bool to a plan's conditions in an episode's states."""
    return truth_of_episode(Plans([plan]), steps)[:, : len(plan.steps)]


def states_of(task: str, episode: int, steps: TensorDictBase, plans: Plans, answers: Tensor | None) -> EpisodeStates:
    """Return an episode's states under the policy's plan; ``answers`` are used if no ``qaf_logits`` were recorded."""
    number = len(plans[task].steps)
    truth = exact_answers(plans[task], steps)
    if (logits := steps.get("qaf_logits", None)) is not None:
        answers = logits > 0
    elif answers is None and (recorded := steps.get("qaf", None)) is not None:
        answers = recorded > 0.5
    answers = truth if answers is None else answers[:, :number]
    weights = steps.get("skill_weights", None)
    weights = one_hot(chosen(answers, number), number).float() if weights is None else weights[:, :number]
    active = attended(weights, torch.ones_like(weights, dtype=torch.bool))
    return EpisodeStates(task, episode, steps, truth, answers, weights, active)


def last_stay_start(states: Tensor) -> int:
    """Return the first state of the last visit in ``states`` (T,) bool; gaps of up to 25 states do not end a visit."""
    places = states.nonzero().flatten()
    if not len(places):
        return len(states) - 1
    gaps = (places.diff() > _AWAY + 1).nonzero()
    return int(places[gaps[-1] + 1] if len(gaps) else places[0])


def stall_step(seen: EpisodeStates, step: int, layout: Layout = METAWORLD) -> int:
    """Return the state in which the hand stopped during the last visit to a plan step.

    If the hand did not stop, return the first state of the visit.
    """
    inside = seen.active == step
    begin = last_stay_start(inside)
    hand = seen.steps.get("observation")[begin:, layout.positions[0]]
    still = ((hand[_AHEAD:] - hand[:-_AHEAD]).norm(dim=-1) < _STILL) & inside[begin : begin + len(hand[_AHEAD:])]
    return begin + (int(still.int().argmax()) if still.any() else 0)


def explain(seen: EpisodeStates, scripts: Scripts, reference: Scripts | None) -> Explanation:
    """Apply the rule of :func:`attribute_failures` to an episode's states.

    Without a reference, the plan is to blame if no condition holds, and a skill if it stays active far from its target.
    """
    plan, length = scripts.plans[seen.task], len(seen.active)
    late = min(_LATE, length)
    late_steps = seen.active[-late:][seen.active[-late:] >= 0]
    stuck = int(torch.bincount(late_steps).argmax()) if len(late_steps) else len(plan.steps) - 1
    stalled = stall_step(seen, stuck, scripts.plans.layout)
    blames, evidence = {}, {"states": float(length)}

    # Query: wrong answers, of which those that changed the chosen plan step matter most.
    wrong = seen.answers != seen.truth
    share = evidence["answers_wrong"] = float(wrong.any(-1).float().mean())
    if share:
        changes = chosen(seen.answers, len(plan.steps)) != chosen(seen.truth, len(plan.steps))
        matter = wrong & changes.unsqueeze(-1) if changes.any() else wrong
        column = int(matter.sum(0).argmax())
        evidence["answers_wrong_late"] = float(wrong[-late:].any(-1).float().mean())
        here = wrong[:, column].int()
        condition = str(plan.steps[column].condition)
        wrong_answers = WrongAnswers(column, condition, int(here.sum()), length, int(here.argmax()))
        blames["query"] = Blame(column, int(matter[:, column].int().argmax()), wrong_answers)

    # Plan: states in which no condition holds, or in which the reference requests a different action.
    none = ~seen.truth.any(-1)
    evidence["no_condition_late"] = float(none[-late:].float().mean())
    if reference is None or seen.task not in reference.plans:
        uncovered = NoCondition(int(none[-late:].sum()), late)
        blames["plan"] = Blame(stuck, last_stay_start(none) if none.any() else stalled, uncovered)
    else:
        other = reference.plans[seen.task]
        departs, ours, theirs = _departs(seen, plan, scripts, other, reference)
        evidence["plan_departs"] = float(departs.float().mean())
        evidence["plan_departs_late"] = float(departs[-late:].float().mean())
        recent, where, step, requested = int(departs[-late:].sum()), departs.clone(), stuck, other.steps[0].skill
        where[:-late] &= not recent
        if where.any():
            step = int(torch.bincount(ours[where]).argmax())
            requested = other.steps[int(torch.bincount(theirs[where & (ours == step)]).argmax())].skill
        uncovers = bool(where.any()) and bool(none[where].float().mean() > 0.5)
        states, of = (recent, late) if recent else (int(departs.sum()), length)
        at = last_stay_start(departs & (ours == step)) if departs.any() else stalled
        finding = PlanDeparts(step, plan.steps[step].skill, requested, states, of, bool(recent), uncovers)
        blames["plan"] = Blame(step, at, finding)

    # Skill: the plan step in which the episode got stuck.
    evidence["in_step_late"] = float((seen.active == stuck)[-late:].float().mean())
    if scripts.known[seen.task][stuck]:
        last = seen.steps[-1:]
        distance = float(scripts.distance(last.get("observation"), last.get("task_id"), stuck))
        evidence["distance_at_end"] = distance
    time = seen.active_time(plan, stuck, evidence.get("distance_at_end"))
    blames["skill"] = blames["undecided"] = Blame(stuck, stalled, time)
    blames["out of time"] = Blame(stuck, length - 1, time)

    cause: Cause = "undecided"
    if share >= _WRONG:
        cause = "query"
    elif "plan_departs_late" in evidence:
        cause = "plan" if evidence["plan_departs_late"] > 0.5 else "skill"
    elif evidence["no_condition_late"] > 0.5:
        cause = "plan"
    elif evidence["in_step_late"] > 0.9 and evidence.get("distance_at_end", 0.0) > 0.05:
        cause = "skill"
    return Explanation(cause, blames, evidence)


def _departs(
    seen: EpisodeStates, plan: ConditionalPlan, scripts: Scripts, other: ConditionalPlan, other_scripts: Scripts
) -> tuple[Tensor, Tensor, Tensor]:
    """Return whether plan and reference request different actions (T,) bool, and the chosen plan step of each (T,)."""
    observation, task_id = seen.steps.get("observation"), seen.steps.get("task_id")
    ours, theirs = chosen(seen.truth, len(plan.steps)), chosen(exact_answers(other, seen.steps), len(other.steps))
    rows = torch.arange(len(ours))
    done = scripts.program(observation, task_id)[rows, ours]
    wanted = other_scripts.program(observation, task_id)[rows, theirs]
    differ = (done - wanted).abs().amax(-1) > OTHER
    # Two skills of which one has no script differ if their texts differ.
    same_text = torch.tensor([[a.skill == b.skill for b in other.steps] for a in plan.steps])[ours, theirs]
    scripted = torch.tensor(scripts.known[plan.task])[ours] & torch.tensor(other_scripts.known[other.task])[theirs]
    return torch.where(scripted, differ, ~same_text), ours, theirs
