"""The command line, ``lw-torchrl``: each command is a function, and its docstring the help text.

What an argument is, a comment beside it says, or the docstring if it takes more words. A command returns what it
found, an :class:`~lw_torchrl.cli.output.Output`, where it has ``--json``.
"""

import os
import signal
import sys
import threading
from collections import UserDict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext, redirect_stdout
from importlib import import_module
from keyword import iskeyword
from types import FrameType
from typing import Any, NoReturn

import tyro

from lw_torchrl import __version__
from lw_torchrl._checks import nearest, shown
from lw_torchrl.cli.faults import TRACEBACK, in_users_module, is_ours
from lw_torchrl.cli.output import Output, complain, nobody_reads, sound_streams
from lw_torchrl.cli.parsing import document, import_modules, in_its_words, parse, unpadded


class Commands(UserDict[str, Any]):
    """Commands by name. One that is given by its module's name is imported when it is asked for: words take longer to
    load than all else here."""

    def __getitem__(self, name: str) -> Any:
        found = super().__getitem__(name)
        if isinstance(found, str):
            function = name.replace("-", "_") + "_" * iskeyword(name)
            found = self[name] = getattr(import_module(f"lw_torchrl.cli.{found}"), function)
        return found


COMMANDS = Commands(
    {
        "demo": "demo",
        "collect": "data",
        "data": "data",
        "train": "train",
        "train-evaluator": "train",
        "evaluate": "evaluate",
        "card": "evaluate",
        "record": "record",
        "view": "record",
        "query": "language",
        "scripted": "evaluate",
        "tasks": "language",
        "queries": "language",
        "skills": "language",
        "plans": "language",
        "plan": "plan",
        "check": "check",
    }
)
_OF_PLAN = dict(prompt="plan", generate="plan_models", serve="plan", read="plan", check="plan")
_OF_PLAN |= dict(repair="plan_models")
_OF_DATA = {"show": "data", "export": "exchange", "import": "exchange"}
GROUPS = {"plan": Commands(_OF_PLAN), "data": Commands(_OF_DATA)}
"""Commands that have commands of their own."""
ABOUT = """Language-World with TorchRL: policies carried by plans in English. --version tells which.

--import MODULE, beside any command, imports a module of yours first, which may add suites, relations, formats, policies
or evaluators of your own to their tables (docs/extending.md).

Exit status: 0, done; 1, a bug of ours, with a traceback; 2, an error that you can fix, in one line on the standard
error, which names the line of a module of yours if it is there (LW_TORCHRL_TRACEBACK=1 shows the traceback); 130,
stopped by Ctrl-C; 141, nobody reads the output. What prints a table prints JSON with --json."""

_RESUMABLE = {"demo", "collect", "train", "train-evaluator", "plan generate", "plan repair"}


def main(args: Sequence[str] | None = None) -> None:
    """Run the command line; an error a user can mend is one line and exit status 2, Ctrl-C is 130."""
    given = sys.argv[1:] if args is None else list(args)
    interrupts: list[int] = []
    with sound_streams(), _noting(interrupts):
        try:
            _run(given)
        except KeyboardInterrupt:
            _stop(given)
        except SystemExit as ended:  # of a module of yours: what was asked for is not done
            if (message := in_users_module(ended)) is None:
                raise
            message += "; a module of yours must not end the program"
            if os.environ.get(TRACEBACK):
                raise RuntimeError(message) from ended
            complain(f"lw-torchrl: error: {message}")
            sys.exit(2)
        except Exception as error:
            if interrupts:  # raised within a library, Ctrl-C may surface as something else
                _stop(given)
            if os.environ.get(TRACEBACK) or (isinstance(error, BrokenPipeError) and nobody_reads()):
                raise
            if (message := in_users_module(error)) is not None:
                message += f"; {TRACEBACK}=1 shows the traceback"
            elif not isinstance(error, (ValueError, TypeError, OSError, ImportError, RuntimeError)):
                raise
            else:
                message = str(error)
                _, args, table = _group(given)
                if is_ours(error) and args and args[0] in table:
                    message = in_its_words(args[0], table[args[0]], message)
            complain(f"lw-torchrl: error: {message}")
            sys.exit(2)


def _run(given: Sequence[str]) -> None:
    for arg in given:  # its name could be written to no file of ours
        if any("\ud800" <= character <= "\udfff" for character in arg):
            raise ValueError(f"the argument {arg!a} is no text in the encoding {sys.getfilesystemencoding()}")
    given = import_modules(given)
    if list(given) == ["--version"]:
        print(f"lw-torchrl {__version__}")
        return
    group, args, table = _group(given)
    prog = f"lw-torchrl {group}".strip()
    try:
        if args and (args[0] in ("-h", "--help") or args[0].startswith("--tyro-")):
            about = COMMANDS[group].__doc__ if group else ABOUT
            with unpadded():
                for command in table.values():
                    document(command)
                tyro.extras.subcommand_cli_from_dict(dict(table), prog=prog, description=about, args=args)
        else:
            name = _command(prog, args, table)
            command = parse(f"{prog} {name}", table[name], args[1:])
            # With --json a command's document is all that goes to the standard output.
            with redirect_stdout(sys.stderr) if command.keywords.get("json") else nullcontext():
                output = command()
            if isinstance(output, Output):
                if output.as_json:
                    print(output.document())
                if output.fault:
                    raise ValueError(output.fault)
    finally:
        sys.stdout.flush()


def _group(given: Sequence[str]) -> tuple[str, list[str], Commands]:
    """The command that has commands of its own, if that is given; what follows it; the commands to choose from."""
    group = given[0] if given and given[0] in GROUPS else ""
    return group, [*given[1:]] if group else [*given], GROUPS.get(group, COMMANDS)


def _command(prog: str, args: Sequence[str], table: Commands) -> str:
    """The name of the command that is given; else :class:`ValueError` with the nearest."""
    known = ", ".join(table)
    if not args or args[0].startswith("-"):
        got = f", got {shown(args[0])}" if args else ""
        raise ValueError(f"a command must come first, one of {known}{got}; `{prog} --help` says what each does")
    if args[0] not in table:
        inner = {name: f"{group} {name}" for group, names in GROUPS.items() for name in names}
        known_as = inner | {name: name for name in table}
        close = nearest(args[0], known_as, n=1)
        hint = f"; did you mean {known_as[close[0]]!r}?" if close else ";"
        raise ValueError(f"there is no command {shown(args[0])}{hint} `{prog} --help` lists them: {known}")
    return args[0]


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
    resumed = "; the same command carries on from here" if named & _RESUMABLE else ""
    complain(f"\nlw-torchrl: stopped{resumed}")
    sys.exit(130)
