"""``lw-torchrl record`` and ``view``: episodes of any policy, recorded and looked at in rerun."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

import lw_torchrl as lw
from lw_torchrl.cli import objects, options
from lw_torchrl.cli.output import Output
from lw_torchrl.language.plans import Plans


def record(
    names: Positional[Annotated[tuple[str, ...], arg(metavar="TASK ...")]],  # tasks, or MT10 or MT50
    /,
    policy: str = "expert",
    compare: str | None = None,  # another one, in the same initial states and with the same noise, side by side
    episodes: tuple[int, ...] = (0,),  # their indices, as in an evaluation with this seed
    plans: tuple[str, ...] = (),
    attribute: bool = False,  # say why failed episodes failed, as evaluate does; for scripted and policies with plans
    reference: tuple[str, ...] = (),  # with --attribute, trusted plans for running failed episodes again
    evaluator: str | None = None,  # answers the conditions: a file of `train-evaluator`, or yours, my_module:evaluator
    suite: options.SuiteName = None,
    speed: options.Speed = 1.0,
    task_file: options.TaskFile = None,
    text_encoder: options.OwnEncoder = None,
    seed: int = 1000,  # fixes initial states, goals and noise
    noise: float = 0.1,  # standard deviation of the noise on the executed action
    max_steps: int | None = None,  # of an episode; the suite's if none is given, Meta-World's 500
    stop_at_success: bool = False,  # end an episode at its first success, which makes the recording lighter
    device: options.Device = "cpu",
    out: Path | None = None,  # the file; runs/recordings/TASK-POLICY.rrd if none is given; replaced if there
    json: options.Json = False,
) -> Output:
    """Record episodes: the robot in 3-D, the plan as it goes, what held when, and how it ended.

    Example: lw-torchrl record drawer-open --policy runs/mt10.safetensors --compare scripted --episodes 0 1

    Args:
        policy: expert, Meta-World's script; scripted, the plan by scripted skills; random; spoilt-60, spoilt-30 or
            wrong, the plan by skills that are right in 60, 30 or 0 of 100 pieces; a policy's file; or one of yours, as
            my_module:policy, as for evaluate.
        plans: whose steps and conditions are shown and, by policies that read plans, carried out: MT10, MT50, .plan or
            .json files, or folders. If none is given, a policy's own, or else the shipped ones.
    """
    options.check_reference(reference, attribute)
    for option, who in (("policy", policy), ("compare", compare or policy)):
        objects.check_policy(option, who)
    objects.check_evaluator(evaluator, policy)
    options.check_encoder(text_encoder)
    elsewhere = options.read_suite(suite, names)
    known = dict(options.read_tasks(task_file, names)) | dict({} if elsewhere is None else elsewhere.tasks)
    tasks = options.simulated("names", options.one_or_many(names), known, elsewhere)
    given = options.read_plans(plans, known) if plans else None
    label = names[0].replace("/", "-") if len(names) == 1 else f"{len(names)}-tasks"
    out = out or Path("runs/recordings") / f"{label}-{objects.name_of(policy)}.rrd"
    options.check_file("--out", out, ".rrd")
    from lw_torchrl._devices import check_device
    from lw_torchrl.record.rollouts import new_recording, run_recorded

    options.use_one_thread()
    acting: dict[str, Any] = {"device": check_device("device", device)}
    trusted = options.read_plans(reference, known) if reference else None
    episode_options: dict[str, Any] = {"seed": seed, "noise_scale": noise, "max_steps": max_steps}
    episode_options["suite"] = elsewhere
    # What can be refused is refused before the first episode runs.
    there: dict[str, Any] = {"text_encoder": text_encoder, "suite": elsewhere, "speed": speed}
    load = partial(options.load_policy, seed=seed, plans=given, **there)
    cast = []
    for who in filter(None, (policy, compare)):
        actor, shown, called = _cast(who, tasks, given, known, load, seed, max_steps, elsewhere)
        asked = None
        if who == policy or getattr(actor, "plans", None) is not None:
            actor, asked = objects.with_evaluator(actor, evaluator, text_encoder)
        cast.append((actor, shown, called, asked))
    rows: list[dict[str, Any]] = []
    recorded: list[list[str]] = []
    with new_recording(out) as logger:
        for actor, shown, who, asked in cast:
            how = episode_options | acting | {"evaluator": asked}
            run = how | {"stop_at_success": stop_at_success, "progress": True}
            found = run_recorded(actor, tasks, plans=shown, episodes=episodes, **run)
            why: Mapping[tuple[str, int], lw.evaluation.Failure] = {}
            if attribute and shown is not None and hasattr(actor, "with_plans"):
                failures = lw.attribute_failures(found, shown, actor=actor, reference=trusted, **how)
                why = {(one.task, one.episode): one for one in failures}
                if failures and not recorded:
                    logger.show_causes(_result(found, failures, episode_options, len(episodes)))
            pages = []
            for one in found:
                failure = why.get((one.task, one.episode))
                first = one.first_success
                ended = "failed" if first is None else f"success at step {first}"
                ended += "" if failure is None else f", {failure.cause}: {failure.why}"
                print(f"{one.task}, episode {one.episode}, {who}: {ended}")
                row = {"task": one.task, "episode": one.episode, "policy": who, "first_success": first}
                rows.append(row | {"failure": None if failure is None else failure.to_json()})
                name = None if compare is None else f"{one.task}-{one.episode}-{len(recorded) + 1}"
                told: dict[str, Any] = {"seed": seed, "policy": who, "failure": failure, "name": name}
                pages.append(lw.log_rollout(logger, one.steps, shown, suite=elsewhere, **told))
            recorded.append(pages)
        for pair, one in zip(zip(*recorded, strict=True), found, strict=True) if compare is not None else ():
            logger.compare(pair, f"{one.task} · episode {one.episode} · side by side")
    output = Output(json).show("episodes", rows)
    return output.show("recording", out, f"written to {out}\nlook at it with: lw-torchrl view {out}")


def _result(found: Any, failures: Any, run: Mapping[str, Any], episodes: int) -> Any:
    """Recorded episodes and their failures as an evaluation's result."""
    result, episode = lw.evaluation.EvaluationResult, lw.evaluation.EpisodeResult
    ended = [(one.task, one.episode, one.first_success) for one in found]
    tasks = list(dict.fromkeys(one.task for one in found))
    config = {
        "tasks": tasks,
        "episodes_per_task": episodes,
        "seed": run["seed"],
        "max_steps": max(len(one.steps) for one in found),
    }
    listed = tuple(episode(task, k, first is not None, first, None, None) for task, k, first in ended)
    return result(config, listed, failures=tuple(failures))


def _cast(
    who: str,
    tasks: Sequence[str],
    plans: Plans | None,
    known: Any,
    load: Any,
    seed: int,
    max_steps: int | None,
    own: Any,
) -> tuple[Any, Plans | None, str]:
    """Who acts, the plans whose conditions are answered, and what the policy is called."""
    from lw_torchrl.data.behaviours import SegmentActor, behaviour_of
    from lw_torchrl.data.missing_episodes import suite_expert
    from lw_torchrl.suites.suite import find_suite

    if who not in options.ACTORS:
        actor = objects.read_policy("--policy", who, plans, load)
        if not isinstance(actor, lw.Policy):
            return actor, getattr(actor, "plans", None), objects.name_of(who)
        if missing := [task for task in tasks if task not in actor.tasks]:
            knows = f"it knows {', '.join(actor.tasks)}"
            raise ValueError(f"the policy of {who!r} does not know {', '.join(missing)}; {knows}")
        return actor, actor.plans, objects.name_of(who)
    suite = find_suite(tasks) if own is None else own
    shown = plans or (options.read_plans(("MT50",), known) if own is None else Plans(own.plans or {}))
    shown.require(tasks)
    shown = Plans({task: shown[task] for task in tasks})
    if who == "expert":
        return suite_expert(suite, tasks), shown, who
    if who == "scripted":
        return lw.ScriptedSkillActor(shown, skills=suite.skills), shown, who
    behaviour, steps = behaviour_of(who, tasks, suite=suite), max_steps or suite.max_steps
    return SegmentActor(behaviour, shown, seed, steps, skills=suite.skills), shown, who


def view(
    recordings: Positional[Annotated[tuple[Path, ...], arg(metavar="RUN|FILE ...")]],  # .rrd files, or folders of one
    /,
    episode: str | None = None,  # open at this tab, by its title or its episode's name
    screenshot: Path | None = None,  # write a .png here, no window; wants Debian's mesa-vulkan-drivers and libvulkan1
    step: int | None = None,  # the step to open at; by default the most telling one, of a training the last
    window_size: str = "1400x900",  # of the picture or the window, WIDTHxHEIGHT
    html: Path | None = None,  # write one self-contained page here, some 11 MB, that opens from disk in a browser
    web: bool = False,  # serve a page on this machine and print its address, until Ctrl-C
    port: int = 0,  # of the page; 0 takes a free one
) -> None:
    """Open recordings in rerun's viewer; or take a picture, or write or serve one as a web page.

    Example: lw-torchrl view runs/demo --episode drawer-open --screenshot picture.png --step 80
    Example: lw-torchrl view runs/small/logs/policy.rrd runs/large/logs/policy.rrd
    """
    given = [f"--{name}" for name, value in (("screenshot", screenshot), ("html", html), ("web", web)) if value]
    if len(given) > 1:
        raise ValueError(f"give one of --screenshot, --html and --web, got {' and '.join(given)}")
    for option, file, ending in (("--screenshot", screenshot, ".png"), ("--html", html, ".html")):
        if file is not None:
            options.check_file(option, file, ending)
    from lw_torchrl.record import WebPage, open_viewer, write_html

    if (web or html is not None) and len(recordings) > 1:
        raise ValueError(f"--web and --html show one recording, got {len(recordings)}")
    if web:
        with WebPage(recordings[0], episode=episode, step=step, port=port) as page:
            print(f"{page.address}  (Ctrl-C ends it)", flush=True)
            with suppress(KeyboardInterrupt):
                page.serve()
    elif html is not None:
        write_html(recordings[0], html, episode=episode, step=step)
    else:
        open_viewer(recordings, screenshot, window_size, step=step, episode=episode)
    if written := html or screenshot:
        print(f"written to {written}")
