"""Check plans in the simulator, and repair them by reporting failures to the model that wrote them."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from lw_torchrl._util.checks import Count, check_value
from lw_torchrl._util.files import AnyPath
from lw_torchrl._util.progress import Progress
from lw_torchrl.envs.episodes import FinishedEpisode
from lw_torchrl.evaluation.plan_use import PlanUse, TaskUse, expert_use
from lw_torchrl.evaluation.protocol import evaluate
from lw_torchrl.language.objects import GRIPPER
from lw_torchrl.language.plan_decoding import DecodedPlan, decode_plan
from lw_torchrl.language.skills import Skills
from lw_torchrl.language.tasks import TASKS, Task, Tasks, get_task
from lw_torchrl.modules.scripted_skill_actor import ScriptedSkillActor
from lw_torchrl.planners.answer_files import CUT_OFF, Answer
from lw_torchrl.planners.openai_planner import OpenAIPlanner

_GAPS = 3  # number of gaps (runs of steps without a true condition) to print, longest first


@dataclass(frozen=True)
class PlanCheck:
    """A report on how a plan was decoded and how it performs in the simulator."""

    task: str
    decoded: DecodedPlan
    expert: TaskUse | None = None  # how often conditions hold in the expert's states; None without a plan
    own: TaskUse | None = None  # how often they hold in the plan's own episodes; None if a step lacks a scripted skill
    success: float = 0.0  # success rate with scripted skills
    failed: tuple[Tensor, ...] = ()  # observations (T, 39) float32 of each failed episode

    @property
    def never(self) -> tuple[int, ...]:
        """The plan steps (from 0) whose condition was never true, either in the expert's or in the plan's episodes."""
        if self.expert is None:
            return ()
        own = [0.0] * len(self.expert.true) if self.own is None else self.own.true
        return tuple(k for k, (a, b) in enumerate(zip(self.expert.true, own, strict=True)) if a == 0.0 and b == 0.0)

    def __str__(self) -> str:
        if self.decoded.plan is None or self.expert is None:
            return "\n".join([f"{self.task}: no plan: {self.decoded.reason}", *map(str, self.decoded.notes)])
        lines = [f"{self.task}, {len(self.decoded.plan.steps)} steps"]
        for k, step in enumerate(step for step in self.decoded.steps if not step.dropped):
            use = self.own
            own = "" if use is None else f" and {use.true[k]:.0%} of the plan's (chosen in {use.chosen[k]:.0%})"
            lines += [
                f"{k + 1}  when {step.condition}{_written(step.written_condition, step.condition_distance)}",
                f"   {step.scripted or 'no scripted skill'}{_written(step.written_skill, step.skill_distance)}",
                f"   holds in {self.expert.true[k]:.0%} of the expert's states{own}",
            ]
        lines += [f"left out, {note}" for note in self.decoded.notes]
        lines.append(f"In {self.expert.covered:.0%} of states up to the expert's success, some condition holds.")
        for episode, first, last in sorted(self.expert.gaps, key=lambda gap: gap[1] - gap[2])[:_GAPS]:
            steps = f"step {first}" if first == last else f"steps {first} to {last}"
            lines.append(f"No condition holds in {steps} of the expert's episode {episode}.")
        lines += [f"Step {k + 1} never fires: its condition was false in every visited state." for k in self.never]
        if self.own is None:
            lines.append("Scripted skills cannot carry out the plan: a step has no scripted skill.")
        else:
            lines.append(f"With scripted skills the plan succeeds in {self.success:.0%} of episodes.")
        return "\n".join(lines)


def _written(text: str, distance: float) -> str:
    """Return a remark with the original text and its distance; "" if the text was not replaced."""
    return f"   <- {text!r} ({distance:.2f})" if distance else ""


def try_plan(
    text: str,
    task: str | Task,
    format: str,
    *,
    episodes: int = 5,
    seed: int = 0,
    skills: Skills | None = None,
    tasks: Tasks = TASKS,
) -> PlanCheck:
    """Decode a plan with :func:`~lw_torchrl.decode_plan`, and run it in the simulator to check its conditions.

    The task must be from Meta-World. The expert and the plan (with scripted skills) run ``episodes`` episodes each.

    Example:
        >>> import lw_torchrl as lw
        >>> check = try_plan(lw.encode_plan(lw.load_plans("MT10")["reach"], "basic_md"), "reach", "basic_md")
        >>> check.never, check.expert.covered, check.success
        ((), 1.0, 1.0)
    """
    task = get_task(task, tasks)
    return _try_decoded(decode_plan(text, task, format, skills=skills, tasks=tasks), task, episodes, seed, skills)


def _try_decoded(decoded: DecodedPlan, task: Task, episodes: int, seed: int, skills: Skills | None) -> PlanCheck:
    if decoded.plan is None:
        return PlanCheck(task.name, decoded)
    expert = expert_use({task.name: decoded.plan}, task.name, episodes_per_task=episodes, seed=seed)[task.name]
    if decoded.scripted is None or not decoded.all_scripted:
        return PlanCheck(task.name, decoded, expert)
    use, failed = PlanUse({task.name: decoded.scripted}), []

    def on_episode(episode: FinishedEpisode) -> None:
        use(episode)
        if episode.first_success is None:
            failed.append(episode.steps.get("observation"))

    result = evaluate(
        ScriptedSkillActor({task.name: decoded.scripted}, skills=skills),
        tasks=task.name,
        episodes_per_task=episodes,
        seed=seed,
        noise_scale=0.0,
        stop_at_success=True,
        also_record=["observation", "qaf", "skill_weights"],
        on_episode=on_episode,
        progress=False,
    )
    success = result.success_once[task.name] or 0.0
    return PlanCheck(task.name, decoded, expert, use.tasks()[task.name], success, tuple(failed))


@dataclass(frozen=True)
class Repair:
    """An answer, its revisions (one per round), and the checks of the answer and of each revision."""

    answers: tuple[Answer, ...]
    checks: tuple[PlanCheck, ...]


def plan_facts(check: PlanCheck, task: Task, notes: Sequence[str] = ()) -> str:
    """Write a report for the model on how its plan performed.

    If ``notes`` state that the answer was cut off, the report repeats this. Other notes are ignored.

    Example:
        >>> from lw_torchrl.language.tasks import TASKS
        >>> print(plan_facts(try_plan("I cannot.", "reach", "basic_py"), TASKS["reach"]))
        The answer was read, and no plan was found in it: the text has no steps for reach or any other task.
        In the answer, line 1: the text is not part of a plan: 'I cannot.'
        Write the plan for `reach` again, the whole of it, in the same form, with this corrected.
    """
    again = f"Write the plan for `{task.name}` again, the whole of it, in the same form, with this corrected."
    unread = [f"The answer is too long: {note}." for note in notes if note == CUT_OFF]
    unread += [f"In the answer, {note}" for note in check.decoded.notes]
    if check.decoded.plan is None:
        reason = check.decoded.reason
        return "\n".join([f"The answer was read, and no plan was found in it: {reason}.", *unread, again])
    carried_out = f"The plan was carried out, and succeeded in {check.success:.0%} of episodes."
    no_skill = "The plan was not carried out: the robot has no skill that is near one of its steps."
    lines = [no_skill if check.own is None else carried_out, *unread]
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
    """Report the minimum and final distances (cm) between gripper and objects, as medians over failed episodes."""
    episodes = [task.published.positions(observation) for observation in failed]
    if not episodes:
        return []
    names = task.published.object_names
    moved = [name for name in names if any((at[name] - at[name][0]).norm(dim=-1).max() > 0.02 for at in episodes)]
    pairs = [(GRIPPER, name) for name in names if name != GRIPPER]
    pairs += [(a, b) for a in moved for b in names if GRIPPER not in (a, b) and b not in moved]
    lines = []
    for a, b in pairs:
        distances = [(at[a] - at[b]).norm(dim=-1) for at in episodes]
        both = [distance.min() for distance in distances], [distance[-1] for distance in distances]
        least, last = (100 * float(torch.stack(values).median()) for values in both)
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
    """Run plans in the simulator, report failures to the model and request revised plans, round by round.

    Args:
        planner: the planner that wrote the answers.
        answers: the planner's answers, all in one format.
        rounds: maximum number of rounds.
        enough: the success rate (0 to 1) at which a plan is good enough and is not revised.
        episodes, seed: number and seed of the episodes that check each plan; use a different seed for evaluation.
        tasks, out, progress: see :meth:`OpenAIPlanner.revise`.
    """
    check_value("rounds", rounds, Count)

    def run(answers: Sequence[Answer]) -> list[PlanCheck]:
        checks = []
        with Progress("carrying out", len(answers), "plan", show=progress) as bar:
            for answer in answers:
                task = get_task(answer.task, tasks)
                checks.append(_try_decoded(answer.decoded, task, episodes, seed, planner.skills))
                bar.update()
        return checks

    first = list(answers)
    repairs = [Repair((answer,), (check,)) for answer, check in zip(first, run(first), strict=True)]
    for number in range(1, rounds + 1):
        failing = [k for k, repair in enumerate(repairs) if repair.checks[-1].success < enough]
        if not failing:
            break
        before = [repairs[k].answers[-1] for k in failing]
        facts = [
            plan_facts(repairs[k].checks[-1], get_task(answer.task, tasks), answer.notes)
            for k, answer in zip(failing, before, strict=True)
        ]
        answered = planner.revise(before, facts, round=number, tasks=tasks, out=out, progress=progress)
        revised = {(answer.task, answer.attempt): answer for answer in answered}
        after = [revised[answer.task, answer.attempt] for answer in before]
        for k, answer, check in zip(failing, after, run(after), strict=True):
            repairs[k] = Repair((*repairs[k].answers, answer), (*repairs[k].checks, check))
    return repairs
