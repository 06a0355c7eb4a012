"""The entry point of the ``lw-torchrl`` command line: parse ``--import``, find the command and report errors.

A command is a dataclass: the docstring and the comments next to the fields are the help text; ``run`` does the work.
"""

from __future__ import annotations

import os
import re
import sys
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stdout, suppress
from dataclasses import is_dataclass
from importlib import import_module
from typing import Any, get_type_hints

from lw_torchrl import __version__
from lw_torchrl._util.checks import check_value, nearest
from lw_torchrl._util.text import PrintableStream, printable

# Map each command to its group, class and summary. Classes are imported later, so `lw-torchrl --help` loads no torch.
COMMANDS = {
    "collect": ("Data", "data:Collect", "Collect demonstrations from an expert, scripted skills or a policy"),
    "data show": ("Data", "data:Show", "Summarize datasets: collection policy, success rate, return"),
    "data export": ("Data", "data:Export", "Convert a dataset to another library's format"),
    "data import": ("Data", "data:Import", "Convert another library's dataset to this library's format"),
    "train": ("Training", "train:Train", "Train a policy on demonstrations"),
    "train-evaluator": ("Training", "train:TrainEvaluator", "Train a network that predicts whether conditions hold"),
    "evaluate": ("Evaluation", "evaluate:Evaluate", "Evaluate a policy, the experts or scripted skills"),
    "record": ("Evaluation", "record:Record", "Record episodes to a Rerun file (.rrd)"),
    "view": ("Evaluation", "record:View", "Open recordings in the Rerun viewer"),
    "tasks": ("Language", "language:Tasks", "List tasks, or show one: objects, queries, plan, skills"),
    "query": ("Language", "language:Ask", "Check whether a query holds in a state of a task"),
    "plan prompt": ("Language", "plan:Prompt", "Print the prompt that asks a language model for a plan"),
    "plan generate": ("Language", "plan:Generate", "Ask a language model for plans"),
    "plan read": ("Language", "plan:Read", "Show how a free-form plan is parsed"),
    "plan repair": ("Language", "plan:Repair", "Ask a language model to repair the plans that fail"),
    "demo": ("Other", "demo:Demo", "Train, evaluate and record a policy on MT10 in a few minutes"),
    "check": ("Other", "language:Check", "Validate a file of plans, skills or tasks, or a suite"),
    "info": ("Other", "data:Info", "Describe a file or, without arguments, this installation"),
}
_MORE = """`lw-torchrl COMMAND --help` explains a command. Every command accepts --import MODULE, which first
imports your Python module, for example to register a suite or a policy class
(docs/custom-networks.md). Commands that print a table accept --json. --version prints the version.

Exit status: 0: success; 1: a bug, with a traceback; 2: an error that you can fix
(LW_TORCHRL_TRACEBACK=1 adds the traceback); 130: stopped by Ctrl-C; 141: broken pipe."""
_HOME = re.compile(r"^(--[\w-]+=)?~(?=/|$)")  # shells do not expand the ~ of --out=~/file
_USER_ERRORS = (ValueError, OSError, ImportError, RuntimeError)


def main(args: Sequence[str] | None = None) -> None:
    """Run the command line; raise :class:`SystemExit` unless the exit status is 0."""
    if args is None:  # called by the console script
        warnings.formatwarning = _warning_text
    words = [_HOME.sub(_expand, word) for word in (sys.argv[1:] if args is None else args)]
    try:
        with _messages_to_stderr() if "--json" in words else redirect_stdout(PrintableStream(sys.stdout)):
            output = _run(words)
        if output is not None:
            with redirect_stdout(PrintableStream(sys.stdout)):
                output.finish()
        sys.stdout.flush()
        if args is None and "--json" in words:
            os.dup2(2, 1)  # an imported module may print at exit
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # else Python prints an error at exit
        sys.exit(141)
    except KeyboardInterrupt:
        _exit("interrupted; most commands resume if you run them again", 130)
    except Exception as error:
        if os.environ.get("LW_TORCHRL_TRACEBACK") or not isinstance(error, _USER_ERRORS):
            raise
        _exit(f"error: {error}", 2)


def _exit(message: str, status: int) -> None:
    print(printable(f"lw-torchrl: {message}"), file=sys.stderr)
    sys.exit(status)


def _expand(match: re.Match[str]) -> str:
    return (match[1] or "") + os.path.expanduser("~")


@contextmanager
def _messages_to_stderr() -> Iterator[None]:
    """Redirect stdout to stderr until the block ends, also for compiled code and child processes."""
    stdout, kept = sys.stdout, None
    with suppress(OSError, ValueError):  # an in-memory stream has no file descriptor
        number = stdout.fileno()
        stdout.flush()
        kept = os.dup(number)
        os.dup2(2, number)
    try:
        with redirect_stdout(PrintableStream(sys.stderr)):
            yield
    finally:
        if kept is not None:
            stdout.flush()  # print to stderr what was written to sys.__stdout__ in the block
            os.dup2(kept, number)
            os.close(kept)


def _warning_text(message: Warning | str, category: type[Warning], *_: Any, **__: Any) -> str:
    return printable(f"{category.__name__}: {message}\n")


def _run(args: list[str]) -> Any:
    """Run a command and return its output, which the caller prints."""
    args = _import_modules(args)
    if args == ["--version"]:
        print(f"lw-torchrl {__version__}")
        return None
    name = " ".join(args[:2]) if " ".join(args[:2]) in COMMANDS else " ".join(args[:1])
    inner = {other: command for other, command in COMMANDS.items() if other.startswith(f"{name} ")}
    if not name or name.startswith("-") or (inner and args[1:] in ([], ["-h"], ["--help"])):
        if name not in ("", "-h", "--help") and not inner:
            raise ValueError(f"the command must come first, got {name!r}; `lw-torchrl --help` lists the commands")
        print(_overview(inner or COMMANDS))
        return None
    if name not in COMMANDS:
        close = nearest(" ".join(args[:2]) if inner else name, inner or COMMANDS, n=1)
        hint = f"; did you mean {close[0]!r}?" if close else ""
        raise ValueError(f"there is no command {' '.join(args[: 1 + bool(inner)])!r}{hint} (see `lw-torchrl --help`)")
    import tyro

    module, _, attribute = COMMANDS[name][1].partition(":")
    kind = getattr(import_module(f"lw_torchrl.cli.{module}"), attribute)
    markers = (tyro.conf.FlagCreatePairsOff, tyro.conf.DisallowNone)
    command = tyro.cli(kind, prog=f"lw-torchrl {name}", args=args[1 + (" " in name) :], config=markers)
    _check(command)
    return command.run()


def _check(command: Any) -> None:
    """Raise a :class:`ValueError` that names the first option whose value does not match its annotation."""
    for name, hint in get_type_hints(type(command), include_extras=True).items():
        value = getattr(command, name)
        if is_dataclass(value):
            _check(value)
        else:
            check_value(f"--{name.replace('_', '-')}", value, hint)


def _overview(commands: dict[str, tuple[str, str, str]]) -> str:
    width = max(map(len, commands))
    lines = ["usage: lw-torchrl COMMAND [ARGUMENTS]", "", "Train and evaluate plan-conditioned robot policies."]
    for title in dict.fromkeys(group for group, _, _ in commands.values()):
        rows = [(name, summary) for name, (group, _, summary) in commands.items() if group == title]
        lines += ["", f"{title}:", *(f"  {name:{width}}  {summary}" for name, summary in rows)]
    return "\n".join([*lines, "", _MORE])


def _import_modules(args: list[str]) -> list[str]:
    """Import the module of each ``--import MODULE`` and return the other arguments."""
    rest, words = [], iter(args)
    for word in words:
        if word == "--import" or word.startswith("--import="):
            if "" not in sys.path:
                sys.path.insert(0, "")  # search the working folder first
            name = next(words, "") if word == "--import" else word.removeprefix("--import=")
            if not name:
                raise ValueError("--import requires the name of a Python module")
            import_module(name)
        else:
            rest.append(word)
    return rest
