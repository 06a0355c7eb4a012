"""``lw-torchrl scripted``: plans carried out by scripted skills."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from lw_torchrl.cli.outputs import check_folder
from lw_torchrl.cli.sources import one_or_many, read_plans, read_skills, read_tasks, simulated
from lw_torchrl.cli.tables import Output


def scripted(
    names: Positional[Annotated[tuple[str, ...], arg(metavar="[NAMES ...]")]] = ("MT10",),
    /,
    episodes: int = 50,
    seed: int = 1000,
    select: Literal["first", "random", "mix"] = "first",
    noise: float = 0.0,
    plans: tuple[str, ...] = ("MT50",),
    skill_file: Path | None = None,
    task_file: Path | None = None,
    full: bool = False,
    out: Path = Path("runs/scripted"),
    json: bool = False,
) -> Output:
    """Carry out plans with scripted skills, and say how each step fared: no training, no expert.

    Example: lw-torchrl scripted MT50 --episodes 50

    Args:
        names: MT10, MT50, or names of tasks.
        episodes: of each task.
        seed: fixes initial states and goals.
        select: of several true steps, take the first, a random one, as in the paper, or mix them.
        noise: standard deviation of the noise on the executed action.
        plans: MT10 or MT50 for the shipped plans, .plan files, .json files of pairs, or folders; where several have a
            plan for a task, the last one's counts.
        skill_file: skills of yours that join ours, or replace those of the same text.
        task_file: tasks of yours, whose objects and points the plans may name.
        full: run all 500 steps, instead of stopping at the first success.
        out: folder for results.json, plan_use.json and success.png.
        json: print one JSON document instead, see docs/cli.md.
    """
    check_folder("--out", out)
    known = read_tasks(task_file)
    chosen = simulated("tasks", one_or_many(names), known)
    loaded = read_plans(plans, known)
    loaded.require(chosen)
    loaded = type(loaded)({task: loaded[task] for task in chosen})
    skills = read_skills(skill_file, known)
    import lw_torchrl as lw
    from lw_torchrl._files import held, write_json
    from lw_torchrl.evaluation.plan_use import PlanUse

    use = PlanUse(loaded)
    result = lw.evaluate(
        lw.ScriptedSkillActor(loaded, select, skills=skills),
        tasks=chosen,
        episodes_per_task=episodes,
        seed=seed,
        noise_scale=noise,
        stop_at_success=not full,
        also_record=["qaf", "skill_weights"],
        on_episode=use,
    )
    seen = use.tasks()
    steps = {
        task: [
            {"skill": step.skill, "true": true, "chosen": taken, "stuck": stuck}
            for step, true, taken, stuck in zip(loaded[task].steps, found.true, found.chosen, found.stuck, strict=True)
        ]
        for task, found in seen.items()
    }
    if not json:
        for task, found in seen.items():
            print(f"{task}: success {result.success_once[task]:.2f}")
            for one in steps[task]:
                ended = f", stuck here in {one['stuck']} of {found.failed} failed episodes" if one["stuck"] else ""
                print(f"    true {one['true']:4.0%}  chosen {one['chosen']:4.0%}  {one['skill']}{ended}")
        print()
    output = Output(json)
    output.result(result, steps=steps)
    with held(out, "out", folder=True, wait=True):
        result.save(out / "results.json", plans=loaded.fingerprint)
        write_json(out / "plan_use.json", {task: found.to_json() for task, found in seen.items()})
        lw.plot_success(result, out / "success.png", title=f"plans and scripted skills, {episodes} episodes a task")
    print(f"written to {out}")
    return output
