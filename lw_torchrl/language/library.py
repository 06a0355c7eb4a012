"""Composite skills: programs that other programs call by name, such as "grasp the mug"."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from importlib.resources import files

from lw_torchrl._util.files import read_toml
from lw_torchrl.language.programs import Action, Block, Branch, Loop, Node, ProgramError, Selector, Sequence

LIBRARY: Mapping[str, str] = read_toml(files("lw_torchrl.language") / "data" / "library.toml", ValueError)
"""The shipped programs by name: "grasp {object}", "place {object} at {place}", "push", "press" and "turn"."""


def expand(program: Node, library: Mapping[str, str], read: Callable[[str], Node], calls: tuple[str, ...] = ()) -> Node:
    """Replace each action that calls a program of the library with that program.

    The name of a program may have placeholders: the action "grasp the mug" calls the program "grasp {object}". Inside
    that program, the same action does not call the program again but is the plain skill.

    Args:
        library: texts of programs by name, with the same placeholders.
        read: converts the text of a program to a tree.
        calls: the calls that led to ``program``, outermost first.

    Raises:
        ProgramError: a program calls itself through other programs.
    """

    def inner(node: Node) -> Node:
        return expand(node, library, read, calls)

    if isinstance(program, Action):
        return _called(program, library, read, calls)
    if isinstance(program, Branch):
        chain, last = list[Branch](), program.otherwise
        chain.append(program)
        while isinstance(last, Branch):  # a loop, since a chain of ``elif`` may be long
            chain.append(last)
            last = last.otherwise
        result = None if last is None else inner(last)
        for each in reversed(chain):
            result = replace(each, then=inner(each.then), otherwise=result)
        return result  # type: ignore[return-value]
    if isinstance(program, Sequence | Block | Selector):
        return replace(program, parts=tuple(map(inner, program.parts)))
    return replace(program, body=inner(program.body)) if isinstance(program, Loop) else program


def _called(action: Action, library: Mapping[str, str], read: Callable[[str], Node], calls: tuple[str, ...]) -> Node:
    """Return the program that an action calls, or the action itself."""
    if calls[-1:] == (action.text,):
        return action
    for name, text in library.items():
        pattern = re.sub(r"\\\{(\w+)\\\}", r"(?P<\1>.+)", re.escape(name))
        if (match := re.fullmatch(pattern, action.text, re.IGNORECASE)) is None:
            continue
        if action.text in calls:
            raise ProgramError(f"a program must not call itself, got {' -> '.join([*calls, action.text])}")
        for key, words in match.groupdict().items():
            text = text.replace(f"{{{key}}}", words)
        # Put the program into a sequence, so that the next action waits until the program is done.
        return Sequence((expand(read(text), library, read, (*calls, action.text)),))
    return action
