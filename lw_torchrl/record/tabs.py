"""The tabs of a recording: an overview, one page per episode, and the curves and tables of a training run."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import fields
from functools import partial
from typing import Any, NamedTuple

from lw_torchrl._util.checks import unknown_name
from lw_torchrl._util.text import markdown
from lw_torchrl.record.entities import EPISODE_TIMELINE, METRIC_TIMELINE, STEP_TIME, entity_path, rr, rrb
from lw_torchrl.record.page import Page

OVERVIEW = "overview"
"""The name of the overview tab and of the overview's entity."""
TITLES = {kind: kind.title() for kind in ("metrics", "histograms", "videos")} | {"hparams": "Hyperparameters"}
"""Titles of tabs without episodes, by the first part of the entity path, which no episode may have as its name."""
ON_METRIC_TIMELINE = {"metrics", "histograms"}
_PROPERTY = "layout"


class Tab(NamedTuple):
    """A viewer tab, labeled with a title or the name of an episode."""

    name: str
    title: str
    view: Callable[[], Any]  # a function that creates the tab's Rerun view
    episodes: list[str]
    timeline: str = EPISODE_TIMELINE


class Tabs:
    """The tabs of a recording, from which the Rerun blueprint is built.

    The tabs are also saved as properties of the recording, because a recording that was never closed has no blueprint.
    """

    def __init__(self) -> None:
        self.pages: dict[str, Page] = {}
        self._compared: list[tuple[str, list[str]]] = []
        self._views: dict[str, list[str]] = {kind: [] for kind in TITLES}  # names of logged values
        self._entries: list[str] = []
        self._saved = self._sent = 0

    def add_view(self, kind: str, name: str = "") -> None:
        """Add a view of the values logged as ``kind``/``name``, unless there is one already."""
        if name not in self._views[kind]:
            self.add("view", [kind, name])

    def add(self, kind: str, content: Any) -> None:
        """Add content of one ``kind``: an episode's "page", a "compare" tab (a title and the names of the episodes to
        compare), or a "view" of logged values."""
        self._entries.append(json.dumps([kind, content]))
        if kind == "page":
            self.pages[content["row"]["name"]] = Page(**content)
        elif kind == "compare":
            self._compared.append((content[0], content[1]))
        else:
            self._views[content[0]].append(content[1])

    @classmethod
    def read(cls, reader: Any) -> Tabs | None:
        """Read the tabs of a recording; return None if the recording was written by another program or version."""
        entries = {}
        for chunk in reader.stream().filter(content=f"/__properties/{_PROPERTY}/**"):
            number = int(str(chunk.entity_path).rpartition("/")[2])
            entries[number] = json.loads(chunk.to_record_batch().column("entry")[-1].as_py()[0])
        tabs = cls()
        for _, (kind, content) in sorted(entries.items()):
            if kind == "page" and {part.name for part in fields(Page)} != set(content):
                return None
            tabs.add(kind, content)
        return tabs if entries else None

    def save(self, stream: Any) -> None:
        """Save new tabs as properties of the recording."""
        for number in range(self._saved, len(self._entries)):
            entry = rr.AnyValues(entry=self._entries[number])
            stream.log(f"__properties/{_PROPERTY}/{number}", entry, static=True)
        self._saved = len(self._entries)

    @property
    def has_grown(self) -> bool:
        """Return whether the number of entries has grown by at least a quarter since the last :meth:`send`."""
        return 4 * (len(self._entries) - self._sent) >= self._sent

    def send(self, stream: Any) -> None:
        """Send the blueprint and the overview table to the recording if there are new tabs."""
        if self._sent == len(self._entries):
            return
        self._sent = len(self._entries)
        if self._has_overview():
            text = overview(page.row for page in self.pages.values())
            document = rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN)
            stream.log(entity_path(OVERVIEW, "table"), document, static=True)
        stream.send_blueprint(self.blueprint())

    def blueprint(self, front: str | None = None) -> rrb.Blueprint:
        """Return the Rerun blueprint, with the tab ``front`` (or the first tab) in front."""
        tabs = self.tabs()
        closed = {"state": "collapsed"}
        fps = 1 / next((page.step_time for page in self.pages.values()), STEP_TIME)
        time = {"timeline": self.tab(front).timeline, "fps": fps, "play_state": "paused", "loop_mode": "all"}
        panels = rrb.BlueprintPanel(**closed), rrb.SelectionPanel(**closed), rrb.TimePanel(**closed, **time)
        active = None if front is None else self.index(front)
        return rrb.Blueprint(rrb.Tabs(*(tab.view() for tab in tabs), active_tab=active), *panels, auto_views=False)

    def tabs(self) -> list[Tab]:
        """Return the tabs from left to right. If there are many episodes, the tabs of a training run come first."""
        pages, has_overview = list(self.pages.values()), self._has_overview()
        if has_overview:
            pages.sort(key=lambda page: _order(page.row))
        # Titles include the policy unless several episodes all have the same policy.
        name_policies = len({page.row["policy"] for page in pages}) > 1 or len(pages) == 1
        titles = {page.row["name"]: page.title(policy=name_policies) for page in pages}
        views = [(title, names, partial(self._comparison, title, names, titles)) for title, names in self._compared]
        compared = [Tab(title, title, view, names) for title, names, view in views]
        of_episodes = [Tab(name, title, partial(self.pages[name].tab, title), [name]) for name, title in titles.items()]
        of_training = []
        for kind, names in self._views.items():
            timeline = METRIC_TIMELINE if kind in ON_METRIC_TIMELINE else EPISODE_TIMELINE
            if names:
                of_training.append(Tab(TITLES[kind], TITLES[kind], partial(_values_view, kind, names), [], timeline))
        if not has_overview:
            return compared + of_episodes + of_training
        title = OVERVIEW.title()
        view = partial(rrb.TextDocumentView, origin=entity_path(OVERVIEW, "table"), name=title)
        return [Tab(OVERVIEW, title, view, [pages[0].row["name"]]), *compared, *of_training, *of_episodes]

    def _comparison(self, title: str, names: list[str], titles: dict[str, str]) -> Any:
        """Return a view with a column for each episode; all columns have the same axes."""
        pages = [self.pages[name] for name in names]
        shown = min(page.shown[0] for page in pages), max(page.shown[1] for page in pages)
        farthest = max(page.farthest for page in pages)
        columns = [self.pages[name].column(titles[name], shown, farthest) for name in names]
        return rrb.Horizontal(*columns, name=title)

    def tab(self, name: str | None = None) -> Tab:
        """Return the tab with the given name or title, or the first tab if None."""
        tabs = self.tabs()
        if not tabs and name is None:
            return Tab("", "", rrb.Tabs, [], METRIC_TIMELINE)
        return tabs[self.index(name)]

    def opening_step(self, tab: str | None = None) -> int | None:
        """Return the time step at which a tab opens, or None if the tab has no episodes.

        This is the earliest decisive step (:func:`~lw_torchrl.record.verdict.decisive_step`) of the tab's episodes.
        """
        return min((self.pages[name].decisive for name in self.tab(tab).episodes), default=None)

    def index(self, name: str | None) -> int:
        """Return the index of the tab with this name or title, or of the only tab whose title contains ``name``."""
        tabs = self.tabs()
        exact = [i for i, tab in enumerate(tabs) if name in (tab.name, tab.title, None)]
        containing = [i for i, tab in enumerate(tabs) if str(name).lower() in tab.title.lower()]
        if exact or len(containing) == 1:
            return (exact or containing)[0]
        raise unknown_name("episode", str(name), [tab.name for tab in tabs])

    def _has_overview(self) -> bool:
        """Return whether an overview tab is needed: there are several episodes, and not exactly one comparison."""
        return len(self.pages) > 1 and len(self._compared) != 1


def _values_view(kind: str, names: list[str]) -> Any:
    views = [_value_view(kind, name) for name in names]
    return views[0] if kind == "hparams" else rrb.Grid(*views, name=TITLES[kind])


def _value_view(kind: str, name: str) -> Any:
    origin, title = entity_path(kind, *(name.split("/") if name else [])), name or TITLES[kind]
    if kind == "metrics":
        legend = rrb.PlotLegend(corner=rrb.Corner2D.RightTop, visible=True)
        return rrb.TimeSeriesView(origin=origin, name=title, plot_legend=legend)
    if kind == "histograms":
        return rrb.BarChartView(origin=origin, name=title, plot_legend=rrb.PlotLegend(visible=False))
    view = rrb.TextDocumentView if kind == "hparams" else rrb.Spatial2DView
    return view(origin=origin, name=title)


def _order(row: dict[str, Any]) -> tuple[Any, ...]:
    """Return the sort key of an episode: failures come first, then episodes are sorted by task and index."""
    return row["ended"] != "failed", row["task"], row["episode"] or 0


def overview(rows: Iterable[dict[str, Any]]) -> str:
    """Return the counts of failures and causes, and a table with one row per episode, failures first, as Markdown."""
    rows = sorted(rows, key=_order)
    ended = Counter(row["ended"] for row in rows)
    causes = Counter(row["cause"] for row in rows if row["cause"])
    known = ended["failed"] + ended["success"]
    counts = [f"{ended['failed']} of {known} episodes failed" if known else f"{len(rows)} episodes"]
    counts += [f"{cause} {number}" for cause, number in causes.most_common()]
    columns = {"": "mark", "episode": "title", "who": "policy", "cause": "cause", "ended": "when"}
    policies = {row["policy"] for row in rows}
    if len(policies) == 1:  # written once above the table, which keeps the table narrow
        del columns["who"]
    if not causes:
        del columns["cause"]
    by = [f"By {markdown(policies.pop())}.", ""] if len(policies) == 1 and None not in policies else []
    lines = [f"#### {' · '.join(counts)}", "", *by, f"| {' | '.join(columns)} |", "|-" * len(columns) + "|"]
    for row in rows:
        mark = {"success": "✓", "failed": "✗"}.get(row["ended"], "·")
        texts = row | {"mark": mark, "when": f"t = {row['at']} ({row['seconds']:.2f} s)"}
        cells = [markdown(texts[key] or "") for key in columns.values()]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"
