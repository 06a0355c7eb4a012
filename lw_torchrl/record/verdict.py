"""The texts and curves of an episode's page: heading, verdict, and the plan at the time cursor."""

from collections.abc import Sequence
from dataclasses import dataclass
from textwrap import shorten
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lw_torchrl._util.text import markdown
from lw_torchrl.evaluation.diagnose.failure import CAUSES, Failure, replacement_text
from lw_torchrl.language.layout import Layout
from lw_torchrl.language.outline import Line, outline
from lw_torchrl.record.entities import FALSE, STEEL, Color, changes, rr, step_color
from lw_torchrl.record.recorded_episode import NO_STEP, Ghost, RecordedEpisode

AFTER_SUCCESS, AROUND_FAILURE = 8, 60
"""The number of time steps to show after the first success, and before and after the first sign of a failure."""
LONGEST = 200  # maximum number of time steps to show from the ghost's divergence to the failure
LINE, MOST_LINES = 78, 2
"""The number of characters per line in a 1100×700 window, and the maximum number of lines for a condition."""
INDENT = "\u2003\u2003"
SPARSE = 8  # outside the shown range, the scene is drawn every 8th time step (a tenth of a second)
MARKS = {True: "✓", False: "✗", None: "·"}


@dataclass(frozen=True)
class Heading:
    """The heading of a page: the episode, the environment's seed, the policy, and the episode's failure."""

    task: str
    episode: int | None = None
    seed: int | None = None
    policy: str | None = None
    failure: Failure | None = None

    @property
    def name(self) -> str:
        """The episode's default name in a recording: "push", or "push-7"."""
        return self.task if self.episode is None else f"{self.task}-{self.episode}"

    def parts(self) -> list[str]:
        """Return the task, episode, seed and policy as texts, omitting unknown ones."""
        numbers = {"episode": self.episode, "seed": self.seed}
        known = [f"{name} {number}" for name, number in numbers.items() if number is not None]
        return [self.task, *known, *([] if self.policy is None else [self.policy])]

    def row(self, episode: RecordedEpisode, name: str) -> dict[str, Any]:
        """Return the overview row of an episode with the given name."""
        at = episode.first_success or len(episode)
        ended = "" if episode.success is None else "failed" if episode.first_success is None else "success"
        cause = self.failure.cause if self.failure is not None and ended == "failed" else None
        title = " · ".join([name if name != self.name else self.task, *self.parts()[1:2]])
        known = {"name": name, "title": title, "task": self.task, "episode": self.episode, "policy": self.policy}
        return known | {"ended": ended, "cause": cause, "at": at, "seconds": at * episode.step_time}

    def ended(self, episode: RecordedEpisode) -> str:
        """Return a short description of the episode's outcome."""
        if episode.first_success is not None:
            return f"SUCCESS at {episode.at(episode.first_success)} of {len(episode)}"
        if self.failure is None:
            return f"FAILED in {len(episode)} steps ({len(episode) * episode.step_time:.2f} s)"
        return f"FAILED: {self.failure.cause}, {CAUSES[self.failure.cause]}"


def decisive_step(heading: Heading, episode: RecordedEpisode, ghost: Ghost | None = None) -> int:
    """Return the time step at which a page opens: the failure, otherwise the first success, otherwise the last step.

    If that time step is not shown, or the ghost (the re-run episode) has not diverged by then, return the ghost's first
    success instead.
    """
    (_, last), step = shown_steps(heading, episode, ghost), _own_decisive_step(heading, episode)
    if ghost is None or ghost.episode.first_success is None or ghost.parts_at(episode) < step <= last:
        return step
    return min(ghost.episode.first_success, last)


def _own_decisive_step(heading: Heading, episode: RecordedEpisode) -> int:
    if heading.failure is not None and episode.first_success is None:
        return min(heading.failure.at, len(episode))
    return len(episode) if episode.first_success is None else episode.first_success


def shown_steps(heading: Heading, episode: RecordedEpisode, ghost: Ghost | None = None) -> tuple[int, int]:
    """Return the first and last time step to show: up to the first success, around the failure, or all steps.

    With a ghost, the range begins where the two episodes diverge, and ends at the ghost's success if the failure shows
    much later.
    """
    at, length = _own_decisive_step(heading, episode), len(episode)
    if ghost is not None:
        first, failed = max(0, ghost.parts_at(episode) - AFTER_SUCCESS), min(at + AFTER_SUCCESS, length)
        end = min((ghost.episode.first_success or len(ghost.episode)) + AFTER_SUCCESS, length)
        return first, max(end, failed if failed - first <= LONGEST else 0, min(first + 2 * AROUND_FAILURE, length))
    if episode.first_success is not None:
        return 0, min(at + AFTER_SUCCESS, length)
    if heading.failure is None:
        return 0, length
    first = max(0, min(at - AROUND_FAILURE, length - 2 * AROUND_FAILURE))
    return first, min(first + 2 * AROUND_FAILURE, length)


def drawn_steps(heading: Heading, episode: RecordedEpisode, ghost: Ghost | None) -> NDArray[np.int64]:
    """Return the time steps at which the scene is drawn.

    These are every step of the shown range (every second step if the range is long), every 8th step elsewhere, the
    decisive step and the last step.
    """
    first, last = shown_steps(heading, episode, ghost)
    steps, stride = np.arange(len(episode)), 1 if last - first <= AROUND_FAILURE else 2
    drawn = (steps >= first) & (steps <= last) & (steps % stride == 0) | (steps % SPARSE == 0)
    drawn[[min(decisive_step(heading, episode, ghost), len(episode) - 1), -1]] = True
    return np.flatnonzero(drawn)


def verdict(heading: Heading, episode: RecordedEpisode, ghost: Ghost | None = None, small: bool = False) -> str:
    """Return the verdict as Markdown, with a small heading if ``small``, otherwise a large heading."""
    lines = [f"{len(episode)} steps"] if episode.success is None else [heading.ended(episode)]
    if episode.success is not None and episode.success.any():
        if not episode.success[-1]:
            solved = int(episode.success.sum())
            lines.append(f"The success did not last: the task was solved in {solved} steps, but not in the last one.")
    elif heading.failure is not None:
        lines += _reasons(heading.failure, episode)
    elif episode.success is not None:
        lines += _observations(episode)
    if ghost is not None:
        end, parting = ghost.episode.first_success, ghost.parts_at(episode)
        ended = "does not succeed" if end is None else f"succeeds at {episode.at(end)}"
        text = f"**The blue ghost**, with {markdown(ghost.by)}, {ended}; the two diverge at **t = {parting}**."
        lines.insert(1, text)
    # Use single line breaks, because paragraphs would not fit into a small window.
    head = f"**{lines[0]}**  \n" if small else f"#### {lines[0]}\n\n"
    return head + "  \n".join([*lines[1:], " · ".join(map(markdown, heading.parts()))]) + "\n"


def _reasons(failure: Failure, episode: RecordedEpisode) -> list[str]:
    lines = [markdown(failure.why)] if failure.why else []
    if failure.also is not None:
        lines.append(f"Also: {failure.also}, {CAUSES[failure.also]}.")
    seen = f"Seen at {episode.at(failure.at)} of {len(episode)}"
    if failure.step is not None and failure.step < len(episode.steps):
        seen += f", in {_step(episode, failure.step)}"
    useless = [replacement_text(name, "removed") for name, helped in failure.counterfactuals.items() if not helped]
    useless_text = f" Replacing {' or '.join(useless)} did not help." if useless else ""
    return [*lines, f"{seen}.{useless_text}"]


def _observations(episode: RecordedEpisode) -> list[str]:
    """Describe a failed episode without an attributed cause: the last active plan step, the distance to that step's
    target, and the conditions that were never true."""
    if episode.active is None or not episode.steps:
        return []
    lines = []
    last = int(episode.active[-1])
    if last == NO_STEP:
        lines.append("At the end no single plan step was active.")
    else:
        steps = int((episode.active == last).sum())
        lines.append(f"At the end {_step(episode, last)}, was active, as in {steps} of {len(episode)} time steps.")
        pose = episode.target_poses[last] if episode.target_poses else None
        if pose is not None and not pose.relative:
            distance = np.where(episode.active == last, pose.distance, np.inf)
            closest, end = (f"{number * 100:.1f} cm" for number in (distance.min(), pose.distance[-1]))
            when = episode.at(int(distance.argmin()))
            lines.append(f"The smallest distance to the target was **{closest}**, at {when}; at the end it was {end}.")
    answers = episode.answers
    never = [] if answers is None else [i for i in range(len(episode.steps)) if not answers[:, i].any()]
    texts = [f"condition {i + 1}, “{markdown(episode.steps[i][0])}”" for i in never]
    return lines + ([f"Never true: {'; '.join(texts)}."] if texts else [])


def _step(episode: RecordedEpisode, step: int) -> str:
    return f"plan step {step + 1}, **“{markdown(episode.steps[step][1])}”**"


def log_plan(stream: Any, root: str, episode: RecordedEpisode) -> int:
    """Log the plan to ``root``/plan as Markdown, for each time step in which a condition or the active step changes.

    The steps are nested below the conditions that they share, and the branches above the active step are bold. Log the
    conditions in full to ``root``/conditions. Return the number of lines of the plan in a small window.
    """
    active = np.full(len(episode), NO_STEP) if episode.active is None else episode.active
    answers = [answers for answers in (episode.qaf, episode.believed) if answers is not None]
    rows = changes(np.concatenate([active[:, None], *answers], axis=1))
    lines = _plan_lines(episode)
    texts = []
    for row in rows.tolist():
        parts = list[str]()
        if episode.active is not None and episode.active[row] == NO_STEP:
            none = episode.answers is None or not episode.answers[row].any()
            parts.append(f"**{'No condition holds' if none else 'No step stands out'}: all steps mixed**")
        for line, text in lines:
            step, is_active, indent = line.steps[0], active[row] in line.steps, INDENT * line.depth
            if not line.head:
                truth = None if episode.qaf is None else bool(episode.qaf[row, step])
                text = f"{MARKS[truth]}  {'→ ' if is_active else ''}{text}"
                if episode.believed is not None and (believed := bool(episode.believed[row, step])) != truth:
                    text += f"  (evaluator: {MARKS[believed]})"
            parts.append(f"{indent}**{text}**" if is_active else f"{indent}{text}")
            reason = markdown(episode.reasons[step]) if episode.reasons and is_active and not line.head else ""
            parts += [f"{indent}{INDENT}*{reason}*"] if reason else []
        texts.append("  \n".join(parts))
    documents = rr.TextDocument.columns(text=texts, media_type=[rr.MediaType.MARKDOWN] * len(texts))
    stream.send_columns(f"{root}/plan", episode.times(rows), documents)
    texts = [f"{i}.  if {markdown(c)}  \n{INDENT}{markdown(skill)}" for i, (c, skill) in enumerate(episode.steps, 1)]
    full = rr.TextDocument("  \n".join(texts), media_type=rr.MediaType.MARKDOWN)
    stream.log(f"{root}/conditions", full, static=True)
    reasons = [max(episode.reasons, key=len, default="")]
    return sum(-(-len(text) // LINE) for text in [INDENT * line.depth + text for line, text in lines] + reasons)


def _plan_lines(episode: RecordedEpisode) -> list[tuple[Line, str]]:
    """Return the lines of the plan's outline, each with its text; long conditions are shortened."""
    lines = []
    for line in outline(episode.guards):
        step = line.steps[0]
        text = shorten(str(line), MOST_LINES * LINE, placeholder=" …") if line.head else episode.steps[step][1]
        lines.append((line, ("" if line.head else f"{step + 1}.  ") + markdown(text)))
    return lines


def log_curves(stream: Any, root: str, episode: RecordedEpisode) -> list[str]:
    """Log the curves ``root``/action, /distance (cm), /reward and /skill_weights; return the names of the
    logged curves."""
    rows, logged = np.arange(len(episode)), []

    def send(name: str, values: NDArray[Any], names: Sequence[str], *color: Color, later: int = 0) -> None:
        colors = list(color) or [step_color(i) for i in range(len(names))]
        stream.log(f"{root}/{name}", rr.SeriesLines(names=names, colors=colors), static=True)
        columns = rr.Scalars.columns(scalars=values.ravel()).partition([values.shape[1]] * len(values))
        stream.send_columns(f"{root}/{name}", episode.times(rows + later), columns)
        logged.append(name)

    if numbers := episode.action.shape[1]:
        send("action", episode.action, action_names(episode.layout) if episode.layout else [*map(str, range(numbers))])
    if (distance := episode.distance) is not None:
        # One line in centimetres, in the color of the active plan step.
        assert episode.active is not None
        steps = range(int(episode.active.max()) + 1)
        colors = np.array([*map(step_color, steps), FALSE], np.uint8)[episode.active]  # NO_STEP is -1: the last color
        columns = [*rr.Scalars.columns(scalars=distance * 100), *rr.SeriesLines.columns(colors=colors)]
        stream.send_columns(f"{root}/distance", episode.times(rows), columns)
        logged.append("distance")
    # A sparse reward equals the success, which already has a lane in the timeline.
    reward: Any = episode.reward
    if reward is not None and not (episode.success is not None and np.array_equal(reward, episode.success)):
        send("reward", reward[:, None], ["reward"], STEEL, later=1)
    weights = episode.skill_weights
    if weights is not None and bool(((weights > 1e-3) & (weights < 1 - 1e-3)).any()):  # else the timeline suffices
        texts = [f" {skill}" for _, skill in episode.steps] or [""] * weights.shape[1]
        send("skill_weights", weights, [f"{i}{text}" for i, text in enumerate(texts, 1)])
    return logged


def action_names(layout: Layout) -> list[str]:
    """Return a name for each of the A values of an action: "dx", "dy", "dz", "gripper", or the index."""
    names = [*map(str, range(layout.action_size))]
    if layout.displacement is not None:
        names[layout.displacement : layout.displacement + 3] = "dx", "dy", "dz"
    if layout.gripper is not None:
        names[layout.gripper] = "gripper"
    return names
