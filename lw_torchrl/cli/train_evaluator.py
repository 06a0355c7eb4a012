"""``lw-torchrl train-evaluator``: a network in the query answering function's place."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

import lw_torchrl as lw
from lw_torchrl._checks import check_choice
from lw_torchrl._rendering import CAMERAS
from lw_torchrl.cli import options
from lw_torchrl.cli.output import Output

WHO = ("expert", "scripted", "spoilt-30", "random")


def train_evaluator(
    tasks: Positional[Annotated[tuple[str, ...], arg(metavar="TASKS ...")]],  # MT10, MT50, or names, held-out ones too
    /,
    out: Path,  # folder for evaluator.zip, report.json, reliability.png, the episodes, and, with --cameras, wrong.png
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
    structure: bool = True,  # read parsed clauses, and objects' positions where the tasks' table says; else only texts
    text_encoder: str | None = None,  # with --no-structure, your function from texts to vectors, as my_texts:encode
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
    if text_encoder is not None and structure:
        raise ValueError("--text-encoder is for --no-structure; with structure no text is read")
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
    options.check_encoder(text_encoder)
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
    network: dict[str, Any] = {"structure": structure, "depth": depth, "hidden" if cameras else "width": width}
    network["text_encoder"] = options.read_encoder(text_encoder)
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
    loss = trainer(evaluator, labelled, config, checkpoint=out / "evaluator.zip").train()
    output = Output(json)
    output.show("evaluator", out / "evaluator.zip")
    output.show("steps", config.steps)
    output.show("loss", loss, f"trained to step {config.steps}" + ("" if loss != loss else f", loss {loss:.4f}"))
    report = lw.evaluation.score_evaluator(evaluator, labelled)
    output.show("parts", {name: one.to_json() for name, one in report.parts.items()}, report.table())
    report.save(out / "report.json")
    lw.evaluation.plot_reliability(report, out / "reliability.png")
    if cameras:
        lw.evaluation.plot_wrong_answers(evaluator, labelled, out / "wrong.png")
    print(f"written to {out}")
    return output
