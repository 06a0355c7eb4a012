"""Questions to an OpenAI-compatible server: what is sent, what may come back, and what each failure means."""

from __future__ import annotations

import asyncio
import os
import re
import threading
from collections.abc import Callable, Coroutine, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from multiprocessing.pool import ThreadPool
from typing import Any, TypeVar
from urllib.parse import parse_qsl, unquote, urlsplit

from lw_torchrl._checks import counted, shown
from lw_torchrl.planners.answers import PlannerError, Reply
from lw_torchrl.planners.chat_reply import NoCompletion, Redactor, bounded_client, in_a_line, read_completion

OPENAI = "https://api.openai.com/v1"
_KEY = "OPENAI_API_KEY"


def server_address(base_url: str | None) -> str:
    """The address of a server, without a name and a password, or a query."""
    try:
        found = urlsplit(_given(base_url))
        host = f"[{found.hostname}]" if found.hostname and ":" in found.hostname else found.hostname
        port = "" if found.port is None else f":{found.port}"
    except (ValueError, AttributeError, TypeError):
        host = None
    if not host or found.scheme not in ("http", "https"):
        raise ValueError(f"base_url must be an address like 'http://127.0.0.1:8000/v1', got {shown(base_url)}")
    return f"{found.scheme}://{host}{port}{found.path.rstrip('/')}"


def _given(base_url: str | None) -> str:
    return base_url or os.environ.get("OPENAI_BASE_URL") or OPENAI


@dataclass(frozen=True)
class Dialect:
    """What servers write differently, as far as the server has told by refusing it."""

    limit: str = "max_tokens"  # the name of the greatest number of tokens
    schema: str = "json_schema"  # the kind of response_format that holds a model to a schema
    refused: str = ""  # what the server said when it did not know "json_schema"

    def after(self, status: int, said: str) -> Dialect:
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

    Arguments are as for :class:`~lw_torchrl.OpenAIPlanner`; without the extra ``[llm]`` it is an ImportError, without a
    key for OpenAI's server, or with one that cannot be sent, a PlannerError.
    """

    def __init__(
        self, model: str, base_url: str | None, timeout: float, retries: int, dialect: Dialect | None = None
    ) -> None:
        try:
            import openai
        except ImportError as error:
            needs = "asking a model needs the extra [llm]: pip install 'lw_torchrl[llm]'"
            raise ImportError(f"{needs} ({error})") from error
        self._openai, self.model, self.timeout, self.retries = openai, model, timeout, retries
        self.address = server_address(base_url)
        own = self.address == OPENAI
        self._key = os.environ.get(_KEY, "").strip()
        if own and not self._key:
            how = f"set the environment variable {_KEY}, or give the base_url of a server that wants none"
            raise PlannerError(f"{model!r} at {self.address} wants a key: {how}", fatal=True)
        if not (self._key.isascii() and self._key.isprintable()):
            raise PlannerError(f"the key in {_KEY} has characters that no key has: set it anew", fatal=True)
        given = urlsplit(_given(base_url))  # with what server_address leaves out
        inside = [given.username, given.password, *(value for _, value in parse_qsl(given.query))]
        self._hidden = Redactor([self._key, *(unquote(text) for text in inside if text)])
        self.dialect = dialect or Dialect("max_completion_tokens" if own else "max_tokens")
        self._settled = False  # whether it has answered, so that its dialect is known
        http = bounded_client(openai, timeout)
        self._client = openai.AsyncOpenAI(api_key=self._key or "none", base_url=base_url, http_client=http)
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="questions to a server", daemon=True)

    def __enter__(self) -> ChatServer:
        self._hidden.__enter__()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Questions that are under way end unanswered."""
        self._wait(self._close())
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()
        self._hidden.__exit__()

    async def _close(self) -> None:
        asked = asyncio.all_tasks() - {asyncio.current_task()}
        for task in asked:
            task.cancel()
        await asyncio.gather(*asked, return_exceptions=True)
        await self._client.close()

    def _wait(self, work: Coroutine[Any, Any, Any]) -> Any:
        try:
            return asyncio.run_coroutine_threadsafe(work, self._loop).result()
        finally:
            work.close()  # where the loop was closed before it began

    def ask(self, request: Mapping[str, Any], question: str) -> Reply:
        """The answer to a request; if none came that can be read, a :class:`PlannerError` that names the question.

        It has "messages", "schema" (None for any text), "max_tokens", and "temperature", "seed" and "options", or None.
        """
        fault: Exception
        while True:
            settled, dialect = self._settled, self.dialect
            try:
                retries = self.retries if settled or not request["schema"] else 0
                content = self._wait(self._create(request, dialect, retries))
            except self._openai.APIStatusError as error:
                adapted = dialect.after(error.status_code, self._said(error))
                if adapted != dialect:
                    self.dialect = adapted
                    continue
                fault = error
            except Exception as error:  # whatever a hostile reply brings the client to
                fault = error
            else:
                self._settled = True
                notes = ["the schema was sent as json_object, since the server takes no json_schema"]
                return self._reply(content, notes if dialect.refused and request["schema"] else [], question)
            if settled or not request["schema"]:
                break
            self._settled = True  # it is not the dialect: again, with all retries
        raise self._explained(fault, question)  # here, where no cause that may hold the key is chained to it

    async def _create(self, request: Mapping[str, Any], dialect: Dialect, retries: int) -> bytes:
        fields: dict[str, Any] = {dialect.limit: request["max_tokens"]}
        fields |= {name: request[name] for name in ("temperature", "seed") if request[name] is not None}
        if request["schema"]:
            fields["response_format"] = dialect.response_format(request["schema"])
        client = self._client.with_options(max_retries=retries).chat.completions.with_raw_response
        fields |= {"model": self.model, "messages": request["messages"]}
        return bytes((await client.create(extra_body=request["options"], **fields)).content)

    def _reply(self, content: bytes, notes: list[str], question: str) -> Reply:
        try:
            reply, answered = read_completion(content, self._hidden)
        except NoCompletion as error:
            raise self._error(question, str(error), error.hint, error.fatal) from None
        if not (answered.startswith(self.model) or self.model.startswith(answered)):  # a date may stand behind
            notes = [*notes, f"the server says that the model {answered!r} answered, not {self.model!r}"]
        return replace(reply, notes=(*notes, *reply.notes))

    def _error(self, question: str, what: str, hint: str, fatal: bool = False) -> PlannerError:
        refused = f" (before, it did not take response_format json_schema: {self.dialect.refused})"
        told = f"{self.model!r} at {self.address}, {question}: {what}{refused if self.dialect.refused else ''}. {hint}."
        return PlannerError(self._hidden(told), fatal=fatal)

    def _explained(self, fault: Exception, question: str) -> PlannerError:
        said, tried = self._said(fault), f", asked {counted(self.retries + 1, 'time')}"
        status, fatal = getattr(fault, "status_code", 0), False
        if isinstance(fault, self._openai.APITimeoutError):
            what, hint = f"no answer within {self.timeout:g} s{tried}", "Give a longer timeout, or a lower concurrency"
        elif isinstance(fault, self._openai.APIConnectionError):
            broken, fatal = fault.__cause__ or fault, True
            cause = in_a_line(str(broken), self._hidden) or type(broken).__name__
            what = f"the connection failed or broke off{tried}: {cause}"
            hint = "See that the server runs, and that base_url is its address"
        elif not isinstance(fault, self._openai.APIStatusError):
            what, hint = f"it could not be asked ({type(fault).__name__}: {said})", "Ask again"
        elif status < 400:
            there, fatal = in_a_line(str(fault.response.headers.get("location", "nowhere")), self._hidden), True
            what = f"the server sends on to {there} (status {status})"
            hint = "Give the address that it really has as base_url; no redirect is followed"
        elif status in (401, 403):
            known = f"the key in {_KEY} is not accepted" if self._key else f"it wants a key, in {_KEY}"
            what, hint, fatal = f"{known} ({said})", "Give the key of this server", True
        elif status == 404:
            hint = f"`GET {self.address}/models` lists its models"
            what, fatal = f"no such model or address ({said})", True
        elif status == 429:
            hint = "Go on later, or with a lower concurrency"
            what, fatal = f"too many requests{tried} ({said})", True
        elif re.search(r"context|too long|max_tokens|maximum.{0,20}length", said, re.IGNORECASE):
            hint = "Give fewer max_tokens, a shorter format (basic_py), or the server a longer context"
            what = f"the question does not fit ({said})"
        elif status >= 500:
            what, hint = f"the server failed{tried} ({said})", "Its own log may say why; ask again"
        else:
            what, hint = f"the request is refused ({said})", "Leave out what it does not know"
        return self._error(question, what, hint, fatal)

    def _said(self, fault: Exception) -> str:
        """What a fault says, or what came if the client does not know its form; without secrets, in a line."""
        said = str(fault)
        if isinstance(fault, self._openai.APIStatusError) and " - " not in said:
            came = fault.response.text.strip()
            said += f" - {came}" if came else ""
        return in_a_line(said, self._hidden)


Item = TypeVar("Item")
Result = TypeVar("Result")


def ask_at_once(
    work: Callable[[Item], Result], items: Iterable[Item], concurrency: int
) -> Iterator[tuple[Item, Result | Exception]]:
    """Each item with what ``work`` gives of it, or raises, in the order in which they end.

    After an error that is no :class:`PlannerError`, or a fatal one, only those under way are waited for.
    """
    stop, listed = threading.Event(), list(items)

    def attempt(item: Item) -> tuple[Item, Result | Exception | None]:
        if stop.is_set():
            return item, None
        try:
            return item, work(item)
        except Exception as error:
            if not isinstance(error, PlannerError) or error.fatal:
                stop.set()
            return item, error

    with ThreadPool(max(1, min(concurrency, len(listed)))) as pool:  # of daemons: none outlives the program
        try:
            for item, found in pool.imap_unordered(attempt, listed):
                if found is not None:
                    yield item, found
        finally:
            stop.set()
