"""Exchanges: which parts of a policy are exchanged in which failed episodes, and what each mends."""

from __future__ import annotations

import warnings
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from lw_torchrl._devices import device_of
from lw_torchrl.evaluation.swaps import Again, Which, WithScripts, with_true_answers
from lw_torchrl.evaluation.visited import Scripts, Visited, candidates
from lw_torchrl.language.plans import Plans
from lw_torchrl.language.skills import ScriptedSkill
from lw_torchrl.modules.networks import evaluating

TRIED_STEPS = 3
"""Steps in which a skill is exchanged, one at a time, before it is in all of them."""
_SAME = 0.02  # how far an action may be from the script's and still be the script's


class Exchanges:
    """Runs the exchanges, and keeps what each gave: its name to the episodes that it was tried in, and their first
    successful step."""

    def __init__(
        self,
        actor: Any,
        plans: Plans,
        evaluator: Any,
        reference: Plans | None,
        scripts: Scripts,
        table: Mapping[str, ScriptedSkill],
        again: Again,
    ) -> None:
        self.actor, self.plans, self.evaluator, self.scripts = actor, plans, evaluator, scripts
        self.table, self.again = table, again
        self.found: dict[str, dict[Which, int | None]] = {}
        self.step: dict[Which, int] = {}  # the step whose skill mends the episode
        self.reference, self.other, self.other_evaluator = reference, None, evaluator
        if reference is not None:
            self._carry_out(reference)

    def _carry_out(self, reference: Plans) -> None:
        """Prepare the exchange of plans, for the tasks in which there is one."""
        other = [reference[task] for task in reference.differences(self.plans)]
        self.reference = Plans(other) if other else None
        if self.reference is None:
            return
        try:
            self.other = self.actor.with_plans(self.reference)
            if hasattr(self.evaluator, "with_plans"):
                self.other_evaluator = self.evaluator.with_plans(self.reference)
        except (AttributeError, ImportError, RuntimeError, TypeError, ValueError) as error:
            self.reference = self.other = None
            warnings.warn(
                f"reference: the policy cannot carry it out, so no plan is exchanged ({type(error).__name__}: {error})",
                stacklevel=4,
            )

    def mends(self, name: str, which: Which) -> bool:
        return self.found.get(name, {}).get(which) is not None

    def _unmended(self, which: Sequence[Which], names: Iterable[str]) -> list[Which]:
        return [one for one in which if not any(self.mends(name, one) for name in names)]

    def run(self, seen: Sequence[Visited], same: Collection[Which] = ()) -> None:
        """All exchanges that are worth it.

        Args:
            seen: the episodes.
            same: those in whose states the reference never asks for anything else, so that it mends nothing.
        """
        every = [(one.task, one.episode) for one in seen]
        wrong = [w for w, one in zip(every, seen, strict=True) if bool((one.given != one.truth).any())]
        with_reference = [w for w in every if self.reference is not None and w[0] in self.reference]
        true = with_true_answers(self.actor)
        can_answer = self.evaluator is not None or true is not self.actor
        if can_answer:
            self._run("query", "true answers", wrong, true, self.plans)
        self._skills(seen)
        self._run("plan", "the reference plan", with_reference, self.other, self.reference, self.other_evaluator)
        left = self._unmended(every, ("query", "skill", "skills"))
        left = [one for one in left if one in same or not self.mends("plan", one)]
        self._run("time", "twice the time", left, self.actor, self.plans, self.evaluator, longer=2)
        left = self._unmended(left, ("time",))
        if can_answer:
            pair = [one for one in left if one in wrong]
            self._run("query + skill", "true answers and scripts", pair, self._scripted(true, self.plans), self.plans)
            if self.other is not None and self.reference is not None:
                both = [one for one in pair if one in with_reference]
                other = with_true_answers(self.other)
                self._run("query + plan", "true answers and the reference plan", both, other, self.reference)
        if self.other is not None and self.reference is not None:
            left = [one for one in self._unmended(left, ("query + skill", "query + plan")) if one in with_reference]
            other = self._scripted(self.other, self.reference)
            what = "the reference plan and scripts"
            self._run("plan + skill", what, left, other, self.reference, self.other_evaluator)

    def _run(
        self,
        name: str,
        what: str,
        which: Sequence[Which],
        actor: Any,
        plans: Plans | None,
        evaluator: Any = None,
        longer: int = 1,
    ) -> None:
        if which and actor is not None and plans is not None:
            self.found.setdefault(name, {}).update(self.again(what, which, actor, plans, evaluator, longer))

    def _scripted(self, actor: Any, plans: Plans, steps: Mapping[Which, int] | None = None) -> WithScripts:
        scripts = self.scripts if plans is self.plans else Scripts(plans, self.table)
        return WithScripts(actor, plans, scripts, steps)

    def _skills(self, seen: Sequence[Visited]) -> None:
        """Scripts in one step, for the likeliest steps in turn, then in all of them."""
        ranked = {}
        for one in seen:
            unlike = unlike_scripts(self.actor, one, self.scripts)
            if unlike is None or unlike.any():
                ranked[one.task, one.episode] = candidates(one, unlike)
        for turn in range(TRIED_STEPS):
            which = self._unmended([w for w, steps in ranked.items() if len(steps) > turn], ("skill",))
            steps = {one: ranked[one][turn] for one in which}
            what = f"scripts in a step ({turn + 1} of up to {TRIED_STEPS})"
            scripted = self._scripted(self.actor, self.plans, steps)
            self._run("skill", what, which, scripted, self.plans, self.evaluator)
            self.step.update({one: steps[one] for one in which if self.mends("skill", one)})
        which = self._unmended([w for w in ranked if len(self.plans[w[0]].steps) > 1], ("skill",))
        self._run(
            "skills", "scripts in all steps", which, self._scripted(self.actor, self.plans), self.plans, self.evaluator
        )

    def shares(self) -> dict[str, dict[str, float]]:
        """Task to the share of its failed episodes that each exchange mends, of those it was tried in."""
        found: dict[str, dict[str, float]] = {}
        for name, results in self.found.items():
            for task in {task for task, _ in results}:
                bits = [hit is not None for (of, _), hit in results.items() if of == task]
                found.setdefault(task, {})[name] = sum(bits) / len(bits)
        return found


def unlike_scripts(actor: Any, seen: Visited, scripts: Scripts) -> Tensor | None:
    """(T,) bool, the states in which the policy does something else than the scripted skills of the steps it is in.

    None where it cannot be asked, since it reads what was not recorded or draws its actions.
    """
    if getattr(actor, "draws", True):
        return None
    keys = [key for key in actor.in_keys if key != "qaf"]
    if any(seen.steps.get(key, None) is None for key in keys):
        return None
    states = seen.steps.select(*keys).clone()
    if "qaf" in actor.in_keys:
        width = actor.plans.num_steps
        states.set("qaf", torch.nn.functional.pad(seen.given, (0, width - seen.given.shape[1])))
    with torch.no_grad(), evaluating(actor):
        action = actor(states.to(device_of(actor))).get("action").cpu()
    program = scripts.program(seen.steps.get("observation"), seen.steps.get("task_id"))[:, : seen.weights.shape[1]]
    wanted = (seen.weights.unsqueeze(-1) * program).sum(-2)
    unscripted = ~torch.tensor(scripts.known[seen.task])[seen.in_force]
    return (seen.in_force >= 0) & (((action - wanted).abs().amax(-1) > _SAME) | unscripted)
