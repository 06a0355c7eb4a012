"""Errors in the words of the command line: options and arguments of the command, where Python's have other names."""

from __future__ import annotations

import re
from collections.abc import Callable
from inspect import Parameter, signature

# Of each command, the names that the functions behind it use, and the command's own.
OWN_NAMES = {
    "demo": {"root": "out", "checkpoint": "out"},
    "collect": {
        "episodes_per_task": "episodes",
        "noise_scale": "noise",
        "gripper_noise_factor": "gripper_noise",
        "root": "out",
        "task": "tasks",
        "checkpoint": "policy",
    },
    "data": {"root": "folders"},
    "train": {"root": "data", "checkpoint": "out", "task": "tasks"},
    "train-evaluator": {
        "episodes_per_task": "episodes",
        "noise_scale": "noise",
        "root": "out",
        "checkpoint": "out",
        "task": "tasks",
        "policy": "behaviours",
    },
    "evaluate": {"episodes_per_task": "episodes", "noise_scale": "noise", "task": "tasks"},
    "record": {"tasks": "names", "task": "names"},
    "view": {"path": "recording"},
    "scripted": {"episodes_per_task": "episodes", "noise_scale": "noise", "tasks": "names", "task": "names"},
    "tasks": {"tasks": "names", "task": "names"},
    "plans": {"tasks": "names", "task": "names"},
    "skills": {"skills": "skill_file"},
    "check": {"plans": "file"},
    "compare": {"resume": "out"},
    "generate": {"task": "tasks", "source": "plans"},
    "online": {"episodes_per_task": "episodes", "root": "out", "checkpoint": "out", "task": "tasks"},
    "reproduce": {"episodes_per_task": "episodes", "root": "out", "checkpoint": "out"},
}


def in_its_words(command: str, function: Callable[..., object], message: str) -> str:
    """The message with the command's names for what it is about.

    A name at its beginning that the rest speaks of is one; elsewhere only a name that no English word is.

    Example:
        >>> def collect(tasks: str, /, episodes: int, redraw_failures: bool): ...
        >>> in_its_words("collect", collect, "episodes_per_task must be at least 1, got 0")
        '--episodes must be at least 1, got 0'
        >>> in_its_words("collect", collect, "too few; set redraw_failures=False")
        'too few; set --no-redraw-failures'
        >>> in_its_words("collect", collect, "tasks must be names; run the same collect_demonstrations again")
        'TASKS must be names; run the same `lw-torchrl collect` again'
    """
    parameters = signature(function).parameters
    own = OWN_NAMES.get(command, {})

    def shown(match: re.Match[str]) -> str:
        given = match[1]
        if given == "collect_demonstrations":
            return f"`lw-torchrl {'collect' if command in ('train', 'data') else command}`"
        name = given if given in parameters and given not in own else own.get(given, "")
        if name not in parameters:
            return match[0]
        if parameters[name].kind is Parameter.POSITIONAL_ONLY:
            return name.upper()  # as the help has it
        option = name.replace("_", "-")
        return f"--no-{option}" if match[2] == "=False" else f"--{option}"

    message = re.sub(r"^([a-z_]+)()(?=:| must| differ)", shown, message)
    return re.sub(r"(?<![\w-])([a-z]+(?:_[a-z]+)+)(=False|=True)?\b", shown, message)
