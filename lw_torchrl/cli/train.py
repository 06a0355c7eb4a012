"""The commands ``train`` and ``train-evaluator``: train a policy, or a network that evaluates conditions."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, arg

import lw_torchrl as lw
from lw_torchrl._util.checks import Count, Natural, Probability, Scale
from lw_torchrl._util.text import counted
from lw_torchrl.cli import options
from lw_torchrl.cli.options import Maybe, Output, read_evaluator

_METHOD = (
    "condition the policy on plans (pcbc), task descriptions (dc) or task indices (one-hot), or the name of a custom "
    "method"
)
_LOSS = (
    "bc (behavioral cloning of an expert); for any dataset with rewards: advantage (advantage-weighted behavioral "
    "cloning with a learned value), iql, td3-bc or cql"
)


@dataclass(kw_only=True)
class Train:
    """Train a policy on demonstrations, or with offline RL on any dataset. To resume, run the same command again.

    Example: lw-torchrl train demos/mt10 --out runs/mt10.safetensors --evaluate-every 2000

    Example: lw-torchrl train data/noisy --out runs/iql.safetensors --loss iql

    Example: lw-torchrl train demos/mt10 --out runs/tuned.safetensors --begin runs/mt10.safetensors --steps 2000
    """

    data: Positional[Annotated[Path, arg(metavar="DATA")]]  # dataset written by `lw-torchrl collect`
    out: Path  # .safetensors file to which the policy is written
    tasks: Annotated[tuple[str, ...], options.OPTIONAL] = ()  # train on the demonstrations of these tasks only
    plans: options.PlanSources = ("MT10",)
    task_file: options.TaskFile = None
    text_encoder: options.Encoder = None
    loss: Annotated[Literal["bc", "advantage", "iql", "td3-bc", "cql"], arg(help=_LOSS)] = "bc"
    method: Annotated[str, arg(help=_METHOD)] = "pcbc"
    features: Maybe[Literal["raw", "differences", "relative", "both"]] = None
    """features of the state: raw (the observation), differences (between hand, objects and goal; the default), both, or
    relative (as differences, but without the hand's height and the gripper opening)"""
    width: Maybe[Count] = None  # units of each hidden layer (default: 256)
    depth: Maybe[Natural] = None  # number of hidden layers (default: 3)
    after_success: Natural = 20  # with --loss bc, drop rows more than N time steps after the first success
    reward: Literal["sparse", "dense", "cost", "dense_cost"] = "dense_cost"  # reward for losses other than bc
    begin: Maybe[Path] = None  # policy file to fine-tune; its plans, network and normalization are kept
    evaluator: options.Evaluator = None
    qaf_anchor: Scale = 0.0  # weight of the evaluator's cross-entropy loss (use 1 for an untrained evaluator)
    steps: Maybe[Count] = None  # number of minibatches (default: 8000 with --loss bc, else 4000)
    batch_size: Maybe[Count] = None  # rows per minibatch, balanced over tasks (default: 500 with --loss bc, else 250)
    learning_rate: Scale = 1e-3  # initial learning rate, decayed to 0 with a cosine schedule
    seed: Natural = 0  # random seed of initial weights and minibatches
    evaluate_every: Maybe[Count] = None  # evaluate every N training steps and at the end, and log the success rate
    evaluate_episodes: Count = 5  # number of episodes of each task per evaluation
    evaluate_seed: Natural = 1000  # random seed of the evaluation (use a different one than for demonstrations)
    logger: Maybe[Literal["csv", "tensorboard", "wandb", "rerun"]] = None  # log to the folder logs/ next to OUT
    device: options.Device = "cpu"
    json: options.Json = False

    def run(self) -> Output:
        if self.logger in ("wandb", "tensorboard") and find_spec(self.logger) is None:
            raise ImportError(f"--logger {self.logger} requires the package {self.logger}: pip install {self.logger}")
        if self.begin is not None and self.out.resolve() == self.begin.resolve():
            raise ValueError(f"--out must differ from --begin, got {str(self.out)!r} for both")
        if self.loss != "bc" and (self.evaluator is not None or self.qaf_anchor):
            raise ValueError("--evaluator and --qaf-anchor only apply to --loss bc")
        import torch  # after the checks, because it takes seconds

        from lw_torchrl.data.dataset import read_metadata
        from lw_torchrl.training.offline import DISTRIBUTIONS

        options.use_one_thread()
        dataset = read_metadata(self.data).config
        if self.evaluate_every is not None and self.evaluate_seed == dataset.seed:
            raise ValueError(f"--evaluate-seed {dataset.seed} is the seed of the demonstrations; use a different seed")
        known = options.read_tasks(self.task_file, dataset.tasks)
        plans = options.read_plans(self.plans, known)
        tasks = options.select_tasks(self.tasks or dataset.tasks, known)
        if missing := set(tasks) - set(dataset.tasks):
            raise ValueError(f"the dataset {str(self.data)!r} has no demonstrations of {', '.join(sorted(missing))}")
        rows: dict[str, Any] = {"device": self.device}
        rows["episodes"] = dict.fromkeys(tasks, dataset.episodes_per_task) if self.tasks else None
        torch.manual_seed(self.seed)
        actor = self._new_actor(plans, tuple(sorted(tasks))) if self.begin is None else self._begun_actor()
        logger = None if self.logger is None else make_logger(self.logger, self.out)
        run: dict[str, Any] = {"checkpoint": self.out, "logger": logger, "evaluate_every": self.evaluate_every}
        trainer: Any
        if self.evaluate_every is not None:
            run["evaluate"] = lambda: self._success_rates(trainer.steps, actor, tasks)
        if self.loss == "bc":
            trainer = self._clone(actor, rows, run)
        else:
            if (distribution := DISTRIBUTIONS[self.loss]) is not None:
                actor = actor.stochastic(distribution)
            trainer = self._learn(actor, plans, rows, run)
        if trainer.steps and not self.json:
            print(f"resuming at step {trainer.steps}", flush=True)
        loss, steps = trainer.train(), trainer.config.steps
        output = Output(self.json).show("policy", self.out).show("steps", steps)
        return output.show("loss", loss, f"{_trained(steps, loss)}: {self.out}")

    @property
    def _numbers(self) -> dict[str, Any]:
        """Keyword arguments for the config of any trainer."""
        steps, batch_size = (8000, 500) if self.loss == "bc" else (4000, 250)
        numbers = {"steps": self.steps or steps, "batch_size": self.batch_size or batch_size}
        return {**numbers, "learning_rate": self.learning_rate, "seed": self.seed}

    def _clone(self, actor: Any, rows: Mapping[str, Any], run: Mapping[str, Any]) -> Any:
        sampler = lw.TaskBalancedSampler(exact=True)
        replay = lw.LanguageWorldExperienceReplay(self.data, after_success=self.after_success, sampler=sampler, **rows)
        _read_transform(actor, replay, self.data)
        more: dict[str, Any] = {"qaf_anchor": self.qaf_anchor, "normalize": self.begin is None}
        config = lw.BehavioralCloningConfig(**self._numbers, **more)
        return lw.BehavioralCloningTrainer(actor, replay, config, device=self.device, **run)

    def _learn(self, actor: Any, plans: lw.Plans, rows: Mapping[str, Any], run: Mapping[str, Any]) -> Any:
        """Return the trainer for a loss other than bc; for --loss advantage, first train the value network."""
        from lw_torchrl._util.devices import place
        from lw_torchrl.modules.policy import plans_of
        from lw_torchrl.training.offline import GAMMA, N_STEPS, learn_advantages, make_loss

        plans = plans_of(actor) or plans
        config = lw.OfflineConfig(**self._numbers)

        def replay(**n_step: Any) -> lw.LanguageWorldExperienceReplay:
            same: dict[str, Any] = {"label": "executed", "terminate_on_success": True, "reward": self.reward}
            same |= {"transform": lw.QAFTransform(plans), "sampler": lw.TaskBalancedSampler(exact=True)}
            return lw.LanguageWorldExperienceReplay(self.data, **same, **rows, **n_step)

        data = n_step_data = replay(n_steps=N_STEPS, gamma=GAMMA)
        device = place(actor, self.device)
        if self.loss == "advantage":
            file = self.out.with_name(f"{self.out.stem}.value.safetensors")
            value: dict[str, Any] = {"checkpoint": file, "title": "training the value"}
            advantage = learn_advantages(plans, n_step_data, config, device, **value)
            data = replay()
            data.add_column("advantage", advantage, of=n_step_data)
        if self.begin is None:
            lw.training.fit_normalization(actor, data)
        loss = make_loss(self.loss, actor, plans, data).to(device)
        config = lw.OfflineConfig(**self._numbers, normalize=False)
        return lw.OfflineTrainer(loss, data, config, actor=actor, **run)

    def _success_rates(self, step: int, actor: Any, tasks: list[str]) -> dict[str, float]:
        """Print and return the success rates on held-out seeds after ``step`` training steps."""
        result = lw.evaluate(
            actor, tasks=tasks, episodes_per_task=self.evaluate_episodes, seed=self.evaluate_seed,
            stop_at_success=True, suite=options.read_suite(None, tasks), progress=False,
        )  # fmt: skip
        episodes = f"{counted(self.evaluate_episodes, 'episode')} of each task, seed {self.evaluate_seed}"
        print(f"step {step}: success {result.mean_success:.3f} ({episodes})", file=sys.stderr)
        rates = {"success": result.mean_success, **{f"success/{task}": r for task, r in result.success_once.items()}}
        return {name: float(rate) for name, rate in rates.items() if rate is not None}

    def _new_actor(self, plans: lw.Plans, tasks: tuple[str, ...]) -> Any:
        """Return an untrained policy for ``tasks``, preceded by the evaluator if there is one."""
        import torch
        from tensordict.nn import TensorDictSequential

        from lw_torchrl.modules import MLPDecoder, ObservationFeatures, make_policy, plans_of

        plans.require(tasks)
        encoder, parts = options.read_encoder(self.text_encoder), dict[str, Any]()
        if encoder is not None:
            parts["text_encoder"] = encoder
        if self.features is not None:
            parts["features"] = ObservationFeatures(self.features, 0.05, plans.layout)
        if (self.width, self.depth) != (None, None):
            width, depth = self.width or 256, 3 if self.depth is None else self.depth
            parts["decoder"] = MLPDecoder(width=width, depth=depth, actions=plans.layout.action_size)
        actor = make_policy(self.method, plans, **parts)
        if plans_of(actor) is None and len(plans) > len(tasks):  # keep only the tasks to train on
            torch.manual_seed(self.seed)
            actor = make_policy(self.method, lw.Plans({task: plans[task] for task in tasks}), **parts)
        if self.evaluator is None:
            return actor
        return TensorDictSequential(self._read_evaluator(plans, "soft"), actor)

    def _begun_actor(self) -> Any:
        """Load the policy named by --begin, preceded by the evaluator if there is one."""
        from tensordict.nn import TensorDictSequential

        from lw_torchrl.modules.policy import plans_of

        assert self.begin is not None
        if self.method != "pcbc" or (self.features, self.width, self.depth) != (None, None, None):
            raise ValueError("--begin fixes the network; remove --method, --features, --width and --depth")
        actor: Any = lw.load_actor(self.begin, text_encoder=options.read_encoder(self.text_encoder))
        if self.evaluator is None:
            return actor
        if "qaf" not in actor.in_keys or (own := plans_of(actor)) is None:
            raise ValueError(f"--evaluator requires a policy that reads qaf, but --begin is a {type(actor).__name__}")
        return TensorDictSequential(self._read_evaluator(own, "hard"), actor)

    def _read_evaluator(self, plans: lw.Plans, answers: Literal["soft", "hard"]) -> lw.QueryEvaluator:
        assert self.evaluator is not None
        evaluator = read_evaluator(self.evaluator, plans, self.text_encoder)
        evaluator.answers = answers
        return evaluator


def _read_transform(actor: Any, replay: Any, data: Path) -> None:
    """Add the actor's other inputs to the replay buffer: the truth values of conditions, or images."""
    from lw_torchrl.modules.policy import plans_of
    from lw_torchrl.modules.query_evaluator import evaluators_of

    for evaluator in evaluators_of(actor):
        if isinstance(evaluator, lw.modules.ImageQueryEvaluator):
            pictures: dict[str, Any] = {name: getattr(evaluator, name) for name in ("cameras", "height", "width")}
            lw.data.add_pictures(data, **pictures)
            replay.add_column("pixels", lw.data.load_pictures(replay, **pictures))
    if "qaf" in actor.in_keys and (plans := plans_of(actor)) is not None:
        replay.append_transform(lw.QAFTransform(plans))


def _trained(steps: int, loss: float) -> str:
    return f"trained to step {steps}" + ("" if loss != loss else f", loss {loss:.4f}")  # NaN: no step was left


def make_logger(kind: str, out: Path) -> Any:
    """Return a TorchRL logger that writes to logs/ next to ``out``; a RerunLogger starts a new recording each time."""
    if kind == "rerun":
        return lw.RerunLogger(out.parent / "logs" / f"{out.stem}.rrd", exp_name=f"{out.parent.name}/{out.stem}")
    from torchrl.record.loggers import get_logger

    return get_logger(kind, str(out.parent / "logs"), out.stem)


_CAMERAS = (
    "predict from images of these cameras instead of the observation: corner, corner2, corner3, corner4, topview, "
    "behindGripper, gripperPOV"
)


@dataclass(kw_only=True)
class TrainEvaluator:
    """Train a network that replaces the exact condition checker, and report the network's accuracy.

    The network is trained on all queries that `lw-torchrl tasks TASK` lists. To resume, run the same command again.

    Example: lw-torchrl train-evaluator MT10 --out runs/evaluator --held-out-tasks push reach

    Example: lw-torchrl train-evaluator drawer-open --out runs/eyes --cameras corner corner3 --episodes 20
    """

    tasks: options.TaskNames
    out: Path  # folder for evaluator.safetensors, report.json and the collected episodes
    data: Annotated[tuple[Path, ...], options.OPTIONAL] = ()
    """datasets written by `lw-torchrl collect`, to use instead of collecting episodes"""
    behaviours: tuple[str, ...] = ("expert", "scripted", "noisy-30", "random")
    """policies that collect the episodes, as for `collect --policy`"""
    episodes: Count = 5  # number of episodes to collect for each task and policy
    max_steps: Count = 500  # time steps per episode
    noise: tuple[Scale, ...] = (0.0, 0.1, 0.2)  # standard deviations of the expert's noise; episodes use them in turn
    cameras: Annotated[tuple[str, ...], options.OPTIONAL, arg(help=_CAMERAS)] = ()
    picture: Count = 64  # with --cameras, height and width of the images in pixels
    every: Maybe[Count] = None  # use every N-th state of an episode (default: 1; 5 with --cameras)
    held_out_tasks: Annotated[tuple[str, ...], options.OPTIONAL] = ()
    """tasks to hold out from training, or the number of tasks to draw at random and hold out"""
    held_out_pairs: Probability = 0.1  # fraction of object pairs whose queries are excluded from training
    width: Count = 128  # units of each hidden layer
    depth: Natural = 3  # number of hidden layers
    steps: Maybe[Count] = None  # number of minibatches (default: 6000; 4000 with --cameras)
    batch_size: Maybe[Count] = None  # (state, query) pairs, or images, per minibatch (default: 1024; 48 with --cameras)
    learning_rate: Maybe[Scale] = None  # initial learning rate (default: 0.003; 0.002 with --cameras)
    seed: Natural = 0  # random seed of episodes, held-out choices, initial weights and minibatches
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
            evaluator = lw.modules.StateQueryEvaluator(plans, width=self.width, depth=self.depth)
        replay = self._replay(tasks)
        if self.cameras:
            for root in self.data or [self.out / "data" / name for name in self.behaviours]:
                lw.data.add_pictures(root, **pictures, every=config.every)
            replay.add_column("pixels", lw.data.load_pictures(replay, **pictures, every=config.every))
        labelled = lw.training.LabelledQueries(replay, config)
        if not any(queries for name, queries in labelled.parts.items() if name != "training"):
            raise ValueError("no held-out queries to score the evaluator on; use --episodes 2 or more")
        file = self.out / "evaluator.safetensors"
        trainer = lw.training.QueryEvaluatorTrainer(evaluator, labelled, config, checkpoint=file, device=self.device)
        loss = trainer.train()
        evaluator.cpu()
        output = Output(self.json).show("evaluator", file).show("steps", config.steps)
        output.show("loss", loss, _trained(config.steps, loss))
        report = lw.evaluation.score_evaluator(evaluator, labelled)
        output.show("parts", {name: part.to_json() for name, part in report.parts.items()}, report.table())
        report.save(self.out / "report.json")
        print(f"written to {self.out}")
        return output

    def _config(self) -> Any:
        numbers: dict[str, Any] = {"learning_rate": 2e-3} if self.cameras else {"steps": 6000}
        overrides = {name: getattr(self, name) for name in ("steps", "batch_size", "learning_rate", "every")}
        numbers |= {name: value for name, value in overrides.items() if value is not None}
        drawn = len(self.held_out_tasks) == 1 and self.held_out_tasks[0].isdigit()
        numbers["held_out_tasks"] = int(self.held_out_tasks[0]) if drawn else self.held_out_tasks
        make = lw.training.ImageQueryEvaluatorConfig if self.cameras else lw.training.QueryEvaluatorConfig
        return make(held_out_pairs=self.held_out_pairs, seed=self.seed, **numbers)

    def _replay(self, tasks: list[str]) -> lw.LanguageWorldExperienceReplay:
        """Collect the episodes, unless --data is given, and return a replay buffer over the episodes of ``tasks``."""
        from lw_torchrl.data.dataset import read_metadata

        roots = self.data or tuple(self.out / "data" / name for name in self.behaviours)
        if not self.data:
            for name, root in zip(self.behaviours, roots, strict=True):
                run: dict[str, Any] = {"max_steps": self.max_steps, "seed": self.seed}
                run["noise_scale"] = self.noise if name == "expert" else 0.0
                lw.collect_demonstrations(tasks, root=root, policy=name, episodes_per_task=self.episodes, **run)
        chosen = []  # for each dataset, the tasks and their number of episodes
        for root in roots:
            dataset = read_metadata(root).config
            if not (shared := [task for task in tasks if task in dataset.tasks]):
                raise ValueError(f"--data {root} has none of the selected tasks, only {', '.join(dataset.tasks)}")
            chosen.append(dict.fromkeys(shared, dataset.episodes_per_task))
        return lw.LanguageWorldExperienceReplay(list(roots), label="executed", episodes=chosen)
