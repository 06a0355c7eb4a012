"""The panels beside the scene (the plan's text, lanes, curves), and the layout that the viewer opens with."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lw_torchrl.record.recorded_episode import RecordedEpisode
from lw_torchrl.record.scene import Color
from lw_torchrl.record.timelines import (
    EPISODE_TIMELINE,
    METRIC_TIMELINE,
    SECONDS_TIMELINE,
    entity_path,
    time_columns,
)

if TYPE_CHECKING:
    import rerun.blueprint as rrb
    from rerun import RecordingStream

# From behind the robot's right shoulder, over a table whose middle is at (0, 0.6, 0).
EYE, TARGET = (0.54, 0.23, 0.46), (0.03, 0.63, 0.10)
BACKGROUND = (24, 27, 33)
TRUE, FALSE = (70, 170, 105), (52, 56, 64)
SERIES_COLORS = (
    (80, 170, 255),
    (255, 150, 70),
    (110, 215, 120),
    (225, 110, 225),
    (240, 215, 80),
    (100, 215, 215),
    (250, 110, 120),
    (170, 150, 250),
)
ACTION_NAMES = ("dx", "dy", "dz", "gripper")
EVENLY = "evenly mixed"


def log_plan(stream: RecordingStream, root: str, task: str, steps: Sequence[tuple[str, str]]) -> None:
    """The plan as a numbered list in ``root``/plan."""
    import rerun as rr

    lines = [f"### {task}", ""]
    lines += [f"{i}. if **{condition}**:  \n   {skill}" for i, (condition, skill) in enumerate(steps, 1)]
    document = rr.TextDocument("\n".join(lines) + "\n", media_type=rr.MediaType.MARKDOWN)
    stream.log(f"{root}/plan", document, static=True)


def log_curves(stream: RecordingStream, root: str, episode: RecordedEpisode) -> None:
    """The numbers over time: ``root``/action, and, where there are any, /skill_weights and /reward."""
    import rerun as rr

    rows = np.arange(len(episode))

    def send(name: str, steps: NDArray[np.int64], values: NDArray[np.float32], names: Sequence[str]) -> None:
        colors = [SERIES_COLORS[i % len(SERIES_COLORS)] for i in range(len(names))]
        stream.log(
            f"{root}/{name}",
            rr.SeriesLines(names=names, colors=colors, widths=[1.5] * len(names)),
            static=True,
        )
        columns = rr.Scalars.columns(scalars=values.ravel()).partition([values.shape[1]] * len(values))
        stream.send_columns(f"{root}/{name}", time_columns(steps), columns)

    send("action", rows, episode.action, ACTION_NAMES)
    if episode.skill_weights is not None:
        send("skill_weights", rows, episode.skill_weights, episode.skills)
    if episode.reward is not None:
        send("reward", rows + 1, episode.reward[:, None], ["reward"])


def log_lanes(stream: RecordingStream, root: str, episode: RecordedEpisode) -> int:
    """What holds when, under ``root``/lanes: "condition-1" and so on, "skill", "success".

    A lane has an entry where its state changes, and an empty one at the end. Returns the number of lanes.
    """
    import rerun as rr

    def send(lane: str, first: int, states: Sequence[str], styles: Mapping[str, tuple[str, Color]]) -> None:
        path = f"{root}/lanes{entity_path(lane)}"
        labels, colors = zip(*styles.values(), strict=True)
        stream.log(path, rr.StateConfiguration(values=list(styles), labels=labels, colors=colors), static=True)
        changes = [i for i in range(len(states)) if i == 0 or states[i] != states[i - 1]]
        entries = [*(states[i] for i in changes), ""]
        times = time_columns(np.array([*changes, len(states)]) + first)
        stream.send_columns(path, times, rr.StateChange.columns(state=entries))

    def truth(lane: str, first: int, values: NDArray[np.bool_], label: str) -> None:
        send(
            lane,
            first,
            np.where(values, "true", "false").tolist(),
            {"true": (f"✓ {label}", TRUE), "false": (f"✗ {label}", FALSE)},
        )

    if episode.qaf is not None:
        for i, column in enumerate(episode.qaf.T):
            truth(f"condition-{i + 1}", 0, column, episode.steps[i][0] if episode.steps else "true")
    if episode.skill_weights is not None:
        skills = episode.skills
        styles = {skill: (skill, SERIES_COLORS[i % len(SERIES_COLORS)]) for i, skill in enumerate(skills)}
        send("skill", 0, active_skill(episode.skill_weights, skills), styles | {EVENLY: (EVENLY, FALSE)})
    if episode.success is not None:
        truth("success", 1, episode.success, "success")
    conditions = 0 if episode.qaf is None else episode.qaf.shape[1]
    return conditions + (episode.skill_weights is not None) + (episode.success is not None)


def active_skill(skill_weights: NDArray[np.float32], skills: Sequence[str]) -> list[str]:
    """The skill of the largest weight (T×S) in each row; "evenly mixed" where all weights are equal."""
    even = (np.ptp(skill_weights, axis=1) < 1e-6) & (len(skills) > 1)
    return [EVENLY if e else skills[i] for e, i in zip(even, skill_weights.argmax(axis=1), strict=True)]


def episode_view(
    root: str, title: str, *, trails: Sequence[str], steps: int, lanes: int, skill_weights: bool
) -> rrb.Horizontal:
    """The views of one episode: the 3-D scene large above the actions, beside them plan, lanes and weights.

    Args:
        root: the episode's entity path, "/drawer-open".
        title: the tab's name.
        trails: the entity paths of what is drawn up to the time cursor.
        steps, lanes: the number of the plan's steps, and of lanes; 0 leaves the view out.
        skill_weights: whether there are any.
    """
    import rerun.blueprint as rrb

    trail = rrb.VisibleTimeRanges([_up_to_now(name) for name in (EPISODE_TIMELINE, SECONDS_TIMELINE)])
    scene = rrb.Spatial3DView(
        origin=f"{root}/scene",
        name="Scene",
        background=BACKGROUND,
        line_grid=False,
        eye_controls=rrb.EyeControls3D(position=EYE, look_target=TARGET, eye_up=(0.0, 0.0, 1.0)),
        overrides={path: trail for path in trails},
    )
    action = _curves(f"{root}/action", "Action", (-1.2, 1.2))
    left = rrb.Vertical(scene, action, row_shares=[3, 1])
    # Shares are about as many pixels as a view needs; what is longer scrolls.
    column: list[tuple[float, Any]] = []
    if steps:
        column.append((70 + 42 * min(steps, 6), rrb.TextDocumentView(origin=f"{root}/plan", name="Plan")))
    if lanes:
        name = "Truth of the conditions, and the active skill"
        column.append((45 + 40 * min(lanes, 8), rrb.StateTimelineView(origin=f"{root}/lanes", name=name)))
    if skill_weights:
        column.append((260, _curves(f"{root}/skill_weights", "Skill weights", (-0.1, 1.1))))
    if not column:
        return rrb.Horizontal(left, name=title)
    shares, views = zip(*column, strict=True)
    return rrb.Horizontal(left, rrb.Vertical(*views, row_shares=shares), column_shares=[11, 9], name=title)


def _up_to_now(timeline: str) -> Any:
    import rerun as rr

    return rr.VisibleTimeRange(
        timeline, start=rr.TimeRangeBoundary.infinite(), end=rr.TimeRangeBoundary.cursor_relative()
    )


def _curves(origin: str, name: str, limits: tuple[float, float]) -> rrb.TimeSeriesView:
    import rerun.blueprint as rrb

    return rrb.TimeSeriesView(
        origin=origin,
        name=name,
        axis_y=rrb.ScalarAxis(range=limits, zoom_lock=True),
        plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.RightTop, visible=True),
    )


def make_blueprint(episodes: Sequence[Any], others: Sequence[Any]) -> rrb.Blueprint:
    """The whole layout; the time panel plays episodes at Meta-World's 80 steps a second."""
    import rerun.blueprint as rrb

    timeline = EPISODE_TIMELINE if episodes else METRIC_TIMELINE
    return rrb.Blueprint(
        rrb.Tabs(*episodes, *others),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=timeline, fps=80.0, play_state="paused", loop_mode="all"),
        auto_views=False,
    )
