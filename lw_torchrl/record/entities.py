"""Helpers for all parts of a recording: entity paths, timelines, colors and images."""

import io
from collections.abc import Iterable
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray

if TYPE_CHECKING:
    import rerun as rr
    import rerun.blueprint as rrb
else:

    class _LazyModule:
        """A module that is imported on first use, because importing rerun takes a second and few programs record."""

        def __init__(self, name: str) -> None:
            self._name = name

        def __getattr__(self, attribute: str) -> Any:
            value = getattr(import_module(self._name), attribute)
            setattr(self, attribute, value)
            return value

    rr, rrb = _LazyModule("rerun"), _LazyModule("rerun.blueprint")

EPISODE_TIMELINE, SECONDS_TIMELINE, METRIC_TIMELINE = "step", "time", "global_step"
STEP_TIME = 0.0125  # seconds per time step if the suite is unknown: Meta-World's 80 Hz
JPEG_QUALITY = 90

Color = tuple[int, ...]
TRUE, FALSE = (70, 170, 105), (52, 56, 64)
STEEL, GOLD, GREEN = (205, 210, 220), (255, 200, 60), (90, 220, 120)
_SERIES = ("50aaff", "ff9646", "6ed778", "e16ee1", "f0d750", "64d7d7", "fa6e78", "aa96fa")
SERIES_COLORS: tuple[Color, ...] = tuple(tuple(bytes.fromhex(color)) for color in _SERIES)


def step_color(step: int) -> Color:
    """Return the color of a plan step (0-based index), which is the same in all views."""
    return SERIES_COLORS[step % len(SERIES_COLORS)]


def entity_path(*parts: str) -> str:
    """Join parts, which may contain any character, into an absolute entity path."""
    return "".join("/" + rr.escape_entity_path_part(part) for part in parts)


def changes(values: NDArray[Any]) -> NDArray[np.int64]:
    """Return the indices of the rows of T×K values that differ from the previous row, and of the first row."""
    return np.flatnonzero(np.concatenate([[True], (values[1:] != values[:-1]).any(axis=1)]))


def time_columns(steps: NDArray[np.int64], step_time: float) -> list[Any]:
    """Return the columns of an episode's two timelines: time steps, and seconds (``step_time`` per time step)."""
    nanoseconds = (steps * round(step_time * 1e9)).astype("timedelta64[ns]")
    return [rr.TimeColumn(EPISODE_TIMELINE, sequence=steps), rr.TimeColumn(SECONDS_TIMELINE, duration=nanoseconds)]


def check_image(name: str, image: Any) -> NDArray[np.uint8]:
    """Convert an image of shape H×W, H×W×C or C×H×W (C = 1 or 3), uint8 or float in [0, 1], to H×W×C uint8."""
    pixels = torch.as_tensor(image).detach().cpu()
    shape = tuple(pixels.shape)
    pixels = pixels[..., None] if len(shape) == 2 else pixels
    if len(shape) == 3 and shape[-1] not in (1, 3):
        pixels = pixels.movedim(0, -1)
    if pixels.is_floating_point() and bool(((pixels >= 0) & (pixels <= 1)).all()):
        pixels = (pixels * 255).round().to(torch.uint8)
    if pixels.ndim != 3 or pixels.shape[-1] not in (1, 3) or not pixels.numel() or pixels.dtype != torch.uint8:
        raise ValueError(f"image {name!r} must be H×W, H×W×C or C×H×W, uint8 or in [0, 1], got {pixels.dtype} {shape}")
    return pixels.contiguous().numpy()


def send_images(stream: Any, path: str, times: Any, images: Iterable[NDArray[np.uint8]]) -> None:
    """Log images H×W×C at the given times, encoded as JPEG."""
    from PIL import Image

    jpegs = []
    for pixels in images:
        buffer = io.BytesIO()
        Image.fromarray(pixels[..., 0] if pixels.shape[-1] == 1 else pixels).save(buffer, "JPEG", quality=JPEG_QUALITY)
        jpegs.append(buffer.getvalue())
    stream.log(path, rr.EncodedImage.from_fields(media_type="image/jpeg"), static=True)
    stream.send_columns(path, times, rr.EncodedImage.columns(blob=jpegs))
