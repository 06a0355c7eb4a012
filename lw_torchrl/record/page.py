"""The page of an episode: the data that is logged, and its views, in a tab or in a column next to others."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lw_torchrl.language.relations import STATES
from lw_torchrl.record.entities import (
    EPISODE_TIMELINE,
    FALSE,
    GOLD,
    SECONDS_TIMELINE,
    STEEL,
    TRUE,
    Color,
    changes,
    entity_path,
    rr,
    rrb,
    step_color,
    time_columns,
)
from lw_torchrl.record.meshes import LoggedMeshes, Motion
from lw_torchrl.record.recorded_episode import NO_STEP, Ghost, RecordedEpisode
from lw_torchrl.record.scene import Point, eye_of, log_pictures, log_scene, touched_objects
from lw_torchrl.record.verdict import Heading, decisive_step, drawn_steps, log_curves, log_plan, shown_steps, verdict

NONE_HOLDS, EVENLY = "no condition holds", "evenly mixed"
OPEN, CLOSED, NOTHING = "open", "closed", "nothing"
_WRONG = "false, answered true", "true, answered false"
FAILED: Color = (215, 75, 75)
WRONG: Color = (200, 60, 140)
TOUCHES_CLOSED, TOUCHES_OPEN = (225, 130, 60), (150, 165, 220)
MANY_LANES = 9  # with more lanes, a small window has little room for the verdict
CURVES: dict[str, tuple[str, tuple[float, float] | None]] = {
    "distance": ("Distance to the target, cm", None),
    "action": ("Action", (-1.2, 1.2)),
    "reward": ("Reward", None),
    "skill_weights": ("Skill weights", (-0.1, 1.1)),
    "corrected": ("How much of the correction counts", (-0.1, 1.1)),
}
"""Each curve's title, and the range of its numbers where it is fixed."""


@dataclass
class Lanes:
    """Lanes below ``root``: a lane has an entry where its state changes, and an empty entry at the end.

    The viewer shows a lane's path as its title, with a backslash before anything but letters, digits and underscores,
    and sorts the lanes; so paths are short, and names begin with numbers.
    """

    root: str
    step_time: float
    states: dict[str, tuple[str, Color]] = field(default_factory=dict)  # text and colour, shared by a view's lanes
    paths: list[str] = field(default_factory=list)
    conditions: list[str] = field(default_factory=list)  # paths of the lanes of conditions

    def send(self, stream: Any, name: str, first: int, states: NDArray[np.str_], looks: Mapping[str, Any]) -> str:
        """Add a lane that begins at step ``first`` and return its path; ``looks`` are colours, or texts and colours."""
        for state, look in looks.items():
            self.states[state] = look if isinstance(look[0], str) else (state, look)
        rows = changes(states[:, None])
        entries = [*states[rows].tolist(), ""]
        times = time_columns(np.array([*rows, len(states)]) + first, self.step_time)
        # The viewer takes this apostrophe for a letter.
        path = self.root + entity_path(name.replace("'", "\u02bc").replace(" ", "_"))
        stream.send_columns(path, times, rr.StateChange.columns(state=entries))
        self.paths.append(path)
        return path


def log_lanes(
    stream: Any,
    root: str,
    episode: RecordedEpisode,
    ended: str,
    touched: Sequence[str] | None,
    ghost: Ghost | None,
) -> Lanes:
    """Log the lanes of an episode below ``root``; ``ended`` is its verdict, ``touched`` what its fingers touched."""
    lanes = Lanes(root, episode.step_time)
    widths = [a.shape[1] for a in (episode.qaf, episode.believed, episode.skill_weights) if a is not None]
    columns = max([len(episode.steps), *widths])
    digits = len(str(columns))
    if episode.success is not None:
        succeeded = episode.first_success is not None
        looks = {"success": TRUE, "not yet": FALSE} if succeeded else {ended: FAILED}
        states = np.where(episode.success, "success", "not yet" if succeeded else ended)
        lanes.send(stream, f"{0:0{digits}} verdict", 1, states, looks)
    if episode.active is not None:
        _log_active_step(stream, lanes, f"{0:0{digits}}b plan step", episode)
    if ghost is not None and ghost.episode.active is not None:
        _log_active_step(stream, lanes, f"{0:0{digits}}c ghost with {ghost.by}", ghost.episode, "ghost")
    for column in range(0 if episode.qaf is None else columns):
        assert episode.qaf is not None
        condition = episode.short_conditions[column] if episode.steps else "condition"
        truth = np.where(episode.qaf[:, column], "true", "false")
        if episode.believed is not None:
            believed = episode.believed[:, column]
            truth = np.where(believed != episode.qaf[:, column], np.where(believed, *_WRONG), truth)
        looks = {"true": TRUE, "false": FALSE, **dict.fromkeys(_WRONG, WRONG)}
        lanes.conditions.append(lanes.send(stream, f"{column + 1:0{digits}} {condition}", 0, truth, looks))
    if episode.opening is None:
        return lanes
    threshold = STATES[OPEN][0].threshold
    states = np.where(episode.opening > threshold, OPEN, CLOSED)
    looks = {OPEN: STEEL, CLOSED: GOLD}
    if touched is not None:
        objects = np.array(touched[: len(episode)])
        states = np.where(objects == NOTHING, states, np.char.add(np.char.add(states, ", touches "), objects))
        for state in np.unique(states[episode.opening > threshold]).tolist():
            looks.setdefault(state, TOUCHES_OPEN)
        for state in np.unique(states).tolist():
            looks.setdefault(state, TOUCHES_CLOSED)
    lanes.send(stream, "gripper", 0, states, looks)
    return lanes


def _log_active_step(stream: Any, lanes: Lanes, name: str, episode: RecordedEpisode, kind: str = "") -> None:
    """Log the active step, numbered from 1; the steps of another ``kind`` of plan have separate names."""
    assert episode.active is not None
    count = max(len(episode.steps), int(episode.active.max()) + 1)
    labels = [f"{i} {skill}" for i, (_, skill) in enumerate(episode.steps, 1)] or map(str, range(1, count + 1))
    looks: dict[str, Any] = {f"{kind}{i}": (label, step_color(i)) for i, label in enumerate(labels)}
    answered = True if episode.answers is None else episode.answers.any(axis=1)
    inactive = np.where(np.broadcast_to(answered, len(episode)), EVENLY, NONE_HOLDS)
    states = np.where(episode.active == NO_STEP, inactive, np.array([*looks, ""])[episode.active])
    lanes.send(stream, name, 0, states, looks | {NONE_HOLDS: FALSE, EVENLY: FALSE})


@dataclass(frozen=True)
class Page:
    """The part of an episode's data on which its views depend; it can be written as JSON."""

    root: str
    trails: Collection[str]  # entities that are shown up to the cursor
    eye: tuple[Point, Point]  # the position from which the scene is seen, and the position looked at
    has_scene: bool  # whether anything is drawn in 3-D
    shown: tuple[int, int]  # the first and last step to show
    decisive: int  # the step to open it at
    curves: Collection[str]
    lines: int  # of the plan's text, in a small window; 0 without a plan
    lanes: Sequence[str]  # their entities
    conditions: Sequence[str]  # entities of the lanes of conditions
    states: dict[str, tuple[str, Color]]  # of the lanes: text and colour
    farthest: float  # the largest distance to a skill's target, cm
    row: dict[str, Any]  # in the overview
    frames: dict[str, str]  # as log_motion returns them
    pictures: float  # width over height of the policy's pictures, 0 without any
    step_time: float  # seconds between two actions
    bounded: bool  # whether all actions are in [-1, 1]

    def title(self, policy: bool = True) -> str:
        """Return the tab's title: the episode's name, the policy unless it is left out, and how it ended."""
        ended = {"failed": "failed", "success": f"success at {self.row['at']}"}.get(self.row["ended"])
        if self.row["cause"]:
            ended = f"failed: {self.row['cause']}"
        return " · ".join(filter(None, [self.row["name"], self.row["policy"] if policy else None, ended]))

    def tab(self, title: str) -> rrb.Horizontal:
        """Return a tab with scene and curves on the left, texts and lanes on the right."""
        # Shares are the pixels that a view needs in a window of 1100×700; longer texts scroll.
        plan = 60 + 15 * self.lines if self.lines else 0
        scene: Any = self._scene()
        if not self.has_scene and self.pictures:
            scene = self._pictures()
        elif self.pictures:  # 0.3 of the width for one picture, 0.4 for two side by side
            share = min(0.2 + 0.1 * self.pictures, 0.5)
            scene = rrb.Horizontal(scene, self._pictures(), column_shares=[1 - share, share])
        left: list[tuple[float, Any]] = [(max(150, 500 - plan), scene)] if self.has_scene or self.pictures else []
        left += [(plan, self._text("plan", "Plan"))] if plan else []
        left += [(105, rrb.Tabs(*(self._curve(name) for name in CURVES if name in self.curves)))] if self.curves else []
        right = self._lanes(self.lanes)
        right.insert(0, (max(100, 605 - sum(share for share, _ in right)), self._text("verdict", "Verdict")))
        return rrb.Horizontal(_stacked(left), _stacked(right), column_shares=[9, 10], name=title)

    def column(self, title: str, shown: tuple[int, int], farthest: float) -> rrb.Vertical:
        """Return a column of verdict, scene, distance and main lanes; those of conditions are behind the scene."""
        page = replace(self, shown=shown, farthest=farthest)
        behind: list[Any] = [view for _, view in page._lanes(self.conditions, "What held")]
        below: list[tuple[float, Any]] = [(100, page._curve("distance"))] if "distance" in page.curves else []
        below += page._lanes([lane for lane in self.lanes if lane not in self.conditions])
        behind += [page._pictures()] if page.pictures else []
        scene = rrb.Tabs(page._scene(), *behind) if behind else page._scene()
        room = max(120, 487 - sum(share for share, _ in below))
        return _stacked([(118, page._text("verdict", title)), (room, scene), *below], title)

    def _scene(self) -> rrb.Spatial3DView:
        first, now = rr.TimeRangeBoundary.infinite(), rr.TimeRangeBoundary.cursor_relative()
        timelines = EPISODE_TIMELINE, SECONDS_TIMELINE
        trail = rrb.VisibleTimeRanges([rr.VisibleTimeRange(name, start=first, end=now) for name in timelines])
        overrides: dict[Any, Any] = {path: trail for path in self.trails}
        overrides |= {mesh: rr.CoordinateFrame(frame) for mesh, frame in self.frames.items() if frame}
        return rrb.Spatial3DView(
            origin=f"{self.root}/scene",
            contents=["$origin/**", *self.frames],
            name="Scene",
            line_grid=False,
            eye_controls=rrb.EyeControls3D(position=self.eye[0], look_target=self.eye[1]),
            overrides=overrides,
        )

    def _pictures(self) -> rrb.Spatial2DView:
        return rrb.Spatial2DView(origin=f"{self.root}/seen", name="What it saw")

    def _text(self, part: str, name: str) -> rrb.TextDocumentView:
        return rrb.TextDocumentView(origin=f"{self.root}/{part}", name=name)

    def _lanes(self, lanes: Sequence[str], name: str = "What went on") -> list[tuple[float, Any]]:
        if not lanes:
            return []
        labels, colors = zip(*self.states.values(), strict=True)
        styles = rr.StateConfiguration(values=list(self.states), labels=labels, colors=colors)
        origin = lanes[0].rpartition("/")[0]
        look = {"time_view": _window(self.shown), "defaults": [styles]}
        return [(50 + 40 * len(lanes), rrb.StateTimelineView(origin=origin, contents=lanes, name=name, **look))]

    def _curve(self, name: str) -> rrb.TimeSeriesView:
        title, limits = CURVES[name]
        limits = None if name == "action" and not self.bounded else limits
        if name == "distance":  # a small view has no room for the axis' numbers
            limits, title = (-0.05 * self.farthest, 1.05 * self.farthest), f"{title} (up to {self.farthest:.0f})"
        return rrb.TimeSeriesView(
            origin=f"{self.root}/{name}",
            name=title,
            axis_x=_window(self.shown),
            axis_y=None if limits is None else rrb.ScalarAxis(range=limits, zoom_lock=True),
        )


def _stacked(parts: Sequence[tuple[float, Any]], name: str | None = None) -> rrb.Vertical:
    return rrb.Vertical(*(view for _, view in parts), row_shares=[share for share, _ in parts], name=name)


def _window(shown: tuple[int, int]) -> Any:
    first, last = (rr.TimeRangeBoundary.absolute(seq=step) for step in shown)
    return rrb.TimeAxis(view_range=rr.TimeRange(start=first, end=last))


def send_page(
    stream: Any,
    number: int,
    name: str,
    heading: Heading,
    episode: RecordedEpisode,
    motion: Motion | None,
    ghost: Ghost | None,
    meshes: LoggedMeshes,
) -> Page:
    """Log the recording's ``number``-th episode, under ``name``, and return its page."""
    root = entity_path(name)
    touched = None if motion is None else touched_objects(motion, episode)
    lanes = log_lanes(stream, entity_path(f"e{number}"), episode, heading.ended(episode), touched, ghost)
    eye = eye_of(episode, motion)
    drawn = drawn_steps(heading, episode, ghost)
    trails, frames = log_scene(stream, root, episode, motion, meshes, drawn, eye, ghost)
    text = verdict(heading, episode, ghost, small=len(lanes.paths) > MANY_LANES)
    stream.log(f"{root}/verdict", rr.TextDocument(text, media_type="text/markdown"), static=True)
    return Page(
        root,
        trails=trails,
        eye=eye,
        has_scene=bool(episode.objects) or motion is not None,
        shown=shown_steps(heading, episode, ghost),
        decisive=decisive_step(heading, episode, ghost),
        curves=log_curves(stream, root, episode),
        lines=log_plan(stream, root, episode) if episode.steps else 0,
        lanes=lanes.paths,
        conditions=lanes.conditions,
        states=lanes.states,
        farthest=1.0 if episode.distance is None else max(1.0, 100 * float(np.nanmax(episode.distance))),
        row=heading.row(episode, name),
        frames=frames,
        pictures=log_pictures(stream, root, episode, drawn),
        step_time=episode.step_time,
        bounded=bool((abs(episode.action) <= 1).all()),
    )
