"""TD3 with demonstrations: clone a policy from one demonstration, then improve it in its environment.

Each minibatch is half demonstrations, half collected rows. The critics learn from both halves. The actor maximizes the
critics' value on both, and imitates the demonstrated half. Exploration noise grows while the plan makes no progress.

python examples/online/td3_with_demonstrations.py --task hammer   # 60,000 steps: about 10 minutes on one core
"""

import signal
import threading
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torchrl.collectors import Collector
from torchrl.data import OfflineToOnlineReplayBuffer
from torchrl.envs import Compose, InitTracker, TransformedEnv
from torchrl.objectives import SoftUpdate

import lw_torchrl as lw
from lw_torchrl.data import REWARDS, ROLLOUT, n_step_returns
from lw_torchrl.training import fit_normalization


@dataclass
class Args:
    task: str = "hammer"
    seed: int = 0  # seed of the demonstrations; training episodes use seed + 20,000, evaluation seed + 10,000
    start: Path | None = None  # policy file to start from; by default, clone one from the demonstrations
    out: Path = Path("runs/td3_with_demonstrations")  # demonstrations and the trained policy
    demonstrations: int = 1  # episodes of the scripted expert
    cloning_steps: int = 1_500  # minibatches of behavioral cloning
    frames: int = 60_000  # environment steps
    num_envs: int = 20
    rollout: int = 25  # steps of each environment in a batch; n-step returns stop at the end of a batch
    max_steps: int = 250  # steps per episode
    learning_starts: int = 1_000  # environment steps before the first gradient step
    utd: float = 0.4  # gradient steps per environment step
    critic_warm_up: int = 2_000  # gradient steps in which only the critics learn
    batch_size: int = 200
    gamma: float = 0.99
    n_steps: int = 5  # number of steps in an n-step return
    actor_lr: float = 1e-4
    critic_lr: float = 5e-4
    bc_weight: float = 2.0  # weight of the imitation loss
    policy_delay: int = 2  # critic updates per actor update
    policy_noise: float = 0.1  # standard deviation of the noise on the target action
    noise_clip: float = 0.3
    noise: float = 0.05  # standard deviation of the exploration noise
    stuck_noise: float = 0.5  # standard deviation of the hand's noise while the plan makes no progress
    noise_hold: int = 5  # steps for which each draw of the noise is kept
    episodes: int = 40  # evaluation episodes


class PlanNoise(TensorDictModuleBase):
    """Add exploration noise that grows from ``noise`` to ``stuck_noise`` while the plan makes no progress, which means
    that all truth values have been constant for longer than in any demonstration. Noise on the gripper stays small."""

    in_keys, out_keys = ["action", "qaf", "is_init"], ["action"]

    def __init__(self, args: Args, demonstrations: TensorDictBase) -> None:
        super().__init__()
        self.args, self.calls, self.truth, self.unchanged = args, 0, torch.tensor(False), torch.tensor(0.0)
        state = torch.cat([demonstrations["collector", "traj_ids"].unsqueeze(-1), demonstrations["qaf"].long()], -1)
        self.patience = int(state.unique_consecutive(dim=0, return_counts=True)[1].max())

    def forward(self, data: TensorDictBase) -> TensorDictBase:
        if self.calls % self.args.noise_hold == 0:
            self.draw = torch.randn_like(data["action"])
        self.calls += 1
        same = (data["qaf"] == self.truth).all(-1) & ~data["is_init"].squeeze(-1)
        self.truth, self.unchanged = data["qaf"].clone(), torch.where(same, self.unchanged + 1, 0.0)
        stuck = (2 * (self.unchanged - self.patience) / self.patience).clamp(0.0, 1.0).unsqueeze(-1)
        scale = self.args.noise + stuck * (self.args.stuck_noise - self.args.noise)
        scale = torch.cat([scale.expand(-1, 3), torch.full_like(scale, 0.2 * self.args.noise)], -1)
        return data.set("action", (data["action"] + scale * self.draw).clamp(-1.0, 1.0))


def minimize(loss: torch.Tensor, optimizer: torch.optim.Optimizer) -> None:
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()


def main(args: Args) -> None:
    torch.manual_seed(args.seed)
    folder = args.out / f"{args.task}-seed{args.seed}"
    demos = folder / "demonstrations"
    options = {"episodes_per_task": args.demonstrations, "seed": args.seed, "redraw_failures": True}
    lw.collect_demonstrations(args.task, root=demos, **options)

    # Start with behavioral cloning of the demonstrations.
    plans = lw.Plans([lw.load_plans("MT50")[args.task]])
    features = lw.modules.ObservationFeatures(noise=0.1)
    actor = lw.load_actor(args.start) if args.start else lw.PlanConditionedActor(plans, features=features)
    options = {"label": "executed", "terminate_on_success": True, "transform": lw.QAFTransform(actor.plans)}
    demonstrations = lw.LanguageWorldExperienceReplay(demos, **options)
    if args.start is None:
        config = lw.BehavioralCloningConfig(args.cloning_steps, args.batch_size, seed=args.seed)
        lw.BehavioralCloningTrainer(actor, demonstrations, config).train()
    actor.eval()

    # Half of each minibatch is demonstrations, half collected rows. The reward is a cost per step until success.
    torch.manual_seed(20_000 + args.seed)
    options |= {"reward": "dense_cost", "n_steps": args.n_steps, "gamma": args.gamma}
    options |= {"keys": [*ROLLOUT, "steps_to_next_obs", "is_demonstration"], "transform": lw.QAFTransform(actor.plans)}
    offline = lw.LanguageWorldExperienceReplay(demos, **options)
    replay = OfflineToOnlineReplayBuffer(offline, online_capacity=args.frames, batch_size=args.batch_size)
    keys = list(offline.sample(1).keys(True, True))
    critic = lw.PlanConditionedQValue(actor.plans).eval()
    fit_normalization(critic, demonstrations)
    options = {"policy_noise": args.policy_noise, "noise_clip": args.noise_clip, "bc_weight": args.bc_weight}
    loss = lw.objectives.DemonstratedTD3Loss(actor, critic, bounds=(-1.0, 1.0), loss_function="l1", **options)
    loss.make_value_estimator(gamma=args.gamma)
    targets = SoftUpdate(loss, eps=0.995)
    actor_optimizer = torch.optim.AdamW(loss.actor_network_params.parameters(), lr=args.actor_lr)
    critic_optimizer = torch.optim.AdamW(loss.qvalue_network_params.parameters(), lr=args.critic_lr)

    episodes = {"max_steps": args.max_steps, "terminate_on_success": True, "seed": 20_000 + args.seed}
    env = lw.LanguageWorldEnv(args.task, num_envs=args.num_envs, reward="dense", **episodes)
    collector = Collector(
        TransformedEnv(env, Compose(lw.QAFTransform(actor.plans), InitTracker())),
        TensorDictSequential(actor, PlanNoise(args, demonstrations[:])),
        frames_per_batch=args.rollout * args.num_envs,
        total_frames=args.frames,
        auto_register_policy_transforms=False,
    )
    stop = threading.Event()  # Ctrl-C ends training between two gradient steps
    handler = signal.signal(signal.SIGINT, lambda *_: stop.set())
    frames = ended = succeeded = step = 0
    for iteration, rows in enumerate(collector, 1):
        cost = REWARDS["dense_cost"].of(rows["next", "reward"], rows["next", "success"])
        ahead = n_step_returns(rows.set(("next", "reward"), cost), args.n_steps, args.gamma)
        ahead["is_demonstration"] = torch.zeros(ahead.shape, dtype=torch.bool)
        replay.extend(ahead.reshape(-1).select(*keys))
        frames += rows.numel()
        ended += int(rows["next", "done"].sum())
        succeeded += int(rows["next", "success"].sum())
        while step < int((frames - args.learning_starts) * args.utd) and not stop.is_set():
            batch = replay.sample()
            minimize(loss.qvalue_loss(batch)[0], critic_optimizer)
            if step >= args.critic_warm_up and step % args.policy_delay == 0:
                minimize(loss.actor_loss(batch)[0], actor_optimizer)
            targets.step()
            step += 1
        if iteration % 10 == 0 or frames >= args.frames:
            print(f"step {frames:6}/{args.frames}: {succeeded} of {ended} episodes succeeded", flush=True)
            ended = succeeded = 0
        if stop.is_set():
            break
    collector.shutdown()
    signal.signal(signal.SIGINT, handler)

    lw.save_actor(actor, folder / "policy.safetensors")
    print(f"saved {folder / 'policy.safetensors'}")
    if not stop.is_set():
        options = {"episodes_per_task": args.episodes, "seed": 10_000 + args.seed, "stop_at_success": True}
        result = lw.evaluate(actor, tasks=args.task, **options)
        print(f"{args.task}: success {result.mean_success:.3f} in {args.episodes} episodes")


if __name__ == "__main__":
    try:
        main(tyro.cli(Args))
    except KeyboardInterrupt:
        raise SystemExit(130) from None
