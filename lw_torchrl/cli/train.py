"""``lw-torchrl train`` and ``train-evaluator``: train a policy, or a network that answers conditions."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, arg

import lw_torchrl as lw
from lw_torchrl.cli import options
from lw_torchrl.cli.acting import read_evaluator
from lw_torchrl.cli.output import Output

_METHOD = (
    "what the policy is conditioned on: pcbc (plans), dc (task descriptions), one-hot (task numbers), or the name of "
    "your own policy class"
)


@dataclass(kw_only=True)
class Train:
    """Train a policy on demonstrations. If it is stopped, the same command resumes it.

    Example: lw-torchrl train demos/mt10 --out runs/mt10.safetensors

    Example: lw-torchrl train demos/mt10 --out runs/tuned.safetensors --begin runs/mt10.safetensors --steps 2000
    """

    data: Positional[Annotated[Path, arg(metavar="DATA")]]  # dataset of `lw-torchrl collect`
    out: Path  # policy file to write
    tasks: tuple[str, ...] = ()  # train on the demonstrations of these tasks, if not on all
    plans: options.PlanSources = ("MT10",)
    task_file: options.TaskFile = None
    text_encoder: options.Encoder = None
    method: Annotated[str, arg(help=_METHOD)] = "pcbc"
    features: Literal["raw", "differences", "relative", "both"] | None = None
    """what the network sees: the raw observation; differences between hand, objects and goal; relative (differences
    without the hand's height and the gripper's opening); or both (raw and differences). None for differences"""
    width: int | None = None  # units of each hidden layer; None for the method's, 256
    depth: int | None = None  # number of hidden layers; None for the method's, 3
    after_success: int = 20  # drop steps more than N steps after the first success
    begin: Path | None = None  # fine-tune this policy file, with its plans, network and normalisation
    evaluator: options.Evaluator = None
    answers: Literal["logit", "tanh", "hard"] | None = None
    """how the evaluator's answers enter the attention (docs/evaluators.md); None for tanh, or with --begin for hard"""
    qaf_anchor: float = 0.0  # weight of the cross entropy with the exact answers; use 1 for a new evaluator
    steps: int = 8000  # number of minibatches
    batch_size: int = 500  # rows of a minibatch, equally many of each task
    learning_rate: float = 1e-3  # at the start; a cosine brings it to 0
    seed: int = 0  # random seed of initial weights and minibatches
    logger: Literal["csv", "tensorboard", "wandb", "rerun"] | None = None  # log the training in logs/ beside OUT
    device: options.Device = "cpu"
    json: options.Json = False

    def run(self) -> Output:
        import torch

        from lw_torchrl.data.dataset import read_metadata

        if self.begin is not None and self.out.resolve() == self.begin.resolve():
            raise ValueError("--out must be a different file from --begin")
        options.use_one_thread()
        dataset = read_metadata(self.data).config
        known = options.read_tasks(self.task_file, dataset.tasks)
        plans = options.read_plans(self.plans, known)
        tasks = options.select_tasks(self.tasks or dataset.tasks, known)
        if missing := set(tasks) - set(dataset.tasks):
            raise ValueError(f"the dataset {str(self.data)!r} has no demonstrations of {', '.join(sorted(missing))}")
        rows: dict[str, Any] = {"after_success": self.after_success, "device": self.device}
        rows["episodes"] = dict.fromkeys(tasks, dataset.episodes_per_task) if self.tasks else None
        replay = lw.LanguageWorldExperienceReplay(self.data, sampler=lw.TaskBalancedSampler(exact=True), **rows)
        torch.manual_seed(self.seed)
        actor = self._new_actor(plans, replay.tasks) if self.begin is None else self._begun_actor(plans)
        _read_transform(actor, replay, self.data)
        names = ("batch_size", "learning_rate", "seed", "qaf_anchor")
        numbers: dict[str, Any] = {name: getattr(self, name) for name in names} | {"normalize": self.begin is None}
        config = lw.BehavioralCloningConfig(self.steps, **numbers)
        logger = None if self.logger is None else make_logger(self.logger, self.out)
        where: dict[str, Any] = {"checkpoint": self.out, "logger": logger, "device": self.device}
        loss = lw.BehavioralCloningTrainer(actor, replay, config, **where).train()
        output = Output(self.json).show("policy", self.out).show("steps", self.steps)
        trained = "" if loss != loss else f", loss {loss:.4f}"  # nan: nothing was left to train
        return output.show("loss", loss, f"trained to step {self.steps}{trained}: {self.out}")

    def _new_actor(self, plans: lw.Plans, tasks: tuple[str, ...]) -> Any:
        from lw_torchrl.modules.registry import find_method, make_policy

        network: dict[str, Any] = {"features": self.features, "width": self.width, "depth": self.depth}
        network = {name: value for name, value in network.items() if value is not None}
        if self.evaluator is not None:
            network["evaluator"] = read_evaluator(self.evaluator, plans, self.text_encoder)
            network["answers"] = self.answers or "tanh"
        plans.require(tasks)
        if not find_method(self.method).reads_plans:
            plans = lw.Plans({task: plans[task] for task in tasks})
        return make_policy(self.method, plans, text_encoder=options.read_encoder(self.text_encoder), **network)

    def _begun_actor(self, plans: lw.Plans) -> Any:
        assert self.begin is not None
        if self.method != "pcbc" or (self.features, self.width, self.depth) != (None, None, None):
            raise ValueError("--begin brings its own --method, --features, --width and --depth; leave them out")
        actor: Any = lw.load_actor(self.begin, text_encoder=options.read_encoder(self.text_encoder))
        if self.evaluator is not None:
            if not isinstance(actor, lw.PlanConditionedActor):
                raise ValueError(f"--evaluator requires a PlanConditionedActor, --begin is a {type(actor).__name__}")
            evaluator = read_evaluator(self.evaluator, actor.plans, self.text_encoder)
            actor = actor.with_evaluator(evaluator, answers=self.answers or "hard")
        return actor


def _read_transform(actor: Any, replay: Any, data: Path) -> None:
    """Give the rows what the actor reads besides the observation: truths of conditions, or pictures."""
    evaluator = getattr(actor, "evaluator", None)
    if isinstance(evaluator, lw.modules.ImageQueryEvaluator):
        pictures: dict[str, Any] = {name: getattr(evaluator, name) for name in ("cameras", "height", "width")}
        lw.data.add_pictures(data, **pictures)
        replay.add_column("pixels", lw.data.load_pictures(replay, **pictures))
    elif (transform := actor.transform()) is not None:
        replay.append_transform(transform)


def make_logger(kind: str, out: Path) -> Any:
    """Return a TorchRL logger that writes to logs/ beside ``out``; rerun's begins a new recording each time."""
    if kind == "rerun":
        return lw.RerunLogger(out.parent / "logs" / f"{out.stem}.rrd", exp_name=f"{out.parent.name}/{out.stem}")
    from torchrl.record.loggers import get_logger

    try:
        return get_logger(kind, str(out.parent / "logs"), out.stem)
    except ImportError as error:
        raise ImportError(f"--logger {kind} requires the package {kind}: pip install {kind}") from error


_CAMERAS = (
    "answer from pictures of these cameras instead of from the observation: corner, corner2, corner3, corner4, "
    "topview, behindGripper, gripperPOV"
)


@dataclass(kw_only=True)
class TrainEvaluator:
    """Train a network that replaces the exact condition checker, and report its accuracy.

    It is trained on all base queries of the tasks. If it is stopped, the same command resumes it.

    Example: lw-torchrl train-evaluator MT10 --out runs/evaluator --held-out-tasks push reach

    Example: lw-torchrl train-evaluator drawer-open --out runs/eyes --cameras corner corner3 --episodes 20
    """

    tasks: options.TaskNames
    out: Path  # folder for evaluator.safetensors, report.json and the collected episodes
    data: tuple[Path, ...] = ()  # datasets of `lw-torchrl collect` to use instead of collecting episodes
    behaviours: tuple[str, ...] = ("expert", "scripted", "spoilt-30", "random")  # who acts, as for `collect --policy`
    episodes: int = 5  # episodes collected of each task and behaviour
    max_steps: int = 500  # steps of an episode
    noise: tuple[float, ...] = (0.0, 0.1, 0.2)  # standard deviations of the expert's execution noise, used in turn
    cameras: Annotated[tuple[str, ...], arg(help=_CAMERAS)] = ()
    picture: int = 64  # with --cameras, height and width of a picture in pixels
    every: int | None = None  # use every N-th state of an episode; None for 1, with --cameras 5
    held_out_tasks: tuple[str, ...] = ()  # tasks whose queries are not trained on, or how many to draw at random
    held_out_pairs: float = 0.1  # fraction of object pairs whose queries are excluded from training
    width: int = 128  # units of each hidden layer
    depth: int = 3  # number of hidden layers
    steps: int | None = None  # number of minibatches; None for 6000, with --cameras 4000
    batch_size: int | None = None  # checks in a minibatch (with --cameras: states); None for 1024 (48)
    learning_rate: float | None = None  # at the start; a cosine brings it to 0; None for 0.003, with --cameras 0.002
    seed: int = 0  # random seed of episodes, held-out choices, initial weights and minibatches
    num_envs: int | None = None  # environments stepped together; does not change the result
    device: options.Device = "cpu"
    json: options.Json = False

    def run(self) -> Output:
        import torch

        options.use_one_thread()
        known = options.read_tasks(None, self.tasks)
        tasks = options.select_tasks(self.tasks, known)
        config = self._config()
        torch.manual_seed(self.seed)
        pictures: dict[str, Any] = {"cameras": self.cameras, "height": self.picture, "width": self.picture}
        plans = options.read_plans(("MT50",), known)
        evaluator: Any
        if self.cameras:
            own = lw.Plans({task: plans[task] for task in tasks})
            evaluator = lw.modules.ImageQueryEvaluator(own, hidden=self.width, depth=self.depth, **pictures)
        else:
            evaluator = lw.StateQueryEvaluator(plans, width=self.width, depth=self.depth)
        replay = self._replay(tasks)
        if self.cameras:
            for root in self.data or [self.out / "data" / who for who in self.behaviours]:
                lw.data.add_pictures(root, **pictures, every=config.every)
            replay.add_column("pixels", lw.data.load_pictures(replay, **pictures, every=config.every))
        labelled = lw.training.LabelledQueries(replay, config)
        if not any(asked for name, asked in labelled.parts.items() if name != "training"):
            raise ValueError("nothing is held out to score the evaluator on; collect at least --episodes 2")
        make = lw.training.ImageQueryEvaluatorTrainer if self.cameras else lw.training.QueryEvaluatorTrainer
        file = self.out / "evaluator.safetensors"
        loss = make(evaluator, labelled, config, checkpoint=file, device=self.device).train()
        evaluator.cpu()
        output = Output(self.json).show("evaluator", file).show("steps", config.steps)
        trained = "" if loss != loss else f", loss {loss:.4f}"  # nan: nothing was left to train
        output.show("loss", loss, f"trained to step {config.steps}{trained}")
        report = lw.evaluation.score_evaluator(evaluator, labelled)
        output.show("parts", {name: one.to_json() for name, one in report.parts.items()}, report.table())
        report.save(self.out / "report.json")
        print(f"written to {self.out}")
        return output

    def _config(self) -> Any:
        numbers: dict[str, Any] = {"learning_rate": 2e-3} if self.cameras else {"steps": 6000}
        stated = {name: getattr(self, name) for name in ("steps", "batch_size", "learning_rate", "every")}
        numbers |= {name: value for name, value in stated.items() if value is not None}
        drawn = len(self.held_out_tasks) == 1 and self.held_out_tasks[0].isdigit()
        numbers["held_out_tasks"] = int(self.held_out_tasks[0]) if drawn else self.held_out_tasks
        make = lw.training.ImageQueryEvaluatorConfig if self.cameras else lw.training.QueryEvaluatorConfig
        return make(held_out_pairs=self.held_out_pairs, seed=self.seed, **numbers)

    def _replay(self, tasks: list[str]) -> lw.LanguageWorldExperienceReplay:
        """Collect the episodes, unless --data names datasets, and return a buffer over those of the tasks."""
        from lw_torchrl.data.dataset import read_metadata

        roots = self.data or tuple(self.out / "data" / who for who in self.behaviours)
        if not self.data:
            for who, root in zip(self.behaviours, roots, strict=True):
                run: dict[str, Any] = {"max_steps": self.max_steps, "seed": self.seed, "num_envs": self.num_envs}
                run["noise_scale"] = self.noise if who == "expert" else 0.0
                lw.collect_demonstrations(tasks, root=root, policy=who, episodes_per_task=self.episodes, **run)
        chosen = []  # of each dataset, every episode of the tasks
        for root in roots:
            dataset = read_metadata(root).config
            if not (there := [task for task in tasks if task in dataset.tasks]):
                raise ValueError(f"--data {root} has none of the tasks; it has {', '.join(dataset.tasks)}")
            chosen.append(dict.fromkeys(there, dataset.episodes_per_task))
        return lw.LanguageWorldExperienceReplay(list(roots), label="executed", episodes=chosen)
