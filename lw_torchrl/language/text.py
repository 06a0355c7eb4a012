"""Text encoders: English to vectors. Those of the shipped texts come with the package; other texts need the extra."""

from collections.abc import Sequence
from functools import lru_cache
from importlib.resources import as_file, files
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from torch import Tensor

TEXT_DIMENSION = 384
TABLE = "embeddings.npz"


@runtime_checkable
class TextEncoder(Protocol):
    """Any function of n texts to (n, D) float32; modules take one as ``text_encoder``."""

    def __call__(self, texts: Sequence[str]) -> Tensor: ...


@lru_cache(maxsize=1)
def _shipped() -> dict[str, Tensor]:
    with as_file(files("lw_torchrl.language") / "data" / TABLE) as path:
        if not path.is_file():
            return {}
        with np.load(path, allow_pickle=False) as table:
            return dict(zip(table["texts"].tolist(), torch.from_numpy(table["vectors"]).float(), strict=True))


def sentence_encoder(texts: Sequence[str]) -> Tensor:
    """Encode texts with all-MiniLM-L6-v2, (n, 384) float32 of length 1; needs the extra ``[text]``."""
    from lw_torchrl.language.embeddings import sentence_vectors  # here: only texts that are not shipped need the model

    return torch.from_numpy(sentence_vectors(texts))


def encode_texts(texts: Sequence[str]) -> Tensor:
    """The default encoder: n texts to (n, 384) float32, each of length 1.

    The shipped texts have shipped vectors; for all others the extra ``[text]`` is needed, an ImportError without it.
    """
    shipped = _shipped()
    new = sorted({*texts} - shipped.keys())
    vectors = shipped | (dict(zip(new, sentence_encoder(new), strict=True)) if new else {})
    return torch.stack([vectors[text] for text in texts])


def encoded(texts: Sequence[str], encoder: TextEncoder | None) -> Tensor:
    """The vectors of texts by an encoder, None for the default one, checked: (n, E) float32."""
    if not callable(encoder or encode_texts):
        raise TypeError(f"text_encoder must be a function of texts, got {encoder!r:.80}")
    found = (encoder or encode_texts)(texts)
    if not isinstance(found, Tensor) or not found.is_floating_point():
        raise TypeError(f"text_encoder must give a tensor of floats, got {found!r:.80}")
    if found.ndim != 2 or len(found) != len(texts):
        raise ValueError(f"text_encoder must give ({len(texts)}, E), got shape {tuple(found.shape)}")
    if not found.isfinite().all():
        wrong = texts[int((~found.isfinite()).any(-1).nonzero()[0])]
        raise ValueError(f"text_encoder must give finite numbers, it gives NaN or infinity for {wrong!r}")
    return found.detach().to(torch.float32)
