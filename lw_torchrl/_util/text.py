"""Escape untrusted text, such as plans and answers of language models, for a terminal or for Markdown."""

from __future__ import annotations

import re
from typing import IO, Any

# Characters, except "\n" and "\t", that control a terminal or change the order in which other characters are shown.
_CONTROL = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\xad\u061c\u180e\u200b-\u200f\u2028-\u202e\u2060-\u206f\ufeff\ufff9-\ufffb\ud800-\udfff"
    "\U000e0000-\U000e007f]"
)
# Characters of Markdown's links, images, HTML, code, emphasis, tables and mathematics, and the ":", "." or "@" of
# addresses that Markdown turns into links, such as https://..., www... or name@host.
_MARKUP = re.compile(r"[\\`*\[\]<>&|~$#]|(?<=[A-Za-z]):(?=//)|(?<=\b[Ww][Ww][Ww])\.|(?<=\w)@|:(?=\w+@)")


def printable(text: str) -> str:
    r"""Replace control characters, such as those of escape sequences, with Python escapes, such as ``\x1b``."""
    return _CONTROL.sub(lambda match: match[0].encode("unicode_escape", "surrogatepass").decode(), text)


def markdown(text: object) -> str:
    """Convert a text to one line of Markdown that renders as plain text, without links, images, HTML or emphasis."""
    return _MARKUP.sub(r"\\\g<0>", printable(" ".join(str(text).split())))


class PrintableStream:
    """A text stream that writes :func:`printable` text to another stream."""

    def __init__(self, stream: IO[str]) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        return self._stream.write(printable(text))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def counted(number: int, noun: str) -> str:
    """Return a number followed by a noun, which is plural unless the number is 1: "1 task", "50 tasks"."""
    return f"{number} {noun}" + "s" * (number != 1)
