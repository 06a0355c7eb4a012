"""Where an error came about: in the package, whose words it then is in, or in a module of the user's."""

from __future__ import annotations

import linecache
import os
import sysconfig
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from traceback import walk_tb
from types import FrameType

TRACEBACK = "LW_TORCHRL_TRACEBACK"
"""The variable of the environment that asks for the traceback of every error."""
_OURS = str(Path(__file__).parents[1]) + os.sep
_PYTHON = tuple(path + os.sep for path in {sysconfig.get_path("stdlib"), sysconfig.get_path("platstdlib")})


def is_ours(error: BaseException) -> bool:
    """Whether the package itself raised it, so that the names in it are those of its arguments."""
    frames = [frame for frame, _ in walk_tb(error.__traceback__)]
    return not frames or frames[-1].f_code.co_filename.startswith(_OURS)


def in_users_module(error: BaseException) -> str | None:
    """An error from within a module of the user's, as "my_method.py:12: KeyError: 'x', at `known['x']`"; None for any
    other. Of several lines it is the innermost in the user's own files, or in a package that extends ours."""
    place = None
    for one in _chain(error):
        lines = [*walk_tb(one.__traceback__)]
        own = [each for each in lines if _is_users(each[0])]
        if own:
            place = own[-1][0].f_code.co_filename, own[-1][1]
        elif isinstance(one, SyntaxError) and one.filename and not _is_library(one.filename):
            place = one.filename, one.lineno or 1
        if own and own[-1] is lines[-1]:  # raised there
            break
    if place is None:
        return None
    file, line = place
    code = linecache.getline(file, line).strip()
    said = " ".join((error.msg if isinstance(error, SyntaxError) else str(error)).split())
    return f"{_short(file)}:{line}: {type(error).__name__}: {said}" + (f", at `{code}`" if code else "")


def _chain(error: BaseException) -> Iterator[BaseException]:
    """An error, and what it was raised from."""
    seen: set[int] = set()
    found: BaseException | None = error
    while found is not None and id(found) not in seen:
        seen.add(id(found))
        yield found
        found = found.__cause__ or (None if found.__suppress_context__ else found.__context__)


def _is_users(frame: FrameType) -> bool:
    file = frame.f_code.co_filename
    if not _is_library(file):
        return True
    return _is_installed(file) and str(frame.f_globals.get("__name__")).partition(".")[0] in _extending()


def _is_library(file: str) -> bool:
    """Whether a file is the package's, Python's or an installed package's, or is none."""
    return file.startswith(("<", _OURS, *_PYTHON)) or _is_installed(file)


def _is_installed(file: str) -> bool:
    return not file.startswith(_OURS) and bool({"site-packages", "dist-packages"} & {*Path(file).parts})


@cache
def _extending() -> set[str]:
    """The installed packages that add to our tables."""
    from importlib.metadata import distributions

    points = [point for found in distributions() for point in found.entry_points]
    return {point.module.partition(".")[0] for point in points if point.group.startswith("lw_torchrl.")}


def _short(file: str) -> str:
    """A file as seen from the working folder, if it lies there."""
    path = Path(file)
    return str(path.relative_to(Path.cwd())) if path.is_relative_to(Path.cwd()) else file
