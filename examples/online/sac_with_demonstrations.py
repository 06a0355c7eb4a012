"""SAC with demonstrations: clone a policy from one demonstration, then improve it in its environment.

Each minibatch is half demonstrations, half collected rows. The critics learn from both halves. The actor maximizes the
critics' value on both, and the mode of its distribution imitates the demonstrated half.

python examples/online/sac_with_demonstrations.py --task hammer   # 60,000 steps: about 10 minutes on one core
"""

import signal
import threading
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from torchrl.collectors import Collector
from torchrl.data import OfflineToOnlineReplayBuffer
from torchrl.envs import TransformedEnv
from torchrl.objectives import SoftUpdate

import lw_torchrl as lw
from lw_torchrl.data import REWARDS, ROLLOUT, n_step_returns
from lw_torchrl.training import fit_normalization


@dataclass
class Args:
    task: str = "hammer"
    seed: int = 0  # seed of the demonstrations; training episodes use seed + 20,000, evaluation seed + 10,000
    start: Path | None = None  # policy file to start from; by default, clone one from the demonstrations
    out: Path = Path("runs/sac_with_demonstrations")  # demonstrations and the trained policy
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
    init_std: float = 0.15  # standard deviation of the policy at the start
    alpha: float = 1e-3  # weight of the entropy at the start
    episodes: int = 40  # evaluation episodes


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

    # Half of each minibatch is demonstrations, half collected rows. The reward is a cost per step until success.
    torch.manual_seed(20_000 + args.seed)
    options |= {"reward": "dense_cost", "n_steps": args.n_steps, "gamma": args.gamma}
    options |= {"keys": [*ROLLOUT, "steps_to_next_obs", "is_demonstration"], "transform": lw.QAFTransform(actor.plans)}
    offline = lw.LanguageWorldExperienceReplay(demos, **options)
    replay = OfflineToOnlineReplayBuffer(offline, online_capacity=args.frames, batch_size=args.batch_size)
    keys = list(offline.sample(1).keys(True, True))
    critic = lw.PlanConditionedQValue(actor.plans).eval()
    fit_normalization(critic, demonstrations)
    actor = actor.stochastic("tanh_normal", args.init_std).eval()
    options = {"bc_weight": args.bc_weight, "alpha_init": args.alpha}
    loss = lw.objectives.DemonstratedSACLoss(actor, critic, loss_function="l1", **options)
    loss.make_value_estimator(gamma=args.gamma)
    targets = SoftUpdate(loss, eps=0.995)
    actor_optimizer = torch.optim.AdamW(loss.actor_network_params.parameters(), lr=args.actor_lr)
    critic_optimizer = torch.optim.AdamW(loss.qvalue_network_params.parameters(), lr=args.critic_lr)
    alpha_optimizer = torch.optim.AdamW([loss.log_alpha], lr=args.actor_lr)

    episodes = {"max_steps": args.max_steps, "terminate_on_success": True, "seed": 20_000 + args.seed}
    env = lw.LanguageWorldEnv(args.task, num_envs=args.num_envs, reward="dense", **episodes)
    collector = Collector(
        TransformedEnv(env, lw.QAFTransform(actor.plans)),
        actor,
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
            losses = loss(batch)
            if step >= args.critic_warm_up:
                minimize(losses["loss_actor"], actor_optimizer)
                minimize(losses["loss_alpha"], alpha_optimizer)
            minimize(losses["loss_qvalue"], critic_optimizer)
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
