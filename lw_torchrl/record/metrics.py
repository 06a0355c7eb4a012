"""What training logs: curves, histograms, videos and hyperparameters, checked and sent to a recording."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lw_torchrl.record.timelines import METRIC_TIMELINE, time_columns

if TYPE_CHECKING:
    from rerun import RecordingStream


def check_name(name: str) -> str:
    """Return a metric's name, else raise :class:`ValueError`."""
    if not isinstance(name, str) or not all(part.strip() for part in name.split("/")):
        raise ValueError(f"name must be words joined by single slashes like 'loss/bc', got {name!r}")
    return name


def send_scalars(stream: RecordingStream, path: str, steps: Sequence[int], values: Sequence[float]) -> None:
    """Add numbers to the curve ``path``."""
    import rerun as rr

    index = [rr.TimeColumn(METRIC_TIMELINE, sequence=steps)]
    stream.send_columns(path, index, rr.Scalars.columns(scalars=values))


def histogram(name: str, data: Any, bins: Any) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """The counts of ``data`` and the edges of the bins, whose number or edges ``bins`` are."""
    values = np.asarray(torch.as_tensor(data).detach().cpu().to(torch.float64)).ravel()
    if not values.size or not np.isfinite(values).all():
        raise ValueError(f"data of histogram {name!r} must be finite and not empty, got {values.tolist()[:8]}")
    counts, edges = np.histogram(values, bins=bins)
    return counts.astype(np.int64), edges


def send_histogram(
    stream: RecordingStream, path: str, step: int, counts: NDArray[np.int64], edges: NDArray[np.float64]
) -> None:
    """Add counts as a bar chart."""
    import rerun as rr

    index = [rr.TimeColumn(METRIC_TIMELINE, sequence=[step])]
    chart = rr.BarChart.columns(values=[counts], abscissa=[(edges[1:] + edges[:-1]) / 2])
    stream.send_columns(path, index, chart)


def check_video(name: str, video: Tensor) -> None:
    """Raise :class:`ValueError` unless ``video`` is uint8 of shape T×C×H×W, C = 1 or 3, and not empty."""
    if video.ndim != 4 or video.shape[1] not in (1, 3) or not video.numel() or video.dtype != torch.uint8:
        raise ValueError(
            f"video {name!r} must be uint8 of shape T×C×H×W with C = 1 or 3, "
            f"got {str(video.dtype).removeprefix('torch.')} of shape {'×'.join(map(str, video.shape))}"
        )


def send_video(stream: RecordingStream, path: str, video: Tensor, fps: float) -> None:
    """Add the frames T×C×H×W of a video as images."""
    import rerun as rr

    frames, channels, height, width = video.shape
    image_format = rr.components.ImageFormat(
        width=width, height=height, color_model="RGB" if channels == 3 else "L", channel_datatype="U8"
    )
    stream.log(path, rr.Image.from_fields(format=image_format), static=True)
    pixels = video.permute(0, 2, 3, 1).reshape(frames, -1).contiguous().numpy()
    times = time_columns(np.arange(frames), 1 / fps)
    stream.send_columns(path, times, rr.Image.columns(buffer=pixels))


def send_hparams(stream: RecordingStream, hparams: Mapping[str, str]) -> None:
    """Show hyperparameters as a table, sorted by name."""
    import rerun as rr

    rows = [f"| {_cell(key)} | {_cell(value)} |" for key, value in sorted(hparams.items())]
    text = "\n".join(["| key | value |", "|---|---|", *rows])
    stream.log("hparams", rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN), static=True)


def flatten(cfg: Mapping[Any, Any], prefix: str = "") -> dict[str, str]:
    """Nested mappings as one: "actor.width" to the text of its value."""
    flat: dict[str, str] = {}
    for key, value in cfg.items():
        if isinstance(value, Mapping) and value:
            flat |= flatten(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = str(value)
    return flat


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")
