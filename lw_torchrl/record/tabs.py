"""The layout of a recording: the pages of episodes, the tabs of them and of training, and which one a viewer opens."""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple

from lw_torchrl._checks import unknown_name
from lw_torchrl.record.conventions import (
    EPISODE_TIMELINE,
    METRIC_TIMELINE,
    SECONDS_TIMELINE,
    Color,
    entity_path,
    rr,
    rrb,
)
from lw_torchrl.record.lanes import log_lanes
from lw_torchrl.record.meshes import Known, Motion
from lw_torchrl.record.overview import OVERVIEW, place, table
from lw_torchrl.record.recorded_episode import MendedRecording, RecordedEpisode
from lw_torchrl.record.scene import Point, log_pictures, log_scene, touched_things
from lw_torchrl.record.verdict import (
    Heading,
    decisive_step,
    drawn_steps,
    farthest,
    log_curves,
    log_plan,
    telling_steps,
    verdict,
)

MANY_LANES = 9  # beside more, a small window has little room for the verdict
_CONDITION = re.compile(r"/0*[1-9]\d*_[^/]*$")  # how lanes of conditions are called, as log_lanes has it

# From behind the robot's right shoulder, over a table whose middle is at (0, 0.6, 0); with the arm, from the front.
SIMPLE_EYE: tuple[Point, Point] = ((0.54, 0.23, 0.46), (0.03, 0.63, 0.10))
ROBOT_EYE: tuple[Point, Point] = ((0.54, 0.18, 0.47), (-0.02, 0.62, 0.13))

CURVES: dict[str, tuple[str, tuple[float, float] | None]] = {
    "distance": ("Distance to the target, cm", None),
    "action": ("Action", (-1.2, 1.2)),
    "reward": ("Reward", None),
    "skill_weights": ("Skill weights", (-0.1, 1.1)),
    "corrected": ("How much of the correction counts", (-0.1, 1.1)),
}
"""Each curve's title, and the range of its numbers where they have one."""


@dataclass(frozen=True)
class Page:
    """What was logged of an episode, as far as its views depend on it."""

    root: str
    trails: Collection[str]  # entities that are shown up to the cursor
    eye: tuple[Point, Point]  # where the scene is seen from, and what is looked at
    shown: tuple[int, int]  # the first and last step worth a look
    decisive: int  # the step to open it at
    curves: Collection[str]
    lines: int  # of the plan's text, in a small window; 0 where there is no plan
    lanes: Sequence[str]  # their entities
    states: dict[str, tuple[str, Color]]  # of the lanes: words and colour
    farthest: float  # of the distances, cm
    row: dict[str, Any]  # in the overview
    frames: dict[str, str]  # as log_motion gives them
    pictures: float  # what the policy saw: width over height, 0 where it saw none

    def title(self, policy: bool = True) -> str:
        """The tab's: the episode's name, who acted if that is to be said, and how it ended, if that is known."""
        ended = {"failed": "failed", "success": f"success at {self.row['at']}"}.get(self.row["ended"])
        if self.row["cause"]:
            ended = f"failed: {self.row['cause']}"
        return " · ".join(filter(None, [self.row["name"], self.row["policy"] if policy else None, ended]))

    def below(self, run: str) -> Page:
        """The page where all entities of its recording lie below that of a ``run``, whose name it takes too."""
        root, row = entity_path(run), self.row
        return replace(
            self,
            root=root + self.root,
            trails=[root + path for path in self.trails],
            lanes=[root + path for path in self.lanes],
            frames={root + mesh: frame for mesh, frame in self.frames.items()},
            row=row | {"name": f"{run}/{row['name']}", "title": f"{run}: {row['title']}"},
        )

    def tab(self, title: str) -> rrb.Horizontal:
        """Scene and curves on the left, words and lanes on the right."""
        # Shares are the pixels that a view needs in a window of 1100×700; what is longer scrolls.
        plan = 60 + 15 * self.lines if self.lines else 0
        scene = self._scene()
        if self.pictures:  # 0.3 of the width for one picture, 0.4 for two side by side
            seen = min(0.2 + 0.1 * self.pictures, 0.5)
            scene = rrb.Horizontal(scene, self._pictures(), column_shares=[1 - seen, seen])
        left: list[tuple[float, Any]] = [(max(150, 500 - plan), scene)]
        left += [(plan, self._words("plan", "Plan"))] if plan else []
        left.append((105, rrb.Tabs(*(self._curve(name) for name in CURVES if name in self.curves))))
        right = self._lanes(self.lanes)
        right.insert(0, (max(100, 605 - sum(share for share, _ in right)), self._words("verdict", "Verdict")))
        return rrb.Horizontal(_stacked(left), _stacked(right), column_shares=[9, 10], name=title)

    def column(self, title: str, shown: tuple[int, int], farthest: float) -> rrb.Vertical:
        """Verdict, scene, distance and main lanes in a column, beside others that show the same steps and centimetres.

        What held is behind the scene.
        """
        page = replace(self, shown=shown, farthest=farthest)
        conditions = [lane for lane in self.lanes if _CONDITION.search(lane)]
        behind: list[Any] = [view for _, view in page._lanes(conditions, "What held")]
        below: list[tuple[float, Any]] = [(100, page._curve("distance"))] if "distance" in page.curves else []
        below += page._lanes([lane for lane in self.lanes if lane not in conditions])
        behind += [page._pictures()] if page.pictures else []
        scene = rrb.Tabs(page._scene(), *behind) if behind else page._scene()
        room = max(120, 487 - sum(share for share, _ in below))
        return _stacked([(118, page._words("verdict", title)), (room, scene), *below], title)

    def _scene(self) -> rrb.Spatial3DView:
        first, now = rr.TimeRangeBoundary.infinite(), rr.TimeRangeBoundary.cursor_relative()
        timelines = EPISODE_TIMELINE, SECONDS_TIMELINE
        trail = rrb.VisibleTimeRanges([rr.VisibleTimeRange(name, start=first, end=now) for name in timelines])
        shown: dict[Any, Any] = {path: trail for path in self.trails}
        shown |= {mesh: rr.CoordinateFrame(frame) for mesh, frame in self.frames.items() if frame}
        return rrb.Spatial3DView(
            origin=f"{self.root}/scene",
            contents=["$origin/**", *self.frames],
            name="Scene",
            line_grid=False,
            eye_controls=rrb.EyeControls3D(position=self.eye[0], look_target=self.eye[1]),
            overrides=shown,
        )

    def _pictures(self) -> rrb.Spatial2DView:
        return rrb.Spatial2DView(origin=f"{self.root}/seen", name="What it saw")

    def _words(self, part: str, name: str) -> rrb.TextDocumentView:
        return rrb.TextDocumentView(origin=f"{self.root}/{part}", name=name)

    def _lanes(self, lanes: Sequence[str], name: str = "What went on") -> list[tuple[float, Any]]:
        if not lanes:
            return []
        labels, colors = zip(*self.states.values(), strict=True)
        styles = rr.StateConfiguration(values=list(self.states), labels=labels, colors=colors)
        origin = lanes[0].rpartition("/")[0]
        view = rrb.StateTimelineView(
            origin=origin, contents=lanes, name=name, time_view=_window(self.shown), defaults=[styles]
        )
        return [(50 + 40 * len(lanes), view)]

    def _curve(self, name: str) -> rrb.TimeSeriesView:
        title, limits = CURVES[name]
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


def send_page(
    stream: Any,
    number: int,
    name: str,
    heading: Heading,
    episode: RecordedEpisode,
    motion: Motion | None,
    ghost: MendedRecording | None,
    meshes: Known,
) -> Page:
    """Log the recording's ``number``-th episode, under ``name``; returns what its views are to show.

    ``meshes`` are those in the recording, as :func:`log_motion` has them.
    """
    root = entity_path(name)
    touched = None if motion is None else touched_things(motion, episode)
    lanes = log_lanes(stream, entity_path(f"e{number}"), episode, heading.ended(episode), touched, ghost)
    eye = SIMPLE_EYE if motion is None else ROBOT_EYE
    drawn = drawn_steps(heading, episode, ghost)
    trails, frames = log_scene(stream, root, episode, motion, meshes, drawn, eye, ghost)
    text = verdict(heading, episode, ghost, small=len(lanes.paths) > MANY_LANES)
    stream.log(f"{root}/verdict", rr.TextDocument(text, media_type="text/markdown"), static=True)
    return Page(
        root,
        trails=trails,
        eye=eye,
        shown=telling_steps(heading, episode, ghost),
        decisive=decisive_step(heading, episode, ghost),
        curves=log_curves(stream, root, episode),
        lines=log_plan(stream, root, episode) if episode.steps else 0,
        lanes=lanes.paths,
        states=lanes.states,
        farthest=farthest(episode),
        row=heading.row(episode, name),
        frames=frames,
        pictures=log_pictures(stream, root, episode, drawn),
    )


def _window(shown: tuple[int, int]) -> Any:
    first, last = (rr.TimeRangeBoundary.absolute(seq=step) for step in shown)
    return rrb.TimeAxis(view_range=rr.TimeRange(start=first, end=last))


TABS = {kind: kind.title() for kind in ("metrics", "histograms", "images", "videos")} | {"hparams": "Hyperparameters"}
"""Titles of the tabs that show no episode. Their keys begin entity paths, so no episode has such a name."""
OF_TRAINING = {"metrics", "histograms", "images"}
"""What lies on the timeline of training; the rest lies on that of episodes."""
_PROPERTY = "layout"


class Tab(NamedTuple):
    """A tab; its name is its episode's, or the title."""

    name: str
    title: str
    episodes: list[str]
    timeline: str = EPISODE_TIMELINE


class Layout:
    """The tabs of a recording, from which rerun's blueprint is made whenever they are sent, with any tab in front.

    They are saved as properties too: whoever opens the recording can choose one, even if its writer was killed.
    """

    def __init__(self) -> None:
        self.pages: dict[str, Page] = {}  # iterate over a copy: the writer's thread reads while pages come
        self._compared: list[tuple[str, list[str]]] = []
        self.figures: list[str] = []  # entities of pictures of the causes
        self._views: dict[str, dict[str, list[str]]] = {kind: {} for kind in TABS}  # titles to what they show
        self._entries: list[str] = []
        self._saved = self._shown = 0

    def add_page(self, name: str, page: Page) -> None:
        """Give an episode a tab."""
        self.pages[name] = page
        self._entries.append(json.dumps(["page", name, vars(page)]))

    def compare(self, title: str, names: Sequence[str]) -> None:
        """Show episodes beside one another in a tab."""
        self._compared.append((title, list(names)))
        self._entries.append(json.dumps(["compare", title, list(names)]))

    def _ordered(self) -> list[Page]:
        """The pages of episodes from left to right: failures first where there is an overview, as in that."""
        pages = list(self.pages.values())
        return sorted(pages, key=lambda page: place(page.row)) if self._has_overview() else pages

    def _title(self, page: Page) -> str:
        """A page's; who acted is said unless that is the same for several."""
        who = {one.row["policy"] for one in list(self.pages.values())}
        return page.title(policy=len(who) > 1 or len(self.pages) == 1)

    def _has_overview(self) -> bool:
        """Whether there are several episodes, other than the two of one comparison."""
        return len(self.pages) > 1 and len(self._compared) != 1

    def add_figure(self, entity: str) -> None:
        """Show a figure of the causes in the overview."""
        self.figures.append(entity)
        self._entries.append(json.dumps(["figure", entity, None]))

    def add_view(self, kind: str, *names: str, title: str | None = None, origin: str | None = None) -> None:
        """Show what is logged under ``kind``/``names``, or under ``origin``, if it is not shown yet."""
        title, origin = title or "/".join(names) or TABS[kind], origin or entity_path(kind, *names)
        shown = self._views[kind].setdefault(title, [])
        if origin not in shown:
            shown.append(origin)
            self._entries.append(json.dumps(["view", kind, [title, origin]]))

    @classmethod
    def joined(cls, runs: Mapping[str, Layout]) -> Layout:
        """The layout of recordings each of which lies below its run's name: curves in one view, and episodes of
        the same name side by side."""
        layout = cls()
        same: dict[str, list[str]] = {}
        for run, one in runs.items():
            root = entity_path(run)
            for page in one.pages.values():
                moved = page.below(run)
                layout.add_page(moved.row["name"], moved)
                same.setdefault(page.row["name"], []).append(moved.row["name"])
            for title, names in one._compared:
                layout.compare(f"{run}: {title}", [f"{run}/{name}" for name in names])
            for figure in one.figures:
                layout.add_figure(root + figure)
            for kind, views in one._views.items():
                for title, origins in views.items():
                    for origin in origins:
                        own = title if kind == "metrics" else f"{title} · {run}"
                        layout.add_view(kind, title=own, origin=root + origin)
        for name, names in same.items():
            if len(names) > 1:
                layout.compare(f"{name} · side by side", names)
        return layout

    @classmethod
    def read(cls, reader: Any) -> Layout | None:
        """The layout of a recording; None if this library did not write it, or an earlier version did."""
        found = {}
        for chunk in reader.stream().filter(content=f"/__properties/{_PROPERTY}/**"):
            number = int(str(chunk.entity_path).rpartition("/")[2])
            found[number] = json.loads(chunk.to_record_batch().column("entry")[-1].as_py()[0])
        layout = cls()
        for _, (kind, name, content) in sorted(found.items()):
            if kind == "page":
                if {part.name for part in fields(Page)} != set(content):
                    return None
                layout.add_page(name, Page(**content))
            elif kind == "compare":
                layout.compare(name, content)
            elif kind == "figure":
                layout.add_figure(name)
            else:
                layout.add_view(name, title=content[0], origin=content[1])
        layout._saved = len(layout._entries)
        return layout if found else None

    def save(self, stream: Any) -> None:
        """Write the new tabs as properties of a recording."""
        while self._saved < len(self._entries):  # another thread may add some meanwhile
            entry = self._entries[self._saved]
            stream.log(f"__properties/{_PROPERTY}/{self._saved}", rr.AnyValues(entry=entry), static=True)
            self._saved += 1

    def is_due(self, seconds: float) -> bool:
        """Whether to send the layout again, ``seconds`` later: rerun takes it only whole, and a page is 0.1 MB."""
        new = len(self._entries) - self._shown
        return bool(new) and (4 * new >= self._shown or seconds >= 5 * self._shown)

    def send(self, stream: Any, tab: str | None = None, *, alone: bool = False) -> None:
        """Have the viewer show the tabs, ``tab`` in front or ``alone``; an unknown one is a ValueError."""
        self._shown = len(self._entries)
        if self._has_overview():
            text = table(page.row for page in list(self.pages.values()))
            document = rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN)
            stream.log(entity_path(OVERVIEW, "table"), document, static=True)
        stream.send_blueprint(self.blueprint(tab, alone=alone))

    def blueprint(self, tab: str | None = None, *, alone: bool = False) -> rrb.Blueprint:
        """The layout as rerun's; its time panel plays episodes at Meta-World's 80 steps a second."""
        tabs: list[Any] = []
        if self._has_overview():
            views: list[Any] = [rrb.TextDocumentView(origin=entity_path(OVERVIEW, "table"), name="Episodes")]
            views += [rrb.Spatial2DView(origin=figure, name="Causes") for figure in self.figures]
            tabs.append(rrb.Horizontal(*views, column_shares=[1] * len(views), name=OVERVIEW.title()))
        for title, names in self._compared:  # a column each
            pages = [self.pages[name] for name in names]
            window = min(page.shown[0] for page in pages), max(page.shown[1] for page in pages)
            farthest = max(page.farthest for page in pages)
            columns = [page.column(self._title(page), window, farthest) for page in pages]
            tabs.append(rrb.Horizontal(*columns, name=title))
        of_episodes = [page.tab(self._title(page)) for page in self._ordered()]
        of_kinds: list[Any] = []
        for kind, shown in self._views.items():
            if shown:
                grid = [_view(kind, title, origins) for title, origins in list(shown.items())]
                of_kinds.append(grid[0] if kind == "hparams" and len(grid) == 1 else rrb.Grid(*grid, name=TABS[kind]))
        tabs += of_kinds + of_episodes if self._has_overview() else of_episodes + of_kinds
        front = None if tab is None else self._find(tab)
        closed = {"state": "collapsed"}
        time = {"timeline": self.tab(tab).timeline, "fps": 80.0, "play_state": "paused", "loop_mode": "all"}
        panels = rrb.BlueprintPanel(**closed), rrb.SelectionPanel(**closed), rrb.TimePanel(**closed, **time)
        if alone and tabs:
            return rrb.Blueprint(tabs[self._find(tab or self.front())], *panels, auto_views=False)
        return rrb.Blueprint(rrb.Tabs(*tabs, active_tab=front), *panels, auto_views=False)

    def tabs(self) -> list[Tab]:
        """The tabs from left to right."""
        pages = self._ordered()
        first = [page.row["name"] for page in pages[:1]]
        tabs = [Tab(OVERVIEW, OVERVIEW.title(), first)] if self._has_overview() else []
        tabs += [Tab(title, title, names) for title, names in self._compared]
        of_episodes = [Tab(page.row["name"], self._title(page), [page.row["name"]]) for page in pages]
        of_kinds = [
            Tab(TABS[kind], TABS[kind], [], METRIC_TIMELINE if kind in OF_TRAINING else EPISODE_TIMELINE)
            for kind, shown in self._views.items()
            if shown
        ]
        # Behind many episodes nobody would find the rest.
        return tabs + (of_kinds + of_episodes if self._has_overview() else of_episodes + of_kinds)

    def _find(self, name: str | None) -> int:
        """The place of the tab of that name or title, or of the only one whose title holds it; of None the first."""
        tabs = self.tabs()
        exact = [i for i, tab in enumerate(tabs) if name in (tab.name, tab.title, None)]
        holding = [i for i, tab in enumerate(tabs) if str(name).lower() in tab.title.lower()]
        if exact or len(holding) == 1:
            return (exact or holding)[0]
        raise unknown_name("episode", str(name), [tab.name for tab in tabs])

    def tab(self, name: str | None = None) -> Tab:
        """The tab of a name, or the first one."""
        tabs = self.tabs()
        return tabs[self._find(name)] if tabs or name is not None else Tab("", "", [], METRIC_TIMELINE)

    def front(self) -> str | None:
        """The name of the tab that shows most: the first one, or that of the episode that an overview begins with."""
        first = self.tab()
        return first.episodes[0] if first.name == OVERVIEW else first.name or None

    def opening_step(self, tab: str | None = None) -> int | None:
        """The step to open a tab at, the earliest decisive one of its episodes; None for a tab of no episode."""
        return min((self.pages[name].decisive for name in self.tab(tab).episodes), default=None)


def _view(kind: str, name: str, origins: Sequence[str]) -> Any:
    origin = origins[0]
    if kind == "metrics":
        legend = rrb.PlotLegend(corner=rrb.Corner2D.RightTop, visible=True)
        several: dict[str, Any] = {"contents": [f"{one}/**" for one in origins]} if len(origins) > 1 else {}
        return rrb.TimeSeriesView(origin="/" if several else origin, name=name, plot_legend=legend, **several)
    if kind == "histograms":
        return rrb.BarChartView(origin=origin, name=name, plot_legend=rrb.PlotLegend(visible=False))
    if kind == "hparams":
        return rrb.TextDocumentView(origin=origin, name=name)
    return rrb.Spatial2DView(origin=origin, name=name)
