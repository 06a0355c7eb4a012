"""Processes that log and are killed: forks of one that has imported the package, so that each starts at once."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

PARENT = """
import json, os, sys, traceback
sys.path.insert(0, sys.argv[1])
import torch
import lw_torchrl.record, recordings

torch.set_num_threads(1)
print(0, flush=True)
for line in sys.stdin:
    program, given, said = json.loads(line)
    child = os.fork()
    if not child:
        stream = os.open(said, os.O_RDWR | os.O_CREAT | os.O_TRUNC)
        os.dup2(stream, 1)
        os.dup2(stream, 2)
        status = 0
        try:
            exec(compile(program, "program", "exec"), {"given": given})
        except BaseException:
            traceback.print_exc()
            status = 1
        sys.stdout.flush()
        os._exit(status)
    print(child, flush=True)
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
"""


class LoggingProcesses:
    """Runs one program text at a time; it finds its arguments in ``given``."""

    def __init__(self, folder):
        self.said = folder / "said"
        self.parent = subprocess.Popen(
            [sys.executable, "-W", "ignore", "-c", PARENT, str(Path(__file__).parent)],
            env=os.environ | {"OMP_NUM_THREADS": "1"},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self.parent.stdout.readline()

    def start(self, program, **given):
        """Begin a program; returns the process's number."""
        self.parent.stdin.write(json.dumps([program, given, str(self.said)]) + "\n")
        self.parent.stdin.flush()
        return int(self.parent.stdout.readline())

    def end(self):
        """Wait until it ends; returns its exit status, or minus the signal, and what it said."""
        return int(self.parent.stdout.readline()), self.said.read_text()

    def close(self):
        self.parent.kill()
        self.parent.wait()
        self.parent.stdin.close()
        self.parent.stdout.close()
