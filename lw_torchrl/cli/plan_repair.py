"""``lw-torchrl plan repair``: a model is told what became of its plans, and writes others."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from lw_torchrl._checks import check_choice, counted
from lw_torchrl.cli.outputs import check_folder
from lw_torchrl.cli.sources import one_or_many, read_plans, read_skills, read_tasks
from lw_torchrl.cli.tables import Columns, Output, Row
from lw_torchrl.cli.threads import use_one_thread


def repair(
    tasks: Positional[Annotated[tuple[str, ...], arg(metavar="TASK ...")]],
    /,
    *,
    model: str,
    base_url: str | None = None,
    format: str = "chain_py",
    attempts: int = 1,
    rounds: int = 3,
    enough: float = 0.8,
    episodes: int = 10,
    episode_seed: int = 0,
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
    """Ask a model for plans, carry them out by scripted skills, tell it what became of those that fail, and ask again.

    What it is told: the step where the robot got stuck, conditions that never held, how near things came, what could
    not be read. It begins with the answers in OUT/<name>, as plan generate wrote them, and asks only for those that are
    missing; none is replaced. Each round's are kept as those of a model of its own, <name>-round1 and so on, for plan
    compare. Stopped and started again it carries on.

    Example: lw-torchrl plan repair MT10 --model llama3.1 --base-url http://127.0.0.1:11434/v1 --rounds 3

    Args:
        tasks: MT10, MT50, or names of tasks.
        model: the model's name at the server.
        base_url: the server's address; OpenAI's, or what OPENAI_BASE_URL says, if none is given.
        format: how plans are written: basic, chain or goal, then _py, _py_md or _md.
        attempts: answers to each question, each repaired for itself.
        rounds: how often the model is told, at most.
        enough: the success rate from which a plan is left as it is.
        episodes: of each plan.
        episode_seed: of these; compare on another one.
        constrain: hold the model to a schema, so that it can only write plans that run.
        free_skills: with --constrain, skills in any words instead of the scripted ones.
        vocabulary: prompts also say which things the task has, and what can be asked of them.
        temperature: the server's own if none is given.
        max_tokens: of an answer, at most.
        seed: attempt k is sent SEED + k, as by plan generate; without, none is sent.
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
    from lw_torchrl.language.tasks import named_tasks

    known = read_tasks(task_file)
    chosen = list(named_tasks(one_or_many(tasks), known=known).values())
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
    check_choice("format", format, lw.PLAN_FORMATS)
    from lw_torchrl.planners.repairing import repair_plans

    use_one_thread()
    first = planner.plans(chosen, format=format, attempts=attempts, out=out, recorded=True)
    found = repair_plans(
        planner, first, rounds=rounds, enough=enough, episodes=episodes, seed=episode_seed, tasks=known, out=out
    )
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
    noted = Counter(note for one in found for answer in one.answers for note in answer.notes)
    output.show("notes", [{"note": note, "answers": times} for note, times in noted.most_common()])
    for note, times in noted.most_common():
        print(f"{counted(times, 'answer')}: {note}")
    asked = sum(not answer.cached for answer in first)
    print(f"{counted(len(first), 'answer')} to begin with, {asked} asked now")
    done = max(len(one.checks) for one in found) - 1
    folders = [out / name for name in (planner.name, *(f"{planner.name}-round{k}" for k in range(1, done + 1)))]
    output.show("folders", folders, f"written to {', '.join(map(str, folders))}")
    return output
