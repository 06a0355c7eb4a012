"""``lw-torchrl evaluate``, trained policies and experts; ``lw-torchrl scripted``, plans carried out by scripts."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, arg

import lw_torchrl as lw
from lw_torchrl._checks import counted
from lw_torchrl._files import locked, write_json, write_text
from lw_torchrl.cli import objects, options
from lw_torchrl.cli.output import Output
from lw_torchrl.language.plans import Plans
from lw_torchrl.language.tasks import Task


def evaluate(
    checkpoint: Positional[Annotated[Path, arg(metavar="CHECKPOINT")]],  # of `lw-torchrl train`, or the word expert
    /,
    tasks: tuple[str, ...] = (),  # MT10, MT50, or names; if none, those of --plans, or else those it was trained on
    plans: tuple[str, ...] = (),
    task_file: options.TaskFile = None,
    text_encoder: options.OwnEncoder = None,
    suite: options.SuiteName = None,
    speed: options.Speed = 1.0,
    max_steps: int | None = None,  # of an episode; the suite's if none is given, Meta-World's 500
    episodes: int = 20,  # of each task
    seed: int = 1000,  # fixes initial states, goals and noise; not one that the demonstrations used
    noise: float = 0.1,  # standard deviation of the noise on the executed action
    stop_at_success: bool = False,  # end an episode at its first success; any-step success stays the same
    num_envs: int | None = None,  # environments stepped together; the result does not depend on it
    attribute: bool = False,  # say why failed episodes failed: a query, the plan, a skill or time; they run again
    reference: tuple[str, ...] = (),  # with --attribute, trusted plans to run failed episodes again, as for --plans
    evaluator: str | None = None,  # answers the conditions: a file of `train-evaluator`, or yours, my_module:evaluator
    out: Path | None = None,  # folder for results.json, success.png and rollout.rrd; with --attribute also failures.png
    device: options.Device = "cpu",
    json: options.Json = False,
) -> Output:
    """Evaluate a trained policy, or the scripted experts, and write the result, a figure and a recording.

    With --suite a policy that was trained with another robot acts there, under that suite's plans. A policy of yours,
    my_module:policy, is what acts: an lw.Policy, or a module or function from TensorDict to TensorDict.

    Example: lw-torchrl evaluate runs/mt10.safetensors --out runs/mt10

    Args:
        plans: carry out these instead of the policy's own: MT10, MT50, .plan or .json files, or folders; where several
            have a plan for a task, the last one's counts.
    """
    if out is not None:
        options.check_folder("--out", out)
    options.check_reference(reference, attribute)  # which may speak of a policy's own tasks
    who = str(checkpoint)
    if who != "expert" and not objects.is_object(who):
        options.check_saved("checkpoint", checkpoint)
    objects.check_evaluator(evaluator, who)
    options.check_encoder(text_encoder)
    elsewhere = options.read_suite(suite, tasks)
    known = dict(options.read_tasks(task_file)) | dict({} if elsewhere is None else elsewhere.tasks)
    chosen = options.simulated("tasks", options.one_or_many(tasks), known, elsewhere) if tasks else ()
    given = options.read_plans(plans, known) if plans else None
    from lw_torchrl._devices import check_device
    from lw_torchrl.data.missing_episodes import suite_expert
    from lw_torchrl.record.rollouts import run_recorded, write_recording
    from lw_torchrl.training.checkpoint import demonstrated_tasks, policy_file

    options.use_one_thread()
    there = check_device("device", device)
    asked = None  # that is not inside the policy
    if who == "expert":
        chosen = chosen or (lw.MT10 if elsewhere is None else tuple(elsewhere.plans or elsewhere.tasks))
        policy = None if elsewhere is None else suite_expert(elsewhere, chosen)
    else:
        there_too: dict[str, Any] = {"text_encoder": text_encoder, "suite": elsewhere, "speed": speed}
        load = partial(options.load_policy, seed=seed, plans=given, **there_too)
        policy = objects.read_policy("checkpoint", who, given, load)
        policy, asked = objects.with_evaluator(policy, evaluator, text_encoder)
        if isinstance(policy, lw.Policy):
            known.update({task: found for task in policy.tasks if (found := policy.definition(task)) is not None})
            shown = set() if plans or objects.is_object(who) else demonstrated_tasks(checkpoint)
            chosen = chosen or _default_tasks(policy, shown, elsewhere)
        elif not chosen:
            raise ValueError(f"--tasks must name some, {who} is no lw.Policy, which would tell")
    if policy is None and there.type != "cpu":
        raise ValueError("--device is for a policy; the scripted experts work on the CPU")
    own = getattr(policy, "plans", None)
    if attribute and own is None:
        raise ValueError(f"--attribute is for a policy with plans, {checkpoint} has none")
    how: dict[str, Any] = {"tasks": chosen, "episodes_per_task": episodes, "seed": seed, "noise_scale": noise}
    how |= {"stop_at_success": stop_at_success, "num_envs": num_envs, "device": there, "attribute": attribute}
    where: dict[str, Any] = {"suite": elsewhere} | ({} if max_steps is None else {"max_steps": max_steps})
    trusted = options.read_plans(reference, known) if reference else None
    result = lw.evaluate(policy or lw.ExpertActor(chosen), reference=trusted, evaluator=asked, **how, **where)
    output = Output(json).result(result)
    if attribute:
        failures = [one.to_json() for one in result.failures or ()]
        output.show("failures", failures, f"\n{result.failure_table()}")
    if out is not None:
        with locked(out, "out", folder=True, wait=True):
            answered = evaluator if evaluator is not None and Path(evaluator).is_file() else None
            told: dict[str, Any] = {"plans": None if own is None else own.fingerprint, "evaluator": answered}
            told["checkpoint"] = None if who == "expert" or objects.is_object(who) else policy_file(checkpoint)
            result.save(out / "results.json", **told)
            lw.plot_success(result, out / "success.png", title=f"{checkpoint}, {episodes} episodes a task")
            if attribute:
                lw.evaluation.plot_failures(result, out / "failures.png", title=str(checkpoint))
            if policy is not None:
                first: list[str | Task] = list(result.config["tasks"][:3])
                recorded = run_recorded(policy, first, seed=seed, noise_scale=noise, evaluator=asked, **where)
                said: dict[str, Any] = {"seed": seed, "policy": objects.name_of(who), "suite": elsewhere}
                write_recording(out / "rollout.rrd", recorded, own, **said)
        print(f"written to {out}")
    return output


def _default_tasks(policy: lw.Policy, shown: set[str], suite: lw.suites.Suite | None) -> tuple[str, ...]:
    """The tasks that a policy was ``shown``, or all it has, if the suite, or any, has them; prints what is left out."""
    from lw_torchrl.suites.suite import known_suite

    chosen = [task for task in policy.tasks if task in shown] or list(policy.tasks)
    own = [task for task in chosen if (known_suite(task) is None if suite is None else task not in suite.tasks)]
    if len(own) == len(chosen):
        raise ValueError(
            f"the simulator has none of the policy's tasks, {', '.join(own)}; name others with --tasks, or the suite "
            "that has these, --import my_module or --suite my_module:suite; for an engine of yours, docs/training.md"
        )
    if len(chosen) < len(policy.tasks):
        ran = counted(len(chosen), "task")
        print(f"on the {ran} that it was trained on, of {len(policy.tasks)} that it knows; --tasks names others")
    if own:
        print(f"without {', '.join(own)}, which the simulator lacks")
    return tuple(task for task in chosen if task not in own)


def card(
    policy: Positional[Annotated[Path, arg(metavar="POLICY")]],  # of `lw-torchrl train`, or few-shot-mt50
    /,
    result: Path | None = None,  # results.json of `lw-torchrl evaluate`, for the table of success
    repo: str = "",  # where the policy can be had, me/my-policy
    out: Path | None = None,  # the file to write, README.md for example; by default the card is printed
    json: options.Json = False,
) -> Output:
    """Write a model card of a policy: what it was trained on, its success, its limits, how to load and cite it.

    Example: lw-torchrl card few-shot-mt50
    Example: lw-torchrl card runs/mt10.safetensors --result runs/mt10/results.json --out README.md
    """
    if out is not None:
        options.check_file("--out", out)
    options.check_saved("policy", policy)
    if result is not None and not result.is_file():
        raise FileNotFoundError(f"--result: no file {str(result)!r}; `lw-torchrl evaluate --out` writes results.json")
    measured = None if result is None else lw.EvaluationResult.load(result)
    text = str(lw.evaluation.policy_card(policy, measured, repo=repo))
    if out is not None:
        write_text(out, text)
    return Output(json).show("card", text, text if out is None else f"written to {out}")


def scripted(
    names: Positional[options.Names] = ("MT10",),  # MT10, MT50, or names of tasks
    /,
    episodes: int = 50,  # of each task
    seed: int = 1000,  # fixes initial states and goals
    select: Literal["first", "random", "mix"] = "first",  # of true steps the first, a random one (the paper), or a mix
    noise: float = 0.0,  # standard deviation of the noise on the executed action
    plans: options.PlanSources = ("MT50",),
    skill_file: options.SkillFile = None,
    task_file: options.TaskFile = None,
    full: bool = False,  # run all 500 steps, instead of stopping at the first success
    out: Path = Path("runs/scripted"),  # folder for results.json, plan_use.json and success.png
    json: options.Json = False,
) -> Output:
    """Carry out plans with scripted skills, and say how each step fared: no training, no expert.

    Example: lw-torchrl scripted MT50 --episodes 50
    """
    options.check_folder("--out", out)
    known = options.read_tasks(task_file, names)
    chosen = options.simulated("tasks", options.one_or_many(names), known)
    loaded = options.read_plans(plans, known)
    loaded.require(chosen)
    loaded = Plans({task: loaded[task] for task in chosen})
    skills = options.read_skills(skill_file, known)
    use = lw.evaluation.PlanUse(loaded)
    actor = lw.ScriptedSkillActor(loaded, select, skills=skills)
    how: dict[str, Any] = {"tasks": chosen, "episodes_per_task": episodes, "seed": seed, "noise_scale": noise}
    how |= {"stop_at_success": not full, "also_record": ["qaf", "skill_weights"], "on_episode": use}
    result = lw.evaluate(actor, **how)
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
    output = Output(json).result(result, steps=steps)
    with locked(out, "out", folder=True, wait=True):
        result.save(out / "results.json", plans=loaded.fingerprint)
        write_json(out / "plan_use.json", {task: found.to_json() for task, found in seen.items()})
        lw.plot_success(result, out / "success.png", title=f"plans and scripted skills, {episodes} episodes a task")
    print(f"written to {out}")
    return output
