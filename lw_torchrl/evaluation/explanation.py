"""What the states of a failed episode tell: which answers were wrong, where the plan departs from a reference, which
step it ended in."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.nn.functional import one_hot

from lw_torchrl.evaluation.failure_records import Cause
from lw_torchrl.evaluation.plan_use import where_stuck
from lw_torchrl.language.layout import METAWORLD, Layout
from lw_torchrl.language.named_objects import GRIPPER
from lw_torchrl.language.plans import ConditionalPlan, Plans
from lw_torchrl.language.skill_program import SkillProgram
from lw_torchrl.language.skills import ScriptedSkill
from lw_torchrl.transforms.qaf import plan_program

_LATE = 100  # the last states, in which a failed episode got nowhere
_AHEAD, _STILL = 10, 0.01  # a hand that within so many states comes less than a centimetre further
_AWAY = 25  # states that a stay in a step may be left for: two steps that alternate are one stay
_WRONG = 0.01  # the share of states with wrong answers from which they count
OTHER = 0.3  # how far two actions differ, on some axis, that are not meant to do the same
_REST = ScriptedSkill("", GRIPPER, gain=(0.0, 0.0, 0.0))  # in the place of a text that is no scripted skill
_RULER = 1e-3  # action per metre, so small that no distance is cut off


class EpisodeStates(NamedTuple):
    """A failed episode, and what its T states say of a plan of S steps."""

    task: str
    episode: int
    steps: TensorDictBase  # of batch (T,)
    truth: Tensor  # (T, S) bool, the query answering function's own answers
    given: Tensor  # (T, S) bool, those that the policy acted on
    weights: Tensor  # (T, S) float32, the policy's attention over the plan's steps
    in_force: Tensor  # (T,) int64, the step with most of it; -1 where all have the same, so that none is in force

    @property
    def which(self) -> tuple[str, int]:
        return self.task, self.episode

    def active_time(self, plan: ConditionalPlan, step: int) -> str:
        """How long a step was in force, in words."""
        late = min(_LATE, len(self.in_force))
        inside = int((self.in_force == step)[-late:].sum())
        return f"step {step + 1}, '{plan.steps[step].skill}', was in force in {inside} of the last {late} states"


class Blame(NamedTuple):
    """Where a cause shows."""

    step: int | None  # of the plan
    at: int  # the state to look at
    why: str  # half a sentence with its numbers


class Explanation(NamedTuple):
    """What the states say by themselves."""

    cause: Cause  # "undecided" where they do not tell
    blames: Mapping[str, Blame]  # of each cause that it may be
    evidence: Mapping[str, float]  # name to number


class Scripts:
    """The scripted skills of plans' steps, as far as a table of text to scripted skill has any."""

    def __init__(self, plans: Plans, table: Mapping[str, ScriptedSkill]) -> None:
        self.plans, self.table = plans, table
        self.known: dict[str, list[bool]] = {}
        found: dict[Any, list[ScriptedSkill]] = {}
        for task, plan in plans.items():
            given = [table.get(step.skill) for step in plan.steps]
            self.known[task] = known = [one is not None and one.suits(plan.definition) for one in given]
            pairs = zip(given, known, strict=True)
            found[plan.definition] = [one.for_task(plan.definition) if one and right else _REST for one, right in pairs]
        rulers: dict[Any, list[ScriptedSkill]] = {}
        for definition, skills in found.items():
            gains: list[Any] = [tuple(_RULER if gain else 0.0 for gain in one.gain) for one in skills]
            rulers[definition] = [replace(one, gain=gain, variants={}) for one, gain in zip(skills, gains, strict=True)]
        self.program, self._ruler = SkillProgram(found), SkillProgram(rulers)

    def distance(self, observation: Tensor, task_id: Tensor, step: int) -> Tensor:
        """(T,) metres, how far what a step's skill moves is from where it goes."""
        return self._ruler(observation, task_id)[:, step, :3].norm(dim=-1) / _RULER


def chosen(truth: Tensor, steps: int) -> Tensor:
    """(T, S) bool to (T,) int64: the first of ``steps`` steps whose condition holds, the last where none does."""
    here = truth[..., :steps]
    return torch.where(here.any(-1), here.int().argmax(-1), steps - 1)


def attended(weights: Tensor, steps: Tensor) -> Tensor:
    """The step in force, (...) int64: the first of those with most attention, ``weights`` (..., S) float32; -1 where
    all ``steps``, (..., S) bool, have the same, since no condition holds or every one does."""
    most = weights.masked_fill(~steps, -1.0).amax(-1, keepdim=True)
    least = weights.masked_fill(~steps, 2.0).amin(-1, keepdim=True)
    first = (steps & (weights >= most - 1e-6)).int().argmax(-1)
    none = ((most - least).squeeze(-1) < 1e-3) & (steps.sum(-1) > 1)
    return torch.where(none, -1, first)


def states_of(task: str, episode: int, steps: TensorDictBase, plans: Plans, given: Tensor | None) -> EpisodeStates:
    """A failed episode under the policy's plan; ``given`` are the answers it acted on, None for what is recorded."""
    number = len(plans[task].steps)
    truth = plan_program(Plans([plans[task]]))(steps.get("observation"), steps.get("task_id"))[:, :number]
    if (logits := steps.get("qaf_logits", None)) is not None:
        given = logits > 0
    elif given is None and (recorded := steps.get("qaf", None)) is not None:
        given = recorded > 0.5
    given = truth if given is None else given[:, :number]
    weights = steps.get("skill_weights", None)
    weights = one_hot(chosen(given, number), number).float() if weights is None else weights[:, :number]
    in_force = attended(weights, torch.ones_like(weights, dtype=torch.bool))
    return EpisodeStates(task, episode, steps, truth, given, weights, in_force)


def candidates(seen: EpisodeStates, among: Tensor | None = None) -> list[int]:
    """The steps that may be to blame for a failure, the likeliest first: of those in force for a while late in the
    episode the furthest and the most frequent, then the furthest of all, then the others."""
    counted = seen.in_force >= 0 if among is None else (seen.in_force >= 0) & among
    if not counted.any():
        return []
    in_charge = one_hot(seen.in_force.clamp(min=0), seen.truth.shape[1]) * counted.unsqueeze(-1)
    ranked: list[int] = []
    for window in (_LATE, len(in_charge)):
        if counted[-window:].any():
            ranked += reversed(where_stuck(in_charge, window))
    ranked += torch.bincount(seen.in_force[counted]).argsort(descending=True).tolist()
    return [step for step in dict.fromkeys(ranked) if step in seen.in_force[counted]]


def last_stay_start(states: Tensor) -> int:
    """(T,) bool to where the last stay in them begins; interruptions of up to 25 states do not end it."""
    found = states.nonzero().flatten()
    if not len(found):
        return len(states) - 1
    gaps = (found.diff() > _AWAY + 1).nonzero()
    return int(found[gaps[-1] + 1] if len(gaps) else found[0])


def stall_step(seen: EpisodeStates, step: int, layout: Layout = METAWORLD) -> int:
    """Where the last stay in a step shows: the first state in it after which the hand gets no further, else its
    beginning."""
    inside = seen.in_force == step
    begin = last_stay_start(inside)
    hand = seen.steps.get("observation")[begin:, layout.positions[0]]
    still = ((hand[_AHEAD:] - hand[:-_AHEAD]).norm(dim=-1) < _STILL) & inside[begin : begin + len(hand[_AHEAD:])]
    return begin + (int(still.int().argmax()) if still.any() else 0)


def explain(seen: EpisodeStates, scripts: Scripts, reference: Scripts | None) -> Explanation:
    """The rule of :func:`attribute_failures`; without a reference, a plan is to blame where no condition holds, and a
    skill that stays in force far from its goal."""
    plan, length = scripts.plans[seen.task], len(seen.in_force)
    late = min(_LATE, length)
    stuck = next(iter(candidates(seen)), len(plan.steps) - 1)
    stalled = stall_step(seen, stuck, scripts.plans.layout)
    blames, evidence = {}, {"states": float(length)}

    wrong = seen.given != seen.truth
    share = evidence["answers_wrong"] = float(wrong.any(-1).float().mean())
    if share:
        changes = chosen(seen.given, len(plan.steps)) != chosen(seen.truth, len(plan.steps))
        matter = wrong & changes.unsqueeze(-1) if changes.any() else wrong
        column = int(matter.sum(0).argmax())
        evidence["answers_wrong_late"] = float(wrong[-late:].any(-1).float().mean())
        here = wrong[:, column].int()
        often = f"{int(here.sum())} of {length} states, first at {int(here.argmax())}"
        why = f"'{plan.steps[column].condition}' (step {column + 1}) was answered wrongly in {often}"
        blames["query"] = Blame(column, int(matter[:, column].int().argmax()), why)

    none = ~seen.truth.any(-1)
    evidence["no_condition_late"] = float(none[-late:].float().mean())
    if reference is None or seen.task not in reference.plans:
        why = f"no condition of the plan held in {int(none[-late:].sum())} of the last {late} states"
        blames["plan"] = Blame(stuck, last_stay_start(none) if none.any() else stalled, why)
    else:
        other = reference.plans[seen.task]
        departs, ours, theirs = _departs(seen, plan, scripts, other, reference)
        evidence["plan_departs"] = float(departs.float().mean())
        evidence["plan_departs_late"] = float(departs[-late:].float().mean())
        recent, where, step, asked = int(departs[-late:].sum()), departs.clone(), stuck, other.steps[0].skill
        where[:-late] &= not recent
        if where.any():
            step = int(torch.bincount(ours[where]).argmax())
            asked = other.steps[int(torch.bincount(theirs[where & (ours == step)]).argmax())].skill
        said = f"the plan asks for something else than the reference, as step {step + 1}, '{plan.steps[step].skill}'"
        if where.any() and none[where].float().mean() > 0.5:
            said = "no condition of the plan holds"
        states = f"{recent} of the last {late}" if recent else f"{int(departs.sum())} of {length}"
        at = last_stay_start(departs & (ours == step)) if departs.any() else stalled
        blames["plan"] = Blame(step, at, f"in {states} states {said}, where the reference says '{asked}'")

    evidence["in_step_late"] = float((seen.in_force == stuck)[-late:].float().mean())
    told = seen.active_time(plan, stuck)
    if scripts.known[seen.task][stuck]:
        last = seen.steps[-1:]
        far = float(scripts.distance(last.get("observation"), last.get("task_id"), stuck))
        evidence["distance_at_end"] = far
        told += f" and ended {100 * far:.0f} cm from where it goes"
    blames["skill"] = blames["undecided"] = Blame(stuck, stalled, told)
    blames["out of time"] = Blame(stuck, length - 1, told)

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
    """(T,) bool, whether the plan's true step is to do something else than the reference's, and which steps these are;
    skills that are no scripts differ where their texts do."""
    observation, task_id = seen.steps.get("observation"), seen.steps.get("task_id")
    answers = plan_program(Plans([other]))(observation, task_id)
    ours, theirs = chosen(seen.truth, len(plan.steps)), chosen(answers, len(other.steps))
    rows = torch.arange(len(ours))
    done = scripts.program(observation, task_id)[rows, ours]
    wanted = other_scripts.program(observation, task_id)[rows, theirs]
    differ = (done - wanted).abs().amax(-1) > OTHER
    same_text = torch.tensor([[a.skill == b.skill for b in other.steps] for a in plan.steps])[ours, theirs]
    scripted = torch.tensor(scripts.known[plan.task])[ours] & torch.tensor(other_scripts.known[other.task])[theirs]
    return torch.where(scripted, differ, ~same_text), ours, theirs
