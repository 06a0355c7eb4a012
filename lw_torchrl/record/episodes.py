"""An episode's name in a recording, and all that is shown of it."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from typing import TYPE_CHECKING

from lw_torchrl.record.blueprint import episode_view, log_curves, log_lanes, log_plan
from lw_torchrl.record.recorded_episode import RecordedEpisode
from lw_torchrl.record.scene import log_scene
from lw_torchrl.record.timelines import entity_path

if TYPE_CHECKING:
    import rerun.blueprint as rrb
    from rerun import RecordingStream

RESERVED = ("metrics", "histograms", "videos", "hparams")


def episode_name(task: str, name: str | None, taken: Collection[str]) -> str:
    """The name of an episode: the one given, or the task's, then "task 2"; one that is taken is a ValueError."""
    if not isinstance(task, str) or not task.strip():
        raise ValueError(f"task must be a task's name, got {task!r}")
    if name is None:
        names: Iterator[str] = (task if i == 1 else f"{task} {i}" for i in range(1, len(taken) + 2))
        return next(free for free in names if free not in taken)
    if not isinstance(name, str) or not name.strip():
        raise ValueError(f"name must be a non-empty string, got {name!r}")
    if name in taken or name in RESERVED:
        raise ValueError(f"name must be another than {', '.join((*RESERVED, *taken))}, got {name!r}")
    return name


def send_episode(stream: RecordingStream, name: str, task: str, episode: RecordedEpisode) -> rrb.Horizontal:
    """Add an episode's scene, plan, curves and lanes under ``name``; returns the views of them."""
    root = entity_path(name)
    trails = log_scene(stream, root, episode)
    if episode.steps:
        log_plan(stream, root, task, episode.steps)
    log_curves(stream, root, episode)
    lanes = log_lanes(stream, root, episode)
    return episode_view(
        root,
        name,
        trails=trails,
        steps=len(episode.steps),
        lanes=lanes,
        skill_weights=episode.skill_weights is not None,
    )
