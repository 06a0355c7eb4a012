"""``lw-torchrl train``: a policy learns from demonstrations, with a query evaluator inside if it is given one."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import asdict
from inspect import signature
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, arg

import lw_torchrl as lw
from lw_torchrl._checks import check_choice
from lw_torchrl._files import read_json
from lw_torchrl.cli import options
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
    method: options.Condition = "pcbc",  # pcbc, by plan; or a baseline: dc, by description, one-hot, by number
    mix: Literal["latents", "actions"] | None = None,
    features: Literal["raw", "differences", "relative", "both"] = "differences",
    width: int = 256,  # of the action decoder's hidden layers
    depth: int = 3,  # number of them
    steps: int = 8000,  # minibatches
    batch_size: int = 500,  # rows of a minibatch, equally many of each task
    learning_rate: float = 1e-3,  # at the start; a cosine brings it to 0
    after_success: int | None = 20,  # leave out steps so long after an episode's first success; None keeps all
    latent_consistency: float = 0.0,  # weight of a term that keeps skills with similar texts similar; with plans
    begin: Path | None = None,  # a trained policy to start from: its weights, plans, options and statistics
    evaluator: str | None = None,
    answers: Literal["logit", "tanh", "hard"] | None = None,
    qaf_anchor: float = 0.0,
    seed: int = 0,  # of the initial weights and the minibatches
    logger: Literal["csv", "tensorboard", "wandb"] | None = None,  # write loss and learning rate to logs/ beside OUT
    device: options.Device = "cpu",
    json: options.Json = False,
) -> Output:
    """Train a policy on demonstrations. If it is stopped, the same command resumes it.

    Example: lw-torchrl train demos/mt10 --out runs/mt10.zip

    Example: lw-torchrl train demos/mt10 --out runs/tuned.zip --begin runs/mt10.zip --evaluator runs/eyes/evaluator.zip

    Args:
        mix: of a policy with plans, mix the skills' latents, as in the paper and by default, or their actions.
        features: what the policy sees: the raw observation; differences between hand, objects and goal; relative, these
            without the hand's height and the gripper's opening; or both the first and the second.
        evaluator: a network that answers the conditions inside the policy and is trained with it: a file of
            `lw-torchrl train-evaluator`, or the word new. If it reads pictures, they are drawn beside DATA.
        answers: how its answers enter the attention, see docs/evaluators.md; by default tanh, with --begin hard.
        qaf_anchor: weight of the error of its answers, beside the error of the actions. Without it conditions may drift
            from their words; a new evaluator needs it.
    """
    options.check_file("--out", out)
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
        given = {"method": method, "mix": mix, "features": features, "width": width, "depth": depth, "plans": plans}
        for name, one in given.items():
            if one != signature(train).parameters[name].default:
                raise ValueError(f"--{name} is that of the policy that --begin names; leave it out")
    if evaluator not in (None, "new"):
        options.check_saved("evaluator", Path(evaluator), "network", "train-evaluator")
    loaded = options.read_plans(plans, known)
    import torch

    from lw_torchrl._devices import check_device
    from lw_torchrl.data.dataset import read_metadata
    from lw_torchrl.modules.policy import METHODS, make_policy, policy_class

    options.use_one_thread()
    there, held = check_device("device", device), read_metadata(data).config
    encoder = options.read_encoder(text_encoder)
    actor_options: dict[str, Any] = {"features": features, "width": width, "depth": depth}
    reads_plans = policy_class(METHODS[method].policy).plan_options
    if reads_plans:
        actor_options["mix"] = mix or "latents"
    for option, value in (("mix", mix), ("latent-consistency", latent_consistency), ("evaluator", evaluator)):
        if value and not reads_plans:
            raise ValueError(f"--{option} is for a method that reads plans, --method {method} does not")
    numbers: dict[str, Any] = {"steps": steps, "batch_size": batch_size, "learning_rate": learning_rate, "seed": seed}
    numbers |= {"latent_consistency": latent_consistency, "qaf_anchor": qaf_anchor}
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
    if isinstance(inside, lw.HeldEvaluator):
        which, mend = "--begin must have", "give the one to train by --evaluator"
        if evaluator is not None:
            which = "--evaluator must be"
            mend = "train with the one inside it, lw.training.save_evaluator(held.evaluator, FILE)"
        raise ValueError(f"{which} no HeldEvaluator, of whose steps a dataset's rows tell nothing: {mend}")
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
    if inside is not None:
        drifts = lw.evaluation.condition_drift(actor, replay[:])
        heading = "conditions that drifted most from their words, in the demonstrations' states:"
        table = lw.evaluation.drift_table(drifts, most=5)
        output.show("drift", [asdict(one) for one in drifts], f"{heading}\n{table}")
    return output


def _told_tasks(folder: Path) -> tuple[str, ...]:
    """A dataset's tasks, read without torch; none where its metadata are no such, which is an error later."""
    with suppress(OSError, ValueError, KeyError, TypeError):
        return tuple(map(str, read_json(folder / "metadata.json", "data")["config"]["tasks"]))
    return ()


def _evaluator(named: str, plans: Plans, encoder: Any) -> lw.QueryEvaluator:
    if named == "new":
        return lw.StateQueryEvaluator(plans)
    return lw.training.load_evaluator(named, plans, text_encoder=encoder)
