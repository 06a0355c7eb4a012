"""The page of an episode: all that is logged of it, and how its views lie."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Any

from lw_torchrl.record.conventions import BACKGROUND, EPISODE_TIMELINE, SECONDS_TIMELINE, Stream, entity_path, rr, rrb
from lw_torchrl.record.mujoco_scene import Motion
from lw_torchrl.record.recorded_episode import RecordedEpisode
from lw_torchrl.record.scene import log_scene
from lw_torchrl.record.timeline import log_curves, log_plan, log_timeline
from lw_torchrl.record.verdict import Heading, decisive_step, telling_steps, verdict

Point = tuple[float, float, float]

# From behind the robot's right shoulder, over a table whose middle is at (0, 0.6, 0); with the arm, from the front.
SIMPLE_EYE: tuple[Point, Point] = ((0.54, 0.23, 0.46), (0.03, 0.63, 0.10))
ROBOT_EYE: tuple[Point, Point] = ((0.54, 0.18, 0.47), (-0.02, 0.62, 0.13))

CURVES: dict[str, tuple[str, int, tuple[float, float] | None]] = {
    "distance": ("Distance of what the skill moves from where it goes, cm", 3, None),
    "action": ("Action", 4, (-1.2, 1.2)),
    "reward": ("Reward", 2, None),
    "skill_weights": ("Skill weights", 4, (-0.1, 1.1)),
    "corrected": ("How much of the correction counts", 2, (-0.1, 1.1)),
}
"""Each curve's title, its share of the height, and the range of its numbers where they have one."""


@dataclass(frozen=True)
class Page:
    """What was logged of an episode, as far as its views depend on it."""

    root: str
    title: str
    trails: Collection[str]  # entities that are shown up to the cursor
    eye: tuple[Point, Point]  # where the scene is seen from, and what is looked at
    shown: tuple[int, int]  # the first and last step worth a look
    decisive: int  # the step to open it at
    curves: Collection[str]
    steps: int  # of the plan
    rows: int  # of the timeline
    good: bool

    def tab(self) -> rrb.Horizontal:
        """Scene and curves on the left, words and timeline on the right."""
        left: list[tuple[float, Any]] = [(13, self._scene())]
        left += [(share, self._curve(name)) for name, (_, share, _) in CURVES.items() if name in self.curves]
        # Shares are about as many pixels as a view needs; what is longer scrolls.
        right: list[tuple[float, Any]] = [(115 if self.good else 215, self._words("verdict", "Verdict"))]
        if self.steps:
            right.append((70 + 58 * min(self.steps, 6), self._words("plan", "Plan")))
        right += self._timeline()
        return rrb.Horizontal(_stacked(left), _stacked(right), column_shares=[6, 5], name=self.title)

    def column(self, shown: tuple[int, int]) -> rrb.Vertical:
        """Verdict, scene, timeline and distance in a column, beside others that show the same steps."""
        page = replace(self, shown=shown)
        parts: list[tuple[float, Any]] = [(130, page._words("verdict", self.title)), (420, page._scene())]
        if "distance" in page.curves:
            parts.append((120, page._curve("distance")))
        parts += page._timeline()
        return _stacked(parts, self.title)

    def _scene(self) -> rrb.Spatial3DView:
        first, now = rr.TimeRangeBoundary.infinite(), rr.TimeRangeBoundary.cursor_relative()
        timelines = EPISODE_TIMELINE, SECONDS_TIMELINE
        trail = rrb.VisibleTimeRanges([rr.VisibleTimeRange(name, start=first, end=now) for name in timelines])
        return rrb.Spatial3DView(
            origin=f"{self.root}/scene",
            name="Scene",
            background=BACKGROUND,
            line_grid=False,
            eye_controls=rrb.EyeControls3D(position=self.eye[0], look_target=self.eye[1], eye_up=(0.0, 0.0, 1.0)),
            overrides={path: trail for path in self.trails},
        )

    def _words(self, part: str, name: str) -> rrb.TextDocumentView:
        return rrb.TextDocumentView(origin=f"{self.root}/{part}", name=name)

    def _timeline(self) -> list[tuple[float, Any]]:
        if not self.rows:
            return []
        origin, name = f"{self.root}/timeline", "The step in force, and what holds"
        view = rrb.StateTimelineView(origin=origin, name=name, time_view=_window(self.shown))
        return [(50 + 40 * min(self.rows, 8), view)]

    def _curve(self, name: str) -> rrb.TimeSeriesView:
        title, _, limits = CURVES[name]
        many = name in ("action", "skill_weights")
        return rrb.TimeSeriesView(
            origin=f"{self.root}/{name}",
            name=title,
            axis_x=_window(self.shown),
            axis_y=None if limits is None else rrb.ScalarAxis(range=limits, zoom_lock=True),
            plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.RightTop, visible=many),
        )


def _stacked(parts: Sequence[tuple[float, Any]], name: str | None = None) -> rrb.Vertical:
    """Views with their shares of the height, one below another."""
    return rrb.Vertical(*(view for _, view in parts), row_shares=[share for share, _ in parts], name=name)


def side_by_side(pages: Sequence[Page], title: str) -> rrb.Horizontal:
    """Episodes beside one another, a column each."""
    shown = min(page.shown[0] for page in pages), max(page.shown[1] for page in pages)
    return rrb.Horizontal(*(page.column(shown) for page in pages), name=title)


def send_page(
    stream: Stream, name: str, title: str, heading: Heading, episode: RecordedEpisode, motion: Motion | None
) -> Page:
    """Log an episode under ``name``; what its views, a tab called ``title``, are to show."""
    root = entity_path(name)
    trails = log_scene(stream, root, episode, motion)
    stream.log(f"{root}/verdict", rr.TextDocument(verdict(heading, episode), media_type="text/markdown"), static=True)
    if episode.steps:
        log_plan(stream, root, episode)
    return Page(
        root,
        title,
        trails=trails,
        eye=SIMPLE_EYE if motion is None else ROBOT_EYE,
        shown=telling_steps(heading, episode),
        decisive=decisive_step(heading, episode),
        curves=log_curves(stream, root, episode),
        steps=len(episode.steps),
        rows=log_timeline(stream, root, episode),
        good=episode.first_success is not None,
    )


def _window(shown: tuple[int, int]) -> Any:
    first, last = (rr.TimeRangeBoundary.absolute(seq=step) for step in shown)
    return rrb.TimeAxis(view_range=rr.TimeRange(start=first, end=last))
