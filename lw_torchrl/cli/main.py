"""The command line, ``lw-torchrl``: parses ``--import``, finds the command and reports errors.

A command is a dataclass: its docstring and the comments beside its fields are the help text, and ``run`` does the work.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import nullcontext, redirect_stdout
from dataclasses import is_dataclass
from importlib import import_module
from typing import Any, get_args, get_type_hints

from beartype.door import is_bearable

from lw_torchrl import __version__
from lw_torchrl._util.checks import Count, Natural, Positive, Probability, Scale, nearest

# Name to group, class and summary. Classes are named, not imported, so that `lw-torchrl --help` loads no torch.
COMMANDS = {
    "collect": ("Data", "data:Collect", "Collect demonstrations of scripted experts, skills or a policy"),
    "data show": ("Data", "data:Show", "Summarise datasets: collection policy, success rate, return"),
    "data export": ("Data", "data:Export", "Convert a dataset to another library's format"),
    "data import": ("Data", "data:Import", "Convert another library's dataset to ours"),
    "train": ("Training", "train:Train", "Train a policy on demonstrations"),
    "train-evaluator": ("Training", "train:TrainEvaluator", "Train a network that answers conditions"),
    "evaluate": ("Evaluation", "evaluate:Evaluate", "Evaluate a policy, the experts or scripted skills"),
    "record": ("Evaluation", "record:Record", "Record episodes as a rerun file"),
    "view": ("Evaluation", "record:View", "Open recordings in the rerun viewer"),
    "tasks": ("Language", "language:Tasks", "List tasks, or show one: objects, queries, plan, skills"),
    "query": ("Language", "language:Ask", "Answer a query in a state of a task"),
    "plan prompt": ("Language", "plan:Prompt", "Print the prompt that asks a language model for a plan"),
    "plan generate": ("Language", "plan:Generate", "Ask a language model for plans"),
    "plan read": ("Language", "plan:Read", "Show how a free-form plan is parsed, with a confidence score"),
    "plan repair": ("Language", "plan:Repair", "Ask a language model to repair the plans that fail"),
    "demo": ("Other", "demo:Demo", "Train, evaluate and record a policy on MT10 in a few minutes"),
    "check": ("Other", "language:Check", "Validate a file of plans, skills or tasks, or a suite"),
    "info": ("Other", "data:Info", "Describe a file, or without one this installation"),
}
_MORE = """`lw-torchrl COMMAND --help` explains a command. Every command accepts --import MODULE, which first
imports your Python module, for example one that registers a suite or a policy class
(docs/custom-networks.md). Commands that print a table accept --json. --version prints the version.

Exit status: 0: done; 1: a bug, with a traceback; 2: an error that you can fix
(LW_TORCHRL_TRACEBACK=1 adds the traceback); 130: stopped by Ctrl-C; 141: broken pipe."""
_USER_ERRORS = (ValueError, OSError, ImportError, RuntimeError)
_RANGES: tuple[tuple[Any, str], ...] = (
    (Count, "at least 1"), (Natural, "at least 0"), (Scale, "at least 0"), (Positive, "above 0"),
    (Probability, "from 0 to 1"),
)  # fmt: skip


def main(args: Sequence[str] | None = None) -> None:
    """Run the command line; ends with :class:`SystemExit` unless the exit status is 0."""
    try:
        _run(list(sys.argv[1:] if args is None else args))
        sys.stdout.flush()
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # else the interpreter complains as it exits
        sys.exit(141)
    except KeyboardInterrupt:
        _exit("stopped; most commands resume if you run them again", 130)
    except Exception as error:
        if os.environ.get("LW_TORCHRL_TRACEBACK") or not isinstance(error, _USER_ERRORS):
            raise
        _exit(f"error: {error}", 2)


def _exit(message: str, status: int) -> None:
    print(f"lw-torchrl: {message}", file=sys.stderr)
    sys.exit(status)


def _run(args: list[str]) -> None:
    args = _import_modules(args)
    if args == ["--version"]:
        print(f"lw-torchrl {__version__}")
        return
    name = " ".join(args[:2]) if " ".join(args[:2]) in COMMANDS else " ".join(args[:1])
    inner = {other: command for other, command in COMMANDS.items() if other.startswith(f"{name} ")}
    if not name or name.startswith("-") or (inner and args[1:] in ([], ["-h"], ["--help"])):
        if name not in ("", "-h", "--help") and not inner:
            raise ValueError(f"the command must come first, got {name!r}; `lw-torchrl --help` lists the commands")
        print(_overview(inner or COMMANDS))
        return
    if name not in COMMANDS:
        close = nearest(" ".join(args[:2]) if inner else name, inner or COMMANDS, n=1)
        hint = f"; did you mean {close[0]!r}?" if close else ""
        raise ValueError(f"there is no command {' '.join(args[: 1 + bool(inner)])!r}{hint} (see `lw-torchrl --help`)")
    import tyro

    module, _, attribute = COMMANDS[name][1].partition(":")
    kind = getattr(import_module(f"lw_torchrl.cli.{module}"), attribute)
    markers = (tyro.conf.FlagCreatePairsOff, tyro.conf.DisallowNone)
    command = tyro.cli(kind, prog=f"lw-torchrl {name}", args=args[1 + (" " in name) :], config=markers)
    _check_ranges(command)
    # With --json the document is all that goes to the standard output.
    with redirect_stdout(sys.stderr) if getattr(command, "json", False) else nullcontext():
        output = command.run()
    if output is not None:
        output.finish()


def _check_ranges(command: Any) -> None:
    """Raise :class:`ValueError`, with the option's name, for the first number that is out of its annotation's range."""
    for name, hint in get_type_hints(type(command), include_extras=True).items():
        value = getattr(command, name)
        if is_dataclass(value):
            _check_ranges(value)
        parts = [*_parts(hint)]
        for allowed, text in _RANGES:
            if get_args(allowed)[1] in parts:
                for number in value if isinstance(value, tuple) else [] if value is None else [value]:
                    if not is_bearable(number, allowed):
                        raise ValueError(f"--{name.replace('_', '-')} must be {text}, got {number}")


def _parts(hint: Any) -> Iterator[Any]:
    """Yield the types and validators in a type hint, nested ones too."""
    yield hint
    for part in get_args(hint):
        yield from _parts(part)


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
                sys.path.insert(0, "")  # the working folder comes first
            name = next(words, "") if word == "--import" else word.removeprefix("--import=")
            if not name:
                raise ValueError("--import requires the name of a Python module")
            import_module(name)
        else:
            rest.append(word)
    return rest
