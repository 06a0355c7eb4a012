"""Commands of ``lw-torchrl`` in processes of their own that need not import anything first.

Each is a fork of one process that has imported the package and compiled the models of all tasks. What it does to files,
and what a signal does to it, is what any process does; only the ten seconds of starting are left out.
"""

from __future__ import annotations

import json
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

PARENT = """
import json, os, sys, traceback
import lw_torchrl as lw
import lw_torchrl.evaluation, lw_torchrl.record.rollouts, matplotlib.figure
from lw_torchrl.cli.main import main

lw.LanguageWorldEnv("MT50", num_threads=1).close()
print(0, flush=True)
for line in sys.stdin:
    arguments, before, out, err = json.loads(line)
    child = os.fork()
    if not child:
        os.setsid()
        print(os.getpid(), flush=True)
        for stream, path in enumerate((os.devnull, out, err)):
            os.dup2(os.open(path, os.O_RDWR | os.O_CREAT | os.O_TRUNC), stream)
        try:
            exec(before, {})
            main(arguments)
            status = 0
        except SystemExit as error:
            status = error.code
        except BaseException:
            traceback.print_exc()
            status = 1
        sys.stdout.flush()
        os._exit(status)
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
"""


class Ended(NamedTuple):
    """How a command ended: its exit status, minus the signal that killed it, and what it said."""

    status: int
    out: str
    err: str


class Forks:
    """Runs one command at a time, in ``folder`` what it says."""

    def __init__(self, folder: Path) -> None:
        self.said = folder / "out", folder / "err"
        self.parent = subprocess.Popen(
            [sys.executable, "-W", "ignore", "-c", PARENT],
            env=os.environ | {"OMP_NUM_THREADS": "1"},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            bufsize=0,
        )
        self.child = self._number()  # none yet

    def _number(self) -> int:
        line = self.parent.stdout.readline()
        assert line, "the process that forks has died"
        return int(line)

    def start(self, *arguments: object, before: str = "") -> None:
        """Begin a command, after a program text."""
        given = [str(one) for one in arguments], before, *map(str, self.said)
        self.parent.stdin.write(json.dumps(given).encode() + b"\n")
        self.child = self._number()

    def running(self, seconds: float = 0.0) -> bool:
        """Whether it still runs after so many seconds; returns sooner if it ends."""
        return not select.select([self.parent.stdout], [], [], seconds)[0]

    def send(self, number: signal.Signals) -> None:
        """A signal to the command and whatever it has started."""
        os.killpg(self.child, number)

    def end(self, seconds: float = 240.0) -> Ended:
        """Wait until it ends."""
        if self.running(seconds):
            self.send(signal.SIGKILL)
            raise TimeoutError(f"it still ran after {seconds} s; it said {self.said[1].read_text()[-2000:]}")
        return Ended(self._number(), *(path.read_text() for path in self.said))

    def whole_and_killed(
        self, command: Callable[[Path], Sequence[object]], folder: Path, before: str = ""
    ) -> tuple[Path, Path]:
        """Do a command undisturbed, and once more killed at five random moments before it comes to its end: where each
        was told to put what it makes."""

        def finish() -> None:
            ended = self.end()
            assert ended.status == 0, ended.err[-2000:]

        whole, killed = folder / "whole", folder / "killed"
        started = time.perf_counter()
        self.start(*command(whole), before=before)
        finish()
        work = time.perf_counter() - started
        kills = 0
        for moment in np.random.default_rng(5).uniform(0.0, 0.25, 5):
            self.start(*command(killed), before=before)
            if self.running(moment * work):
                self.send(signal.SIGKILL)
            kills += self.end().status == -signal.SIGKILL
        assert kills >= 3
        self.start(*command(killed), before=before)
        finish()
        return whole, killed

    def close(self) -> None:
        """Kill the process that forks: it may never see its input end, since other forks hold the pipe too."""
        self.parent.kill()
        self.parent.wait()
        self.parent.stdin.close()
        self.parent.stdout.close()
