"""The tabs of a recording's layout, read from its rows: their titles, and which of them is in front."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import pairwise
from typing import TYPE_CHECKING, Any

from lw_torchrl.record.episodes import RESERVED
from lw_torchrl.record.timelines import EPISODE_TIMELINE, METRIC_TIMELINE

if TYPE_CHECKING:
    from rerun import RecordingStream
    from rerun.chunk import Chunk

OF_TRAINING = {"metrics", "histograms", "images"}
"""What lies on the timeline of training, not of episodes."""


class Tabs:
    """The containers and views of a layout.

    Args:
        layout: the chunks of a blueprint.
    """

    def __init__(self, layout: Iterable[Chunk]) -> None:
        self._values: dict[tuple[str, str], Any] = {}
        for chunk in layout:
            if "blueprint" not in chunk.timeline_names:
                continue  # the viewer would not see it either
            rows = chunk.to_record_batch()
            entity = chunk.entity_path.strip("/")
            for name in rows.schema.names:
                for value in rows.column(name).to_pylist() if ":" in name else ():
                    if value:
                        self._values[entity, name.partition(":")[2]] = value
        # The path from the root to each tab, by its place in the layout.
        self._tabs = list(self._below(self._root(), ()))

    def _root(self) -> str:
        root = self._values.get(("viewport", "root_container"))
        return "" if root is None else f"container/{_uuid(root[0])}"

    def _below(self, container: str, above: tuple[str, ...]) -> Iterable[tuple[str, ...]]:
        for child in self._values.get((container, "contents"), ()):
            path = (*above, container, child.strip("/"))
            yield path
            yield from self._below(path[-1], path[:-1])

    def _title(self, path: tuple[str, ...]) -> str:
        return next(iter(self._values.get((path[-1], "display_name"), ())), "")

    def _origins(self, path: tuple[str, ...]) -> set[str]:
        """The entities, without what is below them, that the views of a tab show."""
        inside = [path, *(other for other in self._tabs if other[: len(path)] == path)]
        origins = (self._values.get((other[-1], "space_origin"), [""])[0] for other in inside)
        return {origin.strip("/").partition("/")[0].replace("\\", "") for origin in origins} - {""}

    def names(self) -> list[str]:
        """What the outermost tabs are found by: the episode's name where there is one, or else the title."""
        found = []
        for path in self._tabs:
            if len(path) == 2 and (title := self._title(path)):
                episodes = self._origins(path) - set(RESERVED)
                found.append(episodes.pop() if len(episodes) == 1 else title)
        return found

    def episodes(self, name: str | None = None) -> set[str]:
        """The episodes that a tab shows; without a name the first tab."""
        path = self._named(name)
        return set() if path is None else self._origins(path) - set(RESERVED)

    def timeline(self, name: str | None = None) -> str:
        """The timeline of what a tab shows; without a name of the first tab."""
        path = self._named(name)
        return METRIC_TIMELINE if path is None else self._timeline(path)

    def _timeline(self, path: tuple[str, ...]) -> str:
        return METRIC_TIMELINE if self._origins(path) <= OF_TRAINING else EPISODE_TIMELINE

    def _named(self, name: str | None) -> tuple[str, ...] | None:
        return self.find(name) if name is not None else next((path for path in self._tabs if len(path) == 2), None)

    def find(self, name: str) -> tuple[str, ...] | None:
        """The tab of that title, or of that episode, or the only one whose title holds those words; None: no one."""
        outer = [path for path in self._tabs if len(path) == 2]
        for paths in (
            [path for path in self._tabs if self._title(path) == name],
            [path for path in outer if self._origins(path) == {name}],
        ):
            if paths:
                return paths[0]
        holding = [path for path in outer if name.lower() in self._title(path).lower()]
        return holding[0] if len(holding) == 1 else None

    def bring_to_front(self, rows: RecordingStream, path: tuple[str, ...]) -> None:
        """Add to a layout's rows that the tab is the one in front, and its timeline the one in force."""
        from rerun.blueprint.archetypes import ContainerBlueprint, TimePanelBlueprint

        rows.set_time("blueprint", sequence=0)
        for container, tab in pairwise(path):
            rows.log(container, ContainerBlueprint.from_fields(active_tab=tab))
        rows.log("time_panel", TimePanelBlueprint.from_fields(timeline=self._timeline(path)))


def _uuid(value: Any) -> str:
    import uuid

    return str(uuid.UUID(bytes=bytes(value)))
