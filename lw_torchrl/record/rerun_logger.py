"""RerunLogger: torchrl's Logger, written to one rerun recording (.rrd)."""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import TYPE_CHECKING, Any

import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.record.loggers import Logger

from lw_torchrl.record.blueprint import make_blueprint, metric_views
from lw_torchrl.record.episodes import episode_name
from lw_torchrl.record.heading import Heading
from lw_torchrl.record.metrics import (
    check_name,
    check_video,
    flatten,
    histogram,
    send_histogram,
    send_hparams,
    send_scalars,
    send_video,
)
from lw_torchrl.record.mujoco_scene import Motion
from lw_torchrl.record.page import send_page
from lw_torchrl.record.recorded_episode import PlanLike, RecordedEpisode
from lw_torchrl.record.recording_file import check_path, hidden_beside, open_stream
from lw_torchrl.record.timelines import CONTROL_PERIOD, entity_path

if TYPE_CHECKING:
    from rerun import RecordingStream

BUFFERED_SCALARS = 1024


class RerunLogger(Logger):
    """A torchrl Logger that writes one rerun recording: metrics, videos, and whole episodes in 3-D.

    The recording grows in a hidden file beside ``path`` and takes that name at :meth:`shutdown`, replacing a
    file that has it already; until then, and after an error inside a ``with`` block, ``path`` is untouched.
    The recording is the logger's own: rerun's global one is neither used nor changed.

    Args:
        path: the file, ending in ".rrd"; missing folders are made.
        exp_name: the name of the run; None takes the file's, without ".rrd".
        application_id: recordings of one application share their layout in rerun's viewer.

    Attributes:
        path: the file, as a Path.
        experiment: the rerun RecordingStream, for logging more by hand.

    Raises:
        ValueError: ``path`` does not end in ".rrd", is a folder, or lies below a file.

    Example:
        >>> import tempfile, os
        >>> path = os.path.join(tempfile.mkdtemp(), "train.rrd")
        >>> with RerunLogger(path) as logger:
        ...     logger.log_hparams({"lr": 3e-4, "actor": {"width": 256}})
        ...     logger.log_scalar("loss/bc", 0.25, step=10)
        >>> os.path.exists(path)
        True
    """

    experiment: RecordingStream
    _service_shutdown: bool = False

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        exp_name: str | None = None,
        application_id: str = "lw_torchrl",
    ) -> None:
        self.path = check_path(path)
        self.application_id = application_id
        self._partial = hidden_beside(self.path)
        self._scalars: defaultdict[str, tuple[list[int], list[float]]] = defaultdict(lambda: ([], []))
        self._counters: dict[str, int] = {}
        self._hparams: dict[str, str] = {}
        self._episodes: dict[str, Any] = {}
        self._histograms: dict[str, None] = {}
        self._videos: dict[str, None] = {}
        super().__init__(exp_name=exp_name or self.path.stem, log_dir=str(self.path.parent))

    def _create_experiment(self) -> RecordingStream:
        stream = open_stream(self._partial, self.application_id, self.exp_name)
        # In another process (service_backend="process") torchrl ends the experiment, not the logger.
        stream.finish = self.shutdown
        return stream

    def __repr__(self) -> str:
        state = "closed" if self._service_shutdown else "open"
        return f"RerunLogger(path={str(self.path)!r}, exp_name={self.exp_name!r}, {state})"

    def __enter__(self) -> RerunLogger:
        return self.start()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self.shutdown()
        else:
            self.discard()

    def _open(self) -> RecordingStream:
        if self._service_shutdown:
            raise RuntimeError(f"{self!r} takes nothing more; make a new RerunLogger")
        return self.experiment

    # ---------------------------------------------------------------- torchrl's Logger

    def log_scalar(self, name: str, value: float, step: int | None = None) -> None:
        """Add a number to the curve "metrics/<name>", on the timeline "global_step".

        Args:
            name: "loss/bc"; slashes make a tree.
            value: a number, or a tensor of one element; NaN is recorded, and leaves a gap.
            step: the training step; None counts the calls with this name from 0.
        """
        self._open()
        steps, values = self._scalars[check_name(name)]
        try:
            number = float(value)
        except (TypeError, ValueError, RuntimeError) as error:
            raise ValueError(f"value of {name!r} must be one number, got {value!r}") from error
        steps.append(self._count(f"metrics/{name}", step))
        values.append(number)
        if len(values) >= BUFFERED_SCALARS:
            self._send_scalars(name)

    def log_video(self, name: str, video: Tensor, step: int | None = None, **kwargs: Any) -> None:
        """Add a video as images "videos/<name>", frame i at step i of the episodes' timelines.

        Args:
            name: "eval/corner2".
            video: T×C×H×W uint8, C = 1 or 3; or N×T×C×H×W, stored as "videos/<name>/0" and so on.
            step: the training step; it becomes part of the path, "videos/<name>/step 1000".
            **kwargs: ``fps``, frames a second (80, the rate of Meta-World's control); others are ignored.

        Raises:
            ValueError: the video has another shape or dtype, or no frames.
        """
        video = torch.as_tensor(video).detach().cpu()
        if video.ndim == 5 and len(video) != 1:
            for i, one in enumerate(video):
                self.log_video(f"{name}/{i}", one, step, **kwargs)
            return
        video = video[0] if video.ndim == 5 else video
        check_video(name, video)
        stream, path = self._open(), entity_path("videos", *check_name(name).split("/"))
        if step is not None:
            path += entity_path(f"step {int(step)}")
        send_video(stream, path, video, float(kwargs.get("fps", 1 / CONTROL_PERIOD)))
        self._videos[path] = None

    def log_hparams(self, cfg: Any) -> None:
        """Show the configuration as a table of keys and values in "hparams"; a later call adds to it.

        Args:
            cfg: a mapping (a DictConfig too), nested ones are written "actor.width".
        """
        if not isinstance(cfg, Mapping):
            raise TypeError(f"cfg must be a mapping, got {type(cfg).__name__}")
        self._hparams.update(flatten(cfg))
        send_hparams(self._open(), self._hparams)

    def log_histogram(self, name: str, data: Sequence[float] | Tensor | NDArray[Any], **kwargs: Any) -> None:
        """Add the counts of ``data`` as a bar chart "histograms/<name>", on the timeline "global_step".

        Args:
            name: "actor/action".
            data: numbers of any shape, all finite.
            **kwargs: ``step``, the training step (None counts the calls), and ``bins``, their number or their
                edges (30).

        Raises:
            ValueError: ``data`` is empty or holds a NaN or an infinity.
        """
        counts, edges = histogram(name, data, kwargs.get("bins", 30))
        path = entity_path("histograms", *check_name(name).split("/"))
        send_histogram(self._open(), path, self._count(path, kwargs.get("step")), counts, edges)
        self._histograms[path] = None

    def flush(self, timeout: float | None = None) -> None:
        """Write what is buffered to the hidden file, within ``timeout`` seconds."""
        if not self._service_shutdown:
            for name in list(self._scalars):
                self._send_scalars(name)
            self.experiment.flush(timeout_sec=1e38 if timeout is None else timeout)

    def shutdown(self, timeout: float | None = None) -> None:
        """Write the rest and the layout, close the file and give it its name. A second call does nothing."""
        if self._service_shutdown:
            return
        others = metric_views(
            metrics=bool(self._scalars),
            histograms=list(self._histograms),
            videos=list(self._videos),
            hparams=bool(self._hparams),
        )
        self.experiment.send_blueprint(make_blueprint(list(self._episodes.values()), others))
        self.flush(timeout)
        self.experiment.disconnect()
        self._service_shutdown = True
        os.replace(self._partial, self.path)

    def discard(self) -> None:
        """Close without a file: what was logged is dropped, ``path`` stays as it was."""
        if not self._service_shutdown:
            self.experiment.disconnect()
            self._service_shutdown = True
            self._partial.unlink(missing_ok=True)

    def _checkpoint_state(self) -> dict[str, Any]:
        return {"counters": dict(self._counters)}

    def _load_checkpoint_state(self, state_dict: Mapping[str, Any]) -> None:
        self._counters = dict(state_dict.get("counters", {}))

    def _count(self, path: str, step: int | None) -> int:
        now = self._counters.get(path, 0) if step is None else int(step)
        self._counters[path] = now + 1
        return now

    def _send_scalars(self, name: str) -> None:
        steps, values = self._scalars[name]
        if values:
            send_scalars(self.experiment, entity_path("metrics", *name.split("/")), steps, values)
            steps.clear()
            values.clear()

    # ---------------------------------------------------------------- episodes

    @property
    def episodes(self) -> list[str]:
        """The names of the episodes so far."""
        return list(self._episodes)

    def log_episode(
        self,
        rollout: TensorDictBase,
        *,
        task: str,
        objects: Mapping[str, Any],
        plan: PlanLike | None = None,
        name: str | None = None,
    ) -> str:
        """Add one episode of anything: a simple scene in 3-D, the verdict, the plan, lanes and curves.

        For Meta-World's robot as it is, see :func:`lw_torchrl.log_rollout`. Row t stands at step t and
        t · 0.0125 seconds; success and reward, its action's outcome, at t + 1.

        Args:
            rollout: batch size (T,). "observation" T×39 (metres), "action" T×4 in [-1,1], or in its place
                ("next", "executed_action"); optional are "qaf" T×S bool, "qaf_logits" T×S, "skill_weights" T×S,
                "action_corrected" T×1, ("next", "success") T×1 bool, ("next", "reward") T×1. Columns beyond the
                plan's steps are padding and left out.
            task: the task's name.
            objects: name -> T×3 positions in metres; without "robot's gripper" it is observation 0:3.
            plan: its ``steps`` each have a ``condition`` and a ``skill``; None shows numbered columns.
            name: the entity that all lies under, and the tab's title; None takes ``task``, then "task-2".

        Returns:
            The name.

        Raises:
            ValueError: a key is missing, has another shape or dtype, or holds a NaN; the name is taken.
            TypeError: ``rollout`` is no TensorDict, ``objects`` no mapping of strings.

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
        episode = RecordedEpisode.from_rollout(rollout, objects, plan)
        return self.add_page(Heading(task), episode, name=name)

    def add_page(
        self, heading: Heading, episode: RecordedEpisode, *, motion: Motion | None = None, name: str | None = None
    ) -> str:
        """Add the page of an episode that was checked; returns its name. With a motion the robot is shown as it is."""
        stream = self._open()
        entity = episode_name(heading.name, name, self._episodes)
        title = heading.title(episode, name)
        self._episodes[entity] = send_page(stream, entity, title, heading, episode, motion)
        return entity
