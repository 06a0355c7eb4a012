"""Language-World and Plan Conditioned Behavioral Cloning as TorchRL components.

Names are imported when they are first used: ``import lw_torchrl`` loads neither torch nor MuJoCo.
The most common names are at the top level; the others are in subpackages, for example losses in ``lw.objectives``.
"""

import re
from importlib import import_module
from pathlib import Path

__version__ = "0.2.0"

# The names and their subpackages are listed once, in __init__.pyi, which type checkers and editors also read.
_LINES = re.findall(r"^from (\S+) import (\S+) as", Path(__file__).with_suffix(".pyi").read_text("utf-8"), re.MULTILINE)
_ROOMS = [name for room, name in _LINES if room == "lw_torchrl"]
_ROOM_OF = {name: room for room, name in _LINES if room != "lw_torchrl"}

__all__ = sorted(_ROOM_OF)


def __getattr__(name: str) -> object:
    if name in _ROOMS:
        return import_module(f"lw_torchrl.{name}")
    if name in _ROOM_OF:
        found = globals()[name] = getattr(import_module(_ROOM_OF[name]), name)
        return found
    verb = name.partition("_")[0]
    similar = [known for known in __all__ if known.partition("_")[0] == verb]
    hint = f"; similar names: {', '.join(similar)}" if similar else ""
    raise AttributeError(f"module 'lw_torchrl' has no attribute {name!r}{hint}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, *_ROOMS})
