"""Answers on disk, each under a key of all that determines it: what was once answered is not asked for again."""

from __future__ import annotations

import json
import os
from dataclasses import asdict, dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

from lw_torchrl._files import JSON_LIMIT, parse_json, read_json, write_text
from lw_torchrl.planners.answers import NO_TOKENS, Tokens, is_count

_VERSION = 1


@dataclass(frozen=True)
class Reply:
    """What a server said.

    Attributes:
        text: the answer; "" if there is none.
        finish: why it ends, in the server's words: "stop", "length", "content_filter", "".
        refusal: what the model said instead of an answer, "".
        tokens: what it cost.
        notes: what was different from what was asked.
    """

    text: str
    finish: str = ""
    refusal: str = ""
    tokens: Tokens = NO_TOKENS
    notes: tuple[str, ...] = ()


def answer_key(request: dict[str, Any]) -> str:
    """The name of an answer: 64 hex digits of all that determines it.

    Example:
        >>> answer_key({"model": "a", "attempt": 0}) == answer_key({"attempt": 0, "model": "a"})
        True
    """
    return sha256(json.dumps([_VERSION, request], sort_keys=True).encode()).hexdigest()


class AnswerCache:
    """Answers in a folder, a file of JSON each, with the question beside the answer.

    Args:
        folder: where they are; it is made at the first answer.
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self.folder = Path(folder)

    def path(self, request: dict[str, Any]) -> Path:
        """The file of the answer to a request."""
        key = answer_key(request)
        return self.folder / key[:2] / f"{key}.json"

    def read(self, request: dict[str, Any]) -> Reply | None:
        """The answer to a request, None if there is none yet.

        Raises:
            ValueError: there is a file that holds no answer to this request.
        """
        path = self.path(request)
        try:
            found = read_json(path, "the kept answer")
        except FileNotFoundError:
            return None
        try:
            return _reply(found, request)
        except ValueError as error:
            raise ValueError(f"the kept answer {str(path)!r} cannot be read: {error}") from error

    def write(self, request: dict[str, Any], reply: Reply) -> None:
        """Keep an answer, whole or not at all.

        Raises:
            ValueError: it could not be read back, so it is not written.
        """
        try:
            text = json.dumps({"request": request, "answer": asdict(reply)}, indent=2, allow_nan=False) + "\n"
            if len(text) > JSON_LIMIT:
                raise ValueError(f"it is larger than {JSON_LIMIT} bytes")
            if _reply(parse_json(text.encode()), request) != reply:
                raise ValueError("it would be read back as another")
        except (TypeError, ValueError, RecursionError) as error:
            raise ValueError(f"the answer cannot be kept: {error}") from error
        write_text(self.path(request), text)


def _reply(found: dict[str, Any], request: dict[str, Any]) -> Reply:
    """The reply in what a file holds; :class:`ValueError` if it is none to this request."""
    try:
        if answer_key(found["request"]) != answer_key(request):
            raise ValueError("it answers another request")
        said = found["answer"]
        reply = Reply(said["text"], said["finish"], said["refusal"], Tokens(**said["tokens"]), tuple(said["notes"]))
    except (KeyError, TypeError, RecursionError) as error:
        raise ValueError(repr(error)) from error
    texts = (reply.text, reply.finish, reply.refusal, *reply.notes)
    if not all(isinstance(text, str) for text in texts):
        raise ValueError("its texts must be strings")
    "".join(texts).encode()  # a lone surrogate goes into no file of an answer
    if not (is_count(reply.tokens.prompt) and is_count(reply.tokens.completion)):
        raise ValueError("its tokens must be integers from 0 to 2**53")
    return reply
