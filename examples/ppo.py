"""Improve a cloned policy with TorchRL's PPO loss; actor and value network share a trunk.

python examples/ppo.py               # window-open, two demonstrations, 30 updates: about five minutes
python examples/ppo.py --updates 2   # a quick test
"""

import argparse
import tempfile

import torch
from torchrl.collectors import Collector
from torchrl.envs import TransformedEnv
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

import lw_torchrl as lw
from lw_torchrl.modules import Value

TASK = "window-open"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--updates", type=int, default=30)
    parser.add_argument("--rows", type=int, default=16)
    parser.add_argument("--horizon", type=int, default=200)
    parser.add_argument("--clone", type=int, default=200, help="steps of behavioral cloning before PPO")
    args = parser.parse_args()
    torch.manual_seed(0)
    plans = lw.load_plans("MT10")

    with tempfile.TemporaryDirectory() as root:
        lw.collect_demonstrations(TASK, episodes_per_task=2, root=f"{root}/demos")
        replay = lw.LanguageWorldExperienceReplay(f"{root}/demos", transform=lw.QAFTransform(plans), after_success=20)
        cloned = lw.PlanConditionedActor(plans)
        config = lw.BehavioralCloningConfig(steps=args.clone, batch_size=100)
        lw.BehavioralCloningTrainer(cloned, replay, config).train()
    actor = cloned.stochastic("normal", init_std=0.2)
    value = Value(actor.trunk)

    env = lw.LanguageWorldEnv(TASK, num_envs=args.rows, reward="dense", max_steps=args.horizon)
    env = TransformedEnv(env, lw.QAFTransform(plans))
    frames = args.rows * args.horizon
    collector = Collector(
        env,
        actor,
        frames_per_batch=frames,
        total_frames=args.updates * frames,
        auto_register_policy_transforms=False,
    )
    advantage = GAE(gamma=0.99, lmbda=0.95, value_network=value, average_gae=True)
    loss = ClipPPOLoss(actor, value, entropy_coeff=1e-3)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-4)
    for update, batch in enumerate(collector):
        with torch.no_grad():
            data = advantage(batch).reshape(-1)
        for rows in torch.randperm(len(data)).repeat(3).split(800):
            found = loss(data[rows])
            total = found["loss_objective"] + found["loss_critic"] + found["loss_entropy"]
            optimizer.zero_grad()
            total.backward()
            torch.nn.utils.clip_grad_norm_(loss.parameters(), 1.0)
            optimizer.step()
        collector.update_policy_weights_()
        succeeded = batch["next", "success"].any(1).float().mean()
        print(f"update {update:3}  reward {batch['next', 'reward'].mean():.3f}  succeeded {succeeded:.2f}")
    collector.shutdown()

    print(lw.evaluate(actor, tasks=TASK, episodes_per_task=5, seed=1_000).table())


if __name__ == "__main__":
    main()
