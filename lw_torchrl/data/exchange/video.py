"""Pictures that ``add_pictures`` rendered, as the video files of a LeRobot dataset."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from lw_torchrl._util.progress import Progress
from lw_torchrl.data.dataset import Demonstrations
from lw_torchrl.data.exchange.table import Array
from lw_torchrl.data.pictures import Pictures

PATH = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
_TOGETHER = 100  # episodes in a file
_FOLDER = re.compile(r"(.+)-(\d+)x(\d+)-every(\d+)")


def existing_pictures(demonstrations: Demonstrations) -> dict[str, Pictures]:
    """The pictures that all episodes of a dataset have, by LeRobot's name of their column."""
    pictures = {}
    for match in filter(None, (_FOLDER.fullmatch(path.name) for path in (demonstrations.root / "pictures").glob("*"))):
        cameras, *sizes = match.groups()
        rendered = Pictures(tuple(cameras.split("+")), *map(int, sizes))
        if all(rendered.file(demonstrations.root, episode).is_file() for episode in demonstrations.episodes):
            pictures[f"observation.images.{match[0]}"] = rendered
    return pictures


def _format(pictures: Pictures) -> str:
    return "yuv444p" if any(size % 2 for size in pictures.shape[:2]) else "yuv420p"


def feature_of(pictures: Pictures, fps: int) -> dict[str, Any]:
    """The entry of a video in LeRobot's info.json."""
    height, width, _ = pictures.shape
    info = {"video.height": height, "video.width": width, "video.codec": "h264", "video.pix_fmt": _format(pictures)}
    info |= {"video.is_depth_map": False, "video.fps": fps, "video.channels": 3, "has_audio": False}
    return {"dtype": "video", "shape": [height, width, 3], "names": ["height", "width", "channels"], "info": info}


def statistics(values: Array) -> dict[str, Array]:
    """Statistics of the rows (R, n), as LeRobot names them."""
    found = {name: getattr(values, name)(0) for name in ("min", "max", "mean", "std")}
    return found | {"count": np.array([len(values)])}


def combined(parts: list[dict[str, Array]]) -> dict[str, Array]:
    """The statistics of all rows, from those of parts."""
    each = {name: np.stack([part[name] for part in parts]) for name in parts[0]}
    share = (each["count"] / each["count"].sum()).reshape(-1, *[1] * (each["mean"].ndim - 1))
    mean = (each["mean"] * share).sum(0)
    variance = ((each["std"] ** 2 + (each["mean"] - mean) ** 2) * share).sum(0)
    whole = {"min": each["min"].min(0), "max": each["max"].max(0), "mean": mean, "std": np.sqrt(variance)}
    return whole | {"count": each["count"].sum(0)}


def write_videos(
    demonstrations: Demonstrations, pictures: Pictures, folder: Path, key: str, fps: int
) -> tuple[dict[str, list[Any]], list[dict[str, Array]]]:
    """Write a picture for each row; rows between two rendered pictures show the earlier one. Return where each episode
    is, and the statistics of its pixels, from 0 to 1, (3, 1, 1)."""
    import av

    names = ("chunk_index", "file_index", "from_timestamp", "to_timestamp")
    places: dict[str, list[Any]] = {name: [] for name in names}
    each = []
    with Progress("writing videos", demonstrations.num_steps, "picture") as bar:
        for number in range(0, len(demonstrations.episodes), _TOGETHER):
            chunk, file = divmod(number // _TOGETHER, 1000)
            path = folder / PATH.format(video_key=key, chunk_index=chunk, file_index=file)
            path.parent.mkdir(parents=True, exist_ok=True)
            frame = 0
            with av.open(str(path), "w") as container:
                stream = container.add_stream("libx264", rate=fps, options={"crf": "18", "g": "2", "bf": "0"})
                stream.height, stream.width, stream.pix_fmt = *pictures.shape[:2], _format(pictures)
                for episode in demonstrations.episodes[number : number + _TOGETHER]:
                    images = pictures.read(demonstrations.root, episode).numpy()
                    for image in images[np.arange(episode.length) // pictures.every]:
                        container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
                    values = statistics(images.reshape(-1, 3) / 255)
                    each.append(
                        {kind: one if kind == "count" else one.reshape(3, 1, 1) for kind, one in values.items()}
                    )
                    times = frame / fps, (frame + episode.length) / fps
                    for name, value in zip(names, (chunk, file, *times), strict=True):
                        places[name].append(value)
                    frame += episode.length
                    bar.update(episode.length)
                container.mux(stream.encode())
    return places, each
