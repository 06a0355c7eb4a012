"""repair_plans: the model that wrote a plan is told what became of it, and writes another."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from lw_torchrl._checks import check_int
from lw_torchrl._files import AnyPath
from lw_torchrl._progress import Progress
from lw_torchrl.language.named_objects import GRIPPER
from lw_torchrl.language.tasks import TASKS, Task, Tasks, get_task
from lw_torchrl.planners.answers import CUT_OFF, Answer
from lw_torchrl.planners.checking import PlanCheck, check_decoded
from lw_torchrl.planners.openai_planner import OpenAIPlanner


@dataclass(frozen=True)
class Repair:
    """An answer and those that came in its place, one a round, with what became of each."""

    answers: tuple[Answer, ...]
    checks: tuple[PlanCheck, ...]

    @property
    def best(self) -> int:
        """The round whose plan succeeds most, the earliest of equals; 0 is the first answer."""
        rates = [check.success for check in self.checks]
        return rates.index(max(rates))


def plan_facts(check: PlanCheck, task: Task, notes: Sequence[str] = ()) -> str:
    """What became of a plan, in words for the model that wrote it; of the answer's ``notes``, that it was cut off.

    Example:
        >>> from lw_torchrl.language.tasks import TASKS
        >>> from lw_torchrl.planners.checking import check_plan
        >>> print(plan_facts(check_plan("I cannot.", "reach", "basic_py"), TASKS["reach"]))
        The answer was read, and no plan was found in it: it has no steps, neither for reach nor for another task.
        In the answer, line 1: is no part of a plan: 'I cannot.'
        Write the plan for `reach` again, the whole of it, in the same form, with this mended.
    """
    again = f"Write the plan for `{task.name}` again, the whole of it, in the same form, with this mended."
    unread = [f"The answer is too long: {note}." for note in notes if note == CUT_OFF]
    unread += [f"In the answer, {note}" for note in check.decoded.notes]
    if check.decoded.plan is None:
        reason = check.decoded.reason
        return "\n".join([f"The answer was read, and no plan was found in it: {reason}.", *unread, again])
    lines = [f"The plan was carried out, and succeeded in {check.success:.0%} of episodes."]
    if check.own is None:
        lines = ["The plan was not carried out: the robot has no skill that is near one of its steps."]
    lines += unread
    for step in check.never:
        condition = check.decoded.plan.steps[step].condition
        lines.append(f"The condition of step {step + 1}, '{condition}', held at no time.")
    if check.own is not None and check.own.failed:
        stuck = check.own.stuck.index(max(check.own.stuck))
        often = f"{check.own.stuck[stuck]} of {check.own.failed} failed episodes"
        lines.append(f"It got stuck in step {stuck + 1}, '{check.decoded.plan.steps[stuck].skill}', in {often}.")
        lines += _distances(task, check.failed)
    return "\n".join([*lines, again])


def _distances(task: Task, failed: Iterable[Tensor]) -> list[str]:
    """How near the gripper came to each thing, and things that move to those that stay: medians of failed episodes."""
    episodes = [task.published.positions(observation) for observation in failed]
    if not episodes:
        return []
    names = task.published.object_names
    moved = [name for name in names if any((one[name] - one[name][0]).norm(dim=-1).max() > 0.02 for one in episodes)]
    pairs = [(GRIPPER, name) for name in names if name != GRIPPER]
    pairs += [(a, b) for a in moved for b in names if GRIPPER not in (a, b) and b not in moved]
    lines = []
    for a, b in pairs:
        far = [(one[a] - one[b]).norm(dim=-1) for one in episodes]
        both = [distance.min() for distance in far], [distance[-1] for distance in far]
        least, last = (100 * float(torch.stack(listed).median()) for listed in both)
        lines.append(f"The {a} came within {least:.0f} cm of the {b}, and ended {last:.0f} cm from it.")
    return lines


def repair_plans(
    planner: OpenAIPlanner,
    answers: Iterable[Answer],
    *,
    rounds: int = 3,
    enough: float = 0.8,
    episodes: int = 10,
    seed: int = 0,
    tasks: Tasks = TASKS,
    out: AnyPath | None = None,
    progress: bool = True,
) -> list[Repair]:
    """Carry out plans, tell the model what became of those that fail, and ask for others, round by round.

    Every answer is kept in ``out``, where each round counts as a model.

    Args:
        planner: who wrote the answers.
        answers: its answers, of one format.
        rounds: at most.
        enough: the success rate from which a plan is left as it is.
        episodes, seed: in which scripted skills carry out plans. Compare repaired plans on another seed.
        tasks: where tasks' names are looked up.
        out: as for :meth:`OpenAIPlanner.revise`.
        progress: show progress bars.

    Raises:
        PlannerError: an answer did not come; those that came are kept.
    """
    check_int("rounds", rounds, minimum=1)
    first = list(answers)
    options: dict[str, Any] = {"episodes": episodes, "seed": seed, "skills": planner.skills}

    def check(answers: Sequence[Answer]) -> list[PlanCheck]:
        checks = []
        with Progress("carrying out", len(answers), "plan", show=progress) as bar:
            for answer in answers:
                checks.append(check_decoded(answer.decoded, get_task(answer.task, tasks), **options))
                bar.update()
        return checks

    found = [Repair((answer,), (checked,)) for answer, checked in zip(first, check(first), strict=True)]
    for number in range(1, rounds + 1):
        open_ = [k for k, one in enumerate(found) if one.checks[-1].success < enough]
        if not open_:
            break
        before = [found[k].answers[-1] for k in open_]
        checks = [found[k].checks[-1] for k in open_]
        facts = [plan_facts(one, tasks[of.task], of.notes) for one, of in zip(checks, before, strict=True)]
        came = planner.revise(before, facts, round=number, tasks=tasks, out=out, progress=progress)
        of = {(answer.task, answer.attempt): answer for answer in came}
        others = [of[answer.task, answer.attempt] for answer in before]
        for k, other, checked in zip(open_, others, check(others), strict=True):
            found[k] = Repair((*found[k].answers, other), (*found[k].checks, checked))
    return found
