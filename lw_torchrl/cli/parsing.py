"""A command's arguments: read as values, refused with the nearest that is allowed, and named in errors as options."""

import io
import os
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout, suppress
from dataclasses import MISSING, fields, is_dataclass
from functools import partial, wraps
from importlib import import_module
from inspect import Parameter, cleandoc, getsource, signature
from itertools import pairwise
from types import ModuleType
from typing import Any, Literal, get_args, get_origin, get_type_hints

import tyro
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from lw_torchrl._checks import check_choice, check_int, check_scale, nearest, shown

COUNTS = ("attempts", "batch_size", "episodes", "jobs", "max_steps", "num_envs", "passes", "steps")
"""Arguments that count something, in every command: at least 1."""
SCALES = ("beta", "gripper_noise", "learning_rate", "noise", "qaf_anchor")
"""Arguments that say how much of something: finite and at least 0."""
_BESIDE = re.compile(r"^    (\w+): .*,  # (.+)$", re.MULTILINE)
_NUMBERS = {int: "an integer", float: "a number"}


def parse(prog: str, function: Callable[..., Any], args: Sequence[str]) -> partial[Any]:
    """A command's function with its arguments; ``--help`` is printed, and ends the program."""
    known = arguments(function)
    _check_options(prog, known, args)
    document(function)

    @wraps(function)
    def found(*args: Any, **kwargs: Any) -> partial[Any]:
        return partial(function, *args, **kwargs)

    said = io.StringIO()
    try:
        with redirect_stderr(said), unpadded():
            # What is beyond the last positional argument is refused in our words, as unknown options are.
            call, beyond = tyro.cli(found, prog=prog, args=args, return_unknown_args=True, registry=_registry())
    except SystemExit as ended:
        if not ended.code:
            raise
        raise ValueError(_refusal(prog, known, said.getvalue())) from None
    sys.stderr.write(said.getvalue())
    if beyond:
        raise ValueError(f"there is one argument too many, {shown(beyond[0])}; `{prog} --help` says what there is")
    given = signature(function).bind(*call.args, **call.keywords).arguments
    for shared in [*given.values()]:
        if is_dataclass(shared):
            given |= vars(shared)
    for name, one in known.items():
        value, kind = given.get(name), _of_one(one.annotation)
        for each in value if isinstance(value, tuple) else () if value is None else (value,):
            if get_origin(kind) is Literal:
                check_choice(name, each, get_args(kind))
            elif kind in _NUMBERS and isinstance(each, str):
                raise ValueError(f"{name} must be {_NUMBERS[kind]}, got {shown(each)}")
            elif name in SCALES:
                check_scale(name, each)
        if name in COUNTS and isinstance(value, int):
            check_int(name, value, minimum=1)
    return call


def document(function: Callable[..., Any]) -> None:
    """Add the comments beside a command's arguments to its docstring, which tyro makes the help text of."""
    about, _, others = cleandoc(function.__doc__ or "").partition("\n\nArgs:\n")
    with suppress(OSError):  # typed at a prompt, a function has no source
        beside = "".join(f"    {name}: {said}.\n" for name, said in _BESIDE.findall(getsource(function)))
        if not others.startswith(beside):
            function.__doc__ = f"{about}\n\nArgs:\n{beside}{others}"


def arguments(function: Callable[..., Any]) -> dict[str, Parameter]:
    """A command's arguments; options that it shares with other commands are the fields of a dataclass."""
    kinds, found = get_type_hints(function), {}
    for name, one in signature(function).parameters.items():
        kind = kinds.get(name, Any)
        if not is_dataclass(kind):
            found[name] = one.replace(annotation=kind)
            continue
        own = get_type_hints(kind)
        for field in fields(kind):
            default = Parameter.empty if field.default is MISSING else field.default
            option = Parameter(field.name, Parameter.KEYWORD_ONLY, default=default, annotation=own[field.name])
            found[field.name] = option
    return found


def _as_typed(name: str, one: Parameter) -> str:
    """An argument as the help has it: TASK, or --max-steps."""
    return name.upper() if one.kind is Parameter.POSITIONAL_ONLY else f"--{name.replace('_', '-')}"


@contextmanager
def unpadded() -> Iterator[None]:
    """Within the block tyro's help goes to a pipe, or where NO_COLOR is set, without boxes, colours and padding."""
    if sys.stdout.isatty() and not os.environ.get("NO_COLOR"):
        yield
        return
    text = io.StringIO()  # whose encoding is none that tyro draws boxes in
    try:
        with redirect_stdout(text):
            yield
    finally:
        sys.stdout.write("".join(f"{line.rstrip()}\n" for line in text.getvalue().splitlines()))


def _check_options(prog: str, known: Mapping[str, Parameter], args: Sequence[str]) -> None:
    """Refuse the first option that is none of the command's; what follows ``--`` is none."""
    typed = {_as_typed(name, one): one for name, one in known.items() if one.kind is not Parameter.POSITIONAL_ONLY}
    options = ["--help", *typed, *(f"--no-{name[2:]}" for name, one in typed.items() if one.annotation is bool)]
    for arg in args:
        if arg == "--":
            return
        option = arg.partition("=")[0].replace("_", "-")
        if not re.match(r"--?[A-Za-z]", arg) or option in (*options, "-h") or re.fullmatch(r"-(inf|nan).*", arg):
            continue
        close = nearest(option, options, n=1)
        hint = f"; did you mean {close[0]}?" if close else ";"
        raise ValueError(f"there is no option {option}{hint} `{prog} --help` lists them")


def _of_one(kind: Any) -> Any:
    """The type of one value where a type is of several, or of one or None."""
    parts = [part for part in get_args(kind) if part not in (type(None), ...)]
    return _of_one(parts[0]) if parts and get_origin(kind) is not Literal else kind


def _registry() -> ConstructorRegistry:
    """How the command line reads words and numbers: whatever stands there, which is checked later, in our words."""
    registry = ConstructorRegistry()

    @registry.primitive_rule
    def word_or_number(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
        if info.type_origin is not Literal and info.type not in _NUMBERS:
            return None

        def read(given: list[str]) -> Any:
            with suppress(ValueError):
                return given[0] if info.type not in _NUMBERS else info.type(given[0])
            return given[0]

        return PrimitiveConstructorSpec(
            nargs=1,
            metavar=info.type.__name__.upper() if info.type in _NUMBERS else f"{{{','.join(get_args(info.type))}}}",
            instance_from_str=read,
            is_instance=lambda value: isinstance(value, (int, float, str)),
            str_from_instance=lambda value: [str(value)],
        )

    return registry


def _refusal(prog: str, known: Mapping[str, Parameter], box: str) -> str:
    """What tyro says in a box, in a line."""
    lines = [line.strip("│ ") for line in box.splitlines()[1:]]
    rules = [number for number, line in enumerate(lines) if re.match("[─╰-]{3}", line)]
    parts = [lines[first + 1 : last] for first, last in pairwise([-1, *rules, len(lines)])]
    text = " ".join(" ".join(next((part for part in parts if any(part)), ["the arguments cannot be read"])).split())
    if text.startswith("Missing from"):
        needed = [_as_typed(name, one) for name, one in known.items() if one.default is Parameter.empty]
        absent = [name for name in needed if name in text.split()] or needed
        return f"{' and '.join(absent)} must be given; `{prog} --help` says what there is"
    return re.sub(r"^Missing value for argument '(\S+)'.*", r"\1 must be given a value", text)


def own_module(absent: str, name: str) -> ModuleType:
    """A module of the user's; the working folder is searched first. Where there is none, the error begins with
    ``absent``; what the module itself raises is passed on."""
    if "" not in sys.path:
        sys.path.insert(0, "")
    if not all(part.isidentifier() for part in name.split(".")):
        raise ValueError(f"{absent}: {name!r} is no module's name, which is like my_module or my_package.my_module")
    try:
        return import_module(name)
    except ModuleNotFoundError as error:
        if not f"{name}.".startswith(f"{error.name}."):  # one that it imports
            raise
        hint = f"; did you mean {name.removesuffix('.py')!r}?" if name.endswith(".py") else ""
        raise ValueError(f"{absent}: {error}{hint}") from None
    except SyntaxError as error:
        if error.filename:
            raise
        raise ValueError(f"{absent}: {error}") from None  # no text, but bytes with zeros


IMPORTED: list[str] = []
"""The modules that this command line's ``--import`` names, for commands that start others."""


def import_modules(given: Sequence[str]) -> list[str]:
    """The command line without each ``--import MODULE``, which is imported."""
    rest, words = [], iter(given)
    IMPORTED.clear()
    for word in words:
        if word != "--import" and not word.startswith("--import="):
            rest.append(word)
            continue
        name = next(words, "") if word == "--import" else word.removeprefix("--import=")
        own_module(f"--import {name!r} names no module", name)
        IMPORTED.append(name)
    return rest


# Names in the library's errors, and the options that they become, of which a command has one.
_OPTIONS = {
    "checkpoint": ("out",),
    "episodes_per_task": ("episodes",),
    "gripper_noise_factor": ("gripper_noise",),
    "method": ("condition", "methods"),
    "noise_scale": ("noise",),
    "path": ("recording",),
    "policy": ("behaviours",),
    "resume": ("out",),
    "root": ("folders", "folder", "out"),
    "skills": ("skill_file",),
    "source": ("plans",),
    "task": ("tasks", "names"),
    "tasks": ("names",),
    "with_plans": ("plans",),
}
_OPTIONS_OF = {
    "collect": {"checkpoint": "policy"},
    "card": {"checkpoint": "policy"},
    "train": {"root": "data"},
    "check": {"plans": "file"},
}
"""Where a command differs, or has an option of that name that means something else."""


def in_its_words(command: str, function: Callable[..., object], message: str) -> str:
    """An error's message, with the command's options and arguments for the names of the library.

    At the beginning any name before a colon, "must" or "differ" is replaced; elsewhere only one with an underscore.

    Example:
        >>> def collect(tasks: str, /, episodes: int, redraw_failures: bool): ...
        >>> in_its_words("collect", collect, "episodes_per_task must be at least 1, got 0")
        '--episodes must be at least 1, got 0'
        >>> in_its_words("collect", collect, "too few; set redraw_failures=False")
        'too few; set --no-redraw-failures'
    """
    known, own = arguments(function), _OPTIONS_OF.get(command, {})

    def shown(match: re.Match[str]) -> str:
        given = match[1]
        if given == "collect_demonstrations":
            return f"`lw-torchrl {'collect' if command in ('train', 'show', 'export') else command}`"
        name = next((one for one in (own.get(given), given, *_OPTIONS.get(given, ())) if one in known), "")
        if not name:
            return match[0]
        typed = _as_typed(name, known[name])
        return typed.replace("--", "--no-", 1) if match[2] == "=False" else typed

    message = re.sub(r"^([a-z_]+)()(?=:| must| differ)", shown, message)
    return re.sub(r"(?<![\w./'\"-])([a-z]+(?:_[a-z]+)+)(=False|=True)?\b", shown, message)
