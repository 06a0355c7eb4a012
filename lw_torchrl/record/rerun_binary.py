"""The program ``rerun`` that the installed rerun-sdk carries: where it is, started and ended, and why it failed."""

from __future__ import annotations

import os
import re
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import IO

LOCAL = "127.0.0.1"

# What the viewer prints when it dies, and what to do about it.
REASONS = {
    r"render context|[Nn]o (graphics|wgpu) adapter|libvulkan": "no graphics driver was found. Without a GPU, install "
    "Vulkan's loader and Mesa's software driver (Debian: apt-get install libvulkan1 mesa-vulkan-drivers)",
    r"DISPLAY is set|EventLoopError|failed to open display": "there is no screen here. Take a picture, --screenshot; "
    "or look at it from another machine: --web serves a page, --html writes one",
    "No glyph for": "a text in the recording has a character outside the one font that pictures are drawn with. "
    "Without --screenshot the viewer uses the system's fonts too",
}


def binary() -> str:
    """The path of the program."""
    if override := os.environ.get("RERUN_CLI_PATH"):
        return override
    # The package needs no import: it is a folder with the viewer in it.
    package = find_spec("rerun_cli")
    if package is None or package.origin is None:
        raise FileNotFoundError("rerun's viewer is not installed; pip install 'rerun-sdk>=0.41,<0.42'")
    folder = Path(package.origin).parent
    names = ("rerun.exe",) if sys.platform == "win32" else ("Rerun.app/Contents/MacOS/Rerun", "rerun")
    found = next((folder / name for name in names if (folder / name).is_file()), None)
    if found is None:
        raise FileNotFoundError(f"rerun's viewer is missing in {str(folder)!r}; reinstall rerun-sdk")
    return str(found)


def free_port() -> int:
    """A port of this machine that nobody listens at."""
    with socket.socket() as free:
        free.bind((LOCAL, 0))
        return int(free.getsockname()[1])


@contextmanager
def running(*arguments: str | Path) -> Iterator[tuple[subprocess.Popen[bytes], IO[bytes]]]:
    """The program, running, and the file that holds what it prints; it ends with the block."""
    with tempfile.TemporaryFile() as output:
        command = [binary(), *map(str, arguments), "--bind", LOCAL]
        # Its notes about software drawing would cover the picture.
        quiet = {"RUST_LOG": "error"} if "--headless" in command else {}
        process = subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT, env=quiet | dict(os.environ))
        try:
            yield process, output
        finally:
            process.terminate()
            try:
                process.wait(10)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def failure(output: IO[bytes]) -> RuntimeError:
    """The error that says why the program ended, by what it printed."""
    output.seek(0)
    text = plain(output.read().decode("utf-8", "replace"))
    for pattern, reason in REASONS.items():
        if re.search(pattern, text):
            return RuntimeError(f"rerun's viewer stopped: {reason}.")
    # Neither the stack nor the lines of routine.
    telling = [line for line in text.splitlines() if line.strip() and not re.match(r"\s+(\d+:|at )|.* INFO ", line)]
    return RuntimeError("rerun's viewer ended with an error:\n" + "\n".join(telling[-12:]))


def plain(text: str) -> str:
    """Without the colours of a terminal."""
    return re.sub(r"\x1b\[[0-9;]*m", "", text)
