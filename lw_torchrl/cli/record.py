"""``lw-torchrl record``: episodes of any policy, to look at in rerun."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional, arg

from lw_torchrl.cli.outputs import check_file
from lw_torchrl.cli.sources import (
    ACTORS,
    check_actor,
    check_encoder,
    check_plan_files,
    load_policy,
    one_or_many,
    read_plans,
    read_tasks,
    simulated,
)
from lw_torchrl.cli.tables import Output
from lw_torchrl.cli.threads import use_one_thread

if TYPE_CHECKING:
    from lw_torchrl.envs.episodes import FinishedEpisode
    from lw_torchrl.evaluation.failures import Failure
    from lw_torchrl.language.plans import Plans
    from lw_torchrl.language.tasks import Task


def record(
    names: Positional[Annotated[tuple[str, ...], arg(metavar="TASK ...")]],
    /,
    policy: str = "expert",
    compare: str | None = None,
    episodes: tuple[int, ...] = (0,),
    plans: tuple[str, ...] = (),
    attribute: bool = False,
    reference: tuple[str, ...] = (),
    task_file: Path | None = None,
    text_encoder: str | None = None,
    seed: int = 1000,
    noise: float = 0.1,
    max_steps: int = 500,
    out: Path | None = None,
    json: bool = False,
) -> Output:
    """Record episodes: the robot in 3-D, the plan as it goes, what held when, and how it ended.

    Example: lw-torchrl record drawer-open --policy runs/mt10.zip --compare scripted --episodes 0 1

    Args:
        names: tasks, or MT10 or MT50.
        policy: expert, Meta-World's script; scripted, the plan by scripted skills; random; spoilt-60, spoilt-30 or
            wrong, the plan by skills that are right in 60, 30 or 0 of 100 pieces; or a policy's file.
        compare: another one, in the same initial states and with the same noise, side by side.
        episodes: their indices, as in an evaluation with this seed.
        plans: whose steps and conditions are shown and, by policies that read plans, carried out: MT10, MT50, .plan or
            .json files, or folders. If none is given, a policy's own, or else the shipped ones.
        attribute: say of each failed episode whether a query, the plan or a skill was at fault, or time; it is run
            again a few times. For scripted and for policies with plans.
        reference: with --attribute, plans that are trusted, for failed episodes to be run again with.
        task_file: tasks of yours, whose objects and points the plans may name.
        text_encoder: the function that a policy was trained with, if it was one of yours, as my_texts:encode.
        seed: fixes initial states, goals and noise.
        noise: standard deviation of the noise on the executed action.
        max_steps: of an episode.
        out: the file; runs/recordings/TASK-POLICY.rrd if none is given. One that is there is replaced.
        json: print one JSON document instead, see docs/cli.md.
    """
    if reference and not attribute:
        raise ValueError("--reference is for --attribute, which runs failed episodes again with these plans")
    for option, who in (("policy", policy), ("compare", compare or policy)):
        check_actor(option, who)
    check_encoder(text_encoder)
    check_plan_files("--reference", reference)
    known = dict(read_tasks(task_file))
    tasks = simulated("names", one_or_many(names), known)
    given = read_plans(plans, known) if plans else None
    label = names[0] if len(names) == 1 else f"{len(names)}-tasks"
    out = out or Path("runs/recordings") / f"{label}-{Path(policy).stem}.rrd"
    check_file("--out", out, ".rrd")
    import lw_torchrl as lw
    from lw_torchrl._files import replacing
    from lw_torchrl.record.rollouts import run_recorded

    use_one_thread()
    trusted = read_plans(reference, known) if reference else None
    options: dict[str, Any] = {"seed": seed, "noise_scale": noise, "max_steps": max_steps}
    # What can be refused is refused before the first episode runs.
    cast = [_cast(who, tasks, given, known, seed, max_steps, text_encoder) for who in filter(None, (policy, compare))]
    output, rows = Output(json), []
    recorded: list[list[str]] = []
    with replacing(out) as file, lw.RerunLogger(file, exp_name=out.stem) as logger:
        for actor, shown, who in cast:
            found = run_recorded(actor, tasks, plans=shown, episodes=episodes, progress=True, **options)
            why: Mapping[tuple[str, int], Failure] = {}
            if attribute and shown is not None and hasattr(actor, "with_plans"):
                failures = lw.attribute_failures(found, shown, actor=actor, reference=trusted, **options)
                why = {(one.task, one.episode): one for one in failures}
            pages = []
            for one in found:
                failure = why.get((one.task, one.episode))
                print(_line(one, who, failure))
                row = {"task": one.task, "episode": one.episode, "policy": who, "first_success": one.first_success}
                rows.append(row | {"failure": None if failure is None else asdict(failure)})
                name = None if compare is None else f"{one.task}-{one.episode}-{len(recorded) + 1}"
                pages.append(
                    lw.log_rollout(logger, one.steps, shown, seed=seed, policy=who, failure=failure, name=name)
                )
            recorded.append(pages)
        for pair, one in zip(zip(*recorded, strict=True), found, strict=True) if compare is not None else ():
            logger.compare(pair, f"{one.task} · episode {one.episode} · side by side")
    output.show("episodes", rows)
    output.show("recording", out, f"written to {out}\nlook at it with: lw-torchrl view {out}")
    return output


def _cast(
    who: str,
    tasks: Sequence[str],
    plans: Plans | None,
    known: Mapping[str, Task],
    seed: int,
    max_steps: int,
    text_encoder: str | None,
) -> tuple[Any, Plans | None, str]:
    """Who acts, the plans whose conditions are answered, and what the policy is called."""
    import lw_torchrl as lw
    from lw_torchrl.data.behaviours import SegmentActor, behaviour_of

    if who not in ACTORS:
        actor = load_policy(Path(who), seed, plans, text_encoder)
        if missing := [task for task in tasks if task not in actor.tasks]:
            raise ValueError(
                f"the policy of {who!r} does not know {', '.join(missing)}; it knows {', '.join(actor.tasks)}"
            )
        return actor, actor.plans, Path(who).stem
    shown = read_plans(("MT50",), known) if plans is None else plans
    shown.require(tasks)
    shown = lw.Plans({task: shown[task] for task in tasks})
    if who == "expert":
        return lw.ExpertActor(tasks), shown, who
    if who == "scripted":
        return lw.ScriptedSkillActor(shown), shown, who
    return SegmentActor(behaviour_of(who, tasks), shown, seed, max_steps), shown, who


def _line(episode: FinishedEpisode, who: str, failure: Failure | None) -> str:
    """How an episode went, in a line."""
    first = episode.first_success
    ended = "failed" if first is None else f"success at step {first}"
    why = "" if failure is None else f", {failure.cause}: {failure.why}"
    return f"{episode.task}, episode {episode.episode}, {who}: {ended}{why}"
