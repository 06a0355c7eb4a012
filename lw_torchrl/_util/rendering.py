"""Check camera names and image sizes, and raise an error that names a missing rendering library."""

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from lw_torchrl._util.checks import Count, check_choice, check_value

RENDER_LIBRARIES = {
    "egl": "libEGL (Debian: apt-get install libegl1)",
    "osmesa": "OSMesa (Debian: apt-get install libosmesa6)",
}
CAMERAS = ("corner2", "corner", "corner3", "corner4", "topview", "behindGripper", "gripperPOV")  # Meta-World's cameras
_LARGEST = 4096  # pixels along a side


def check_picture(camera: str, height: int, width: int, most: int = _LARGEST) -> None:
    """Raise a :class:`ValueError` if the camera is unknown, or the height or width is not in [1, ``most``] pixels."""
    check_choice("camera", camera, CAMERAS)
    if max(check_value("height", height, Count), check_value("width", width, Count)) > most:
        raise ValueError(f"height and width must be at most {most} pixels, got {height} and {width}")


def check_cameras(cameras: str | Sequence[str], height: int, width: int, most: int = _LARGEST) -> tuple[str, ...]:
    """Return the camera names as a tuple; raise an error if there are none, or if a name is unknown or repeated."""
    names = (cameras,) if isinstance(cameras, str) else tuple(cameras)
    if not names or len({*names}) < len(names):
        raise ValueError(f"cameras must be one or more distinct names, got {cameras!r}")
    for name in names:
        check_picture(name, height, width, most)
    return names


@contextmanager
def naming_absent_renderer() -> Iterator[None]:
    """Convert MuJoCo's AttributeError to an ImportError that names the library that MUJOCO_GL requires."""
    try:
        yield
    except AttributeError as error:
        backend = os.environ.get("MUJOCO_GL", "").lower()
        if backend not in RENDER_LIBRARIES:
            raise
        remedy = f"install {RENDER_LIBRARIES[backend]}, or unset MUJOCO_GL: only camera images need it"
        raise ImportError(f"MUJOCO_GL is {backend!r}, but a library is missing; {remedy}") from error
