"""A failed episode with its re-runs, and functions that find the plan step and the state where it went wrong."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor

from lw_torchrl.envs.episodes import FinishedEpisode
from lw_torchrl.evaluation.diagnose.failure import Finding, MendedEpisode
from lw_torchrl.evaluation.diagnose.replacements import EpisodeId, Scripts, chosen
from lw_torchrl.language.plans import ConditionalPlan, Plans
from lw_torchrl.transforms.qaf import truth_of_episode

_BRIEF = 5  # with fewer states, a plan step's error is not measured
_SAME = 0.02  # actions that differ by less than this count as equal
_HALF = 0.5  # the fraction of an error that a fault may leave unexplained
_DELAYS = 26  # only delays shorter than this number of time steps are tried
_LATE = 100  # number of final states of a failed episode that are assumed to show no progress
_AHEAD, _STILL = 10, 0.01  # the hand stands still if it moves less than 1 cm in 10 states
_AWAY = 25  # a visit to a plan step may be interrupted for up to 25 states, for example if two plan steps alternate
_OTHER_STATES = ("other states", "other first state")
_SAME_STATE = 1e-6  # smaller differences between two simulations of a state are rounding
WRONG, OFTEN_WRONG = 0.01, 0.5  # wrong answers in these fractions of states are a possible and a certain cause
OTHER = 0.3  # actions that differ by more than this on any axis serve different purposes


class Motion(NamedTuple):
    """The right and the actual action, and the active plan step, in each of T states."""

    wanted: Tensor  # (T, A) float32, the right actions; NaN where unknown
    done: Tensor  # (T, A) float32, the actual actions
    active: Tensor  # (T,) int64, -1 for none

    def and_also(self, other: Motion) -> Motion:
        """Return the motion with another episode's states appended."""
        return Motion(*(torch.cat(both) for both in zip(self, other, strict=True)))

    def of(self, entries: Tensor) -> Motion:
        """Select the action entries ``entries`` (A,) bool, in states with an active step and a known right action."""
        known = (self.active >= 0) & self.wanted.isfinite().all(-1)
        return Motion(self.wanted[known][:, entries], self.done[known][:, entries], self.active[known])

    def error(self) -> float:
        """Return the largest error (root mean square) among the plan steps that were active in 5 states or more."""
        return max(self.errors().values(), default=0.0)

    def errors(self) -> dict[int, float]:
        """Return the error of each plan step that was active in 5 states or more."""
        steps = {step: self.active == step for step in self.active.unique().tolist() if self.done.shape[-1]}
        return {step: _rms(self.done - self.wanted, here) for step, here in steps.items() if here.sum() >= _BRIEF}

    def predicted(self, where: Tensor) -> tuple[str, Tensor]:
        """Return the name of the simplest fault that fits the states ``where`` (T,) bool, and predicted actions (T, A).

        Each fault (a constant, a factor for each axis, a shift, a delay of whole time steps, or a linear map of all
        axes) is fitted to these states by least squares. The name is "irregular" if none explains half of the error.
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
        """Return ``in_all`` (whether all plan steps have the fault), ``worst`` (a plan step) and the fault's name.

        ``worst`` is the plan step with the largest error; -1 if no plan step was active in 5 states. The fault is
        fitted to this step. ``in_all`` is True if the fault also explains the errors in the other plan steps, or if
        they are about as large; False if they are smaller than the fault predicts; and None if neither is clear. With
        ``exact``, only the fault can cause errors, so any error in another plan step gives True.
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
        # If the actions are exact in many states, the policy has no errors except the fault.
        equal = float(((self.done - self.wanted).abs().amax(-1) < 1e-5).float().mean()) > 0.1
        if (exact and measured > 1e-3) or (equal and measured > _SAME):
            return True, worst, name
        unexplained = _rms(self.done - fault, others)
        if min(errors.values()) > _SAME and name == "irregular" and min(errors.values()) > _HALF * errors[worst]:
            return True, worst, name
        if measured <= _SAME:  # the other plan steps are executed almost exactly
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


@dataclass(eq=False)
class FailedEpisode:
    """A failed episode with a plan of S steps, its plain re-run of T states, and the results of further re-runs."""

    plan: ConditionalPlan
    plain: FinishedEpisode  # the re-run with nothing replaced
    truth: Tensor  # (T, S) bool, the exact answers
    answers: Tensor  # (T, S) bool, the answers that the policy acted on
    active: Tensor  # (T,) int64, the plan step with the largest weight; -1 where all weights are equal
    scripted: Motion  # the actions of the scripts and of the policy
    wrapped: Motion | None = None  # the actions of the innermost module and of the policy, if they differ
    executed: Motion | None = None  # the policy's actions with noise and the executed actions, if they differ
    misled: Finding | None = None
    differs: Finding | None = None  # the first difference between the rollout and the plain re-run
    step: int | None = None  # the only plan step in which a script replaces the policy, if one is tried
    # For each replacement that was tried: the re-run if it succeeded, otherwise None.
    results: dict[str, MendedEpisode | None] = field(default_factory=dict)

    @property
    def task(self) -> str:
        return self.plain.task

    @property
    def which(self) -> EpisodeId:
        return self.plain.task, self.plain.episode

    @property
    def late(self) -> int:
        """The number of final states that are assumed to show no progress: 100, or all states of a shorter episode."""
        return min(_LATE, len(self.active))

    @property
    def answers_wrong(self) -> float:
        """The fraction of states in which a condition was answered wrongly."""
        return float((self.answers != self.truth).any(-1).float().mean())

    @property
    def environment_differs(self) -> bool:
        first = self.differs
        return first is not None and first.kind in _OTHER_STATES and float(first.values["size"]) > _SAME_STATE

    @property
    def fails_elsewhere(self) -> bool:
        """Whether the environment differs between the rollout and the plain re-run, or the plain re-run succeeds."""
        return self.environment_differs or self.plain.first_success is not None

    def is_fixed(self, *names: str) -> bool:
        return any(self.results.get(name) is not None for name in names)

    def unlike(self, entries: Tensor) -> float:
        """Return the largest root-mean-square difference of a plan step between policy and scripts, in ``entries``."""
        return self.scripted.of(entries).error()


class Blame(NamedTuple):
    """The plan step and the state (``at``) at which a cause becomes visible, and the finding for that state."""

    step: int
    at: int
    finding: Finding


class Departures(NamedTuple):
    """A comparison of a plan with a reference plan in T states."""

    reference: ConditionalPlan
    departs: Tensor  # (T,) bool, whether the two plans request different actions
    ours: Tensor  # (T,) int64, the step that the plan chooses
    theirs: Tensor  # (T,) int64, the step that the reference chooses


def exact_answers(plan: ConditionalPlan, steps: TensorDictBase) -> Tensor:
    """Return the exact answers (T, S) bool to a plan's conditions in an episode's states."""
    return truth_of_episode(Plans([plan]), steps)[:, : len(plan.steps)]


def last_stay_start(states: Tensor) -> int:
    """Return where the last visit begins in the mask ``states`` (T,) bool; a visit may have gaps of up to 25 states."""
    places = states.nonzero().flatten()
    if not len(places):
        return len(states) - 1
    gaps = (places.diff() > _AWAY + 1).nonzero()
    return int(places[gaps[-1] + 1] if len(gaps) else places[0])


def stall_step(failed: FailedEpisode, step: int) -> int:
    """Return the state in which the hand stopped during the last visit to a plan step.

    If the hand did not stop, return the first state of the visit.
    """
    inside = failed.active == step
    begin = last_stay_start(inside)
    hand = failed.plain.steps.get("observation")[begin:, failed.plan.definition.layout.positions[0]]
    still = ((hand[_AHEAD:] - hand[:-_AHEAD]).norm(dim=-1) < _STILL) & inside[begin : begin + len(hand[_AHEAD:])]
    return begin + (int(still.int().argmax()) if still.any() else 0)


def last_active_step(failed: FailedEpisode) -> int:
    """Return the plan step that was active most often in the last 100 states, or the last step if none was active."""
    late = failed.active[-failed.late :]
    return int(torch.bincount(late[late >= 0]).argmax()) if (late >= 0).any() else len(failed.plan.steps) - 1


def blame_step(failed: FailedEpisode, scripts: Scripts, step: int) -> Blame:
    """Blame a plan step in which the episode got stuck."""
    states = int((failed.active == step)[-failed.late :].sum())
    values: dict[str, Any] = {"step": step, "skill": failed.plan.steps[step].skill, "states": states, "of": failed.late}
    distance = scripts.distance(failed.task, step, failed.plain.steps.get("observation")[-1])
    if distance is not None:
        values["distance_cm"] = 100 * distance
    return Blame(step, stall_step(failed, step), Finding("active step" if distance is None else "distant step", values))


def blame_answers(failed: FailedEpisode) -> Blame:
    """Blame the plan step with the most wrong answers, counting only those that changed the chosen step, if any did."""
    wrong, number = failed.answers != failed.truth, len(failed.plan.steps)
    changes = chosen(failed.answers, number) != chosen(failed.truth, number)
    matter = wrong & changes.unsqueeze(-1) if changes.any() else wrong
    step = int(matter.sum(0).argmax())
    here = wrong[:, step].int()
    values: dict[str, Any] = {"step": step, "condition": str(failed.plan.steps[step].condition)}
    values |= {"states": int(here.sum()), "of": len(here), "first": int(here.argmax())}
    finding = Finding("wrong answers", values)
    return Blame(step, int(matter[:, step].int().argmax()), finding)


def blame_plan(failed: FailedEpisode, compared: Departures) -> Blame:
    """Blame the plan step that departs from the reference most often in the last states, or else in all states."""
    reference, departs, ours, theirs = compared
    of = failed.late if departs[-failed.late :].any() else len(departs)
    where = departs.clone()
    where[:-of] = False
    step = int(torch.bincount(ours[where]).argmax())
    requested = reference.steps[int(torch.bincount(theirs[where & (ours == step)]).argmax())].skill
    kind = "no condition" if float((~failed.truth.any(-1))[where].float().mean()) > _HALF else "plan departs"
    values: dict[str, Any] = {"step": step, "skill": failed.plan.steps[step].skill, "reference": requested}
    finding = Finding(kind, values | {"states": int(where.sum()), "of": of})
    return Blame(step, last_stay_start(departs & (ours == step)), finding)


def departures(failed: FailedEpisode, scripts: Scripts, trusted: Scripts) -> Departures:
    """Compare the actions that a plan and the reference plan in ``trusted`` request in each state of an episode."""
    steps, plan, other = failed.plain.steps, failed.plan, trusted.plans[failed.task]
    ours, theirs = chosen(failed.truth, len(plan.steps)), chosen(exact_answers(other, steps), len(other.steps))
    inputs, rows = (steps.get("observation"), steps.get("task_id")), torch.arange(len(ours))
    done, wanted = scripts.program(*inputs)[rows, ours], trusted.program(*inputs)[rows, theirs]
    # If one of two skills has no script, compare their texts.
    same_text = torch.tensor([[a.skill == b.skill for b in other.steps] for a in plan.steps])[ours, theirs]
    scripted = scripts.has_script(failed.task)[ours] & trusted.has_script(failed.task)[theirs]
    departs = torch.where(scripted, (done - wanted).abs().amax(-1) > OTHER, ~same_text)
    return Departures(other, departs, ours, theirs)
