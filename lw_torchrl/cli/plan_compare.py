"""``lw-torchrl plan compare``: what scripted skills make of the plans that models wrote."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from lw_torchrl.cli.outputs import check_folder
from lw_torchrl.cli.sources import read_tasks
from lw_torchrl.cli.tables import Output
from lw_torchrl.cli.threads import use_one_thread

_BEST = ": of each task the plan that did best, be it one that never succeeds"


def compare(
    source: Positional[Annotated[Path, arg(metavar="DIR|FILE")]],
    /,
    episodes: int = 20,
    seed: int = 1000,
    choose: Literal["random", "first"] = "random",
    noise: float = 0.0,
    max_steps: int = 500,
    task_file: Path | None = None,
    out: Path = Path("runs/compare"),
    json: bool = False,
) -> Output:
    """Compare models by the plans they wrote: decode every answer, carry all of them out by scripted skills, at once.

    The plan of each task that did best, be it one that never succeeds, is kept in OUT/best/MODEL/FORMAT, for --plans of
    any other command. Stopped and started again it carries on.

    Example: lw-torchrl plan compare runs/plans --out runs/compare

    Args:
        source: a folder MODEL/FORMAT/TASK-ATTEMPT.EXT, as plan generate writes it, or a .jsonl file of answers.
        episodes: of each plan, the same initial states for all plans of a task.
        seed: fixes initial states, goals and what is chosen.
        choose: of several true steps a random one, as in the paper, or the first.
        noise: standard deviation of the noise on the executed action.
        max_steps: of an episode.
        task_file: tasks of yours, instead of ours of the same name or beside ours.
        out: folder for results.json, summary.md, models.png, formats.png and best/.
        json: print one JSON document instead, see docs/cli.md.
    """
    check_folder("--out", out)
    from lw_torchrl.planners.answer_files import ignored_files, recorded_answers

    known = read_tasks(task_file)
    recorded_answers(source)
    from lw_torchrl.planners.comparing import compare_plans
    from lw_torchrl.planners.comparison_report import no_plans, write_report

    use_one_thread()
    found = compare_plans(
        source,
        episodes=episodes,
        seed=seed,
        choose=choose,
        noise_scale=noise,
        max_steps=max_steps,
        tasks=known,
        resume=out / "fared.json",
    )
    output = Output(json)
    groups = [
        {"model": model, "format": format, "success": found.mean(model, format)}
        | {"best_answer": found.best_of(model, format)}
        for model, format in found.groups
    ]
    output.show("models", groups, f"{found.table()}\n\n{found.task_table()}\n")
    answers = [
        {"model": one.model, "format": one.format, "task": one.task, "attempt": one.attempt, "steps": one.steps}
        | {"dropped": one.dropped, "reason": one.reason or None, "success": one.rate}
        for one in found.answers
    ]
    output.show("answers", answers)
    if lines := no_plans(found):
        print("\n".join(lines), end="\n\n")
    if strays := ignored_files(source):
        names = ", ".join(map(str, strays[:5])) + (", ..." if len(strays) > 5 else "")
        print(f"not read, since no answer is named so (<task>-<attempt>.<ext>): {names}\n")
    for file in write_report(found, out):
        print(f"written to {file}{_BEST if file.name == 'best' else ''}")
    return output
