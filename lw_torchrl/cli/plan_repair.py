"""``lw-torchrl plan repair``: a model is told what became of its plans, and writes others."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from lw_torchrl.cli.outputs import check_folder
from lw_torchrl.cli.sources import one_or_many, read_tasks
from lw_torchrl.cli.threads import use_one_thread


def repair(
    tasks: Positional[Annotated[tuple[str, ...], arg(metavar="TASK ...")]],
    /,
    model: str,
    base_url: str | None = None,
    format: str = "chain_py",
    attempts: int = 1,
    rounds: int = 3,
    enough: float = 0.8,
    episodes: int = 10,
    seed: int = 0,
    constrain: bool = False,
    temperature: float | None = None,
    max_tokens: int = 1024,
    task_file: Path | None = None,
    cache: Path = Path("runs/answers"),
    out: Path = Path("runs/plans"),
) -> None:
    """Ask a model for plans, carry them out by scripted skills, tell it what became of those that fail, and ask again.

    What it is told: the step where the robot got stuck, conditions that never held, how near things came, what could
    not be read. Answers that plan generate got are not asked for again; each round's are kept as those of a model of
    its own, MODEL-round1 and so on, for plan compare. Stopped and started again it carries on.

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
        seed: of these; compare on another one.
        constrain: hold the model to a schema, so that it can only write plans that run.
        temperature: the server's own if none is given.
        max_tokens: of an answer, at most.
        task_file: tasks of yours, instead of ours of the same name or beside ours.
        cache: folder where answers are kept.
        out: folder for the answers as texts.
    """
    check_folder("--out", out)
    check_folder("--cache", cache)
    import lw_torchrl as lw
    from lw_torchrl.cli.tables import print_table
    from lw_torchrl.language.tasks import named_tasks
    from lw_torchrl.planners.repairing import repair_plans

    use_one_thread()
    known = read_tasks(task_file)
    chosen = list(named_tasks(one_or_many(tasks), known=known).values())
    planner = lw.OpenAIPlanner(
        model,
        base_url=base_url,
        constrain=constrain,
        temperature=temperature,
        max_tokens=max_tokens,
        cache=cache,
    )
    first = planner.plans(chosen, format=format, attempts=attempts, out=out)
    found = repair_plans(
        planner, first, rounds=rounds, enough=enough, episodes=episodes, seed=seed, tasks=known, out=out
    )
    columns = ("task", "attempt", "first", *(f"round {k}" for k in range(1, rounds + 1)))
    rows = []
    for one in found:
        rates = [f"{check.success:.0%}" for check in one.checks]
        rows.append((one.answers[0].task, str(one.answers[0].attempt), *rates, *[""] * (rounds + 1 - len(rates))))
    print_table(f"success by scripted skills, {planner.model} in {format}", columns, rows)
    print(f"written to {out / planner.name} and {out / planner.name}-round1 to -round{rounds}")
