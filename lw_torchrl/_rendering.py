"""Names a rendering library that is absent; TorchRL loads MuJoCo, and with it that library, wherever it is imported."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

RENDER_LIBRARIES = {
    "egl": "libEGL (Debian: apt-get install libegl1)",
    "osmesa": "OSMesa (Debian: apt-get install libosmesa6)",
}


@contextmanager
def naming_absent_renderer() -> Iterator[None]:
    """Say what the obscure AttributeError of importing MuJoCo means: the library that MUJOCO_GL asks for is absent."""
    try:
        yield
    except AttributeError as error:
        backend = os.environ.get("MUJOCO_GL", "").lower()
        if backend not in RENDER_LIBRARIES:
            raise
        raise ImportError(
            f"MUJOCO_GL is {backend!r}, but {RENDER_LIBRARIES[backend]} is not installed. Install it, or unset "
            "MUJOCO_GL: only camera images need it."
        ) from error
