"""The names of the episodes in a recording."""

from __future__ import annotations

from collections.abc import Collection
from itertools import count

RESERVED = ("metrics", "histograms", "images", "videos", "hparams")


def episode_name(wanted: str, name: str | None, taken: Collection[str]) -> str:
    """The name of an episode: the one given, or the one wanted, then "wanted-2"; one that is taken is a ValueError."""
    if name is None:
        names = (wanted if i == 1 else f"{wanted}-{i}" for i in count(1))
        return next(free for free in names if free not in taken and free not in RESERVED)
    if not isinstance(name, str) or not name.strip():
        raise ValueError(f"name must be a non-empty string, got {name!r}")
    if name in taken or name in RESERVED:
        raise ValueError(f"name must be another than {', '.join((*RESERVED, *taken))}, got {name!r}")
    return name
