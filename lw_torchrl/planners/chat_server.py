"""One question to an OpenAI-compatible server: what is sent, what may come back, and what each failure means."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import TracebackType
from typing import Any
from urllib.parse import urlsplit

from lw_torchrl._checks import shown
from lw_torchrl.planners.answer_cache import Reply
from lw_torchrl.planners.answers import Tokens
from lw_torchrl.planners.errors import PlannerError

OPENAI = "https://api.openai.com/v1"
_KEY = "OPENAI_API_KEY"
_LONGEST = 300  # characters of what a server said, in an error


def server_address(base_url: str | None) -> str:
    """The address of a server, without what is no address: a name and a password, a query.

    Raises:
        ValueError: it is none.

    Example:
        >>> server_address("http://me:secret@127.0.0.1:8000/v1/")
        'http://127.0.0.1:8000/v1'
    """
    given = base_url or os.environ.get("OPENAI_BASE_URL") or OPENAI
    try:
        found = urlsplit(given)
        host = f"[{found.hostname}]" if found.hostname and ":" in found.hostname else found.hostname
        port = "" if found.port is None else f":{found.port}"
    except (ValueError, AttributeError, TypeError):
        host = None
    if not host or found.scheme not in ("http", "https"):
        raise ValueError(f"base_url must be an address like 'http://127.0.0.1:8000/v1', got {shown(base_url)}")
    return f"{found.scheme}://{host}{port}{found.path.rstrip('/')}"


@dataclass(frozen=True)
class Dialect:
    """What servers write differently, as far as one has told by refusing it.

    Attributes:
        limit: the name of the greatest number of tokens.
        schema: the kind of response_format that holds a model to a schema.
        refused: what the server said when it did not know "json_schema".
    """

    limit: str = "max_tokens"
    schema: str = "json_schema"
    refused: str = ""

    def after(self, status: int, said: str) -> Dialect:
        """The dialect to go on with after an error; this one if the error says nothing of it."""
        if self.limit == "max_tokens" and status == 400 and "max_completion_tokens" in said:
            return replace(self, limit="max_completion_tokens")
        named = "response_format" in said or "json_schema" in said
        if self.schema == "json_schema" and status in (400, 415, 422, 500, 501) and named:
            return replace(self, schema="json_object", refused=said)  # llama-cpp-python says 500
        return self

    def response_format(self, schema: dict[str, Any]) -> dict[str, Any]:
        if self.schema == "json_object":
            return {"type": "json_object", "schema": schema}
        return {"type": "json_schema", "json_schema": {"name": "plan", "schema": schema, "strict": True}}


class ChatServer:
    """A server, while the block lasts; any number of threads may ask it at once.

    Args:
        model: its name there.
        base_url: None for what OPENAI_BASE_URL says, or OpenAI's.
        timeout: seconds that an answer may take.
        retries: how often a question is asked again after a rate limit, a fault of the server or of the connection.
        dialect: what it is known to write.

    Raises:
        ImportError: the extra ``[llm]`` is absent.
        PlannerError: there is no key for a server that wants one.
    """

    def __init__(
        self, model: str, base_url: str | None, timeout: float, retries: int, dialect: Dialect | None = None
    ) -> None:
        try:
            import openai
        except ImportError as error:
            raise ImportError(
                f"asking a model needs the extra [llm]: pip install 'lw_torchrl[llm]' ({error})"
            ) from error
        self._openai, self.model, self.timeout, self.retries = openai, model, timeout, retries
        self.address = server_address(base_url)
        own = self.address == OPENAI
        self._key = os.environ.get(_KEY, "").strip()
        if own and not self._key:
            raise PlannerError(
                f"{model!r} at {self.address} wants a key: set the environment variable {_KEY}, or give the "
                "base_url of a server that wants none",
                fatal=True,
            )
        self.dialect = dialect or Dialect("max_completion_tokens" if own else "max_tokens")
        self._settled = False  # whether it has answered, so that its dialect is known
        self._client = openai.OpenAI(
            api_key=self._key or "none", base_url=base_url, timeout=openai.Timeout(timeout, connect=min(timeout, 10.0))
        )

    def __enter__(self) -> ChatServer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._client.close()

    def ask(self, request: Mapping[str, Any], question: str) -> Reply:
        """The answer to a request.

        Args:
            request: "messages", "schema" (None for any text), "max_tokens", and "temperature", "seed" and "options",
                None where the server's own are wanted.
            question: what to call it in an error.

        Raises:
            PlannerError: no answer came.
        """
        fault: Exception
        while True:
            settled, dialect = self._settled, self.dialect
            try:
                found = self._create(request, dialect, self.retries if settled or not request["schema"] else 0)
            except self._openai.APIStatusError as error:
                adapted = dialect.after(error.status_code, self._clean(str(error)))
                if adapted != dialect:
                    self.dialect = adapted
                    continue
                fault = error
            except (self._openai.OpenAIError, ValueError) as error:  # the second: JSON that is none
                fault = error
            else:
                self._settled = True
                notes = ["the schema was sent as json_object, since the server takes no json_schema"]
                return self._reply(found, notes if dialect.refused and request["schema"] else [], question)
            if settled or not request["schema"]:
                break
            self._settled = True  # it is not the dialect: again, with all retries
        raise self._explained(fault, question)  # here, where no cause that may hold the key is chained to it

    def _create(self, request: Mapping[str, Any], dialect: Dialect, retries: int) -> Any:
        fields: dict[str, Any] = {dialect.limit: request["max_tokens"]}
        fields |= {name: request[name] for name in ("temperature", "seed") if request[name] is not None}
        if request["schema"]:
            fields["response_format"] = dialect.response_format(request["schema"])
        return self._client.with_options(max_retries=retries).chat.completions.create(
            model=self.model, messages=request["messages"], extra_body=request["options"], **fields
        )

    def _reply(self, found: Any, notes: list[str], question: str) -> Reply:
        choices = getattr(found, "choices", None)
        choice = choices[0] if isinstance(choices, list) and choices else None
        message = getattr(choice, "message", None)
        if message is None:
            raise self._error(
                question,
                f"what came is no chat completion: {self._clean(str(found))}",
                "See that base_url is the address of an OpenAI-compatible server; it usually ends in /v1",
                fatal=True,
            )
        usage, answered = getattr(found, "usage", None), self._clean(_text(getattr(found, "model", None)))
        if not (answered.startswith(self.model) or self.model.startswith(answered)):  # a date may stand behind
            notes = [*notes, f"the server says that the model {answered!r} answered, not {self.model!r}"]
        return Reply(
            _text(getattr(message, "content", None)),
            _text(getattr(choice, "finish_reason", None)),
            _text(getattr(message, "refusal", None)),
            Tokens(_count(usage, "prompt_tokens"), _count(usage, "completion_tokens")),
            tuple(notes),
        )

    def _error(self, question: str, what: str, hint: str, fatal: bool = False) -> PlannerError:
        refused = f" (before, it did not take response_format json_schema: {self.dialect.refused})"
        told = f"{self.model!r} at {self.address}, {question}: {what}{refused if self.dialect.refused else ''}. {hint}."
        return PlannerError(self._hidden(told), fatal=fatal)

    def _explained(self, fault: Exception, question: str) -> PlannerError:
        """The error in our words: what came, and what to try."""
        said, tried = self._clean(str(fault)), f"asked {self.retries + 1} times"
        cause = self._clean(str(fault.__cause__ or fault))
        if isinstance(fault, self._openai.APITimeoutError):
            what, hint = (
                f"no answer within {self.timeout:g} s, {tried}",
                "Give a longer timeout, or a lower concurrency",
            )
        elif isinstance(fault, self._openai.APIConnectionError):
            what = f"the connection failed or broke off, {tried}: {cause}"
            return self._error(question, what, "See that the server runs, and that base_url is its address", fatal=True)
        elif not isinstance(fault, self._openai.APIStatusError):
            return self._error(question, f"the answer was cut off or is no JSON: {said}", "Ask again")
        else:
            return self._refused(fault.status_code, said, question)
        return self._error(question, what, hint)

    def _refused(self, status: int, said: str, question: str) -> PlannerError:
        tried, fatal = f", asked {self.retries + 1} times", status in (401, 403, 404, 429)
        if status in (401, 403):
            known = f"the key in {_KEY} is not accepted" if self._key else f"it wants a key, in {_KEY}"
            return self._error(question, f"{known} ({said})", "Give the key of this server", fatal)
        if status == 404:
            return self._error(
                question, f"no such model or address ({said})", f"`GET {self.address}/models` lists its models", fatal
            )
        if status == 429:
            return self._error(
                question, f"too many requests{tried} ({said})", "Go on later, or with a lower concurrency", fatal
            )
        if re.search(r"context|too long|max_tokens|maximum.{0,20}length", said, re.IGNORECASE):
            hint = "Give fewer max_tokens, a shorter format (basic_py), or the server a longer context"
            return self._error(question, f"the question does not fit ({said})", hint)
        if status >= 500:
            return self._error(question, f"the server failed{tried} ({said})", "Its own log may say why; ask again")
        return self._error(question, f"the request is refused ({said})", "Leave out what it does not know")

    def _clean(self, text: str) -> str:
        """What a server said: in one line, short, and without the key."""
        plain = self._hidden(" ".join(re.sub(r"<(style|script).*?</\1>|<[^>]*>", " ", text, flags=re.DOTALL).split()))
        return plain if len(plain) <= _LONGEST else f"{plain[:_LONGEST]} ..."

    def _hidden(self, text: str) -> str:
        return text.replace(self._key, "(the key)") if self._key else text


def _text(value: Any) -> str:
    """A text that any file can hold; "" for what is none."""
    return value.encode("utf-8", "replace").decode() if isinstance(value, str) else ""


def _count(usage: Any, name: str) -> int:
    value = getattr(usage, name, 0)
    return value if type(value) is int and value >= 0 else 0
