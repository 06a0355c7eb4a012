"""TD3 from one demonstration, by hand: a collector, 1:1 minibatches, a loss that imitates the demonstrated half.

python examples/online_from_demonstrations.py               # hammer, 60,000 steps: about five minutes
python examples/online_from_demonstrations.py --frames 200  # only to see it run
"""

import argparse
import tempfile

import torch
from tensordict.nn import TensorDictSequential
from torchrl.collectors import Collector
from torchrl.envs import TransformedEnv
from torchrl.modules import AdditiveGaussianModule
from torchrl.objectives import SoftUpdate

import lw_torchrl as lw

TASK, ROWS, GAMMA = "hammer", 20, 0.99


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=60_000)
    parser.add_argument("--clone", type=int, default=1_500, help="steps of behavioral cloning before")
    parser.add_argument("--episodes", type=int, default=20)
    args = parser.parse_args()
    torch.manual_seed(0)
    plans = lw.Plans([lw.load_plans("MT50")[TASK]])
    actor = lw.PlanConditionedActor(plans, feature_noise=0.1)
    critic = lw.PlanConditionedQValue(plans)

    root = tempfile.TemporaryDirectory()
    lw.collect_demonstrations(TASK, episodes_per_task=1, root=f"{root.name}/demos", redraw_failures=True)
    ends = {"label": "executed", "terminate_on_success": True}  # demonstrations end where the environment does
    demonstrations = lw.LanguageWorldExperienceReplay(f"{root.name}/demos", transform=actor.transform(), **ends)
    config = lw.BehavioralCloningConfig(steps=args.clone, batch_size=50)
    lw.BehavioralCloningTrainer(actor, demonstrations, config).train()
    critic.fit_normalization(demonstrations[:]["observation"])

    # Each minibatch is half of demonstrations, half of what came; the reward is a cost that ends at success.
    replay = lw.LanguageWorldExperienceReplay(
        f"{root.name}/demos",
        reward="dense_cost",
        n_steps=5,
        gamma=GAMMA,
        grow=args.frames,
        batch_size=200,
        sampler=lw.CoLearningSampler("grown"),
        transform=actor.transform(),
        **ends,
    )
    loss = lw.objectives.DemonstratedTD3Loss(
        actor, critic, bounds=(-1.0, 1.0), policy_noise=0.1, noise_clip=0.3, bc_weight=2.0
    )
    loss.make_value_estimator(gamma=GAMMA)
    targets = SoftUpdate(loss, eps=0.995)
    of_actor = torch.optim.AdamW(loss.actor_network_params.parameters(), lr=1e-4)
    of_critic = torch.optim.AdamW(loss.qvalue_network_params.parameters(), lr=5e-4)

    env = lw.LanguageWorldEnv(TASK, num_envs=ROWS, seed=1, reward="dense", terminate_on_success=True, max_steps=250)
    noise = AdditiveGaussianModule(actor.spec, sigma_init=0.15, sigma_end=0.15)
    collector = Collector(
        TransformedEnv(env, actor.transform()),
        TensorDictSequential(actor, noise),
        frames_per_batch=5 * ROWS,
        total_frames=args.frames,
        auto_register_policy_transforms=False,
    )
    ended = succeeded = step = 0
    for number, rows in enumerate(collector):
        replay.extend(rows)
        ended += int(rows["next", "done"].sum())
        succeeded += int(rows["next", "success"].sum())
        for _ in range(20):  # 0.2 gradient steps for each step of the environment
            batch, step = replay.sample(), step + 1
            of_critic.zero_grad()
            loss.qvalue_loss(batch)[0].backward()
            of_critic.step()
            if step > 400 and step % 2 == 0:  # the critics come first
                of_actor.zero_grad()
                loss.actor_loss(batch)[0].backward()
                of_actor.step()
            targets.step()
        if number % 50 == 49 or args.frames < 1_000:
            print(f"step {(number + 1) * 5 * ROWS:6}  {succeeded} of {ended} episodes succeeded", flush=True)
            ended = succeeded = 0
    collector.shutdown()
    print(lw.evaluate(actor.eval(), tasks=TASK, episodes_per_task=args.episodes, seed=1_000).table())


if __name__ == "__main__":
    main()
