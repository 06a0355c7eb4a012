"""Pictures of a dataset, which ``add_pictures`` drew, as the video files of a LeRobot dataset."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from lw_torchrl._progress import Progress
from lw_torchrl.data.dataset import Demonstrations
from lw_torchrl.data.pictures import Pictures

FPS = 80  # steps a second of Meta-World's control, and so pictures
PATH = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
_TOGETHER = 100  # episodes in a file
_FOLDER = re.compile(r"(.+)-(\d+)x(\d+)-every(\d+)")


def drawn_pictures(found: Demonstrations) -> dict[str, Pictures]:
    """What was drawn of a dataset, all of its episodes: LeRobot's name of the column, and which pictures."""
    made = {}
    for folder in sorted((found.root / "pictures").glob("*")):
        if told := _FOLDER.fullmatch(folder.name):
            cameras, *sizes = told.groups()
            drawn = Pictures(tuple(cameras.split("+")), *map(int, sizes))
            if all(drawn.file(found.root, episode).is_file() for episode in found.episodes):
                made[f"observation.images.{folder.name}"] = drawn
    return made


def _format(drawn: Pictures) -> str:
    return "yuv444p" if any(size % 2 for size in drawn.shape[:2]) else "yuv420p"


def feature_of(drawn: Pictures) -> dict[str, Any]:
    """What LeRobot's info.json says of such a video."""
    height, width, _ = drawn.shape
    told = {"video.height": height, "video.width": width, "video.codec": "h264", "video.pix_fmt": _format(drawn)}
    told |= {"video.is_depth_map": False, "video.fps": FPS, "video.channels": 3, "has_audio": False}
    return {"dtype": "video", "shape": [height, width, 3], "names": ["height", "width", "channels"], "info": told}


@contextmanager
def _file(path: Path, drawn: Pictures) -> Iterator[Any]:
    """A function that appends pictures, (n, H, W, 3) uint8, to a new video file."""
    import av

    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=FPS, options={"crf": "18", "g": "2", "bf": "0"})
        stream.height, stream.width, stream.pix_fmt = *drawn.shape[:2], _format(drawn)

        def append(pictures: Any) -> None:
            for picture in pictures:
                container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))

        yield append
        container.mux(stream.encode())


def write_videos(
    found: Demonstrations, drawn: Pictures, folder: Path, key: str
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Write a picture for each row, between two that were drawn the earlier one. Where each episode is, and the
    statistics of each, from 0 to 1, (E, 3)."""
    files = [found.episodes[first : first + _TOGETHER] for first in range(0, len(found.episodes), _TOGETHER)]
    places: dict[str, list[Any]] = {
        name: [] for name in ("chunk_index", "file_index", "from_timestamp", "to_timestamp")
    }
    kinds: dict[str, list[Any]] = {name: [] for name in ("min", "max", "mean", "std", "count")}
    with Progress("writing videos", found.num_steps, "picture") as bar:
        for number, episodes in enumerate(files):
            chunk, frame = divmod(number, 1000)[0], 0
            path = folder / PATH.format(video_key=key, chunk_index=chunk, file_index=number % 1000)
            with _file(path, drawn) as append:
                for episode in episodes:
                    pictures = drawn.read(found.root, episode).numpy()
                    append(pictures[np.arange(episode.length) // drawn.every])
                    values = pictures.reshape(-1, 3) / 255
                    for name in ("min", "max", "mean", "std"):
                        kinds[name].append(getattr(values, name)(0))
                    kinds["count"].append([len(pictures)])
                    between = frame / FPS, (frame + episode.length) / FPS
                    for name, value in zip(places, (chunk, number % 1000, *between), strict=True):
                        places[name].append(value)
                    frame += episode.length
                    bar.update(episode.length)
    return places, {name: np.stack(values) for name, values in kinds.items()}
