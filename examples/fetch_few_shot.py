"""Train a Fetch robot to reach, push, and pick and place: python examples/fetch_few_shot.py

Scripted skills that follow plans provide ten noisy demonstrations of each task. The policy observes only the relative
positions of the objects of the active plan step, and the gripper's opening: with so few demonstrations, a policy with
more features would overfit.
"""

import argparse
from pathlib import Path

import torch

import lw_torchrl as lw
from lw_torchrl.modules import Concat, ObservationFeatures, RoleFeatures
from lw_torchrl.suites import load_suite

TASKS = ["fetch/reach", "fetch/push", "fetch/pick-and-place"]

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument(
    "--seeds", type=int, nargs="+", default=[0], help="random seeds of demonstrations, weights and minibatches"
)
parser.add_argument("--demonstrations", type=int, default=10, help="number of demonstrations per task")
parser.add_argument("--steps", type=int, default=3000, help="number of minibatches, of 300 rows each")
parser.add_argument("--episodes", type=int, default=50, help="evaluation episodes per task (seed 1000, noise 0.1)")
parser.add_argument("--out", type=Path, default=Path("runs/fetch-few-shot"))
options = parser.parse_args()

plans = lw.canonical_plans(lw.Plans([load_suite("fetch").plans[task] for task in TASKS]))
for seed in options.seeds:
    folder = options.out / f"seed{seed}"
    lw.collect_demonstrations(
        TASKS,
        episodes_per_task=options.demonstrations,
        root=folder / "demonstrations",
        seed=seed,
        noise_scale=(0.0, 0.1, 0.2, 0.3),
        noise_hold=5,
        redraw_failures=True,
    )
    torch.manual_seed(seed)
    features = Concat(ObservationFeatures("opening", 0.05, plans.layout), RoleFeatures(plans, 0.05))
    policy = lw.PlanConditionedActor(plans, features=features)
    replay = lw.LanguageWorldExperienceReplay(
        folder / "demonstrations", sampler=lw.TaskBalancedSampler(), transform=lw.QAFTransform(plans)
    )
    config = lw.BehavioralCloningConfig(steps=options.steps, batch_size=300, seed=seed)
    lw.BehavioralCloningTrainer(policy, replay, config, checkpoint=folder / "policy.safetensors").train()
    result = lw.evaluate(policy, tasks=TASKS, episodes_per_task=options.episodes, seed=1000, noise_scale=0.1)
    print(f"seed {seed}:", ", ".join(f"{task} {rate:.2f}" for task, rate in result.success_once.items()), flush=True)
