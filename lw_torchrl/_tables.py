"""Tables by name that users add to, all in the same three ways: in Python, by ``--import``, by an entry point."""

import re
import warnings
from collections import UserDict
from collections.abc import Callable, Mapping
from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING, Any, Generic, TypeVar

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

Thing = TypeVar("Thing")
Base = TypeVar("Base")
_PLACE = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_][\w.]*")


@cache
def plugins_of(group: str) -> "dict[str, EntryPoint]":
    """The entry points of installed packages in a group, by name: reads what is installed once, and imports nothing."""
    from importlib.metadata import entry_points

    return {point.name: point for point in entry_points(group=group)}


class Table(UserDict[str, Thing]):
    """Things of one kind by name: ours, those that you add, and those of installed packages.

    ``TABLE["mine"] = thing`` adds one and ``del`` removes it. A text "module:object" stands for what is imported when
    its name is first asked for. A name that is not there is looked for among the entry points of installed packages.
    Iterating gives what is there; :meth:`names` gives the plugins too, none of which is imported for that.

    Args:
        kind: what the things are called in errors, "policy".
        group: of the entry points, "lw_torchrl.policies".
        entries: ours.

    Raises:
        KeyError: there is nothing of that name, here or installed.
        ImportError: what the name stands for cannot be imported, or is none of the kind; it says whose it is.
        TypeError: what is added is none of the kind.

    Example:
        >>> from lw_torchrl.modules import POLICIES
        >>> POLICIES["PlanConditionedActor"].__name__
        'PlanConditionedActor'

    Source: the entry points of the Python packaging user guide; gymnasium's registry.
    """

    def __init__(self, kind: str, group: str, entries: Mapping[str, Any]) -> None:
        self.kind, self.group = kind, group
        self._broken: set[str] = set()
        super().__init__(entries)

    def check(self, name: str, thing: Any) -> Thing:
        """Return what is to be kept of a thing; :class:`TypeError` or :class:`ValueError` if it is none of the kind."""
        return thing

    def names(self) -> list[str]:
        """All names, those of installed packages last."""
        return [*self.data, *(name for name in plugins_of(self.group) if name not in self.data)]

    def load_plugins(self) -> bool:
        """Load what installed packages add; whether there was any. One that cannot be loaded is a warning, once."""
        before = len(self.data)
        for name in plugins_of(self.group):
            try:
                if name not in self.data and name not in self._broken:
                    self[name]
            except ImportError as error:
                self._broken.add(name)
                warnings.warn(str(error), stacklevel=2)
        return len(self.data) > before

    def __setitem__(self, name: str, thing: Thing | str) -> None:
        later = isinstance(thing, str) and _PLACE.fullmatch(thing)
        kept: Any = thing if later else self.check(name, thing)
        super().__setitem__(name, kept)

    def __contains__(self, name: object) -> bool:
        return isinstance(name, str) and (name in self.data or name in plugins_of(self.group))

    def __getitem__(self, name: str) -> Thing:
        if name not in self:
            raise KeyError(name)
        found: Any = self.data.get(name)
        if found is not None and not isinstance(found, str):
            return found
        point = None if found else plugins_of(self.group)[name]
        place = found or f"{point.module}:{point.attr}"  # type: ignore[union-attr]
        try:
            module, _, attributes = place.partition(":")
            made: Any = import_module(module)
            for attribute in attributes.split("."):
                made = getattr(made, attribute)
            made = self.data[name] = self.check(name, made)
        except Exception as error:  # a plugin may fail in any way
            if place.startswith("lw_torchrl."):
                raise  # ours say what to install
            whose = f" of the package {point.dist.name}" if point is not None and point.dist is not None else ""
            what = f"{self.kind} {name!r} is {place}{whose}, which cannot be loaded"
            raise ImportError(f"{what} ({type(error).__name__}: {error})") from error
        return made


class Classes(Table[Any], Generic[Base]):
    """A table of classes derived from ``base``."""

    def __init__(self, kind: str, base: type[Base], group: str, entries: Mapping[str, Any]) -> None:
        self.base = base
        super().__init__(kind, group, entries)

    def __setitem__(self, name: str, thing: type[Base] | str) -> None:
        super().__setitem__(name, thing)

    def check(self, name: str, thing: Any) -> Any:
        if not isinstance(thing, type) or not issubclass(thing, self.base):
            raise TypeError(
                f"{self.kind} {name!r} must be a class derived from {self.base.__name__}, got {thing!r:.80}"
            )
        return thing


class Functions(Table[Any]):
    """A table of functions, or of classes that are called."""

    def __setitem__(self, name: str, thing: Callable[..., Any] | str) -> None:
        super().__setitem__(name, thing)

    def check(self, name: str, thing: Any) -> Any:
        if not callable(thing):
            raise TypeError(f"{self.kind} {name!r} must be a function, got {thing!r:.80}")
        return thing
