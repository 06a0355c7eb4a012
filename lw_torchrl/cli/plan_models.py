"""``lw-torchrl plan generate`` and ``repair``: a language model is asked for plans, and told what became of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import OmitArgPrefixes, Positional

import lw_torchrl as lw
from lw_torchrl._checks import check_choice, counted
from lw_torchrl.cli import options
from lw_torchrl.cli.output import Columns, Output, Row
from lw_torchrl.language.formats import PLAN_FORMATS
from lw_torchrl.language.tasks import Task, named_tasks


@dataclass(frozen=True)
class Asking:
    """Which model is asked, and how."""

    model: str  # the model's name at the server.
    base_url: str | None = None  # the server's address; OpenAI's, or what OPENAI_BASE_URL says, if none is given.
    attempts: int = 1  # answers to each question.
    constrain: bool = False  # hold the model to a schema, so that its plans run; the server must know schemas.
    free_skills: bool = False  # with --constrain, skills in any words instead of the scripted ones.
    vocabulary: bool = False  # prompts also say which things the task has, and what can be asked of them.
    temperature: float | None = None  # the server's own if none is given.
    max_tokens: int = 1024  # of an answer, at most; models that think first want more.
    seed: int | None = None  # attempt k is sent SEED + k; without, none is sent.
    name: str | None = None  # of the folder for its answers; by default the model's, with "-constrained" if it is.
    plans: tuple[str, ...] = ("MT10",)  # of the prompts' examples: MT10 or MT50, .plan files, .json files or folders.
    skill_file: options.SkillFile = None
    task_file: options.TaskFile = None
    concurrency: int = 4  # questions at once.
    retries: int = 6  # how often a question is asked again after a rate limit or a fault, with growing waits.
    timeout: float = 300.0  # seconds for one try as a whole, to the answer's last byte; each retry has as long.
    cache: Path = Path("runs/answers")  # folder where answers are kept, each under a key of all that determines it.
    out: Path = Path("runs/plans")  # folder for the answers as texts, OUT/<name>/<format>/<task>-<attempt>.py or .md.

    def begin(self, names: tuple[str, ...]) -> tuple[lw.OpenAIPlanner, dict[str, Task], Mapping[str, Task]]:
        """The model, the tasks that are named, and all tasks."""
        options.check_folder("--out", self.out)
        options.check_folder("--cache", self.cache)
        known = options.read_tasks(self.task_file, names)
        chosen = dict(named_tasks(options.one_or_many(names), known=known))
        ours = ("attempts", "out", "plans", "skill_file", "task_file")
        asked = {name: value for name, value in vars(self).items() if name not in ours}
        skills = options.read_skills(self.skill_file, known) if self.skill_file else None
        return lw.OpenAIPlanner(skills=skills, plans=options.read_plans(self.plans, known), **asked), chosen, known


def generate(
    tasks: Positional[options.TaskNames] = ("MT10",),
    /,
    *,
    asking: Annotated[Asking, OmitArgPrefixes],  # which model is asked, and how
    format: tuple[str, ...] = ("chain_py",),  # basic, chain or goal, then _py, _py_md or _md; several, or "all" nine
    json: options.Json = False,
) -> Output:
    """Ask a language model for plans, and say what became of them.

    The model is behind an OpenAI-compatible server: OpenAI's own, vLLM (http://127.0.0.1:8000/v1), Ollama
    (http://127.0.0.1:11434/v1), llama.cpp's (http://127.0.0.1:8080/v1). A key is taken from the environment variable
    OPENAI_API_KEY; a server of your own wants none. What is answered is kept: stopped or killed, the same command asks
    only for what is missing, and the same question costs nothing a second time.

    Example: lw-torchrl plan generate MT10 --model llama3.1 --base-url http://127.0.0.1:11434/v1 --attempts 4
    """
    planner, chosen, _ = asking.begin(tasks)
    formats = [*PLAN_FORMATS] if format == ("all",) else list(dict.fromkeys(format))
    for one in formats:
        if one == "all":
            raise ValueError(f"--format must be one of 'all', {', '.join(map(repr, PLAN_FORMATS))}, and 'all' alone")
        check_choice("format", one, ["all", *PLAN_FORMATS])
    rows, notes, total = [], [], 0
    for one in formats:
        answers = planner.plans([*chosen.values()], format=one, attempts=asking.attempts, out=asking.out)
        total += answers.tokens.total
        notes += [note for answer in answers for note in answer.notes]
        for task in dict.fromkeys(answer.task for answer in answers):
            rows.append({"task": task, "format": one, **_counts([answer for answer in answers if answer.task == task])})
    output = Output(json)
    title = f"{planner.model} at {planner.address}"
    output.table("answers", rows, {key.replace("_", " "): key for row in rows[:1] for key in row}, title)
    output.notes(notes)
    output.show("tokens", total)
    folder = asking.out / planner.name
    return output.show("folder", folder, f"{total} tokens; written to {folder}")


def _counts(answers: Sequence[lw.planners.Answer]) -> dict[str, int]:
    """What a row of the table says of the answers to one question."""
    plans = [answer.decoded for answer in answers if answer.decoded.plan is not None]
    return {
        "answers": len(answers),
        "plans": len(plans),
        "all_scripted": sum(decoded.all_scripted for decoded in plans),
        "asked_now": sum(not answer.cached for answer in answers),
        "tokens_read": sum(answer.tokens.prompt for answer in answers),
        "tokens_written": sum(answer.tokens.completion for answer in answers),
    }


def repair(
    tasks: Positional[options.TaskNames],
    /,
    *,
    asking: Annotated[Asking, OmitArgPrefixes],  # which model is asked, and how
    format: str = "chain_py",  # how plans are written: basic, chain or goal, then _py, _py_md or _md
    rounds: int = 3,  # how often the model is told, at most
    enough: float = 0.8,  # the success rate from which a plan is left as it is
    episodes: int = 10,  # of each plan
    episode_seed: int = 0,  # of these; compare on another one
    json: options.Json = False,
) -> Output:
    """Ask a model for plans, carry them out by scripted skills, tell it what became of those that fail, and ask again.

    What it is told: the step where the robot got stuck, conditions that never held, how near things came, what could
    not be read. It begins with the answers in OUT/<name>, as plan generate wrote them, and asks only for those that are
    missing; none is replaced. Each round's are kept as those of a model of its own, <name>-round1 and so on, for plan
    compare. If it is stopped, the same command resumes it.

    Example: lw-torchrl plan repair MT10 --model llama3.1 --base-url http://127.0.0.1:11434/v1 --rounds 3
    """
    planner, chosen, known = asking.begin(tasks)
    check_choice("format", format, PLAN_FORMATS)
    from lw_torchrl.planners.repairing import repair_plans

    options.use_one_thread()
    first = planner.plans([*chosen.values()], format=format, attempts=asking.attempts, out=asking.out, recorded=True)
    repairing: dict[str, Any] = {"rounds": rounds, "enough": enough, "episodes": episodes, "seed": episode_seed}
    found = repair_plans(planner, first, tasks=known, out=asking.out, **repairing)
    rows = []
    for one in found:
        row = {"task": one.answers[0].task, "attempt": one.answers[0].attempt}
        rows.append(row | {"success": [check.success for check in one.checks]})

    def after(told: int) -> Callable[[Row], str]:
        return lambda row: f"{row['success'][told]:.0%}" if told < len(row["success"]) else ""

    each = {f"round {k}": after(k) for k in range(1, rounds + 1)}
    output = Output(json)
    columns: Columns = {"task": "task", "attempt": "attempt", "first": after(0), **each}
    output.table("plans", rows, columns, f"success by scripted skills, {planner.model} in {format}")
    output.notes(note for one in found for answer in one.answers for note in answer.notes)
    asked = sum(not answer.cached for answer in first)
    print(f"{counted(len(first), 'answer')} to begin with, {asked} asked now")
    done = max(len(one.checks) for one in found) - 1
    folders = [asking.out / planner.name, *(asking.out / f"{planner.name}-round{k}" for k in range(1, done + 1))]
    return output.show("folders", folders, f"written to {', '.join(map(str, folders))}")
