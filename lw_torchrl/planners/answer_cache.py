"""Answers on disk, each under a key of all that determines it: what was once answered is not asked for again."""

from __future__ import annotations

import json
import os
from dataclasses import asdict, dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

from lw_torchrl._files import read_json, write_json
from lw_torchrl.planners.answers import NO_TOKENS, Tokens

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
            if answer_key(found["request"]) != answer_key(request):
                raise ValueError("it answers another request")
            said = found["answer"]
            reply = Reply(said["text"], said["finish"], said["refusal"], Tokens(**said["tokens"]), tuple(said["notes"]))
            texts = (reply.text, reply.finish, reply.refusal, *reply.notes)
            if not all(isinstance(text, str) for text in texts):
                raise ValueError("its texts must be strings")
            if not all(type(count) is int for count in (reply.tokens.prompt, reply.tokens.completion)):
                raise ValueError("its tokens must be integers")
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"the kept answer {str(path)!r} cannot be read: {error!r}") from error
        return reply

    def write(self, request: dict[str, Any], reply: Reply) -> None:
        """Keep an answer, whole or not at all."""
        write_json(self.path(request), {"request": request, "answer": asdict(reply)})
