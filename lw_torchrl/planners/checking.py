"""check_plan: what a plan was taken for, and which of its conditions hold in the states of episodes."""

from dataclasses import dataclass

from torch import Tensor

from lw_torchrl.envs.episodes import FinishedEpisode
from lw_torchrl.evaluation.plan_use import PlanUse, TaskUse, expert_use
from lw_torchrl.evaluation.protocol import evaluate
from lw_torchrl.language.plan_decoding import DecodedPlan, decode_plan
from lw_torchrl.language.skills import Skills
from lw_torchrl.language.tasks import TASKS, Task, Tasks, get_task
from lw_torchrl.modules.scripted_skill_actor import ScriptedSkillActor

_GAPS = 3  # the longest are told of


@dataclass(frozen=True)
class PlanCheck:
    """What became of a plan."""

    task: str
    decoded: DecodedPlan  # what the text was taken for
    expert: TaskUse | None = None  # how its conditions fare in the states of Meta-World's expert; None without a plan
    own: TaskUse | None = None  # how its steps fare if scripted skills carry it out; None if they cannot
    success: float = 0.0  # the success rate of these episodes
    failed: tuple[Tensor, ...] = ()  # the observations of those that failed, (T, 39) float32

    @property
    def never(self) -> tuple[int, ...]:
        """The steps whose condition held in no state, neither the expert's nor its own, from 0."""
        if self.expert is None:
            return ()
        own = [0.0] * len(self.expert.true) if self.own is None else self.own.true
        return tuple(k for k, (a, b) in enumerate(zip(self.expert.true, own, strict=True)) if a == 0.0 and b == 0.0)

    def __str__(self) -> str:
        if self.decoded.plan is None:
            return "\n".join([f"{self.task}: no plan: {self.decoded.reason}", *map(str, self.decoded.notes)])
        assert self.expert is not None
        lines = [f"{self.task}, {len(self.decoded.plan.steps)} steps"]
        for k, step in enumerate(step for step in self.decoded.steps if not step.dropped):
            own = "" if self.own is None else f", {self.own.true[k]:.0%} of its own; acts in {self.own.chosen[k]:.0%}"
            lines += [
                f"{k + 1}  when {step.condition}{_said(step.written_condition, step.condition_distance)}",
                f"   {step.scripted or 'no scripted skill'}{_said(step.written_skill, step.skill_distance)}",
                f"   holds in {self.expert.true[k]:.0%} of the expert's states{own}",
            ]
        lines += [f"left out, {note}" for note in self.decoded.notes]
        lines.append(f"Some condition holds in {self.expert.covered:.0%} of the states up to the expert's success.")
        for episode, first, last in sorted(self.expert.gaps, key=lambda gap: gap[1] - gap[2])[:_GAPS]:
            steps = f"step {first}" if first == last else f"steps {first} to {last}"
            lines.append(f"No condition holds in {steps} of the expert's episode {episode}.")
        for k in self.never:
            lines.append(f"Step {k + 1} never fires: its condition held in no state that was visited.")
        if self.own is None:
            lines.append("Scripted skills cannot carry it out: a step's skill is near none of them.")
        else:
            lines.append(f"Carried out by scripted skills it succeeds in {self.success:.0%} of episodes.")
        return "\n".join(lines)


def _said(written: str, distance: float) -> str:
    return f"   <- {written!r} ({distance:.2f})" if distance else ""


def check_plan(
    text: str,
    task: str | Task,
    format: str,
    *,
    episodes: int = 5,
    seed: int = 0,
    skills: Skills | None = None,
    tasks: Tasks = TASKS,
) -> PlanCheck:
    """Decode a text, as :func:`~lw_torchrl.decode_plan`, and look where its plan's conditions hold.

    The task is one of Meta-World's; ``episodes`` and ``seed`` are the expert's, and of the plan by scripted skills.

    Example:
        >>> import lw_torchrl as lw
        >>> found = check_plan(lw.encode_plan(lw.load_plans("MT10")["reach"], "basic_md"), "reach", "basic_md")
        >>> found.never, found.expert.covered, found.success
        ((), 1.0, 1.0)
    """
    owner = get_task(task, tasks)
    decoded = decode_plan(text, owner, format, skills=skills, tasks=tasks)
    return check_decoded(decoded, owner, episodes=episodes, seed=seed, skills=skills)


def check_decoded(
    decoded: DecodedPlan, owner: Task, *, episodes: int = 5, seed: int = 0, skills: Skills | None = None
) -> PlanCheck:
    """As :func:`check_plan`, of what was made of a text; the task is ``owner``."""
    if decoded.plan is None:
        return PlanCheck(owner.name, decoded)
    expert = expert_use({owner.name: decoded.plan}, owner.name, episodes_per_task=episodes, seed=seed)[owner.name]
    if decoded.scripted is None or not decoded.all_scripted:
        return PlanCheck(owner.name, decoded, expert)
    use, failed = PlanUse({owner.name: decoded.scripted}), []

    def note(episode: FinishedEpisode) -> None:
        use(episode)
        if episode.first_success is None:
            failed.append(episode.steps.get("observation"))

    result = evaluate(
        ScriptedSkillActor({owner.name: decoded.scripted}, skills=skills),
        tasks=owner.name,
        episodes_per_task=episodes,
        seed=seed,
        noise_scale=0.0,
        stop_at_success=True,
        also_record=["observation", "qaf", "skill_weights"],
        on_episode=note,
        progress=False,
    )
    rate = result.success_once[owner.name] or 0.0
    return PlanCheck(owner.name, decoded, expert, use.tasks()[owner.name], rate, tuple(failed))
