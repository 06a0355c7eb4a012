"""Forward requests to a server on this machine, if their Host header names this machine.

A foreign web page can make its own host name resolve to 127.0.0.1 (DNS rebinding). Its scripts can then read all
replies of a server on this machine, unless the server rejects foreign host names. Rerun's servers do not reject
them.
"""

from __future__ import annotations

import socket
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from secrets import randbelow
from socketserver import StreamRequestHandler, ThreadingTCPServer
from threading import Thread
from typing import Any

LOCAL = "127.0.0.1"
START_SECONDS = 60.0
_LONGEST, _MOST = 16_384, 100  # maximum length and number of the header lines


def hidden_address() -> str:
    """Return a random loopback address, which no web page can guess. On systems other than Linux, return 127.0.0.1."""
    return f"127.{randbelow(256)}.{randbelow(256)}.{1 + randbelow(254)}" if sys.platform == "linux" else LOCAL


class _Handler(StreamRequestHandler):
    rbufsize = 0  # read no byte after the headers
    server: Any

    def handle(self) -> None:
        lines: list[bytes] = []
        while len(lines) < _MOST and (line := self.rfile.readline(_LONGEST)).strip():
            lines.append(line)
        headers = [(name.strip().lower(), value.strip()) for name, _, value in (line.partition(b":") for line in lines)]
        names = {b"%s:%d" % (name, self.server.server_address[1]) for name in (LOCAL.encode(), b"localhost")}
        if not {value for name, value in headers if name == b"host"} <= names or b"host" not in dict(headers):
            self.wfile.write(b"HTTP/1.1 403 Forbidden\r\nContent-Length: 0\r\nConnection: close\r\n\r\n")
            return
        kept = [line for line, (name, _) in zip(lines, headers, strict=True) if name != b"connection"]
        with suppress(OSError), self._connected() as backend:
            backend.sendall(b"".join([*kept, b"Connection: close\r\n\r\n"]))  # no reuse, so each request is checked
            Thread(target=_copy, args=(self.request, backend), daemon=True).start()
            _copy(backend, self.request)

    def _connected(self) -> socket.socket:
        end = time.monotonic() + START_SECONDS
        while True:
            try:
                return socket.create_connection(self.server.backend)
            except ConnectionError:  # the server is still starting
                if time.monotonic() > end:
                    raise
                time.sleep(0.1)


def _copy(source: socket.socket, target: socket.socket) -> None:
    with suppress(OSError):
        while part := source.recv(2**16):
            target.sendall(part)
        target.shutdown(socket.SHUT_WR)


class _Server(ThreadingTCPServer):
    allow_reuse_address = daemon_threads = True
    block_on_close = False


@contextmanager
def forwarded(port: int, backend: tuple[str, int]) -> Iterator[int]:
    """Forward requests to a port of 127.0.0.1 (0: a free port) to the address and port ``backend``; yield the port."""
    with _Server((LOCAL, port), _Handler) as server:
        server.backend = backend  # type: ignore[attr-defined]
        Thread(target=server.serve_forever, daemon=True).start()
        try:
            yield server.server_address[1]
        finally:
            server.shutdown()
