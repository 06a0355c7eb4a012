"""Plan Conditioned Behavioral Cloning without a trainer: a training loop with TorchRL's loss and replay buffer.

python examples/train_bc.py            # drawer-open and window-open, about two minutes
python examples/train_bc.py --steps 50 # a quick test
"""

import argparse
import tempfile
import warnings

import torch
from torchrl.envs import TransformedEnv
from torchrl.objectives import BCLoss

import lw_torchrl as lw

TASKS = ["drawer-open", "window-open"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--demonstrations", type=int, default=5)
    parser.add_argument("--episodes", type=int, default=5)
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
        lw.training.fit_normalization(actor, replay)
        warnings.filterwarnings("ignore", message=".*target_actor_network_params")  # BCLoss's own, irrelevant warning
        loss = BCLoss(actor, loss_function="l2")
        optimizer = torch.optim.AdamW(loss.parameters(), lr=1e-3)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, args.steps)
        for step in range(args.steps):
            value = loss(replay.sample())["loss_bc"]
            optimizer.zero_grad()
            value.backward()
            optimizer.step()
            schedule.step()
            if step % 100 == 0:
                print(f"step {step:5}  loss {value.item():.4f}")

    result = lw.evaluate(actor, tasks=TASKS, episodes_per_task=args.episodes, seed=1_000)
    print(result.table())

    env = TransformedEnv(lw.LanguageWorldEnv(TASKS, seed=1_000), lw.QAFTransform(plans))
    with torch.no_grad():
        rollout = env.rollout(100, actor.eval())
    for row, task in enumerate(TASKS):
        led = rollout["skill_weights"][row].argmax(-1).unique_consecutive().tolist()
        print(f"{task}: " + " > ".join(plans[task].steps[step].skill for step in led))
    env.close()


if __name__ == "__main__":
    main()
