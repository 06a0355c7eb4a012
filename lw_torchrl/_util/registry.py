"""The Registry class: a mapping from names to objects that users and installed packages can extend."""

import re
from collections import UserDict
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING, Any, TypeVar

from lw_torchrl._util.checks import check_value, unknown_name

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

Key = TypeVar("Key")
Entry = TypeVar("Entry")
_PLACE = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_][\w.]*")


@cache
def entry_points_of(group: str) -> "dict[str, EntryPoint]":
    """Return the entry points in a group, by name, from all installed packages, without importing the packages."""
    from importlib.metadata import entry_points

    return {point.name: point for point in entry_points(group=group)}


class ReadOnlyDict(Mapping[Key, Entry]):
    """A read-only mapping that, unlike ``types.MappingProxyType``, can be pickled."""

    def __init__(self, items: Mapping[Key, Entry]) -> None:
        self._items = items

    def __getitem__(self, name: Key) -> Entry:
        return self._items[name]

    def __iter__(self) -> Iterator[Key]:
        return iter(self._items)

    def __len__(self) -> int:
        return len(self._items)

    def __repr__(self) -> str:
        return repr(self._items)


class Registry(UserDict[str, Entry]):
    """A mapping from names to objects of one kind: shipped with this library, added by users, or provided by installed
    packages.

    ``REGISTRY["mine"] = entry`` adds an entry and ``del REGISTRY["mine"]`` removes it. A string "module:object", or the
    entry point of an installed package, is imported on first use.

    Args:
        kind: the word for an entry in error messages, such as "method".
        group: the entry point group, such as "lw_torchrl.methods".
        entries: the shipped entries.
        check: a function ``(name, object) -> entry`` that raises an error for an invalid object.

    Raises:
        KeyError: the name is unknown; the message suggests the closest names.
        ImportError: an entry cannot be imported or is invalid; the message names the entry's package.

    Example:
        >>> from lw_torchrl.modules import METHODS
        >>> METHODS["pcbc"].__name__
        'PlanConditionedActor'

    Source: the entry points of the Python packaging user guide; gymnasium's registry.
    """

    def __init__(self, kind: str, group: str, entries: Mapping[str, Any], check: Callable[[str, Any], Entry]) -> None:
        self.kind, self.group, self.check = kind, group, check
        super().__init__(entries)

    def __setitem__(self, name: str, entry: Entry | str) -> None:
        is_place = isinstance(entry, str) and _PLACE.fullmatch(entry)
        self.data[name] = entry if is_place else self.check(name, entry)  # type: ignore[assignment]

    def __contains__(self, name: object) -> bool:
        return isinstance(name, str) and (name in self.data or name in entry_points_of(self.group))

    def __iter__(self) -> Iterator[str]:
        return iter({**self.data, **entry_points_of(self.group)})

    def __len__(self) -> int:
        return len(self.data.keys() | entry_points_of(self.group).keys())

    def __getitem__(self, name: str) -> Entry:
        if name not in self:
            raise KeyError(str(unknown_name(self.kind, name, self)))
        entry: Any = self.data.get(name)
        if entry is None or isinstance(entry, str):
            entry = self.data[name] = self._load(name, entry)
        return entry

    def _load(self, name: str, place: str | None) -> Entry:
        package = ""
        if place is None:
            point = entry_points_of(self.group)[name]
            place, package = point.value, f" from the package {point.dist.name}" if point.dist else ""
        try:
            module, _, attributes = place.partition(":")
            entry: Any = import_module(module)
            for attribute in attributes.split("."):
                entry = getattr(entry, attribute)
            return self.check(name, entry)
        except Exception as error:  # a plugin can raise any exception
            if place.startswith("lw_torchrl."):
                raise  # errors in this library's modules already name the extra to install
            reason = f"{type(error).__name__}: {error}"
            raise ImportError(f"{self.kind} {name!r} ({place}{package}) cannot be loaded ({reason})") from error


def is_function(name: str, entry: Any) -> Callable[..., Any]:
    """Return ``entry`` if it is callable; otherwise raise a :class:`TypeError`."""
    function: Callable[..., Any] = check_value(repr(name), entry, Callable)
    return function
