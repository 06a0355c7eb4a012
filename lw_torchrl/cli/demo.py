"""The command ``lw-torchrl demo``: collect demonstrations, and train, evaluate and record a policy."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import lw_torchrl as lw
from lw_torchrl.cli import options
from lw_torchrl.cli.options import Flag, Maybe
from lw_torchrl.language.tasks import MT10

RECORDED = ("drawer-open", "window-open")


@dataclass(frozen=True)
class DemoConfig:
    """The settings of the demo, which are written to config.json in the output folder."""

    tasks: tuple[str, ...] = MT10
    demonstrations_per_task: int = 20
    demonstration_seed: int = 0
    demonstration_noise: tuple[float, ...] = (0.0, 0.1, 0.2, 0.3, 0.4)
    noise_hold: int = 10
    after_success: int = 20
    training_steps: int = 8000
    batch_size: int = 500
    training_seed: int = 0
    episodes_per_task: int = 20
    evaluation_seed: int = 1000
    evaluation_noise: float = 0.1


QUICK = DemoConfig(tasks=RECORDED, demonstrations_per_task=4, training_steps=800, batch_size=100, episodes_per_task=5)


@dataclass(kw_only=True)
class Demo:
    """Train a plan-conditioned policy on MT10, evaluate it and record an episode, in a few minutes on two cores.

    To resume an interrupted demo, run the same command again.

    Example: lw-torchrl demo --quick
    """

    out: Maybe[Path] = None  # output folder (default: runs/demo, or runs/demo-quick with --quick)
    quick: Flag = False  # train briefly on two tasks, in under a minute (the success rate is not meaningful)

    def run(self) -> None:
        options.use_one_thread()
        out = self.out or Path("runs/demo-quick" if self.quick else "runs/demo")
        run_demo(out, QUICK if self.quick else DemoConfig())


def run_demo(out: Path, config: DemoConfig) -> lw.EvaluationResult:
    """Run or resume the demo, write its files to ``out`` and print its results."""
    from lw_torchrl._util.files import locked, read_json, write_json

    described, path = json.loads(json.dumps(asdict(config))), out / "config.json"
    with locked(out, "out", folder=True):
        if not path.is_file():
            write_json(path, described)
        elif read_json(path, "out: the configuration") != described:
            raise ValueError(f"out: {str(out)!r} holds a demo with a different configuration; choose another folder")
        return _run(out, config)


def _run(out: Path, config: DemoConfig) -> lw.EvaluationResult:
    import torch

    from lw_torchrl.record.rollouts import run_recorded, write_recording

    plans = lw.load_plans("MT10")
    print(f"1/4  collecting {config.demonstrations_per_task} demonstrations for each of {len(config.tasks)} tasks")
    how: dict[str, Any] = {"noise_scale": config.demonstration_noise, "noise_hold": config.noise_hold}
    how |= {"episodes_per_task": config.demonstrations_per_task, "seed": config.demonstration_seed}
    lw.collect_demonstrations(config.tasks, root=out / "demonstrations", redraw_failures=True, **how)
    print(f"2/4  training a plan-conditioned policy for {config.training_steps} steps")
    torch.manual_seed(config.training_seed)
    actor = lw.PlanConditionedActor(plans)
    rows: dict[str, Any] = {"after_success": config.after_success, "transform": lw.QAFTransform(plans)}
    rows["sampler"] = lw.TaskBalancedSampler(exact=True)
    replay = lw.LanguageWorldExperienceReplay(out / "demonstrations", **rows)
    cloning = lw.BehavioralCloningConfig(config.training_steps, config.batch_size, seed=config.training_seed)
    lw.BehavioralCloningTrainer(actor, replay, cloning, checkpoint=out / "checkpoint.safetensors").train()
    print(f"3/4  evaluating {config.episodes_per_task} episodes per task on seeds unused in the demonstrations")
    results = out / "results.json"
    noise: dict[str, Any] = {"seed": config.evaluation_seed, "noise_scale": config.evaluation_noise}
    if results.is_file():
        result = lw.EvaluationResult.load(results)
    else:
        result = lw.evaluate(actor, tasks=config.tasks, episodes_per_task=config.episodes_per_task, **noise)
        result.save(results, checkpoint=out / "checkpoint.safetensors", plans=plans.fingerprint)
    lw.evaluation.plot_success(result, out / "success.png", title="Plan-conditioned behavioral cloning")
    print("4/4  recording a rollout")
    episodes = run_recorded(actor, RECORDED, **noise)
    write_recording(out / "rollout.rrd", episodes, plans, seed=config.evaluation_seed, policy="demo")
    print(f"\n{result.table()}\n")
    print(f"results   {results}\nfigure    {out / 'success.png'}\npolicy    {out / 'checkpoint.safetensors'}")
    print(f"recording lw-torchrl view {out / 'rollout.rrd'}")
    return result
