"""python -m benchmarks.images: compare conditions that are answered from camera images with exact answers."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import torch
import tyro

import lw_torchrl as lw
from benchmarks.evaluator_report import plot_wrong_answers, write_report, wrong_answers
from benchmarks.evaluators import WHO, demonstrations, evaluated, in_front
from benchmarks.figures import markdown_table
from benchmarks.statistics import Estimate
from lw_torchrl._util.files import write_text
from lw_torchrl.evaluation import EvaluationResult
from lw_torchrl.evaluation.result import wilson_interval


@dataclass(frozen=True)
class Arguments:
    """Train an evaluator on images for two tasks, and evaluate few-shot policies with it, before and after tuning.
    The decoder keeps the state's features. If the command is stopped, run it again to resume.
    """

    policy: tuple[Path, ...] = ()
    """Few-shot policies of MT10, one per seed, for example from benchmarks.evaluators; by default, only scripted skills
    are evaluated."""
    tasks: tuple[str, ...] = ("button-press-topdown", "drawer-open")
    cameras: tuple[str, ...] = ("corner", "corner3")
    size: int = 64
    """Height and width of an image, in pixels."""
    every: int = 5
    """Number of steps between images, in the data and in rollouts."""
    behaviours: tuple[int, ...] = (30, 30, 30, 15)
    """Number of rendered episodes per task: of experts, scripted skills, noisy scripted skills and random actions."""
    max_steps: int = 150
    """Number of steps per rendered episode."""
    steps: int = 4000
    """Number of minibatches to train the evaluator."""
    tuning_steps: int = 500
    """Number of minibatches of 64 rows to tune policy and evaluator."""
    seed: int = 0
    """Random seeds of states, demonstrations, evaluator and tuning."""
    episodes: int = 20
    """Number of evaluation episodes per task."""
    evaluation_seed: int = 1000
    quick: bool = False
    """Run few steps and episodes as a test; the numbers are meaningless."""
    out: Path = Path("runs/images")

    @property
    def pictures(self) -> dict[str, Any]:
        return {"cameras": self.cameras, "height": self.size, "width": self.size}


def frames_per_second(args: Arguments) -> float:
    """Return the number of images that one core renders per second."""
    env = lw.LanguageWorldEnv(args.tasks)
    env.reset()
    for camera in args.cameras:
        env.render(camera=camera, height=args.size, width=args.size)
    count, start = 0, perf_counter()
    while perf_counter() - start < 3.0:
        for camera in args.cameras:
            count += len(env.render(camera=camera, height=args.size, width=args.size))
    env.close()
    return count / (perf_counter() - start)


def evaluator(args: Arguments, plans: lw.Plans) -> Any:
    """Train an evaluator on rendered states, and save it with a report and figures."""
    config = lw.training.ImageQueryEvaluatorConfig(
        steps=args.steps,
        every=args.every,
        learning_rate=2e-3,
        states_per_task=100_000,
        held_out_pairs=0.0,
        seed=args.seed,
    )
    roots = [args.out / "states" / who for who in WHO]
    for who, root, episodes in zip(WHO, roots, args.behaviours, strict=True):
        noise = (0.0, 0.1, 0.2) if who == "expert" else 0.0
        options: dict[str, Any] = {"max_steps": args.max_steps, "seed": args.seed, "noise_scale": noise}
        lw.collect_demonstrations(args.tasks, episodes_per_task=episodes, root=root, policy=who, **options)
        lw.data.add_pictures(root, **args.pictures, every=config.every)
    replay = lw.LanguageWorldExperienceReplay(roots, label="executed")
    replay.add_column("pixels", lw.data.load_pictures(replay, **args.pictures, every=config.every))
    labelled = lw.training.LabelledQueries(replay, config)
    torch.manual_seed(args.seed)
    made = lw.modules.ImageQueryEvaluator(plans, **args.pictures, every=args.every)
    file = args.out / "evaluator.safetensors"
    lw.training.QueryEvaluatorTrainer(made, labelled, config, checkpoint=file).train()
    report = write_report(made, labelled, args.out / "reliability.json", most=20)
    plot_wrong_answers(wrong_answers(made, labelled), args.out / "wrong.png")
    print(f"{labelled.describe()['states']['training']} drawn states trained\n{report}", flush=True)
    return lw.training.load_evaluator(file, plans)


def tuned(args: Arguments, name: str, actor: Any) -> Any:
    """Tune a policy and its evaluator with the imitation loss, whose gradient passes through the attention."""
    root = args.out / "demonstrations"
    replay = demonstrations(root, args.tasks, args.seed, args.max_steps)
    lw.data.add_pictures(root, **args.pictures)
    replay.add_column("pixels", lw.data.load_pictures(replay, **args.pictures))
    config = lw.BehavioralCloningConfig(
        steps=args.tuning_steps, batch_size=64, learning_rate=3e-4, normalize=False, seed=args.seed
    )
    file = args.out / f"{name}.safetensors"
    lw.BehavioralCloningTrainer(actor, replay, config, checkpoint=file).train()
    return lw.load_actor(file)


def main(args: Arguments) -> None:
    if args.quick:
        args = replace(args, behaviours=(2, 1, 1, 1), steps=20, tuning_steps=5, episodes=1)
    print(f"{frames_per_second(args):.0f} pictures of {args.size} times {args.size} pixels a second, on one core")
    plans = lw.load_plans("MT10")
    plans = lw.Plans({task: plans[task] for task in args.tasks})
    eyes = evaluator(args, plans)
    found: dict[str, list[EvaluationResult]] = {}

    def note(row: str, name: str, actor: Any) -> None:
        file = args.out / "results" / f"{name}.json"
        result = evaluated(file, actor, args.tasks, args.episodes, args.evaluation_seed)
        found.setdefault(row, []).append(result)
        print(f"{name}: {result.mean_success:.3f}", flush=True)

    scripted = lw.ScriptedSkillActor(plans)
    note("scripted skills, exact answers", "scripted", scripted)
    note("scripted skills, pictures", "scripted-pictures", in_front(eyes, scripted))
    for number, file in enumerate(args.policy):
        policy: Any = lw.load_actor(file).with_plans(plans)
        note("PCBC, exact answers", f"pcbc-{number}", policy)
        note("PCBC, pictures", f"pcbc-{number}-pictures", in_front(eyes, policy))
        begun = in_front(lw.training.load_evaluator(args.out / "evaluator.safetensors", plans), policy)
        name = f"pcbc-{number}-pictures-tuned"
        note("PCBC, pictures, tuned", name, tuned(args, name, begun))
    rows = []
    for row, results in found.items():
        hits = np.array([one.success for result in results for one in result.episodes])
        each = [f"{np.mean([result.success_once[task] for result in results]):.2f}" for task in args.tasks]
        rows.append([row, str(Estimate(float(hits.mean()), *wilson_interval(int(hits.sum()), hits.size))), *each])
    table = markdown_table(["", "mean", *args.tasks], rows)
    write_text(args.out / "table.md", table)
    print(f"\n{table}\nwritten to {args.out / 'table.md'}, reliability.json, reliability.png and wrong.png")


if __name__ == "__main__":
    torch.set_num_threads(1)
    main(tyro.cli(Arguments))
