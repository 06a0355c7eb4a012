"""The page of a recorded episode: its logged data and views, shown in a tab or next to another episode."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from textwrap import shorten
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lw_torchrl.language.outline import short_condition
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
LONGEST_LANE = 130  # maximum number of characters of a lane's title
MANY_LANES = 9  # with more timeline lanes, a small window has little room for the verdict
CURVES: dict[str, tuple[str, tuple[float, float] | None]] = {  # name -> title, and value range (None: not fixed)
    "distance": ("Distance to the target, cm", None),
    "action": ("Action", (-1.2, 1.2)),
    "reward": ("Reward", None),
    "skill_weights": ("Skill weights", (-0.1, 1.1)),
}


@dataclass
class Lanes:
    """The lanes (rows) of an episode's timeline view, logged below ``root``. A lane has an entry for each state change,
    and an empty entry at the end.

    The viewer sorts the lanes and uses their paths as titles, with a backslash before every character except letters,
    digits and underscores. Therefore paths are short, and names begin with numbers.
    """

    root: str
    step_time: float
    states: dict[str, tuple[str, Color]] = field(default_factory=dict)  # state -> (text, color), shared by all lanes
    paths: list[str] = field(default_factory=list)
    conditions: list[str] = field(default_factory=list)  # paths of the condition lanes

    def send(self, stream: Any, name: str, first: int, states: NDArray[np.str_], looks: Mapping[str, Any]) -> str:
        """Log a lane that begins at time step ``first`` and return the lane's path; ``looks`` maps each state to a
        color, or to a text and a color."""
        for state, look in looks.items():
            self.states[state] = look if isinstance(look[0], str) else (state, look)
        rows = changes(states[:, None])
        entries = [*states[rows].tolist(), ""]
        times = time_columns(np.array([*rows, len(states)]) + first, self.step_time)
        # The viewer treats this apostrophe as a letter.
        path = self.root + entity_path(name.replace("'", "\u02bc").replace(" ", "_"))
        stream.send_columns(path, times, rr.StateChange.columns(state=entries))
        self.paths.append(path)
        return path


def log_lanes(
    stream: Any, root: str, episode: RecordedEpisode, ended: str, touched: Sequence[str] | None, ghost: Ghost | None
) -> Lanes:
    """Log the timeline lanes of an episode below ``root``; ``ended`` is the verdict, and ``touched`` holds the object
    that the fingers touch in each row."""
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
        condition = short_condition(episode.guards[column]) if episode.steps else "condition"
        condition = shorten(condition, LONGEST_LANE, placeholder=" etc")
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
    """Log the active plan step (1-based) as a timeline lane; the prefix ``kind`` distinguishes two logged plans."""
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
    """The data of one episode, from which the views of its page are built; it can be written as JSON."""

    root: str
    trails: Collection[str]  # entities that are shown up to the time cursor
    eye: tuple[Point, Point]  # the camera position, and the position that the camera looks at
    has_scene: bool  # whether anything is drawn in 3-D
    shown: tuple[int, int]  # the first and last time step to show
    decisive: int  # the time step at which the page opens
    curves: Collection[str]
    lines: int  # number of lines of the plan text in a small window; 0 without a plan
    lanes: Sequence[str]  # entities of the timeline lanes
    conditions: Sequence[str]  # entities of the condition lanes
    states: dict[str, tuple[str, Color]]  # state -> (text, color), for all lanes
    farthest: float  # the largest distance to a skill's target, cm
    row: dict[str, Any]  # the episode's row in the overview table
    frames: dict[str, str]  # the result of log_motion
    pictures: float  # aspect ratio (width / height) of the policy's images; 0 without images
    step_time: float  # seconds between two actions
    bounded: bool  # whether all actions are in [-1, 1]

    def title(self, policy: bool = True) -> str:
        """Return the tab's title: the episode's name, the policy (if ``policy``), and the outcome."""
        ended = {"failed": "failed", "success": f"success at {self.row['at']}"}.get(self.row["ended"])
        if self.row["cause"]:
            ended = f"failed: {self.row['cause']}"
        return " · ".join(filter(None, [self.row["name"], self.row["policy"] if policy else None, ended]))

    def tab(self, title: str) -> rrb.Horizontal:
        """Return a tab with the scene, plan and curves on the left, and the verdict and timeline on the right."""
        # Shares are the heights in pixels that the views need in a window of 1100×700; longer texts scroll.
        plan = 60 + 15 * self.lines if self.lines else 0
        scene: Any = self._scene()
        if not self.has_scene and self.pictures:
            scene = self._pictures()
        elif self.pictures:  # 0.3 of the width for one image, 0.4 for two images side by side
            share = min(0.2 + 0.1 * self.pictures, 0.5)
            scene = rrb.Horizontal(scene, self._pictures(), column_shares=[1 - share, share])
        left: list[tuple[float, Any]] = [(max(150, 500 - plan), scene)] if self.has_scene or self.pictures else []
        texts = rrb.Tabs(self._text("plan", "Plan"), self._text("conditions", "Conditions in full"))
        left += [(plan, texts)] if plan else []
        left += [(105, rrb.Tabs(*(self._curve(name) for name in CURVES if name in self.curves)))] if self.curves else []
        right = self._lanes(self.lanes)
        right.insert(0, (max(100, 605 - sum(share for share, _ in right)), self._text("verdict", "Verdict")))
        return rrb.Horizontal(_stacked(left), _stacked(right), column_shares=[9, 10], name=title)

    def column(self, title: str, shown: tuple[int, int], farthest: float) -> rrb.Vertical:
        """Return a column with the verdict, scene, distance and main lanes; the condition lanes are in a tab behind the
        scene."""
        page = replace(self, shown=shown, farthest=farthest)
        behind: list[Any] = [view for _, view in page._lanes(self.conditions, "Conditions")]
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
        return rrb.Spatial2DView(origin=f"{self.root}/seen", name="Policy input")

    def _text(self, part: str, name: str) -> rrb.TextDocumentView:
        return rrb.TextDocumentView(origin=f"{self.root}/{part}", name=name)

    def _lanes(self, lanes: Sequence[str], name: str = "Timeline") -> list[tuple[float, Any]]:
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
        if name == "distance":  # a small view has no room for axis labels, so the range is in the title
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
    """Log the ``number``-th episode of a recording under ``name``, and return the episode's page."""
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
