"""Train our actor and critic with TorchRL's TD3 on an environment from another library, gymnasium's FetchReach."""

import argparse

import gymnasium
import gymnasium_robotics
import torch
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import Compose, TransformedEnv
from torchrl.envs.libs.gym import GymEnv
from torchrl.objectives import SoftUpdate, TD3Loss

import lw_torchrl as lw
from lw_torchrl.modules import Concat, ObservationFeatures, RoleFeatures
from lw_torchrl.suites.fetch import load_plans
from lw_torchrl.transforms import SuiteTransform

gymnasium.register_envs(gymnasium_robotics)
PLANS = lw.canonical_plans(lw.Plans([load_plans()["fetch/reach"]]))


def observe(state: torch.Tensor, goal: torch.Tensor) -> torch.Tensor:
    """Convert Fetch's observation to our axes (x right, y away from the robot); values of the absent object are 0."""
    seen = state.new_zeros(*state.shape[:-1], 25)
    for at, place in ((0, state[..., :3]), (22, goal)):
        seen[..., at : at + 3] = torch.stack((0.75 - place[..., 1], place[..., 0] - 0.745, place[..., 2] - 0.377), -1)
    return seen


def act(action: torch.Tensor) -> torch.Tensor:
    return torch.stack((action[..., 1], -action[..., 0], action[..., 2], -action[..., 3]), -1)


def features() -> Concat:
    """Create features: differences of positions, and the target relative to the object that the active step moves."""
    return Concat(ObservationFeatures(layout=PLANS.layout), RoleFeatures(PLANS))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=4_000)
    args = parser.parse_args()
    keys = ["observation", "desired_goal"]
    turned = SuiteTransform(PLANS["fetch/reach"].definition, observe, act=act, in_keys=keys)
    actor = lw.PlanConditionedActor(PLANS, features=features())
    env = TransformedEnv(GymEnv("FetchReachDense-v4"), Compose(turned, lw.QAFTransform(PLANS)))
    critic = lw.PlanConditionedQValue(PLANS, features=features())
    loss = TD3Loss(actor, critic, bounds=(-1.0, 1.0), num_qvalue_nets=2)
    loss.make_value_estimator(gamma=0.9)
    targets, optimizer = SoftUpdate(loss, eps=0.99), torch.optim.AdamW(loss.parameters(), lr=3e-4)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(args.frames), batch_size=128)
    noisy = TensorDictModule(lambda action: (action + 0.2 * torch.randn(4)).clamp(-1, 1), ["action"], ["action"])
    collector = Collector(
        env,
        TensorDictSequential(actor, noisy),
        frames_per_batch=50,
        total_frames=args.frames,
        init_random_frames=500,
        auto_register_policy_transforms=False,
    )
    for number, episode in enumerate(collector):
        buffer.extend(episode)
        for _ in range(50):
            losses = loss(buffer.sample())
            optimizer.zero_grad()
            (losses["loss_actor"] + losses["loss_qvalue"]).backward()
            optimizer.step()
            targets.step()
        if number % 10 == 9:
            print(f"{(number + 1) * 50} steps, return of the last episode {episode['next', 'reward'].sum():.2f}")
    collector.shutdown()


if __name__ == "__main__":
    main()
