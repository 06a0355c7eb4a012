"""Record a training run with Rerun: grouped loss curves, the policy's skills and actions, and whole rollouts.

python examples/rerun_training.py                          # drawer-open and window-open, about two minutes
python examples/rerun_training.py --connect 127.0.0.1:9876 # the same, live in a viewer that you start with `rerun`
python examples/rerun_training.py --steps 20               # a quick test
lw-torchrl view runs/rerun_training                        # show the recording, during or after training
"""

import argparse
import tempfile
import time
import warnings
from pathlib import Path

import torch
from torchrl.envs import TransformedEnv
from torchrl.objectives import BCLoss

import lw_torchrl as lw
from lw_torchrl.training import fit_normalization

TASKS = ["drawer-open", "window-open"]
SEED = 1_000


def show(logger, env, actor, plans, step, length) -> None:
    """Run and log one rollout of each task: success, the share of each skill, actions, and the episodes themselves."""
    with torch.no_grad():
        rollout = env.rollout(length, actor.eval())
    actor.train()
    success = rollout["next", "success"].any(-2).flatten()
    for task, done in zip(TASKS, success.tolist(), strict=True):
        logger.log_scalar(f"success/{task}", done, step=step)
    logger.log_scalar("success/mean", success.float().mean(), step=step)
    logger.log_scalar("skills/share of steps", rollout["skill_weights"].mean((0, 1)), step=step)
    logger.log_histogram("action", rollout["action"], step=step)
    for row, task in enumerate(TASKS):
        lw.log_rollout(logger, rollout[row], plans, seed=SEED, policy=f"step {step}", name=f"{task} after {step}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--demonstrations", type=int, default=5)
    parser.add_argument("--rollouts", type=int, default=4, help="number of times to record rollouts")
    parser.add_argument("--length", type=int, default=150, help="number of steps per rollout")
    parser.add_argument("--out", default="runs/rerun_training/training.rrd")
    parser.add_argument("--connect", help="address of a running viewer")
    args = parser.parse_args()
    torch.manual_seed(0)
    plans = lw.load_plans("MT10")

    with tempfile.TemporaryDirectory() as root:
        lw.collect_demonstrations(
            TASKS,
            episodes_per_task=args.demonstrations,
            root=f"{root}/demos",
            noise_scale=[0.0, 0.1, 0.2],
            redraw_failures=True,
        )
        replay = lw.LanguageWorldExperienceReplay(
            f"{root}/demos",
            batch_size=100,
            sampler=lw.TaskBalancedSampler(),
            transform=lw.QAFTransform(plans),
            after_success=20,
        )
        actor = lw.PlanConditionedActor(plans)
        fit_normalization(actor, replay)
        warnings.filterwarnings("ignore", message=".*target_actor_network_params")  # BCLoss's own, irrelevant warning
        loss = BCLoss(actor, loss_function="l2")
        optimizer = torch.optim.AdamW(loss.parameters(), lr=1e-3)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, args.steps)
        env = TransformedEnv(lw.LanguageWorldEnv(TASKS, seed=SEED), lw.QAFTransform(plans))

        with lw.RerunLogger(args.out, connect=args.connect, exp_name=Path(args.out).parent.name) as logger:
            logger.log_hparams(vars(args) | {"optimizer": {"name": "AdamW", "lr": 1e-3}})
            began = time.perf_counter()
            for step in range(args.steps):
                value = loss(replay.sample())["loss_bc"]
                optimizer.zero_grad()
                value.backward()
                size = torch.nn.utils.clip_grad_norm_(loss.parameters(), 10.0)
                optimizer.step()
                schedule.step()
                if step % 10 == 0:
                    speed = (step + 1) / (time.perf_counter() - began)
                    logger.log_metrics({"loss/bc": value, "gradient/norm": size, "speed/steps a second": speed}, step)
                if (step + 1) % max(1, args.steps // args.rollouts) == 0:
                    show(logger, env, actor, plans, step + 1, args.length)
                    print(f"step {step + 1:5}  loss {value.item():.4f}")
        env.close()
    print(f"lw-torchrl view {logger.path}")


if __name__ == "__main__":
    main()
