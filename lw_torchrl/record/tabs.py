"""The layout of a recording: the tabs of episodes' pages and of training, and which one a viewer opens."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any, NamedTuple

from lw_torchrl._checks import unknown_name
from lw_torchrl.record.conventions import EPISODE_TIMELINE, METRIC_TIMELINE, entity_path, rr, rrb
from lw_torchrl.record.overview import OVERVIEW, place, table
from lw_torchrl.record.page import Page

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
