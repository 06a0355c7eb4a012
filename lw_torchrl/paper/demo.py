"""The demo: demonstrations, a plan-conditioned policy, its evaluation and a recording, in one go."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from lw_torchrl._checks import counted
from lw_torchrl._files import held, read_json, write_json
from lw_torchrl.data import LanguageWorldExperienceReplay, TaskBalancedSampler, collect_demonstrations
from lw_torchrl.evaluation import EvaluationResult, evaluate, plot_success
from lw_torchrl.language.plan_files import load_plans
from lw_torchrl.language.tasks import MT10
from lw_torchrl.modules import PlanConditionedActor
from lw_torchrl.paper.runs import plain
from lw_torchrl.record.rollouts import active_skills, run_recorded, write_recording
from lw_torchrl.training import BehavioralCloningConfig, BehavioralCloningTrainer
from lw_torchrl.transforms import QAFTransform

RECORDED = ("drawer-open", "window-open")


@dataclass(frozen=True)
class DemoConfig:
    """What the demo does, kept in config.json beside the results."""

    tasks: tuple[str, ...] = MT10
    demonstrations_per_task: int = 10
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


def run_demo(out: Path, config: DemoConfig) -> EvaluationResult:
    """Run the demo, or what is left of it, and print its results; ``out`` must hold none of another configuration.

    It gets config.json, demonstrations/, checkpoint.zip, results.json, success.png and rollout.rrd.
    """
    stated, path = plain(asdict(config)), out / "config.json"
    with held(out, "out", folder=True):
        if not path.is_file():
            write_json(path, stated)
        elif read_json(path, "out: the configuration") != stated:
            raise ValueError(f"out: {str(out)!r} holds a demo of another configuration; choose another folder")
        return _run(out, config)


def _run(out: Path, config: DemoConfig) -> EvaluationResult:
    plans = load_plans("MT10")
    print(f"1/4  {config.demonstrations_per_task} demonstrations of each of {counted(len(config.tasks), 'task')}")
    options: dict[str, Any] = {"noise_scale": config.demonstration_noise, "noise_hold": config.noise_hold}
    options |= {"episodes_per_task": config.demonstrations_per_task, "seed": config.demonstration_seed}
    collect_demonstrations(config.tasks, root=out / "demonstrations", redraw_failures=True, **options)
    print(f"2/4  training a plan-conditioned policy for {config.training_steps} steps")
    torch.manual_seed(config.training_seed)
    actor = PlanConditionedActor(plans)
    options = {"after_success": config.after_success, "transform": QAFTransform(plans)}
    replay = LanguageWorldExperienceReplay(out / "demonstrations", sampler=TaskBalancedSampler(), **options)
    cloning = BehavioralCloningConfig(config.training_steps, config.batch_size, seed=config.training_seed)
    BehavioralCloningTrainer(actor, replay, cloning, checkpoint=out / "checkpoint.zip").train()
    print(f"3/4  evaluating {config.episodes_per_task} episodes of each task on seeds no demonstration used")
    results = out / "results.json"
    if results.is_file():
        result = EvaluationResult.load(results)
    else:
        options = {"seed": config.evaluation_seed, "noise_scale": config.evaluation_noise}
        result = evaluate(actor, tasks=config.tasks, episodes_per_task=config.episodes_per_task, **options)
        result.save(results, checkpoint=out / "checkpoint.zip", plans=plans.fingerprint)
    plot_success(result, out / "success.png", title="Plan-conditioned behavioral cloning")
    print("4/4  recording a rollout")
    episodes = run_recorded(actor, config.tasks, seed=config.evaluation_seed, noise_scale=config.evaluation_noise)
    chosen = [one for one in episodes if one.task in RECORDED] or episodes[:1]
    write_recording(out / "rollout.rrd", chosen, plans, seed=config.evaluation_seed, policy="demo")
    print(f"\n{result.table()}\n")
    print("skills that led, in order, up to the first success (steps):")
    for one in episodes:
        led = [f"{skill} ({steps})" for skill, steps in active_skills(one, plans[one.task])]
        shown = led if len(led) <= 8 else [*led[:4], f"... {len(led) - 7} changes ...", *led[-3:]]
        print(f"  {one.task}: " + " > ".join(shown))
    print(f"\nresults   {results}\nfigure    {out / 'success.png'}\npolicy    {out / 'checkpoint.zip'}")
    print(f"recording lw-torchrl view {out / 'rollout.rrd'}")
    return result
