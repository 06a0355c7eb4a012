"""``lw-torchrl train``, a policy learns from demonstrations; ``train-evaluator``, a network answers conditions."""

from __future__ import annotations

from contextlib import suppress
from inspect import signature
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, arg

import lw_torchrl as lw
from lw_torchrl._checks import check_choice
from lw_torchrl._files import read_json
from lw_torchrl._rendering import CAMERAS
from lw_torchrl.cli import options
from lw_torchrl.cli.objects import fresh_evaluator
from lw_torchrl.cli.output import Output
from lw_torchrl.language.plans import Plans
from lw_torchrl.language.tasks import resolve_tasks


def train(
    data: Positional[Annotated[Path, arg(metavar="DATA")]],  # a dataset's folder, of `lw-torchrl collect`
    /,
    out: Path,  # the policy, one file
    tasks: tuple[str, ...] = (),  # MT10, or names of tasks, whose demonstrations alone are used; by default all
    plans: options.PlanSources = ("MT10",),
    task_file: options.TaskFile = None,
    text_encoder: options.EncoderName = None,
    method: options.Condition = "pcbc",
    features: Literal["raw", "differences", "relative", "both"] | None = None,
    width: int | None = None,  # of the action decoder's hidden layers; by default the method's, 256
    depth: int | None = None,  # number of them; by default the method's, 3
    steps: int = 8000,  # minibatches
    batch_size: int = 500,  # rows of a minibatch, equally many of each task
    learning_rate: float = 1e-3,  # at the start; a cosine brings it to 0
    after_success: int | None = 20,  # leave out steps so long after an episode's first success; None keeps all
    begin: Path | None = None,  # a trained policy to start from: its weights, plans, options and statistics
    evaluator: str | None = None,
    answers: Literal["logit", "tanh", "hard"] | None = None,
    qaf_anchor: float = 0.0,
    seed: int = 0,  # of the initial weights and the minibatches
    logger: options.Logs | None = None,  # write loss and learning rate to logs/ beside OUT
    device: options.Device = "cpu",
    json: options.Json = False,
) -> Output:
    """Train a policy on demonstrations. If it is stopped, the same command resumes it.

    Example: lw-torchrl train demos/mt10 --out runs/mt10.safetensors

    Example: lw-torchrl train demos/mt10 --out runs/tuned.safetensors --begin runs/mt10.safetensors --evaluator new

    Args:
        features: what the policy sees: the raw observation; differences between hand, objects and goal, the default of
            our methods; relative, these without the hand's height and the gripper's opening; or both the first and the
            second.
        evaluator: a network that answers the conditions inside the policy and is trained with it: a file of
            `lw-torchrl train-evaluator`; the word new; or a class of yours, of lw.modules.EVALUATORS. If it reads
            pictures, they are drawn beside DATA.
        answers: how its answers enter the attention, see docs/evaluators.md; by default tanh, with --begin hard.
        qaf_anchor: weight of the error of its answers, beside the error of the actions. Without it conditions may drift
            from their words; a new evaluator needs it.
    """
    options.check_file("--out", out)
    options.check_condition("method", method)
    if begin is not None and out.resolve() == begin.resolve():
        raise ValueError("--out must be another file than --begin, which is only read")
    if answers is not None and evaluator is None:
        raise ValueError("--answers is of an evaluator's answers; give --evaluator")
    if qaf_anchor and evaluator is None and begin is None:
        raise ValueError("--qaf-anchor is of an evaluator's answers; give --evaluator")
    if evaluator == "new" and not qaf_anchor:
        raise ValueError(
            "--evaluator new knows nothing: give --qaf-anchor 1 too, by which it learns what conditions mean"
        )
    options.check_dataset("data", data)
    options.check_encoder(text_encoder)
    known = options.read_tasks(task_file, _told_tasks(data))
    chosen = resolve_tasks(options.one_or_many(tasks), tasks=known) if tasks else ()
    if begin is not None:
        options.check_saved("--begin", begin)
        given = {"method": method, "features": features, "width": width, "depth": depth, "plans": plans}
        for name, one in given.items():
            if one != signature(train).parameters[name].default:
                raise ValueError(f"--{name} is that of the policy that --begin names; leave it out")
    if evaluator not in (None, "new") and not Path(evaluator).exists():
        if evaluator.endswith(".safetensors"):
            options.check_saved("evaluator", Path(evaluator), "network", "train-evaluator")
        options.check_listed("evaluator", evaluator, ("new",), "lw_torchrl.modules:EVALUATORS", ("evaluators",))
    loaded = options.read_plans(plans, known)
    import torch

    from lw_torchrl._devices import check_device
    from lw_torchrl.data.dataset import read_metadata
    from lw_torchrl.modules.registry import find_method, make_policy

    options.use_one_thread()
    there, held = check_device("device", device), read_metadata(data).config
    encoder = options.read_encoder(text_encoder)
    asked: dict[str, Any] = {"features": features, "width": width, "depth": depth}
    actor_options = {name: value for name, value in asked.items() if value is not None}
    reads_plans = find_method(method).reads_plans
    if evaluator and not reads_plans:
        raise ValueError(f"--evaluator is for a method that reads plans, --method {method} does not")
    numbers: dict[str, Any] = {"steps": steps, "batch_size": batch_size, "learning_rate": learning_rate, "seed": seed}
    numbers["qaf_anchor"] = qaf_anchor
    config = lw.BehavioralCloningConfig(normalize=begin is None, **numbers)
    wanted = {check_choice("tasks", task, held.tasks): held.episodes_per_task for task in chosen}
    rows: dict[str, Any] = {"episodes": wanted or None, "after_success": after_success}
    replay = lw.LanguageWorldExperienceReplay(data, sampler=lw.TaskBalancedSampler(), device=there, **rows)
    torch.manual_seed(seed)
    if begin is not None:
        try:
            actor = lw.load_actor(begin, text_encoder=encoder)
        except (OSError, ValueError) as error:  # elsewhere a checkpoint is --out
            raise ValueError(str(error).replace("checkpoint:", "--begin:", 1)) from error
        loaded = actor.plans if actor.plans is not None else loaded
        if evaluator is not None:
            if not isinstance(actor, lw.PlanConditionedActor):
                raise ValueError(f"--evaluator is for one policy with plans, --begin names a {type(actor).__name__}")
            actor = actor.with_evaluator(_evaluator(evaluator, actor.plans, encoder), answers=answers or "hard")
    else:
        shown = loaded if reads_plans else {task: loaded[task] for task in replay.tasks}
        if evaluator is not None:
            actor_options |= {"evaluator": _evaluator(evaluator, loaded, encoder), "answers": answers or "tanh"}
        actor = make_policy(method, shown, text_encoder=encoder, **actor_options)
    loaded.require(replay.tasks)
    inside = getattr(actor, "evaluator", None)
    if isinstance(inside, lw.modules.ImageQueryEvaluator):
        pictures: dict[str, Any] = {"cameras": inside.cameras, "height": inside.height, "width": inside.width}
        lw.data.add_pictures(data, **pictures)
        replay.add_column("pixels", lw.data.load_pictures(replay, **pictures))
    elif (transform := actor.transform()) is not None:
        replay.append_transform(transform)
    writes = None if logger is None else options.make_logger(logger, out)
    loss = lw.BehavioralCloningTrainer(actor, replay, config, checkpoint=out, logger=writes, device=there).train()
    output = Output(json)
    output.show("policy", out)
    output.show("steps", steps)
    output.show("loss", loss, f"trained to step {steps}" + ("" if loss != loss else f", loss {loss:.4f}") + f": {out}")
    return output


def _told_tasks(folder: Path) -> tuple[str, ...]:
    """A dataset's tasks, read without torch; none where its metadata are no such, which is an error later."""
    with suppress(OSError, ValueError, KeyError, TypeError):
        return tuple(map(str, read_json(folder / "metadata.json", "data")["config"]["tasks"]))
    return ()


def _evaluator(named: str, plans: Plans, encoder: Any) -> lw.QueryEvaluator:
    if named == "new":
        return lw.StateQueryEvaluator(plans)
    if not Path(named).exists():
        return fresh_evaluator(named, lw.modules.EVALUATORS[named], plans, encoder)
    return lw.training.load_evaluator(named, plans, text_encoder=encoder)


WHO = ("expert", "scripted", "spoilt-30", "random")


def train_evaluator(
    tasks: Positional[Annotated[tuple[str, ...], arg(metavar="TASKS ...")]],  # MT10, MT50, or names, held-out ones too
    /,
    out: Path,  # folder for evaluator.safetensors, report.json and the episodes
    data: tuple[Path, ...] = (),  # datasets of `lw-torchrl collect` to use instead of running episodes
    behaviours: tuple[str, ...] = WHO,  # who acts in the episodes that are run, as for `lw-torchrl collect`
    episodes: int = 5,  # of each task and behaviour
    max_steps: int = 500,  # steps of an episode
    noise: tuple[float, ...] = (0.0, 0.1, 0.2),  # standard deviations of the expert's execution noise, used in turn
    cameras: tuple[str, ...] = (),
    picture: int = 64,  # with --cameras, pixels of a picture's height and width
    every: int | None = None,  # use every n-th state of an episode; by default 1, with --cameras 5
    held_out_tasks: tuple[str, ...] = (),  # names, or a number of tasks to draw: none of their queries is trained
    held_out_pairs: float = 0.1,  # the share of pairs of objects none of whose queries is trained
    held_out_states: float = 0.2,  # the share of episodes that are not trained on
    width: int = 128,  # of the hidden layers
    depth: int = 3,  # number of them
    steps: int | None = None,  # minibatches; by default 6000, with --cameras 4000
    batch_size: int | None = None,  # pairs of state and clause, by default 1024; with --cameras states, 48
    learning_rate: float | None = None,  # at the start; a cosine brings it to 0. By default 0.003, with --cameras 0.002
    states_per_task: int = 2000,  # the most states that are labelled of each task
    seed: int = 0,  # of the episodes, of what is held out, the initial weights and the minibatches
    num_envs: int | None = None,  # environments stepped together; the result does not depend on it
    json: options.Json = False,
) -> Output:
    """Train a network to answer conditions, on all base queries of tasks, and say how well it does.

    If it is stopped, the same command resumes it.

    Example: lw-torchrl train-evaluator MT10 --out runs/evaluator --held-out-tasks push reach

    Example: lw-torchrl train-evaluator drawer-open --out runs/eyes --cameras corner corner3 --episodes 20

    Args:
        cameras: answer from these cameras' pictures instead of from the observation: corner, corner2, corner3, corner4,
            topview, behindGripper, gripperPOV.
    """
    options.check_folder("--out", out)
    known = options.read_tasks(None, tasks)
    names = options.simulated("tasks", options.one_or_many(tasks), known)
    drawn = len(held_out_tasks) == 1 and held_out_tasks[0].isdigit()
    for argument, given, allowed in (
        ("behaviours", behaviours, options.ACTORS),
        ("cameras", cameras, CAMERAS),
        ("held_out_tasks", () if drawn else held_out_tasks, names),
    ):
        for one in given:
            check_choice(argument, one, allowed)
    for folder in data:
        options.check_dataset("data", folder)
    import torch

    from lw_torchrl.data.dataset import read_metadata

    options.use_one_thread()
    numbers: dict[str, Any] = {"learning_rate": 2e-3} if cameras else {"steps": 6000}
    said = {"steps": steps, "batch_size": batch_size, "learning_rate": learning_rate, "every": every, "seed": seed}
    numbers |= {name: value for name, value in said.items() if value is not None}
    numbers |= {"held_out_states": held_out_states, "held_out_pairs": held_out_pairs}
    numbers |= {"held_out_tasks": int(held_out_tasks[0]) if drawn else held_out_tasks}
    make_config = lw.training.ImageQueryEvaluatorConfig if cameras else lw.training.QueryEvaluatorConfig
    config = make_config(states_per_task=states_per_task, **numbers)
    torch.manual_seed(seed)
    network: dict[str, Any] = {"depth": depth, "hidden" if cameras else "width": width}
    pictures: dict[str, Any] = {"cameras": cameras, "height": picture, "width": picture}
    plans = options.read_plans(("MT50",), known)
    evaluator: Any
    if cameras:
        own = lw.Plans({task: plans[task] for task in names})
        evaluator = lw.modules.ImageQueryEvaluator(own, **network, **pictures)
    else:
        evaluator = lw.StateQueryEvaluator(plans, **network)
    run: dict[str, Any] = {"episodes_per_task": episodes, "max_steps": max_steps, "seed": seed, "num_envs": num_envs}
    roots = list(data) or [out / "data" / who for who in behaviours]
    if not data:
        for who, root in zip(behaviours, roots, strict=True):
            noise_scale = noise if who == "expert" else 0.0
            lw.collect_demonstrations(names, root=root, policy=who, noise_scale=noise_scale, **run)
    chosen = []  # of each dataset every episode of the tasks
    for root in roots:
        held = read_metadata(root).config
        if not (there := [task for task in names if task in held.tasks]):
            raise ValueError(f"--data {root} holds none of the tasks; it holds {', '.join(held.tasks)}")
        chosen.append(dict.fromkeys(there, held.episodes_per_task))
    replay = lw.LanguageWorldExperienceReplay(roots, label="executed", episodes=chosen)
    if cameras:
        for root in roots:
            lw.data.add_pictures(root, **pictures, every=config.every)
        replay.add_column("pixels", lw.data.load_pictures(replay, **pictures, every=config.every))
    labelled = lw.training.LabelledQueries(replay, config)
    trainer = lw.training.ImageQueryEvaluatorTrainer if cameras else lw.training.QueryEvaluatorTrainer
    loss = trainer(evaluator, labelled, config, checkpoint=out / "evaluator.safetensors").train()
    output = Output(json)
    output.show("evaluator", out / "evaluator.safetensors")
    output.show("steps", config.steps)
    output.show("loss", loss, f"trained to step {config.steps}" + ("" if loss != loss else f", loss {loss:.4f}"))
    score = lw.evaluation.score_evaluator(evaluator, labelled)
    output.show("parts", {name: part.to_json() for name, part in score.parts.items()}, score.table())
    score.save(out / "report.json")
    print(f"written to {out}")
    return output
