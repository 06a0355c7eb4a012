"""Compare offline RL with cloning the successful episodes, on data from policies that are wrong most of the time.

python examples/offline_rl.py             # drawer-open and push, about five minutes
python examples/offline_rl.py --steps 20 --episodes 1 --data 6  # a quick test
"""

import argparse
import tempfile
import warnings

import torch
from torchrl.objectives import BCLoss, SoftUpdate

import lw_torchrl as lw
from lw_torchrl.training import fit_normalization

TASKS, GAMMA = ["drawer-open", "push"], 0.99


def collect(root: str, episodes: int) -> list[str]:
    """Collect two datasets: their segments of 8 to 24 steps follow the plan with probability 0.3, or never."""
    for policy in ("noisy-30", "wrong"):
        lw.collect_demonstrations(
            TASKS, episodes_per_task=episodes, root=f"{root}/{policy}", policy=policy, noise_scale=0.3, noise_hold=10
        )
    return [f"{root}/noisy-30", f"{root}/wrong"]


def show(roots: list[str], plans: lw.Plans, **options) -> lw.LanguageWorldExperienceReplay:
    """Open both datasets as one buffer that samples tasks equally; episodes end at their first success."""
    return lw.LanguageWorldExperienceReplay(
        roots,
        label="executed",
        terminate_on_success=True,
        batch_size=100,
        sampler=lw.TaskBalancedSampler(),
        transform=lw.QAFTransform(plans),
        **options,
    )


def train(loss, replay, steps: int, learning_rate: float) -> None:
    """Minimize a loss on a buffer; ``lw.OfflineTrainer`` does the same and also writes checkpoints."""
    targets = SoftUpdate(loss, eps=0.995) if "target_value_network_params" in dict(loss.named_children()) else None
    fit_normalization(loss, replay)  # also sets the statistics of target networks
    optimizer = torch.optim.AdamW([p for p in loss.parameters() if p.requires_grad], lr=learning_rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    for step in range(steps):
        found = loss(replay.sample())
        total = sum(value for name, value in found.items() if name.startswith("loss_"))
        optimizer.zero_grad()
        total.backward()
        optimizer.step()
        schedule.step()
        if targets is not None:
            targets.step()
        if step % 500 == 0:
            print(f"step {step:5}  loss {total.item():.4f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=int, default=20, help="number of episodes per task and dataset")
    parser.add_argument("--steps", type=int, default=3000)
    parser.add_argument("--episodes", type=int, default=20, help="number of evaluation episodes per task")
    args = parser.parse_args()
    torch.manual_seed(0)
    plans = lw.load_plans("MT10")
    warnings.filterwarnings("ignore", message=".*target_actor_network_params")  # BCLoss's own, irrelevant warning

    with tempfile.TemporaryDirectory() as root:
        roots = collect(root, args.data)

        print("training the state value, with 10-step returns")
        rows = show(roots, plans, reward="dense_cost", n_steps=10, gamma=GAMMA)
        value = lw.objectives.ExpectileValueLoss(lw.PlanConditionedValue(plans, ensemble=2), expectile=0.7)
        value.make_value_estimator(gamma=GAMMA)
        train(value, rows, args.steps, 5e-4)
        advantage = torch.cat([value.advantage(rows[i : i + 10_000]) for i in range(0, len(rows), 10_000)])

        print("training a policy on advantage-weighted rows")
        weighted = show(roots, plans, reward="dense_cost")
        weighted.add_column("advantage", lw.objectives.standardize_by_task(advantage, weighted[:]["task_id"]), of=rows)
        ours = lw.PlanConditionedActor(plans)
        train(lw.objectives.AdvantageWeightedLoss(ours, beta=2.0), weighted, args.steps, 1e-3)

        print("training a policy on successful episodes")
        successes = show(roots, plans, keep=lw.data.EpisodeFilter(success=True))
        cloned = lw.PlanConditionedActor(plans)
        train(BCLoss(cloned, loss_function="l2"), successes, args.steps, 1e-3)

    for name, actor in {"advantage-weighted": ours, "successes cloned": cloned}.items():
        found = lw.evaluate(actor, tasks=TASKS, episodes_per_task=args.episodes, seed=1_000, stop_at_success=True)
        print(f"{name}: {found.success_once}")


if __name__ == "__main__":
    main()
