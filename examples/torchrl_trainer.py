"""Train a policy for reach from scratch, with PPO in TorchRL's Trainer and its collector, buffer, hooks and logger.

python examples/torchrl_trainer.py             # 60 updates of 1,600 steps, about two minutes
python examples/torchrl_trainer.py --updates 2 # a quick test
"""

import argparse

import torch
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, SamplerWithoutReplacement, TensorDictReplayBuffer
from torchrl.envs import TransformedEnv
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE
from torchrl.record.loggers import CSVLogger
from torchrl.trainers import DefaultOptimizationStepper, LogScalar, ReplayBufferTrainer, Trainer

import lw_torchrl as lw

TASK = "reach"


class Stepper(DefaultOptimizationStepper):
    """TorchRL's stepper with detached losses; otherwise the Trainer's log would keep all autograd graphs in memory."""

    def step(self, trainer, sub_batch):
        return super().step(trainer, sub_batch).detach()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, default in (("updates", 60), ("rows", 16), ("horizon", 100)):
        parser.add_argument(f"--{name}", type=int, default=default)
    args = parser.parse_args()
    torch.manual_seed(0)
    frames = args.rows * args.horizon

    actor = lw.PlanConditionedActor(lw.load_plans("MT10")).stochastic("normal", init_std=0.5)
    value = lw.modules.Value(actor.trunk)
    env = lw.LanguageWorldEnv(TASK, num_envs=args.rows, reward="dense", max_steps=args.horizon)
    collector = Collector(
        TransformedEnv(env, lw.QAFTransform(actor.plans)),
        actor,
        frames_per_batch=frames,
        total_frames=args.updates * frames,
        auto_register_policy_transforms=False,
    )
    loss = ClipPPOLoss(actor, value, entropy_coeff=1e-3)
    trainer = Trainer(
        collector=collector,
        total_frames=args.updates * frames,
        frame_skip=1,
        loss_module=loss,
        optimizer=torch.optim.Adam(loss.parameters(), lr=3e-4),
        optimization_stepper=Stepper(),
        optim_steps_per_batch=16,
        clip_norm=1.0,
        logger=CSVLogger("ppo", log_dir="runs/torchrl_trainer"),
        log_interval=frames - 1,  # the Trainer logs after more than this many frames, so after every update
        progress_bar=False,
    )
    # Compute the advantage before the buffer flattens the batch: GAE would treat flattened rows as one long episode.
    advantage = GAE(gamma=0.99, lmbda=0.95, value_network=value, average_gae=True)
    trainer.register_op("batch_process", torch.no_grad()(advantage))
    # The buffer holds one update: new rows replace the old ones, whose log-probabilities are those of an older policy.
    rows = LazyTensorStorage(frames)
    buffer = TensorDictReplayBuffer(storage=rows, sampler=SamplerWithoutReplacement(), batch_size=frames // 4)
    replay = ReplayBufferTrainer(buffer, flatten_tensordicts=True)
    trainer.register_op("batch_process", replay.extend)
    trainer.register_op("process_optim_batch", replay.sample)
    LogScalar(("next", "reward"), "reward", include_std=False).register(trainer)
    LogScalar(("next", "success"), "success", include_std=False).register(trainer)
    trainer.train()
    print("mean reward of each update:", *(f"{reward:.2f}" for reward in trainer._log_dict["reward"]))
    lw.save_actor(actor, "runs/torchrl_trainer/policy.safetensors")  # the Trainer's own files do not contain the plans
    print(lw.evaluate(actor, tasks=TASK, episodes_per_task=5, seed=1_000, progress=False).table())


if __name__ == "__main__":
    main()
