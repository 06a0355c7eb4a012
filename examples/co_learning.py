"""Co-learning on your own data: half of each minibatch is your demonstration of a target task, half base tasks.

python examples/co_learning.py            # window-open with two base tasks, about two minutes
python examples/co_learning.py --steps 20 # a quick test
"""

import argparse
import tempfile
import warnings

import torch
from tensordict import TensorDict
from torchrl.data import TensorDictReplayBuffer, TensorStorage
from torchrl.objectives import BCLoss

import lw_torchrl as lw
from lw_torchrl.training import fit_normalization

BASE, TARGET = ["drawer-open", "door-open"], "window-open"


def my_demonstration() -> TensorDict:
    """Return one demonstration; replace this by your own observations (T, 39) and actions (T, 4), or a file of them."""
    env = lw.LanguageWorldEnv(TARGET, seed=7)
    rollout = env.rollout(100, lw.ExpertActor(TARGET))[0]
    env.close()
    return TensorDict(
        {
            "observation": rollout["observation"],
            "action": rollout["action"].clamp(-1, 1),
            "task_id": torch.full((len(rollout),), lw.task_id(TARGET)),
        },
        [len(rollout)],
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--demonstrations", type=int, default=5, help="number of demonstrations per base task")
    parser.add_argument("--episodes", type=int, default=5)
    args = parser.parse_args()
    torch.manual_seed(0)
    plans = lw.load_plans("MT10")

    with tempfile.TemporaryDirectory() as root:
        lw.collect_demonstrations(BASE, episodes_per_task=args.demonstrations, root=root, noise_scale=[0.0, 0.2])
        mine = my_demonstration()
        base = lw.load_demonstrations(root, after_success=20, keys=mine.keys())
        replay = TensorDictReplayBuffer(
            storage=TensorStorage(torch.cat([base, mine])),
            sampler=lw.CoLearningSampler(TARGET),
            transform=lw.QAFTransform(plans),
            batch_size=100,
        )
        actor = lw.PlanConditionedActor(plans)
        fit_normalization(actor, replay)
        warnings.filterwarnings("ignore", message=".*target_actor_network_params")  # BCLoss's own, irrelevant warning
        loss = BCLoss(actor, loss_function="l2")
        optimizer = torch.optim.AdamW(loss.parameters(), lr=1e-3)
        for step in range(args.steps):
            batch = replay.sample()
            value = loss(batch)["loss_bc"]
            optimizer.zero_grad()
            value.backward()
            optimizer.step()
            if step % 100 == 0:
                print(f"step {step:5}  loss {value.item():.4f}  rows of the target {int(batch['is_target'].sum())}")

    print(lw.evaluate(actor, tasks=[TARGET, *BASE], episodes_per_task=args.episodes, seed=1_000).table())


if __name__ == "__main__":
    main()
