"""Analyze the states of a failed episode: wrong answers, deviations from a reference plan, and the final plan step."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torch.nn.functional import one_hot, pad
from torchrl.envs.utils import ExplorationType, set_exploration_type

from lw_torchrl._util.devices import device_of
from lw_torchrl.evaluation.diagnose.failure import ActiveStep, Cause, Finding, NoCondition, PlanDeparts, WrongAnswers
from lw_torchrl.evaluation.diagnose.replacements import Scripts, attended
from lw_torchrl.evaluation.plan_use import where_stuck
from lw_torchrl.language.layout import METAWORLD, Layout
from lw_torchrl.language.plans import ConditionalPlan, Plans
from lw_torchrl.modules.parts import evaluating
from lw_torchrl.modules.policy import draws, plans_of
from lw_torchrl.transforms.qaf import truth_of_episode

_OFTEN, _BRIEF = 0.4, 5  # "often": more than this fraction of a plan step's states; with fewer than 5, undecided
_SAME = 0.02  # actions that differ from the script's by less than this count as equal
_HALF = 0.5  # the fraction of the error that a fault may leave unexplained, and that counts in other plan steps
_LATE = 100  # number of last states of a failed episode, in which the episode made no progress
_AHEAD, _STILL = 10, 0.01  # the hand stands still if it moves less than 1 cm in 10 states
_AWAY = 25  # longest interruption (in states) of a visit to a plan step, so that two alternating steps are one visit
_WRONG = 0.01  # the smallest fraction of states with wrong answers that counts
OTHER = 0.3  # actions that differ by more than this on any axis serve different purposes


class ScriptComparison(NamedTuple):
    """A policy's actions in T states, and the actions of the active plan steps' scripted skills."""

    done: Tensor  # (T, A) float32, the policy's actions
    wanted: Tensor  # (T, A) float32, the scripts' actions; infinite where the active plan step has no scripted skill
    active: Tensor  # (T,) int64, the active plan step, -1 for none

    def followed_by(self, other: ScriptComparison | None) -> ScriptComparison:
        """Return the comparison with another episode's states appended."""
        if other is None:
            return self
        return ScriptComparison(*(torch.cat(both) for both in zip(self, other, strict=True)))

    def part(self, numbers: Tensor) -> ScriptComparison:
        """Return the comparison of the action's entries selected by ``numbers`` (A,) bool."""
        return ScriptComparison(self.done[:, numbers], self.wanted[:, numbers], self.active)

    def differ_by(self, size: float) -> Tensor:
        """Return (T,) bool: whether actions differ by more than ``size`` on any axis; False if no step is active."""
        return (self.done - self.wanted).abs().amax(-1).masked_fill(self.active < 0, 0.0) > size

    def unlike(self) -> Tensor:
        """Return (T,) bool: whether the policy's action differs from the script's."""
        return self.differ_by(_SAME)

    def far(self, steps: Iterable[int]) -> float:
        """Return the largest fraction, over plan steps, of a step's states with actions far from the script's."""
        far, stays = self.differ_by(OTHER), [self.active == step for step in steps]
        return max((float(far[stay].float().mean()) for stay in stays if stay.sum() >= _BRIEF), default=0.0)

    def often_far(self, steps: Iterable[int]) -> bool:
        return self.far(steps) > _OFTEN

    def seldom_far(self, steps: Iterable[int]) -> bool:
        return self.far(steps) < _OFTEN / 2

    def in_other_steps(self, step: int) -> bool | None:
        """Return whether the other plan steps have the same fault as ``step``; None if that cannot be decided.

        The fault is estimated on the axis with the largest error, as a factor of the script's action or as a shift. The
        other plan steps have the fault if it explains more than half of their error. The result is None if neither a
        factor nor a shift explains the error in ``step``, if the fault would not show in the other plan steps, or if
        their error is large (more than half of the error in ``step``) but unexplained.
        """
        known = self.wanted.isfinite().all(-1) & (self.active >= 0)
        inside, others = known & (self.active == step), known & (self.active != step)
        if min(int(inside.sum()), int(others.sum())) < _BRIEF:
            return None
        axis = int((self.done - self.wanted)[inside].square().mean(0).argmax())
        done, wanted = self.done[:, axis], self.wanted[:, axis]
        factor = (done * wanted)[inside].sum() / wanted[inside].square().sum().clamp(min=_SAME**2)
        faults = [factor * wanted, wanted + (done - wanted)[inside].mean()]
        faults = [fault for fault in faults if _off(done - fault, inside) < _HALF * _off(done - wanted, inside)]
        faults = [fault for fault in faults if _off(fault - wanted, others) > _SAME]
        off = _off(done - wanted, others)
        if any(_off(done - fault, others) < _HALF * off for fault in faults):
            return True
        return None if not faults or off > _HALF * _off(done - wanted, inside) else False


def _off(values: Tensor, where: Tensor) -> float:
    return float(values[where].square().mean().sqrt())


def compare_with_scripts(actor: Any, seen: EpisodeStates, scripts: Scripts) -> ScriptComparison | None:
    """Compare a policy's actions with the scripts' actions in an episode's states.

    Return None if the policy's actions cannot be computed, because it is stochastic or reads keys not recorded.
    """
    keys = [key for key in getattr(actor, "in_keys", ()) if key != "qaf"]
    plans = plans_of(actor)
    is_known = isinstance(actor, TensorDictModuleBase) and not draws(actor)
    if not is_known or any(seen.steps.get(key, None) is None for key in keys):
        return None
    states = seen.steps.select(*keys).clone()
    if "qaf" in actor.in_keys and plans is not None:
        states.set("qaf", pad(seen.answers, (0, plans.num_steps - seen.answers.shape[1])))
    with torch.no_grad(), evaluating(actor), set_exploration_type(ExplorationType.DETERMINISTIC):
        action = actor(states.to(device_of(actor))).get("action").cpu()
    program = scripts.program(seen.steps.get("observation"), seen.steps.get("task_id"))[:, : seen.weights.shape[1]]
    wanted = (seen.weights.unsqueeze(-1) * program).sum(-2)
    unscripted = ~torch.tensor(scripts.known[seen.task])[seen.active]
    return ScriptComparison(action, wanted.masked_fill(unscripted.unsqueeze(-1), torch.inf), seen.active)


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


def states_of(task: str, episode: int, steps: TensorDictBase, plans: Plans, answers: Tensor | None) -> EpisodeStates:
    """Return an episode's states under the policy's plan; ``answers`` are used if no ``qaf_logits`` were recorded."""
    number = len(plans[task].steps)
    truth = truth_of_episode(Plans([plans[task]]), steps)[:, :number]
    if (logits := steps.get("qaf_logits", None)) is not None:
        answers = logits > 0
    elif answers is None and (recorded := steps.get("qaf", None)) is not None:
        answers = recorded > 0.5
    answers = truth if answers is None else answers[:, :number]
    weights = steps.get("skill_weights", None)
    weights = one_hot(chosen(answers, number), number).float() if weights is None else weights[:, :number]
    active = attended(weights, torch.ones_like(weights, dtype=torch.bool))
    return EpisodeStates(task, episode, steps, truth, answers, weights, active)


def candidates(seen: EpisodeStates, among: Tensor | None = None) -> list[int]:
    """Return the plan steps that may be to blame for a failure, the likeliest first.

    Only the states ``among`` (T,) bool count (None for all). The furthest and the most frequent plan step late in the
    episode come first, then the furthest and the most frequent of the whole episode, then the others by frequency.
    """
    counted = seen.active >= 0 if among is None else (seen.active >= 0) & among
    if not counted.any():
        return []
    active = one_hot(seen.active.clamp(min=0), seen.truth.shape[1]) * counted.unsqueeze(-1)
    ranked: list[int] = []
    for window in (_LATE, len(active)):
        if counted[-window:].any():
            ranked += reversed(where_stuck(active, window))
    ranked += torch.bincount(seen.active[counted]).argsort(descending=True).tolist()
    return [step for step in dict.fromkeys(ranked) if step in seen.active[counted]]


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
    stuck = next(iter(candidates(seen)), len(plan.steps) - 1)
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
    answers = truth_of_episode(Plans([other]), seen.steps)
    ours, theirs = chosen(seen.truth, len(plan.steps)), chosen(answers, len(other.steps))
    rows = torch.arange(len(ours))
    done = scripts.program(observation, task_id)[rows, ours]
    wanted = other_scripts.program(observation, task_id)[rows, theirs]
    differ = (done - wanted).abs().amax(-1) > OTHER
    # Two skills of which one has no script differ if their texts differ.
    same_text = torch.tensor([[a.skill == b.skill for b in other.steps] for a in plan.steps])[ours, theirs]
    scripted = torch.tensor(scripts.known[plan.task])[ours] & torch.tensor(other_scripts.known[other.task])[theirs]
    return torch.where(scripted, differ, ~same_text), ours, theirs
