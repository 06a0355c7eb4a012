"""What the viewer opens with: the tabs of metrics, and the layout, of which only what is new is sent again."""

from __future__ import annotations

import uuid
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

from lw_torchrl.record.timelines import entity_path

if TYPE_CHECKING:
    import rerun.blueprint as rrb
    from rerun import RecordingStream


class Layout:
    """The layout of one recording, which grows: sending it again costs the views that came, not all of them.

    Rerun keeps a layout as a recording of its own. This one stays the same, its later rows replace or join the former.
    """

    def __init__(self, application_id: str) -> None:
        import rerun_bindings
        from rerun import RecordingStream

        native = rerun_bindings.new_blueprint(application_id, make_default=False, make_thread_default=False)
        self._stream = RecordingStream._from_native(native)
        self._rows = self._stream.memory_recording()
        self._root = uuid.uuid4()
        self._sent: dict[str, Any] = {}

    def send(self, stream: RecordingStream, blueprint: rrb.Blueprint) -> None:
        """Make ``blueprint`` the layout of the recording that ``stream`` writes; its views are known by their ids."""
        import rerun_bindings

        self._stream.set_time("blueprint", sequence=0)  # a stream's time is another one in each thread
        blueprint.root_container.id = self._root
        blueprint._log_to_stream(self)
        rerun_bindings.send_blueprint(self._rows.storage, True, True, recording=stream.to_native())

    def log(self, path: str, *values: Any, **options: Any) -> None:
        """What a blueprint calls for each of its parts; those that were sent are left out."""
        if path in self._sent and path.startswith("view/"):
            return
        content = [batch.as_arrow_array() for value in values for batch in _batches(value)]
        if path not in self._sent or self._sent[path] != content:
            self._sent[path] = content
            self._stream.log(path, *values, **options)


def _batches(value: Any) -> Iterable[Any]:
    return value.as_component_batches() if hasattr(value, "as_component_batches") else value


class MetricTabs:
    """The tabs of what is no episode: a view for each group of metrics, each histogram, image and video."""

    def __init__(self) -> None:
        self.kinds: dict[str, dict[tuple[str, ...], Any]] = {kind: {} for kind in TABS}
        self._ids = {kind: uuid.uuid4() for kind in TABS}

    def add(self, kind: str, *names: str) -> None:
        """Have a view of what is logged under ``kind``/``names``, if there is none yet."""
        if names not in self.kinds[kind]:
            self.kinds[kind][names] = _view(kind, names)

    def count(self) -> int:
        """How many views there are."""
        return sum(map(len, self.kinds.values()))

    def tabs(self) -> list[Any]:
        """A tab for each kind that has a view."""
        import rerun.blueprint as rrb

        tabs: list[Any] = []
        for kind, views in self.kinds.items():
            if not views:
                continue
            shown = list(views.values())
            tab = shown[0] if kind == "hparams" else rrb.Grid(*shown, name=TABS[kind])
            if kind != "hparams":
                tab.id = self._ids[kind]
            tabs.append(tab)
        return tabs


TABS = {
    "metrics": "Metrics",
    "histograms": "Histograms",
    "images": "Images",
    "videos": "Videos",
    "hparams": "Hyperparameters",
}


def _view(kind: str, names: Sequence[str]) -> Any:
    import rerun.blueprint as rrb

    origin, name = entity_path(kind, *names), "/".join(names)
    if kind == "metrics":
        legend = rrb.PlotLegend(corner=rrb.Corner2D.RightTop, visible=True)
        return rrb.TimeSeriesView(origin=origin, name=name, plot_legend=legend)
    if kind == "histograms":
        return rrb.BarChartView(origin=origin, name=name, plot_legend=rrb.PlotLegend(visible=False))
    if kind == "hparams":
        return rrb.TextDocumentView(origin="/hparams", name=TABS[kind])
    return rrb.Spatial2DView(origin=origin, name=name)
