"""Places to write to, looked at before the work begins."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path


def check_folder(option: str, path: Path) -> Path:
    """Return ``path`` if it is a folder that can be written to, or one could be made there.

    Raises:
        ValueError: it is a file, lies below one, or cannot be written to.
    """
    here = path
    while not os.path.lexists(here):
        here = here.parent
    if not here.is_dir():
        where = f"{str(path)!r} is none" if here == path else f"{str(path)!r} lies below the file {str(here)!r}"
        raise ValueError(f"{option} must be a folder, {where}")
    try:
        with tempfile.TemporaryFile(dir=here):
            pass
    except OSError as error:
        raise ValueError(f"{option}: {str(here)!r} cannot be written to ({error.strerror})") from error
    return path


def check_file(option: str, path: Path, ending: str = "") -> Path:
    """Return ``path`` if it is a file that can be written to, or one could be made there.

    Raises:
        ValueError: it is a folder, its folder cannot be written to, or its name ends otherwise.
    """
    if path.is_dir():
        raise ValueError(f"{option} must be a file, {str(path)!r} is a folder")
    check_folder(f"{option}'s folder", path.parent)
    if not path.name.endswith(ending):
        raise ValueError(f"{option} must end in {ending!r}, got {str(path)!r}")
    return path
