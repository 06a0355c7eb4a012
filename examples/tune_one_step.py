"""Reinforcement learning of one step of a plan, where the policy is weak; all the rest of it stays as it is.

python examples/tune_one_step.py                           # about 8 minutes on one core
python examples/tune_one_step.py --frames 400 --clone 20   # only to see it run
"""

import argparse
import tempfile

import torch
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

import lw_torchrl as lw
from lw_torchrl.evaluation import PlanUse, stuck_steps, stuck_table, weakest_step
from lw_torchrl.training.algorithms import ResidualConfig

TASK, OTHER = "pick-place", "push"
CARRY = 3  # the step of pick-place's plan that the policy is not shown


def clone(root: str, plans: lw.Plans, steps: int) -> lw.PlanConditionedActor:
    """A policy of both tasks, from demonstrations in which one step's rows are left out."""
    lw.collect_demonstrations(
        [TASK, OTHER], episodes_per_task=5, root=root, noise_scale=[0.0, 0.1, 0.2], noise_hold=10, redraw_failures=True
    )
    actor = lw.PlanConditionedActor(plans, feature_noise=0.1)
    rows = lw.LanguageWorldExperienceReplay(root, after_success=20, transform=actor.transform())[:]
    left_out = (rows["task_id"] == lw.task_id(TASK)) & rows["qaf"][:, CARRY]
    rows = rows[~left_out].select("observation", "task_id", "qaf", "action")
    replay = TensorDictReplayBuffer(storage=LazyTensorStorage(len(rows)), sampler=lw.TaskBalancedSampler())
    replay.extend(rows)
    config = lw.BehavioralCloningConfig(steps=steps, batch_size=250)
    lw.BehavioralCloningTrainer(actor, replay, config, progress=False).train()
    return actor


def look(actor: lw.Policy, task: str, episodes: int, seed: int = 1_000) -> tuple[lw.EvaluationResult, PlanUse]:
    """How a policy fares in a task, and how it used the plan."""
    use = PlanUse(actor.plans)
    result = lw.evaluate(
        actor,
        tasks=task,
        episodes_per_task=episodes,
        seed=seed,
        stop_at_success=True,
        also_record=["qaf", "skill_weights"],
        on_episode=use,
    )
    return result, use


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=30_000, help="steps of the environment")
    parser.add_argument("--clone", type=int, default=2_000, help="gradient steps of behavioral cloning")
    parser.add_argument("--episodes", type=int, default=20, help="evaluated, each time")
    args = parser.parse_args()
    torch.manual_seed(0)
    known = lw.load_plans("MT50")
    plans = lw.Plans([known[TASK], known[OTHER]])

    with tempfile.TemporaryDirectory() as root:
        base = clone(f"{root}/demos", plans, args.clone)
        before, other_before = look(base, TASK, args.episodes)[0], look(base, OTHER, args.episodes)[0]

        # Where does it fail? Other episodes tell than those that success is measured in.
        _, use = look(base, TASK, args.episodes, seed=2_000)
        print(stuck_table(stuck_steps(use)))
        weakest = weakest_step(use, TASK)
        print(f"tuning step {weakest.step + 1}, {weakest.skill}", flush=True)

        # A correction that counts in this step alone, and one whole demonstration beside what comes.
        actor = lw.ResidualActor(base, scale=1.0, steps={TASK: [weakest.step]})
        lw.collect_demonstrations(TASK, episodes_per_task=1, root=f"{root}/one", seed=100, redraw_failures=True)
        replay = lw.LanguageWorldExperienceReplay(
            f"{root}/one",
            label="executed",
            reward="dense_cost",
            terminate_on_success=True,
            n_steps=5,
            gamma=0.99,
            grow=args.frames,
            sampler=lw.CoLearningSampler("grown"),
            transform=actor.transform(),
        )
        config = ResidualConfig(frames=args.frames, first_frames=min(1_000, args.frames // 2))
        lw.OnlineTrainer(actor, replay, config, method="residual").train()

        after, other_after = look(actor, TASK, args.episodes)[0], look(actor, OTHER, args.episodes)[0]
    print(f"{TASK}: success {before.mean_success:.2f} before, {after.mean_success:.2f} after")
    same = other_before.episodes == other_after.episodes
    print(f"{OTHER}: success {other_after.mean_success:.2f}, " + ("as before in every episode" if same else "changed"))


if __name__ == "__main__":
    main()
