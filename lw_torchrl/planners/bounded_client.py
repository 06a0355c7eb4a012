"""The HTTP client of a chat server with two bounds that ``timeout`` does not give: an answer's time as a whole, and its
size. It follows no redirects, so that a key and a question reach the server that was named and no other."""

from __future__ import annotations

import asyncio
from importlib import import_module
from typing import Any

REPLY_LIMIT = 4 * 2**20
"""Bytes of a reply; one byte more is kept, so that a larger one is told from one that fits."""
_KEPT = ("location", "retry-after", "retry-after-ms", "x-should-retry")


def bounded_client(openai: Any, timeout: float) -> Any:
    """A client for :class:`openai.AsyncOpenAI`, each of whose answers is read whole.

    Args:
        openai: the module.
        timeout: seconds from the connection to the last byte of an answer, however slowly it comes.
    """
    known: Any = openai.DefaultAsyncHttpxClient
    httpx: Any = import_module(known.send.__module__.partition(".")[0])  # the one that this openai works with

    class Bounded(known):
        async def send(self, request: Any, **options: Any) -> Any:
            request.headers["accept-encoding"] = "identity"  # a compressed reply has no size before it is read
            try:
                async with asyncio.timeout(timeout):
                    reply = await super().send(request, **{**options, "stream": True, "follow_redirects": False})
                    try:
                        content = await _read(reply)
                    finally:
                        await reply.aclose()
            except TimeoutError:
                raise httpx.ReadTimeout(f"no whole answer within {timeout:g} s", request=request) from None
            headers = {name: reply.headers[name] for name in _KEPT if name in reply.headers}
            return httpx.Response(reply.status_code, headers=headers, content=content, request=request)

    return Bounded(timeout=openai.Timeout(timeout, connect=min(timeout, 10.0)))


async def _read(reply: Any) -> bytes:
    content = bytearray()
    async for part in reply.aiter_raw():
        content += part
        if len(content) > REPLY_LIMIT:
            break
    return bytes(content[: REPLY_LIMIT + 1])
