"""Commands of ``lw-torchrl`` in separate processes: forks of one that has imported the package, which takes 10 s."""

import json
import os
import select
import signal
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

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
    """The end of a command: its exit status, or minus the signal that killed it, and its output."""

    status: int
    out: str
    err: str


class Forks:
    """Runs one command at a time and writes its output to ``folder``."""

    def __init__(self, folder: Path) -> None:
        self.outputs = folder / "out", folder / "err"
        command, environment = [sys.executable, "-W", "ignore", "-c", PARENT], os.environ | {"OMP_NUM_THREADS": "1"}
        pipes = dict.fromkeys(("stdin", "stdout"), subprocess.PIPE)
        self.parent = subprocess.Popen(command, env=environment, bufsize=0, **pipes)
        self.child = self._number()  # 0: no child yet

    def _number(self) -> int:
        line = self.parent.stdout.readline()
        assert line, "the process that forks has died"
        return int(line)

    def start(self, *arguments: object, before: str = "") -> None:
        """Start a command, after the program ``before``."""
        job = [str(argument) for argument in arguments], before, *map(str, self.outputs)
        self.parent.stdin.write(json.dumps(job).encode() + b"\n")
        self.child = self._number()

    def running(self, seconds: float = 0.0) -> bool:
        """Return whether the command still runs after some seconds; return earlier if it ends."""
        return not select.select([self.parent.stdout], [], [], seconds)[0]

    def send(self, number: signal.Signals) -> None:
        """Send a signal to the command and its children."""
        os.killpg(self.child, number)

    def end(self, seconds: float = 240.0) -> Ended:
        """Wait for the end of the command."""
        if self.running(seconds):
            self.send(signal.SIGKILL)
            raise TimeoutError(f"still running after {seconds} s: {self.outputs[1].read_text()[-2000:]}")
        return Ended(self._number(), *(path.read_text() for path in self.outputs))

    def close(self) -> None:
        """Kill the parent, which may not see the end of its input, because forks hold the pipe too."""
        self.parent.kill()
        self.parent.wait()
        self.parent.stdin.close()
        self.parent.stdout.close()
