"""Training metrics: curves, histograms, images, videos and hyperparameters, checked and sent to a recording."""

import io
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lw_torchrl.record.entities import rr

MOST_CURVES = 64
JPEG_QUALITY = 90
BARS = (80, 170, 255)


def check_name(name: str) -> str:
    """Return a metric's name, else raise :class:`ValueError`."""
    if not isinstance(name, str) or not all(part.strip() for part in name.split("/")):
        raise ValueError(f"name must be words joined by single slashes like 'loss/bc', got {name!r}")
    return name


def numbers(name: str, value: Any) -> list[float]:
    """Return a metric's value as a list of numbers, or raise :class:`ValueError`."""
    if type(value) is float or type(value) is int:
        return [float(value)]
    try:
        value = value.detach().cpu() if isinstance(value, Tensor) else value
        values = torch.as_tensor(value, dtype=torch.float64).ravel().tolist()
    except (TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"value of {name!r} must be a number or several, got {value!r}") from error
    if not 1 <= len(values) <= MOST_CURVES:
        hint = "; log_histogram shows more" if values else ""
        raise ValueError(f"value of {name!r} must be 1 to {MOST_CURVES} numbers, got {len(values)}{hint}")
    return values


def histogram(name: str, data: Any, bins: Any) -> Any:
    """Return the counts of ``data`` as a bar chart in columns; ``bins`` is the number or the edges of the bins."""
    values = np.asarray(torch.as_tensor(data).detach().cpu().to(torch.float64)).ravel()
    if not values.size or not np.isfinite(values).all():
        raise ValueError(f"data of histogram {name!r} must be finite and not empty, got {values.tolist()[:8]}")
    counts, edges = np.histogram(values, bins=bins)
    centers, widths = (edges[1:] + edges[:-1]) / 2, np.diff(edges)
    return rr.BarChart.columns(values=[counts.astype(np.int64)], abscissa=[centers], widths=[widths], color=[BARS])


def check_image(name: str, image: Any) -> NDArray[np.uint8]:
    """Return an image as H×W×C uint8: from H×W, H×W×C or C×H×W with C = 1 or 3, of uint8 or of floats in [0, 1]."""
    pixels = torch.as_tensor(image).detach().cpu()
    shape = tuple(pixels.shape)
    if pixels.ndim == 2:
        pixels = pixels[..., None]
    elif pixels.ndim == 3 and shape[-1] not in (1, 3) and shape[0] in (1, 3):
        pixels = pixels.permute(1, 2, 0)
    if pixels.is_floating_point() and bool(((pixels >= 0) & (pixels <= 1)).all()):
        pixels = (pixels * 255).round().to(torch.uint8)
    if pixels.ndim != 3 or pixels.shape[-1] not in (1, 3) or not pixels.numel() or pixels.dtype != torch.uint8:
        wanted = "uint8, or floats in [0, 1], of shape H×W, H×W×C or C×H×W with C = 1 or 3"
        given = f"{str(pixels.dtype).removeprefix('torch.')} of shape {'×'.join(map(str, shape))}"
        raise ValueError(f"image {name!r} must be {wanted}, got {given}")
    return pixels.contiguous().numpy()


def send_images(stream: Any, path: str, times: Any, images: Iterable[NDArray[np.uint8]]) -> None:
    """Add images H×W×C, each a JPEG at its time."""
    from PIL import Image

    jpegs = []
    for pixels in images:
        buffer = io.BytesIO()
        Image.fromarray(pixels[..., 0] if pixels.shape[-1] == 1 else pixels).save(buffer, "JPEG", quality=JPEG_QUALITY)
        jpegs.append(buffer.getvalue())
    stream.log(path, rr.EncodedImage.from_fields(media_type="image/jpeg"), static=True)
    stream.send_columns(path, times, rr.EncodedImage.columns(blob=jpegs))


def flatten(cfg: Mapping[Any, Any], prefix: str = "") -> dict[str, str]:
    """Flatten nested mappings: "actor.width" to the text of its value."""
    flat: dict[str, str] = {}
    for key, value in cfg.items():
        if isinstance(value, Mapping) and value:
            flat |= flatten(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = str(value)
    return flat
