"""``lw-torchrl plan``: plans from language models, one command for each thing to do with them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from lw_torchrl._checks import counted
from lw_torchrl.cli.outputs import check_folder
from lw_torchrl.cli.plan_check import check
from lw_torchrl.cli.plan_compare import compare
from lw_torchrl.cli.plan_repair import repair
from lw_torchrl.cli.plan_serve import serve
from lw_torchrl.cli.sources import one_or_many, read_plans, read_skills, read_tasks
from lw_torchrl.cli.tables import Output

if TYPE_CHECKING:
    from lw_torchrl.planners import Answer


def prompt(
    task: Positional[Annotated[str, arg(metavar="TASK")]],
    /,
    format: str = "chain_py",
    vocabulary: bool = False,
    plans: tuple[str, ...] = ("MT10",),
    task_file: Path | None = None,
) -> None:
    """Print the text that asks a language model for a plan: plans of three other tasks, then the task.

    Example: lw-torchrl plan prompt drawer-open --format chain_py

    Args:
        task: the task that a plan is wanted for.
        format: how plans are written: basic, chain or goal, then _py, _py_md or _md.
        vocabulary: also say which things the task has, and what can be asked of them.
        plans: where the examples come from: MT10 or MT50 for the shipped plans, .plan files, .json files or folders.
        task_file: tasks of yours, instead of ours of the same name or beside ours.
    """
    from lw_torchrl.planners.prompts import plan_prompt

    known = read_tasks(task_file)
    found = plan_prompt(task, format, plans=read_plans(plans, known), vocabulary=vocabulary, tasks=known)
    print(found, end="")


def generate(
    tasks: Positional[Annotated[tuple[str, ...], arg(metavar="[TASKS ...]")]] = ("MT10",),
    /,
    *,
    model: str,
    base_url: str | None = None,
    format: tuple[str, ...] = ("chain_py",),
    attempts: int = 1,
    constrain: bool = False,
    free_skills: bool = False,
    vocabulary: bool = False,
    temperature: float | None = None,
    max_tokens: int = 1024,
    seed: int | None = None,
    name: str | None = None,
    plans: tuple[str, ...] = ("MT10",),
    skill_file: Path | None = None,
    task_file: Path | None = None,
    concurrency: int = 4,
    retries: int = 6,
    timeout: float = 300.0,
    cache: Path = Path("runs/answers"),
    out: Path = Path("runs/plans"),
    json: bool = False,
) -> Output:
    """Ask a language model for plans, and say what became of them.

    The model is behind an OpenAI-compatible server: OpenAI's own, vLLM (http://127.0.0.1:8000/v1), Ollama
    (http://127.0.0.1:11434/v1), llama.cpp's (http://127.0.0.1:8080/v1). A key is taken from the environment variable
    OPENAI_API_KEY; a server of your own wants none. What is answered is kept: stopped or killed, the same command asks
    only for what is missing, and the same question costs nothing a second time.

    Example: lw-torchrl plan generate MT10 --model llama3.1 --base-url http://127.0.0.1:11434/v1 --attempts 4

    Args:
        tasks: MT10, MT50, or names of tasks.
        model: the model's name at the server.
        base_url: the server's address; OpenAI's, or what OPENAI_BASE_URL says, if none is given.
        format: how plans are written, one or several: basic, chain or goal, then _py, _py_md or _md; "all" for nine.
        attempts: answers to each question.
        constrain: hold the model to a schema, so that it can only write plans that run; the server must know schemas.
        free_skills: with --constrain, skills in any words instead of the scripted ones.
        vocabulary: prompts also say which things the task has, and what can be asked of them.
        temperature: the server's own if none is given.
        max_tokens: of an answer, at most; models that think first want more.
        seed: attempt k is sent SEED + k; without, none is sent.
        name: of the folder for its answers; the model's, with "-constrained" behind it where it is, if none is given.
        plans: where the prompts' examples come from: MT10 or MT50, .plan files, .json files or folders.
        skill_file: skills of yours that join ours, or replace those of the same text.
        task_file: tasks of yours, instead of ours of the same name or beside ours.
        concurrency: questions at once.
        retries: how often a question is asked again after a rate limit or a fault, with growing waits.
        timeout: seconds that one try may take as a whole, to the answer's last byte; each retry has as long.
        cache: folder where answers are kept, each under a key of all that determines it.
        out: folder for the answers as texts, OUT/<name>/<format>/<task>-<attempt>.py or .md.
        json: print one JSON document instead, see docs/cli.md.
    """
    check_folder("--out", out)
    check_folder("--cache", cache)
    import lw_torchrl as lw
    from lw_torchrl._checks import check_choice
    from lw_torchrl.language.tasks import named_tasks

    known = read_tasks(task_file)
    chosen = list(named_tasks(one_or_many(tasks), known=known).values())
    formats = [*lw.PLAN_FORMATS] if format == ("all",) else list(dict.fromkeys(format))
    for one in formats:
        if one == "all":
            raise ValueError(f"--format must be one of 'all', {', '.join(map(repr, lw.PLAN_FORMATS))}, and 'all' alone")
        check_choice("format", one, ["all", *lw.PLAN_FORMATS])
    planner = lw.OpenAIPlanner(
        model,
        base_url=base_url,
        constrain=constrain,
        free_skills=free_skills,
        skills=read_skills(skill_file, known) if skill_file else None,
        plans=read_plans(plans, known),
        vocabulary=vocabulary,
        temperature=temperature,
        max_tokens=max_tokens,
        seed=seed,
        name=name,
        cache=cache,
        concurrency=concurrency,
        retries=retries,
        timeout=timeout,
    )
    rows, noted, total = [], Counter[str](), 0
    for one in formats:
        answers = planner.plans(chosen, format=one, attempts=attempts, out=out)
        total += answers.tokens.total
        noted.update(note for answer in answers for note in answer.notes)
        for task in dict.fromkeys(answer.task for answer in answers):
            rows.append({"task": task, "format": one, **_counts([answer for answer in answers if answer.task == task])})
    output = Output(json)
    title = f"{planner.model} at {planner.address}"
    output.table("answers", rows, {key.replace("_", " "): key for row in rows[:1] for key in row}, title)
    output.show("notes", [{"note": note, "answers": times} for note, times in noted.most_common()])
    for note, times in noted.most_common():
        print(f"{counted(times, 'answer')}: {note}")
    output.show("tokens", total)
    output.show("folder", out / planner.name, f"{total} tokens; written to {out / planner.name}")
    return output


def _counts(answers: Sequence[Answer]) -> dict[str, int]:
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


COMMANDS: dict[str, Callable[..., Output | None]] = {
    "prompt": prompt,
    "generate": generate,
    "serve": serve,
    "check": check,
    "compare": compare,
    "repair": repair,
}


def plan() -> None:
    """Plans from language models: the prompt, asking a model, and checking, comparing and repairing what it wrote."""
