"""The states of a failed episode: wrong answers, departures of the plan from a reference, and the step it ended in."""

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
from lw_torchrl.transforms.qaf import plan_program

_OFTEN, _BRIEF = 0.4, 5  # "often" is a larger share of a step's states; fewer states decide nothing
_SAME = 0.02  # actions that differ by less count as equal to the script's
_HALF = 0.5  # the share of the error that a fault may leave unexplained, and that counts in other steps
_LATE = 100  # the last states of a failed episode, in which it made no progress
_AHEAD, _STILL = 10, 0.01  # the hand stands still if it moves less than a centimetre in 10 states
_AWAY = 25  # longest interruption of a stay in a step, in states: two alternating steps are one stay
_WRONG = 0.01  # the smallest share of states with wrong answers that counts
OTHER = 0.3  # actions that differ by more, on some axis, have different purposes


class ScriptComparison(NamedTuple):
    """A policy's actions in T states, and the actions of the scripted skills of the active steps."""

    done: Tensor  # (T, A) float32
    wanted: Tensor  # (T, A) float32, infinite where the active step has no scripted skill
    active: Tensor  # (T,) int64, the active step, -1 for none

    def followed_by(self, other: ScriptComparison | None) -> ScriptComparison:
        """Append another episode's states."""
        if other is None:
            return self
        return ScriptComparison(*(torch.cat(both) for both in zip(self, other, strict=True)))

    def part(self, numbers: Tensor) -> ScriptComparison:
        """Select some of the action's numbers, (A,) bool."""
        return ScriptComparison(self.done[:, numbers], self.wanted[:, numbers], self.active)

    def differ_by(self, size: float) -> Tensor:
        """Return (T,) bool: whether the actions differ by more than ``size`` on any axis; False without active step."""
        return (self.done - self.wanted).abs().amax(-1).masked_fill(self.active < 0, 0.0) > size

    def unlike(self) -> Tensor:
        """Return (T,) bool: whether the policy's action is not the script's."""
        return self.differ_by(_SAME)

    def far(self, steps: Iterable[int]) -> float:
        """Return the largest share, over these steps, of a step's states whose actions are far from the scripts'."""
        far, stays = self.differ_by(OTHER), [self.active == step for step in steps]
        return max((float(far[stay].float().mean()) for stay in stays if stay.sum() >= _BRIEF), default=0.0)

    def often_far(self, steps: Iterable[int]) -> bool:
        return self.far(steps) > _OFTEN

    def seldom_far(self, steps: Iterable[int]) -> bool:
        return self.far(steps) < _OFTEN / 2

    def in_other_steps(self, step: int) -> bool | None:
        """Return whether the other steps have the fault of a step; None if that cannot be decided.

        The fault is estimated on the axis with the largest error, as a factor of the script's action or as a shift. The
        other steps have it if it explains at least half of their error. It is undecided if neither describes the step's
        error, if the fault would not show in the other steps, or if these are half as far off in another way.
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
    """Compare a policy with scripts in an episode's states; return None if its actions there cannot be computed.

    That is so if the policy draws its actions, or reads keys that were not recorded.
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
    """The T states of a failed episode under a plan of S steps."""

    task: str
    episode: int
    steps: TensorDictBase  # of batch (T,)
    truth: Tensor  # (T, S) bool, the exact answers
    answers: Tensor  # (T, S) bool, those that the policy acted on
    weights: Tensor  # (T, S) float32, the policy's attention over the plan's steps
    active: Tensor  # (T,) int64, the step with most attention; -1 where all steps have the same

    @property
    def which(self) -> tuple[str, int]:
        return self.task, self.episode

    def active_time(self, plan: ConditionalPlan, step: int, distance: float | None = None) -> ActiveStep:
        """Return how long a step was active late in the episode."""
        late = min(_LATE, len(self.active))
        states = int((self.active == step)[-late:].sum())
        return ActiveStep(step, plan.steps[step].skill, states, late, distance)


class Blame(NamedTuple):
    """The step of the plan and the state at which a cause shows, and the finding there."""

    step: int
    at: int
    finding: Finding


class Explanation(NamedTuple):
    """The cause that the states alone show."""

    cause: Cause  # "undecided" if they do not decide
    blames: Mapping[str, Blame]  # by possible cause
    evidence: Mapping[str, float]


def chosen(truth: Tensor, steps: int) -> Tensor:
    """Return (T,) int64: the first of ``steps`` steps whose condition holds in (T, S) bool, else the last step."""
    here = truth[..., :steps]
    return torch.where(here.any(-1), here.int().argmax(-1), steps - 1)


def states_of(task: str, episode: int, steps: TensorDictBase, plans: Plans, answers: Tensor | None) -> EpisodeStates:
    """Return an episode's states under the policy's plan; ``answers`` are the policy's, None for the recorded ones."""
    number = len(plans[task].steps)
    truth = plan_program(Plans([plans[task]]))(steps.get("observation"), steps.get("task_id"))[:, :number]
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
    """Return the steps that may be to blame for a failure, the likeliest first, by the states ``among`` (T,) bool.

    The furthest and the most frequent step late in the episode come first, then those of all states, then the others.
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
    """Return the start of the last stay in ``states`` (T,) bool; an interruption of up to 25 states does not end it."""
    places = states.nonzero().flatten()
    if not len(places):
        return len(states) - 1
    gaps = (places.diff() > _AWAY + 1).nonzero()
    return int(places[gaps[-1] + 1] if len(gaps) else places[0])


def stall_step(seen: EpisodeStates, step: int, layout: Layout = METAWORLD) -> int:
    """Return the state of the last stay in a step from which the hand stands still, else the start of the stay."""
    inside = seen.active == step
    begin = last_stay_start(inside)
    hand = seen.steps.get("observation")[begin:, layout.positions[0]]
    still = ((hand[_AHEAD:] - hand[:-_AHEAD]).norm(dim=-1) < _STILL) & inside[begin : begin + len(hand[_AHEAD:])]
    return begin + (int(still.int().argmax()) if still.any() else 0)


def explain(seen: EpisodeStates, scripts: Scripts, reference: Scripts | None) -> Explanation:
    """Apply the rule of :func:`attribute_failures` to an episode's states.

    Without a reference, the plan is to blame if no condition holds, and a skill that stays active far from its target.
    """
    plan, length = scripts.plans[seen.task], len(seen.active)
    late = min(_LATE, length)
    stuck = next(iter(candidates(seen)), len(plan.steps) - 1)
    stalled = stall_step(seen, stuck, scripts.plans.layout)
    blames, evidence = {}, {"states": float(length)}

    # Wrong answers; those that changed the chosen step matter most.
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

    # The plan: states in which no condition holds, or in which the reference requests another action.
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

    # The step in which the episode ended.
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
    """Return whether the plan's true step requests another action than the reference's, (T,) bool, and both steps."""
    observation, task_id = seen.steps.get("observation"), seen.steps.get("task_id")
    answers = plan_program(Plans([other]))(observation, task_id)
    ours, theirs = chosen(seen.truth, len(plan.steps)), chosen(answers, len(other.steps))
    rows = torch.arange(len(ours))
    done = scripts.program(observation, task_id)[rows, ours]
    wanted = other_scripts.program(observation, task_id)[rows, theirs]
    differ = (done - wanted).abs().amax(-1) > OTHER
    # Skills without a script differ if their texts do.
    same_text = torch.tensor([[a.skill == b.skill for b in other.steps] for a in plan.steps])[ours, theirs]
    scripted = torch.tensor(scripts.known[plan.task])[ours] & torch.tensor(other_scripts.known[other.task])[theirs]
    return torch.where(scripted, differ, ~same_text), ours, theirs
