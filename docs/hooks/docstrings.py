"""Docstrings speak of names as Sphinx does, ``:class:`Task```; here a name becomes a link where the site has it."""

from __future__ import annotations

import re
from typing import Any

from griffe import Extension, Object

ROLE = re.compile(r":(?:class|func|meth|attr|data|mod):`(~?)([^`]+)`")


def linked(match: re.Match[str]) -> str:
    name = match[2].rpartition(".")[2] if match[1] else match[2]
    return f'<autoref identifier="{match[2]}" optional><code>{name}</code></autoref>'


class Roles(Extension):
    def on_object(self, *, obj: Object, **kwargs: Any) -> None:
        if obj.docstring is not None:
            obj.docstring.value = ROLE.sub(linked, obj.docstring.value).replace("``", "`")
