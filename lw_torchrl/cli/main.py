"""The command line, ``lw-torchrl``: each command is a function, and its docstring the help text."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import FrameType
from typing import Any, NoReturn

import tyro

from lw_torchrl import __version__
from lw_torchrl.cli import experiments as cli_experiments
from lw_torchrl.cli import language as cli_language
from lw_torchrl.cli import plan as cli_plan
from lw_torchrl.cli import policies, show
from lw_torchrl.cli.check import check
from lw_torchrl.cli.data import data
from lw_torchrl.cli.errors import in_its_words
from lw_torchrl.cli.offline import offline
from lw_torchrl.cli.online import online
from lw_torchrl.cli.record import record
from lw_torchrl.cli.scripted import scripted
from lw_torchrl.cli.streams import check_arguments, complain, nobody_reads, sound_streams
from lw_torchrl.cli.train import train
from lw_torchrl.cli.train_evaluator import train_evaluator

COMMANDS: dict[str, Any] = {
    "demo": show.demo,
    "collect": policies.collect,
    "data": data,
    "train": train,
    "train-evaluator": train_evaluator,
    "evaluate": policies.evaluate,
    "record": record,
    "view": show.view,
    "query": show.query,
    "scripted": scripted,
    "tasks": cli_language.tasks,
    "queries": cli_language.queries,
    "skills": cli_language.skills,
    "plans": cli_language.plans,
    "plan": cli_plan.plan,
    "check": check,
    "reproduce": cli_experiments.reproduce,
    "offline": offline,
    "online": online,
}
GROUPS: dict[str, dict[str, Any]] = {"plan": cli_plan.COMMANDS}
"""Commands that have commands of their own."""


RESUMABLE = (
    "demo",
    "collect",
    "train",
    "train-evaluator",
    "plan generate",
    "plan compare",
    "plan repair",
    "reproduce",
    "offline",
    "online",
)


def main(args: Sequence[str] | None = None) -> None:
    """Run the command line; an error a user can mend is one line and exit status 2, Ctrl-C is 130."""
    given = sys.argv[1:] if args is None else list(args)
    interrupts: list[int] = []
    with sound_streams(), _noting(interrupts):
        try:
            _run(given)
        except KeyboardInterrupt:
            _stop(given)
        except Exception as error:
            if interrupts:  # raised within a library, Ctrl-C may surface as something else
                _stop(given)
            if not isinstance(error, (ValueError, TypeError, OSError, ImportError, RuntimeError)):
                raise
            if isinstance(error, BrokenPipeError) and nobody_reads():
                raise
            message = str(error)
            command, table = _table(given)
            if command in table:
                message = in_its_words(command, table[command], message)
            complain(f"lw-torchrl: error: {message}")
            sys.exit(2)


def _run(given: Sequence[str]) -> None:
    check_arguments(given)
    if list(given) == ["--version"]:
        print(f"lw-torchrl {__version__}")
        return
    about = "Language-World with TorchRL: policies carried by plans in English. --version tells which."
    group = given[0] if given and given[0] in GROUPS else ""
    try:
        tyro.extras.subcommand_cli_from_dict(
            GROUPS.get(group, COMMANDS),
            prog=f"lw-torchrl {group}".strip(),
            description=COMMANDS[group].__doc__ if group else about,
            args=given[1:] if group else given,
        )
    finally:
        sys.stdout.flush()


def _table(given: Sequence[str]) -> tuple[str, dict[str, Any]]:
    """The command that is given, and the table it may be found in."""
    group = given[0] if given and given[0] in GROUPS else ""
    rest = given[1:] if group else given
    return rest[0] if rest else "", GROUPS.get(group, COMMANDS)


@contextmanager
def _noting(interrupts: list[int]) -> Iterator[None]:
    """Within the block Ctrl-C also leaves a note."""
    before = signal.getsignal(signal.SIGINT) if threading.current_thread() is threading.main_thread() else None
    if before is not signal.default_int_handler:
        yield
        return

    def note(number: int, frame: FrameType | None) -> None:
        interrupts.append(number)
        signal.default_int_handler(number, frame)

    signal.signal(signal.SIGINT, note)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _stop(given: Sequence[str]) -> NoReturn:
    named = {" ".join(given[:1]), " ".join(given[:2])}
    resumed = "; the same command carries on from here" if named & {*RESUMABLE} else ""
    complain(f"\nlw-torchrl: stopped{resumed}")
    sys.exit(130)
