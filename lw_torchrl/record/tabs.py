"""The layout of a recording: its tabs, of episodes and of what training logs, and which of them a viewer opens."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any, NamedTuple

from lw_torchrl._checks import unknown_name
from lw_torchrl.record.conventions import EPISODE_TIMELINE, METRIC_TIMELINE, Stream, entity_path, rr, rrb
from lw_torchrl.record.episode_page import Page, side_by_side

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
        self._views: dict[str, list[list[str]]] = {kind: [] for kind in TABS}
        self._entries: list[str] = []
        self._saved = self._shown = 0

    def add_page(self, name: str, page: Page) -> None:
        """Give an episode a tab."""
        self.pages[name] = page
        self._entries.append(json.dumps(["page", name, asdict(page)]))

    def compare(self, title: str, names: Sequence[str]) -> None:
        """Show episodes beside one another in a tab."""
        self._compared.append((title, list(names)))
        self._entries.append(json.dumps(["compare", title, list(names)]))

    def add_view(self, kind: str, *names: str) -> None:
        """Show what is logged under ``kind``/``names``, if it is not shown yet."""
        if list(names) not in self._views[kind]:
            self._views[kind].append(list(names))
            self._entries.append(json.dumps(["view", kind, names]))

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
                layout.add_page(name, Page(**content))
            elif kind == "compare":
                layout.compare(name, content)
            else:
                layout.add_view(name, *content)
        return layout if found else None

    def save(self, stream: Stream) -> None:
        """Write the new tabs as properties of a recording."""
        for number in range(self._saved, len(self._entries)):
            values = rr.AnyValues(entry=self._entries[number])
            stream.log(f"__properties/{_PROPERTY}/{number}", values, static=True)
        self._saved = len(self._entries)

    def is_due(self, seconds: float) -> bool:
        """Whether to send the layout again, ``seconds`` later: rerun takes it only whole, and a page is 0.1 MB."""
        new = len(self._entries) - self._shown
        return bool(new) and (4 * new >= self._shown or seconds >= 5 * self._shown)

    def send(self, stream: Stream, tab: str | None = None) -> None:
        """Have the viewer show the tabs, ``tab`` in front; an unknown one is a ValueError."""
        self._shown = len(self._entries)
        stream.send_blueprint(self.blueprint(tab))

    def blueprint(self, tab: str | None = None) -> rrb.Blueprint:
        """The layout as rerun's; its time panel plays episodes at Meta-World's 80 steps a second."""
        tabs: list[Any] = [side_by_side([self.pages[name] for name in names], title) for title, names in self._compared]
        tabs += [page.tab() for page in list(self.pages.values())]
        for kind, views in self._views.items():
            if views:
                shown = [_view(kind, names) for names in views]
                tabs.append(shown[0] if kind == "hparams" else rrb.Grid(*shown, name=TABS[kind]))
        front = None if tab is None else self._find(tab)
        time: dict[str, Any] = {
            "timeline": self.tab(tab).timeline,
            "fps": 80.0,
            "play_state": "paused",
            "loop_mode": "all",
        }
        panels = [rrb.BlueprintPanel(state="collapsed"), rrb.SelectionPanel(state="collapsed")]
        panels.append(rrb.TimePanel(state="collapsed", **time))
        return rrb.Blueprint(rrb.Tabs(*tabs, active_tab=front), *panels, auto_views=False)

    def tabs(self) -> list[Tab]:
        """The tabs from left to right."""
        return [
            *(Tab(title, title, names) for title, names in self._compared),
            *(Tab(name, page.title, [name]) for name, page in list(self.pages.items())),
            *(
                Tab(TABS[kind], TABS[kind], [], METRIC_TIMELINE if kind in OF_TRAINING else EPISODE_TIMELINE)
                for kind, views in self._views.items()
                if views
            ),
        ]

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

    def opening_step(self, tab: str | None = None) -> int | None:
        """The step to open a tab at, the earliest decisive one of its episodes; None for a tab of no episode."""
        return min((self.pages[name].decisive for name in self.tab(tab).episodes), default=None)


def _view(kind: str, names: Sequence[str]) -> Any:
    origin, name = entity_path(kind, *names), "/".join(names)
    if kind == "metrics":
        legend = rrb.PlotLegend(corner=rrb.Corner2D.RightTop, visible=True)
        return rrb.TimeSeriesView(origin=origin, name=name, plot_legend=legend)
    if kind == "histograms":
        return rrb.BarChartView(origin=origin, name=name, plot_legend=rrb.PlotLegend(visible=False))
    if kind == "hparams":
        return rrb.TextDocumentView(origin="/hparams", name=TABS[kind])
    return rrb.Spatial2DView(origin=origin, name=name)
