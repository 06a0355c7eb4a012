"""The RerunLogger class: a TorchRL logger that writes a Rerun recording (.rrd)."""

from __future__ import annotations

import atexit
import os
import threading
import time
import uuid
import warnings
from collections.abc import Mapping, Sequence
from contextlib import suppress
from itertools import chain, count
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.record.loggers import Logger

from lw_torchrl._util.checks import Positive, check_choice, typed
from lw_torchrl._util.files import AnyPath
from lw_torchrl._util.text import markdown
from lw_torchrl.language.layout import METAWORLD
from lw_torchrl.language.plans import ConditionalPlan
from lw_torchrl.record.entities import METRIC_TIMELINE, STEP_TIME, entity_path, rr, send_images, time_columns
from lw_torchrl.record.meshes import LoggedMeshes, Motion
from lw_torchrl.record.page import send_page
from lw_torchrl.record.recorded_episode import Ghost, PlanLike, RecordedEpisode
from lw_torchrl.record.tabs import OVERVIEW, TITLES, Tabs
from lw_torchrl.record.verdict import Heading
from lw_torchrl.suites.suite import known_suite

MOST_CURVES = 64  # maximum number of curves with the same name
BAR_COLOR = (80, 170, 255)
BUFFERED_SCALARS = 1024
SEND_SECONDS, SEND_SHARE = 0.5, 0.01
"""The minimum time between two transmissions of buffered scalars: in seconds, and as a fraction of the logger's age."""
FLUSH_SECONDS = 5.0


class RerunLogger(Logger):
    """A TorchRL logger that writes one Rerun recording: metrics, videos, and whole episodes in 3-D.

    Rerun writes the file in a background thread while the program runs, so a killed program leaves a recording that
    :func:`open_viewer` can open. A full disk or a lost viewer never stops the program: Rerun prints an error, and the
    rest of the recording is lost. A recording is never overwritten: if "run.rrd" exists, the logger writes "run-2.rrd".

    Args:
        path: the file to write, ending in ".rrd"; missing folders are created. None writes no file.
        connect: the address of a running viewer that shows the recording as it grows, "127.0.0.1:9876" or
            "rerun+http://127.0.0.1:9876/proxy"; start the viewer with ``rerun``. If no viewer responds, Rerun waits
            five seconds at the start and at the end.
        exp_name: the name of the run; None for the file's name without ".rrd".

    Attributes:
        path: the path of the written file, or None.
        experiment: the rerun RecordingStream, for direct use of the rerun API. It is not Rerun's global recording.

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

    @typed
    def __init__(self, path: AnyPath | None = None, *, connect: str | None = None, exp_name: str | None = None) -> None:
        if path is None and connect is None:
            raise ValueError("path (a file to write), connect (a running viewer) or both are required, got neither")
        if path is not None and Path(path).suffix != ".rrd":
            raise ValueError(f"path must end in '.rrd', got {str(path)!r}")
        self.path = None if path is None else _new_file(Path(path))
        self.connect = f"rerun+http://{connect}/proxy" if connect is not None and "://" not in connect else connect
        self._lock = threading.RLock()
        self._scalars: dict[str, tuple[list[int], list[list[float]]]] = {}
        self._curves: dict[str, int] = {}  # name -> number of curves
        self._counters: dict[str, int] = {}
        self._hparams: dict[str, str] = {}
        self._tabs = Tabs()
        self._meshes: LoggedMeshes = {}
        self._began = self._sent = time.monotonic()
        name = exp_name or (Path(path).stem if path is not None else "lw_torchrl")
        super().__init__(exp_name=name, log_dir=str(self.path.parent) if self.path else os.curdir)

    def _create_experiment(self) -> rr.RecordingStream:
        # The Rerun viewer shows recordings with the same application id in the same layout, so each gets its own id.
        stream = rr.RecordingStream(f"{self.exp_name}-{uuid.uuid4().hex[:8]}", recording_id=uuid.uuid4())
        stream.set_log_time_enabled(False)
        stream.set_log_tick_enabled(False)
        sinks = [] if self.connect is None else [rr.GrpcSink(self.connect)]
        stream.set_sinks(*sinks, *([] if self.path is None else [rr.FileSink(self.path)]))
        stream.send_recording_name(self.exp_name)
        # In another process (service_backend="process"), TorchRL closes the experiment instead of the logger.
        stream.finish = self.shutdown
        atexit.register(self.shutdown)
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
            raise RuntimeError(f"{self!r} was shut down; create a new RerunLogger")
        return self.experiment

    def log_scalar(self, name: str, value: Any, step: int | None = None) -> None:
        """Add one or more numbers to the curves "metrics/<name>" on the timeline "global_step".

        Args:
            name: the metric's name, such as "loss/bc"; the part before the first slash is a group with its own view.
            value: a number, or up to 64 numbers (a tensor, an array, a list), each with its own curve; NaN leaves a
                gap.
            step: the training step; None counts the calls with this name, starting at 0.
        """
        stream = self._open()
        row, parts = _numbers(name, value), _name_parts(name)
        with self._lock:
            if len(row) > self._curves.get(name, 0):
                self._curves[name] = len(row)
                self._tabs.add_view("metrics", parts[0])
                names = [parts[-1]] if len(row) == 1 else [f"{parts[-1]} {i}" for i in range(len(row))]
                lines = rr.SeriesLines(names=names, widths=[1.5] * len(row))
                stream.log(entity_path("metrics", *parts), lines, static=True)
            steps, values = self._scalars.setdefault(name, ([], []))
            steps.append(self._count(entity_path("metrics", *parts), step))
            values.append(row)
            self._send(now=len(values) >= BUFFERED_SCALARS)

    def log_video(self, name: str, video: Tensor, step: int | None = None, **kwargs: Any) -> None:
        """Log a video as "videos/<name>" in JPEG images, with frame i at time step i of the episodes' timelines.

        Args:
            video: a video T×C×H×W or 1×T×C×H×W uint8 (C = 1 or 3).
            step: the training step, which becomes part of the path: "videos/<name>/step 1000".
            **kwargs: ``fps``, frames per second (default: 80, as in Meta-World); other arguments are ignored.
        """
        video = torch.as_tensor(video).detach().cpu()
        video = video[0] if video.ndim == 5 and len(video) == 1 else video
        if video.ndim != 4 or video.shape[1] not in (1, 3) or not video.numel() or video.dtype != torch.uint8:
            actual = f"{video.dtype} of shape {tuple(video.shape)}"
            raise ValueError(f"video {name!r} must be uint8 of shape T×C×H×W (C = 1 or 3), got {actual}")
        frames = video.permute(0, 2, 3, 1).contiguous().numpy()
        stream, parts = self._open(), _name_parts(name)
        if step is not None:
            parts.append(f"step {int(step)}")
        times = time_columns(np.arange(len(frames)), 1 / float(kwargs.get("fps", 1 / STEP_TIME)))
        with self._lock:
            send_images(stream, entity_path("videos", *parts), times, frames)
            self._tabs.add_view("videos", "/".join(parts))
            self._send()

    @typed
    def log_hparams(self, cfg: Mapping[Any, Any]) -> None:
        """Add a mapping (such as a dict or DictConfig) to the table "hparams"; nested keys become "actor.width"."""
        stream = self._open()
        with self._lock:
            self._hparams.update(_flatten(cfg))
            rows = [f"| {markdown(key)} | {markdown(value)} |" for key, value in sorted(self._hparams.items())]
            table = "\n".join(["| key | value |", "| --- | --- |", *rows])
            stream.log("hparams", rr.TextDocument(table, media_type=rr.MediaType.MARKDOWN), static=True)
            self._tabs.add_view("hparams")
            self._send()

    def log_histogram(self, name: str, data: Sequence[float] | Tensor | NDArray[Any], **kwargs: Any) -> None:
        """Log a histogram as "histograms/<name>", a bar chart on the timeline "global_step".

        Args:
            name: the histogram's name.
            data: finite numbers, in any shape.
            **kwargs: ``step``, as in :meth:`log_scalar`; ``bins``, the number of bins or the bin edges (default: 30).
        """
        values = np.asarray(torch.as_tensor(data).detach().cpu().to(torch.float64)).ravel()
        if not values.size or not np.isfinite(values).all():
            raise ValueError(f"data of histogram {name!r} must be finite and not empty, got {values.tolist()[:8]}")
        counts, edges = np.histogram(values, bins=kwargs.get("bins", 30))
        bars = {"abscissa": [(edges[1:] + edges[:-1]) / 2], "widths": [np.diff(edges)], "color": [BAR_COLOR]}
        chart = rr.BarChart.columns(values=[counts.astype(np.int64)], **bars)
        stream, path = self._open(), entity_path("histograms", *_name_parts(name))
        with self._lock:
            self._tabs.add_view("histograms", name)
            step = rr.TimeColumn(METRIC_TIMELINE, sequence=[self._count(path, kwargs.get("step"))])
            stream.send_columns(path, [step], chart)
            self._send()

    def flush(self, timeout: float | None = None) -> None:
        """Send all data to the file and the viewer, and wait at most ``timeout`` seconds (default: 5) for delivery."""
        if not self._service_shutdown:
            self._send(now=True, layout=self.connect is not None)
            with suppress(RuntimeError):  # a full disk or a lost viewer; Rerun has already printed an error
                self.experiment.flush(timeout_sec=FLUSH_SECONDS if timeout is None else timeout)

    def shutdown(self, timeout: float | None = None) -> None:
        """Flush and close the file; further calls do nothing."""
        if self._service_shutdown:
            return
        self._send(now=True, layout=True)
        self.flush(timeout)
        self._service_shutdown = True
        atexit.unregister(self.shutdown)
        # If the disk is full, Rerun's writer thread has ended. Rerun may wait forever for the thread, here and at exit.
        closing = threading.Thread(target=self.experiment.disconnect, daemon=True)
        closing.start()
        wait = FLUSH_SECONDS if timeout is None else timeout
        closing.join(wait if self.connect is None else wait + 4 * FLUSH_SECONDS)  # Rerun tries to reconnect once
        if closing.is_alive():
            rr.unregister_shutdown()
        if self.path is not None and not is_complete(self.path):
            warnings.warn(f"recording {str(self.path)!r} is incomplete: the end could not be written", stacklevel=2)

    def _checkpoint_state(self) -> dict[str, Any]:
        return {"counters": dict(self._counters)}

    def _load_checkpoint_state(self, state_dict: Mapping[str, Any]) -> None:
        self._counters = dict(state_dict.get("counters", {}))

    def _count(self, path: str, step: int | None) -> int:
        number = self._counters.get(path, 0) if step is None else int(step)
        self._counters[path] = number + 1
        return number

    def _send(self, *, now: bool = False, layout: bool = False) -> None:
        """Save new tabs, and send the buffered scalars if enough time has passed or ``now`` is true.

        Rerun accepts only complete layouts (0.1 MB per page), so the layout is sent to a file only at the end, and to a
        live viewer only occasionally.
        """
        with self._lock:
            stream, time_now = self.experiment, time.monotonic()
            self._tabs.save(stream)
            if not now and time_now - self._sent < max(SEND_SECONDS, SEND_SHARE * (time_now - self._began)):
                return
            self._sent = time_now
            waiting, self._scalars = self._scalars, {}
            for name, (steps, values) in waiting.items():
                index = [rr.TimeColumn(METRIC_TIMELINE, sequence=steps)]
                columns = rr.Scalars.columns(scalars=[number for row in values for number in row])
                path = entity_path("metrics", *name.split("/"))
                stream.send_columns(path, index, columns.partition([len(row) for row in values]))
            if layout or (self.connect is not None and self._tabs.has_grown):
                self._tabs.send(stream)

    @property
    def episodes(self) -> list[str]:
        """The names of the episodes recorded so far."""
        return list(self._tabs.pages)

    @typed
    def log_episode(
        self,
        rollout: TensorDictBase,
        *,
        task: str,
        objects: Mapping[str, Any] | None = None,
        plan: PlanLike | None = None,
        name: str | None = None,
        step_time: Positive | None = None,
    ) -> str:
        """Add one episode of any TorchRL environment: objects in 3-D, the verdict, the plan, the timeline and curves.

        A hand with a gripper is drawn if the layout of the observation is known, from the plan's task, from the suite
        that has the task, or because the observation has Meta-World's 39 values. To show the robot's own meshes, use
        :func:`lw_torchrl.log_rollout`. Row t is drawn at time step t, but the row's success and reward at t + 1. Return
        the episode's name.

        Args:
            rollout: one episode of batch size (T,). Without a layout, all keys are optional: "action" T×A, ("next",
                "success") T×1, ("next", "reward") T×1 float32, "pixels" T×H×W×C or T×C×H×W. With a layout,
                "observation" T×D float32 (metres) and "action" are required. The other keys of
                :func:`lw_torchrl.log_rollout` are also accepted. Columns beyond the plan's S steps are padding.
            task: the task's name.
            objects: name -> T×3 positions in metres; "robot's gripper" is added if the layout is known.
            plan: an object whose ``steps`` each have a ``condition`` and a ``skill``; None shows numbered columns.
            name: the tab's title and the root entity; None for ``task``, then "task-2" etc.
            step_time: seconds per time step; None for the value of the suite that has the task, otherwise 0.0125.

        Raises:
            ValueError: a column has a wrong shape or is not finite, or the name is already used.

        Example:
            >>> import tempfile, torch
            >>> from torchrl.envs import PendulumEnv
            >>> rollout = PendulumEnv().rollout(20)
            >>> tip = torch.stack((rollout["th"].sin(), torch.zeros(20), rollout["th"].cos()), -1)
            >>> with RerunLogger(tempfile.mkdtemp() + "/swing.rrd") as logger:
            ...     logger.log_episode(rollout, task="swing", objects={"tip": tip}, step_time=0.05)
            'swing'
        """
        suite, observation = known_suite(task), rollout.get("observation", None)
        layout = None if suite is None else suite.layout
        if isinstance(plan, ConditionalPlan):
            layout = plan.definition.layout
        elif layout is None and isinstance(observation, Tensor) and observation.shape[-1:] == (METAWORLD.size,):
            layout = METAWORLD
        step_time = step_time or (STEP_TIME if suite is None else suite.step_time)
        episode = RecordedEpisode.from_rollout(rollout, objects or {}, plan, layout, step_time)
        return self.add_page(Heading(task), episode, name=name)

    def add_page(
        self,
        heading: Heading,
        episode: RecordedEpisode,
        *,
        motion: Motion | None = None,
        ghost: Ghost | None = None,
        name: str | None = None,
    ) -> str:
        """Add the page of a validated episode and return its name; with a motion, the robot's meshes are shown."""
        stream = self._open()
        with self._lock:
            reserved, first = (*TITLES, OVERVIEW, *self._tabs.pages), heading.name if name is None else name
            if not first.strip() or (name is not None and name in reserved):
                raise ValueError(f"name {first!r} is empty or reserved (reserved: {', '.join(reserved)})")
            candidates = chain([first], (f"{first}-{i}" for i in count(2)))
            name = next(candidate for candidate in candidates if candidate not in reserved)
            page = send_page(stream, len(self.episodes) + 1, name, heading, episode, motion, ghost, self._meshes)
            self._tabs.add("page", vars(page))
            self._send()
        return name

    @typed
    def compare(self, names: Sequence[str], title: str = "Side by side") -> None:
        """Show the named episodes side by side in a tab before the episodes' own tabs, with a common time cursor."""
        self._open()
        if isinstance(names, str) or len(names) < 2:
            raise ValueError(f"names must hold at least two episode names, got {names!r}")
        with self._lock:
            self._tabs.add("compare", [title, [check_choice("names", name, self._tabs.pages) for name in names]])


def is_complete(path: Path) -> bool:
    """Return whether a recording was closed, in which case the file ends with an index."""
    with path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - 32))
        return b"RRF2FOOT" in file.read()


def _new_file(path: Path) -> Path:
    """Create the file ``path``, or if it exists, "run-2.rrd", "run-3.rrd", etc. (the first unused name), and return the
    path of the new file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    free, number = path, 1
    while True:
        with suppress(FileExistsError):
            free.touch(exist_ok=False)
            return free
        free, number = path.with_stem(f"{path.stem}-{number + 1}"), number + 1


def _name_parts(name: str) -> list[str]:
    parts = name.split("/") if isinstance(name, str) else []
    if not parts or not all(part.strip() for part in parts):
        raise ValueError(f"name must be non-empty parts joined by slashes, such as 'loss/bc', got {name!r}")
    return parts


def _numbers(name: str, value: Any) -> list[float]:
    """Convert a metric's value to a list of numbers."""
    if type(value) is float or type(value) is int:  # fast path for the usual case
        return [float(value)]
    try:
        value = value.detach().cpu() if isinstance(value, Tensor) else value
        values = torch.as_tensor(value, dtype=torch.float64).ravel().tolist()
    except (TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"value of {name!r} must be one or more numbers, got {value!r}") from error
    if not 1 <= len(values) <= MOST_CURVES:
        raise ValueError(f"value of {name!r} must be 1 to {MOST_CURVES} numbers, got {len(values)}; use log_histogram")
    return values


def _flatten(cfg: Mapping[Any, Any], prefix: str = "") -> dict[str, str]:
    """Flatten nested mappings into a dict of strings with dotted keys such as "actor.width"."""
    flat: dict[str, str] = {}
    for key, value in cfg.items():
        if isinstance(value, Mapping) and value:
            flat |= _flatten(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = str(value)
    return flat
