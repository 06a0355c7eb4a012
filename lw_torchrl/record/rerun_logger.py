"""RerunLogger: torchrl's Logger, written to one rerun recording (.rrd)."""

from __future__ import annotations

import atexit
import io
import math
import os
import threading
import time
import uuid
import warnings
from collections.abc import Mapping, Sequence
from itertools import count
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.record.loggers import Logger

from lw_torchrl._checks import check_choice, checked
from lw_torchrl._files import AnyPath
from lw_torchrl.evaluation.figures import plot_failures
from lw_torchrl.evaluation.result import EvaluationResult
from lw_torchrl.language.layout import METAWORLD
from lw_torchrl.language.plans import ConditionalPlan
from lw_torchrl.record import metrics
from lw_torchrl.record.conventions import CONTROL_PERIOD, METRIC_TIMELINE, entity_path, rr, time_columns
from lw_torchrl.record.meshes import Known, Motion, log_meshes
from lw_torchrl.record.metrics import check_name
from lw_torchrl.record.overview import OVERVIEW
from lw_torchrl.record.page import send_page
from lw_torchrl.record.recorded_episode import MendedRecording, PlanLike, RecordedEpisode
from lw_torchrl.record.resuming import Begun
from lw_torchrl.record.tabs import TABS, Layout
from lw_torchrl.record.verdict import Heading
from lw_torchrl.record.writer import RecordingWriter, check_address, check_path
from lw_torchrl.suites.engine import RowModel

BUFFERED_SCALARS = 1024


class RerunLogger(Logger):
    """A torchrl Logger that makes one rerun recording: metrics, images, videos, and whole episodes in 3-D.

    Everything is written within half a second to a file that has its name from the start, so a killed run leaves a
    recording that opens. An older file of that name is kept, as "run.previous.rrd", then "run.previous-2.rrd". A viewer
    that is absent or goes away, and a full disk, cost one warning each, and training goes on.

    Args:
        path: the file, ending in ".rrd"; missing folders are made. None writes no file.
        connect: the address of a viewer that shows the recording as it grows, "127.0.0.1:9876" or
            "rerun+http://127.0.0.1:9876/proxy"; start it with ``rerun``.
        exp_name: the name of the run; None takes the file's, without ".rrd".
        application_id: recordings of one application share the last one's layout in rerun's viewer; None for a new one.
        resume: go on in the recording that the file holds, if it is there: a viewer shows one, with all curves and
            episodes, and steps that nobody gives count on. What a training logs a second time, since it had gone
            further than its last checkpoint, stands there twice.

    Attributes:
        previous: where an older file of that name is kept, or None.
        experiment: the rerun RecordingStream, for logging more by hand. Rerun's global one is not used.

    Raises:
        OSError: the file cannot be made.
        ValueError: what is to be gone on with is no recording, or one of an earlier version.

    Example:
        >>> import tempfile, os
        >>> path = os.path.join(tempfile.mkdtemp(), "train.rrd")
        >>> with RerunLogger(path) as logger:
        ...     logger.log_hparams({"lr": 3e-4, "actor": {"width": 256}})
        ...     logger.log_scalar("loss/bc", 0.25, step=10)
        >>> os.path.exists(path)
        True
    """

    experiment: rr.RecordingStream
    _service_shutdown: bool = False

    @checked
    def __init__(
        self,
        path: AnyPath | None = None,
        *,
        connect: str | None = None,
        exp_name: str | None = None,
        application_id: str | None = None,
        resume: bool = False,
    ) -> None:
        if path is None and connect is None:
            raise ValueError("give path, a file to write, or connect, a viewer to show it in, or both; got neither")
        self.path = None if path is None else check_path(path)
        self.connect = None if connect is None else check_address(connect)[0]
        name = exp_name or (self.path.stem if self.path else "lw_torchrl")
        if resume and self.path is None:
            raise ValueError("resume=True needs path, the file to go on with")
        begun = None
        if resume and self.path is not None and self.path.is_file() and self.path.stat().st_size:
            begun = Begun.read(self.path)
            application_id = application_id or begun.application_id
        self.application_id = application_id or f"{name}-{uuid.uuid4().hex[:8]}"
        self._lock, self._adding = threading.RLock(), threading.Lock()
        self._scalars: dict[str, tuple[list[int], list[list[float]]]] = {}
        self._curves: dict[str, int] = {}
        self._counters = {} if begun is None else begun.counters
        self._hparams = {} if begun is None else begun.hparams
        self._layout, self._sent = Layout() if begun is None else begun.layout, 0.0
        self._meshes: Known = {} if begun is None else {**begun.meshes}
        self._recording_id = None if begun is None else begun.recording_id
        super().__init__(exp_name=name, log_dir=str(self.path.parent) if self.path else os.curdir)

    def _create_experiment(self) -> rr.RecordingStream:
        name, prepare, begun = self.exp_name, self._send_waiting, self._recording_id
        self._writer = RecordingWriter(self.path, self.connect, self.application_id, name, prepare, begun)
        stream = self._writer.stream
        # In another process (service_backend="process") torchrl ends the experiment, not the logger.
        stream.finish = self.shutdown
        self.previous = self._writer.previous
        self._layout.send(stream)
        atexit.register(self.shutdown)
        self._tell()
        return stream

    def __repr__(self) -> str:
        state = "closed" if self._service_shutdown else "open"
        places = f"path={None if self.path is None else str(self.path)!r}, connect={self.connect!r}"
        return f"RerunLogger({places}, exp_name={self.exp_name!r}, {state})"

    def __enter__(self) -> RerunLogger:
        return self.start()

    def __exit__(self, *error: object) -> None:
        self.shutdown()

    def _open(self) -> rr.RecordingStream:
        if self._service_shutdown:
            raise RuntimeError(f"{self!r} takes nothing more; make a new RerunLogger")
        self._tell()
        return self.experiment

    def _tell(self) -> None:
        for trouble in self._writer.take_troubles():
            warnings.warn(trouble, stacklevel=4)

    def log_scalar(self, name: str, value: Any, step: int | None = None) -> None:
        """Add a number, or several, to the curves "metrics/<name>", on the timeline "global_step".

        Args:
            name: "loss/bc"; what comes before the first slash is the group, which has a view and an axis of its own.
            value: a number, or up to 64 of them (a tensor, an array, a list), each a curve; NaN leaves a gap.
            step: the training step; None counts the calls with this name from 0.
        """
        stream = self._open()
        row, parts = metrics.numbers(name, value), check_name(name).split("/")
        if len(row) > self._curves.get(name, 0):
            self._curves[name] = len(row)
            self._layout.add_view("metrics", parts[0])
            names = [parts[-1]] if len(row) == 1 else [f"{parts[-1]} {i}" for i in range(len(row))]
            lines = rr.SeriesLines(names=names, widths=[1.5] * len(row))
            stream.log(entity_path("metrics", *parts), lines, static=True)
        with self._lock:
            steps, values = self._scalars.setdefault(name, ([], []))
            steps.append(self._count(entity_path("metrics", *parts), step))
            values.append(row)
            full = len(values) >= BUFFERED_SCALARS
        if full:
            self._send_scalars()

    def log_image(self, name: str, image: Any, step: int | None = None) -> None:
        """Add an image "images/<name>", a JPEG on the timeline "global_step".

        Args:
            image: H×W, H×W×C or C×H×W, C = 1 or 3; uint8, or floats in [0, 1].
            step: the training step; None counts the calls with this name from 0.
        """
        stream, pixels = self._open(), metrics.check_image(name, image)
        metrics.send_images(stream, *self._place("images", name, step), [pixels])

    def log_video(self, name: str, video: Tensor, step: int | None = None, **kwargs: Any) -> None:
        """Add a video as JPEG images "videos/<name>", frame i at step i of the episodes' timelines.

        Args:
            video: T×C×H×W uint8, C = 1 or 3; or N×T×C×H×W, stored as "videos/<name>/0" and so on.
            step: the training step; it becomes part of the path, "videos/<name>/step 1000".
            **kwargs: ``fps``, frames a second (80, the rate of Meta-World's control); others are ignored.
        """
        video = torch.as_tensor(video).detach().cpu()
        if video.ndim == 5 and len(video) != 1:
            for i, one in enumerate(video):
                self.log_video(f"{name}/{i}", one, step, **kwargs)
            return
        video = video[0] if video.ndim == 5 else video
        if video.ndim != 4 or video.shape[1] not in (1, 3) or not video.numel() or video.dtype != torch.uint8:
            got = f"{str(video.dtype).removeprefix('torch.')} of shape {'×'.join(map(str, video.shape))}"
            raise ValueError(f"video {name!r} must be uint8 of shape T×C×H×W with C = 1 or 3, got {got}")
        frames = video.permute(0, 2, 3, 1).contiguous().numpy()
        stream, parts = self._open(), check_name(name).split("/")
        if step is not None:
            parts.append(f"step {int(step)}")
        times = time_columns(np.arange(len(frames)), 1 / float(kwargs.get("fps", 1 / CONTROL_PERIOD)))
        metrics.send_images(stream, entity_path("videos", *parts), times, frames)
        self._layout.add_view("videos", *parts)

    def log_hparams(self, cfg: Any) -> None:
        """Show a mapping (a DictConfig too) as the table "hparams"; nested keys are written "actor.width".

        A later call adds to the table.
        """
        if not isinstance(cfg, Mapping):
            raise TypeError(f"cfg must be a mapping, got {type(cfg).__name__}")
        self._hparams.update(metrics.flatten(cfg))
        rows = [("key", "value"), ("---", "---"), *sorted(self._hparams.items())]
        cells = [[text.replace("|", "\\|").replace("\n", " ") for text in row] for row in rows]
        table = "\n".join(f"| {key} | {value} |" for key, value in cells)
        self._open().log("hparams", rr.TextDocument(table, media_type=rr.MediaType.MARKDOWN), static=True)
        self._layout.add_view("hparams")

    def log_histogram(self, name: str, data: Sequence[float] | Tensor | NDArray[Any], **kwargs: Any) -> None:
        """Add the counts of ``data`` as a bar chart "histograms/<name>", on the timeline "global_step".

        Args:
            data: numbers of any shape, all finite.
            **kwargs: ``step``, the training step (None counts the calls), and ``bins``, their number or edges (30).
        """
        chart = metrics.histogram(name, data, kwargs.get("bins", 30))
        self._open().send_columns(*self._place("histograms", name, kwargs.get("step")), chart)

    def _place(self, kind: str, name: str, step: int | None) -> tuple[str, list[Any]]:
        """The entity and the time of what is logged at a training step; it is shown from now on."""
        parts = check_name(name).split("/")
        path = entity_path(kind, *parts)
        self._layout.add_view(kind, *parts)
        return path, [rr.TimeColumn(METRIC_TIMELINE, sequence=[self._count(path, step)])]

    def flush(self, timeout: float | None = None) -> None:
        """Write what waits to the file, within ``timeout`` seconds; by itself that is done each half second."""
        if not self._service_shutdown:
            self._writer.write(timeout)
            self._tell()

    def shutdown(self, timeout: float | None = None) -> None:
        """Write the rest and close the file; a viewer gets a second for it, or ``timeout``. Once is enough."""
        if not self._service_shutdown:
            self._service_shutdown = True
            atexit.unregister(self.shutdown)
            if self._layout.is_due(math.inf):
                self._layout.send(self._writer.stream)
            self._writer.close(timeout)
            self._tell()

    def discard(self) -> None:
        """Close without a file: what was logged is dropped, an older file of that name gets it back."""
        if not self._service_shutdown:
            self._service_shutdown = True
            atexit.unregister(self.shutdown)
            self._writer.close(discard=True)

    def _checkpoint_state(self) -> dict[str, Any]:
        return {"counters": dict(self._counters)}

    def _load_checkpoint_state(self, state_dict: Mapping[str, Any]) -> None:
        self._counters = dict(state_dict.get("counters", {}))

    def _count(self, path: str, step: int | None) -> int:
        with self._lock:
            now = self._counters.get(path, 0) if step is None else int(step)
            self._counters[path] = now + 1
        return now

    def _send_scalars(self) -> None:
        with self._lock:
            waiting, self._scalars = self._scalars, {}
        for name, (steps, values) in waiting.items():
            index = [rr.TimeColumn(METRIC_TIMELINE, sequence=steps)]
            columns = rr.Scalars.columns(scalars=[number for row in values for number in row])
            path = entity_path("metrics", *name.split("/"))
            self._writer.stream.send_columns(path, index, columns.partition([len(row) for row in values]))

    def _send_waiting(self) -> None:
        """Send numbers that wait, and the layout where there is something new to show."""
        self._send_scalars()
        self._layout.save(self._writer.stream)
        if self._layout.is_due(time.monotonic() - self._sent):
            self._layout.send(self._writer.stream)
            self._sent = time.monotonic()

    @property
    def episodes(self) -> list[str]:
        """The names of the episodes so far."""
        return list(self._layout.pages)

    def log_episode(
        self,
        rollout: TensorDictBase,
        *,
        task: str,
        objects: Mapping[str, Any],
        plan: PlanLike | None = None,
        name: str | None = None,
    ) -> str:
        """Add one episode of anything: a simple scene in 3-D, the verdict, the plan, the timeline and curves.

        For Meta-World's robot as it is, see :func:`lw_torchrl.log_rollout`. Row t stands at step t and
        t · 0.0125 seconds; success and reward, its action's outcome, at t + 1.

        Args:
            rollout: batch size (T,). "observation" T×39 float32 (metres) and "action" T×4 float32 in [-1, 1]; optional
                are what :func:`lw_torchrl.log_rollout` lists and ("next", "success") T×1 bool. Columns beyond the
                plan's S steps are padding and left out.
            task: the task's name.
            objects: name -> T×3 positions in metres; without "robot's gripper" it is observation 0:3.
            plan: its ``steps`` each have a ``condition`` and a ``skill``; None shows numbered columns.
            name: the entity that all lies under, and the tab's title; None takes ``task``, then "task-2".

        Returns:
            The name.

        Example:
            >>> import tempfile, torch
            >>> from tensordict import TensorDict
            >>> rollout = TensorDict({"observation": torch.rand(5, 39), "action": torch.rand(5, 4)}, [5])
            >>> with RerunLogger(tempfile.mkdtemp() + "/reach.rrd") as logger:
            ...     objects = {"puck": rollout["observation"][:, 4:7]}
            ...     logger.log_episode(rollout, task="reach", objects=objects)
            'reach'
        """
        if not isinstance(task, str) or not task.strip():
            raise ValueError(f"task must be a task's name, got {task!r}")
        layout = plan.definition.layout if isinstance(plan, ConditionalPlan) else METAWORLD
        episode = RecordedEpisode.from_rollout(rollout, objects, plan, layout)
        return self.add_page(Heading(task), episode, name=name)

    def add_page(
        self,
        heading: Heading,
        episode: RecordedEpisode,
        *,
        motion: Motion | None = None,
        ghost: MendedRecording | None = None,
        name: str | None = None,
    ) -> str:
        """Add the page of an episode that was checked; returns its name. With a motion the robot is shown as it is."""
        stream = self._open()
        with self._adding:  # else two threads find the same name free
            taken, own = (*TABS, OVERVIEW, *self._layout.pages), heading.name
            if name is None:
                name = next(free for i in count(1) if (free := own if i == 1 else f"{own}-{i}") not in taken)
            elif not isinstance(name, str) or not name.strip():
                raise ValueError(f"name must be a non-empty string, got {name!r}")
            elif name in taken:
                raise ValueError(f"name must be another than {', '.join(taken)}, got {name!r}")
            page = send_page(stream, len(self.episodes) + 1, name, heading, episode, motion, ghost, self._meshes)
            self._layout.add_page(name, page)
        return name

    def prepare(self, model: RowModel) -> None:
        """Add the shapes of a model's bodies now, half a second's work, which its first page is spared."""
        with self._adding:
            log_meshes(self._open(), model, self._meshes)

    def show_causes(self, result: EvaluationResult) -> None:
        """Put :func:`lw_torchrl.evaluation.plot_failures` of a result into the overview of several episodes."""
        picture = io.BytesIO()
        plot_failures(result).savefig(picture, format="png", dpi=100)
        stream = self._open()
        encoded = rr.EncodedImage(contents=picture.getvalue(), media_type="image/png")
        path = entity_path(OVERVIEW, "causes")
        stream.log(path, encoded, static=True)
        self._layout.add_figure(path)

    def compare(self, names: Sequence[str], title: str = "Side by side") -> None:
        """Show episodes beside one another, in a tab before their own: one cursor moves in all of them.

        Args:
            names: of two episodes or more, as :func:`lw_torchrl.log_rollout` returned them.
            title: of the tab.
        """
        self._open()
        names = [names] if isinstance(names, str) else list(names)
        if len(names) < 2:
            raise ValueError(f"names must be of two episodes or more, got {', '.join(names) or 'none'}")
        self._layout.compare(title, [check_choice("names", name, self._layout.pages) for name in names])
