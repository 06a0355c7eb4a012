"""Adapt docstrings to the site: Sphinx roles become links, an example a block of code, "a, b: text" two entries."""

from __future__ import annotations

import re
from typing import Any

from griffe import Extension, Object

ROLE = re.compile(r":(?:class|func|meth|attr|data|mod):`(~?)([^`]+)`")

SEVERAL = re.compile(r"^( +)(\w+(?:, \w+)*), (\w+):(?= )", re.MULTILINE)


def linked(match: re.Match[str]) -> str:
    name = match[2].rpartition(".")[2] if match[1] else match[2]
    return f'<autoref identifier="{match[2]}" optional><code>{name}</code></autoref>'


def one_by_one(match: re.Match[str]) -> str:
    """Turn "a, b: text" into an entry for each name."""
    indent, names, last = match.groups()
    return "".join(f"{indent}{name}: see `{last}`.\n" for name in names.split(", ")) + f"{indent}{last}:"


class Roles(Extension):
    def on_object(self, *, obj: Object, **kwargs: Any) -> None:
        if obj.docstring is not None:
            text = ROLE.sub(linked, obj.docstring.value).replace("``", "`")
            text = re.sub(r"^( *)Example:$", r"\1Examples:", text, flags=re.MULTILINE)
            obj.docstring.value = SEVERAL.sub(one_by_one, text)
