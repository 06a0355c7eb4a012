"""Expert iteration: clone a policy from one demonstration, then repeatedly from its own successes.

In each round, every environment runs one or more episodes. Successful episodes are added to the buffer, and each
minibatch is half demonstrations, half successes. Exploration noise grows while the plan makes no progress.

python examples/online/expert_iteration.py --task hammer   # 60,000 steps: about 4 minutes on one core
"""

import signal
import threading
import warnings
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torchrl.collectors import Collector
from torchrl.data import OfflineToOnlineReplayBuffer
from torchrl.envs import Compose, InitTracker, TransformedEnv
from torchrl.objectives import BCLoss

import lw_torchrl as lw


@dataclass
class Args:
    task: str = "hammer"
    seed: int = 0  # seed of the demonstrations; training episodes use seed + 20,000, evaluation seed + 10,000
    start: Path | None = None  # policy file to start from; by default, clone one from the demonstrations
    out: Path = Path("runs/expert_iteration")  # demonstrations and the trained policy
    demonstrations: int = 1  # episodes of the scripted expert
    cloning_steps: int = 1_500  # minibatches of behavioral cloning
    frames: int = 60_000  # environment steps
    num_envs: int = 20
    max_steps: int = 250  # steps per episode
    learning_starts: int = 1_000  # environment steps before the first gradient step
    utd: float = 0.4  # gradient steps per environment step
    batch_size: int = 200
    learning_rate: float = 3e-4
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

    # The buffer holds demonstrations and the policy's own successful episodes.
    torch.manual_seed(20_000 + args.seed)
    options |= {"keys": ["observation", "task_id", "action"], "transform": lw.QAFTransform(actor.plans)}
    offline = lw.LanguageWorldExperienceReplay(demos, **options)
    replay = OfflineToOnlineReplayBuffer(offline, online_capacity=args.frames, batch_size=args.batch_size)
    keys = list(offline.sample(1).keys())
    warnings.filterwarnings("ignore", message=".*target_actor_network_params")  # BCLoss's own, irrelevant warning
    loss = BCLoss(actor.train(), loss_function="l1")  # the loss uses train mode, with noise on the features
    actor.eval()  # the collector acts in eval mode, without this noise
    optimizer = torch.optim.AdamW(loss.parameters(), lr=args.learning_rate)

    episodes = {"max_steps": args.max_steps, "terminate_on_success": True, "seed": 20_000 + args.seed}
    env = lw.LanguageWorldEnv(args.task, num_envs=args.num_envs, **episodes)
    collector = Collector(
        TransformedEnv(env, Compose(lw.QAFTransform(actor.plans), InitTracker())),
        TensorDictSequential(actor, PlanNoise(args, demonstrations[:])),
        frames_per_batch=args.max_steps * args.num_envs,  # one round
        total_frames=args.frames,
        reset_at_each_iter=True,
        auto_register_policy_transforms=False,
    )
    stop = threading.Event()  # Ctrl-C ends training between two gradient steps
    handler = signal.signal(signal.SIGINT, lambda *_: stop.set())
    frames = step = 0
    for rows in collector:
        frames += rows.numel()
        ids, success = rows["collector", "traj_ids"], rows["next", "success"].squeeze(-1)
        successful = torch.isin(ids, ids[success])
        if successful.any():
            replay.extend(rows[successful].select(*keys))
        due = int(max(0, frames - args.learning_starts) * args.utd)
        if len(replay) == len(demonstrations):  # no episode has succeeded yet
            step = due
        while step < due and not stop.is_set():
            bc_loss = loss(replay.sample())["loss_bc"]
            optimizer.zero_grad()
            bc_loss.backward()
            optimizer.step()
            step += 1
        ended = int(rows["next", "done"].sum())
        print(f"step {frames:6}/{args.frames}: {int(success.sum())} of {ended} episodes succeeded", flush=True)
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
