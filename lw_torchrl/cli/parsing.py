"""A command's arguments as values: what it does not know, or not allow, is refused with the nearest that it does."""

from __future__ import annotations

import io
import os
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from functools import partial, wraps
from inspect import Parameter, Signature, signature
from itertools import pairwise
from typing import Any, Literal, get_args, get_origin, get_type_hints

import tyro
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from lw_torchrl._checks import check_choice, check_int, check_scale, nearest, shown

COUNTS = ("attempts", "batch_size", "episodes", "jobs", "max_steps", "num_envs", "passes", "steps")
"""Arguments that count something, in every command: at least 1."""
SCALES = ("beta", "gripper_noise", "latent_consistency", "learning_rate", "noise", "qaf_anchor")
"""Arguments that say how much of something: finite and at least 0."""
_NUMBERS = {int: "an integer", float: "a number"}


def parse(prog: str, function: Callable[..., Any], args: Sequence[str]) -> partial[Any]:
    """A command's function with its arguments; ``--help`` is printed, and ends the program.

    Raises:
        ValueError: an option that the command does not have, an argument too many or too few, a word where a number
            must be, another word than those allowed.

    Example:
        >>> def cook(dish: Literal["soup", "stew"], /, minutes: int = 10): ...
        >>> parse("kitchen", cook, ["stew", "--minutes", "30"]).keywords
        {'minutes': 30}
        >>> parse("kitchen", cook, ["stew", "--minute", "30"])
        Traceback (most recent call last):
        ValueError: there is no option --minute; did you mean --minutes? `kitchen --help` lists them
    """
    parameters = signature(function)
    _check_options(prog, parameters, args)

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
        raise ValueError(_refusal(prog, parameters, said.getvalue())) from None
    sys.stderr.write(said.getvalue())
    if beyond:
        raise ValueError(f"there is one argument too many, {shown(beyond[0])}; `{prog} --help` says what there is")
    given = parameters.bind(*call.args, **call.keywords).arguments
    for name, kind in get_type_hints(function).items():
        value = given.get(name)
        for one in value if isinstance(value, tuple) else [value]:
            _check_value(name, one, _of_one(kind))
            if name in SCALES and one is not None:
                check_scale(name, one)
        if name in COUNTS and isinstance(value, int):
            check_int(name, value, minimum=1)
    return call


def _check_value(name: str, value: Any, kind: Any) -> None:
    """Refuse a word that is none of those allowed, or no number; the rules of :func:`_registry` let them pass."""
    if get_origin(kind) is Literal and value is not None:
        check_choice(name, value, get_args(kind))
    elif kind in _NUMBERS and isinstance(value, str):
        raise ValueError(f"{name} must be {_NUMBERS[kind]}, got {shown(value)}")


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


def _options(parameters: Signature) -> list[str]:
    found = ["--help"]
    for name, one in parameters.parameters.items():
        if one.kind is not Parameter.POSITIONAL_ONLY:
            option = name.replace("_", "-")
            found += [f"--{option}", *([f"--no-{option}"] if one.annotation in (bool, "bool") else [])]
    return found


def _check_options(prog: str, parameters: Signature, args: Sequence[str]) -> None:
    """Refuse the first option that is none of the command's; what follows ``--`` is none."""
    options = _options(parameters)
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
    def word(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
        if info.type_origin is not Literal:
            return None
        return PrimitiveConstructorSpec(
            nargs=1,
            metavar="{" + ",".join(get_args(info.type)) + "}",
            instance_from_str=lambda given: given[0],
            is_instance=lambda value: isinstance(value, str),
            str_from_instance=lambda value: [value],
        )

    @registry.primitive_rule
    def number(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
        if info.type not in _NUMBERS:
            return None

        def read(given: list[str]) -> Any:
            try:
                return info.type(given[0])
            except ValueError:
                return given[0]

        return PrimitiveConstructorSpec(
            nargs=1,
            metavar=info.type.__name__.upper(),
            instance_from_str=read,
            is_instance=lambda value: isinstance(value, (int, float, str)),
            str_from_instance=lambda value: [str(value)],
        )

    return registry


def _refusal(prog: str, parameters: Signature, box: str) -> str:
    """What tyro says in a box, in a line."""
    lines = [line.strip("│ ") for line in box.splitlines()[1:]]
    rules = [number for number, line in enumerate(lines) if re.match("[─╰-]{3}", line)]
    parts = [lines[first + 1 : last] for first, last in pairwise([-1, *rules, len(lines)])]
    text = " ".join(" ".join(next((part for part in parts if any(part)), ["the arguments cannot be read"])).split())
    if text.startswith("Missing from"):
        needed = [one for one in parameters.parameters.values() if one.default is Parameter.empty]
        names = [
            one.name.upper() if one.kind is Parameter.POSITIONAL_ONLY else f"--{one.name.replace('_', '-')}"
            for one in needed
        ]
        absent = [name for name in names if name in text.split()]
        return f"{' and '.join(absent or names)} must be given; `{prog} --help` says what there is"
    return re.sub(r"^Missing value for argument '(\S+)'.*", r"\1 must be given a value", text)
