"""PPO in TorchRL's own Trainer, with its collector, replay buffer, hooks and logger: reach, from nothing.

python examples/torchrl_trainer.py             # 60 updates of 1,600 steps, about two minutes
python examples/torchrl_trainer.py --updates 2 # only to see it run
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
    """TorchRL's own gives losses with their graphs, which Trainer's log would keep for ever."""

    def step(self, trainer, sub_batch):
        return super().step(trainer, sub_batch).detach()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--updates", type=int, default=60)
    parser.add_argument("--rows", type=int, default=16)
    parser.add_argument("--horizon", type=int, default=100)
    args = parser.parse_args()
    torch.manual_seed(0)
    frames = args.rows * args.horizon

    plans = lw.load_plans("MT10")
    actor = lw.PlanConditionedActor(plans).stochastic("normal", init_std=0.5)
    value = lw.modules.Value(actor.trunk)
    env = lw.LanguageWorldEnv(TASK, num_envs=args.rows, reward="dense", max_steps=args.horizon)
    collector = Collector(
        TransformedEnv(env, lw.QAFTransform(plans)),
        actor,
        frames_per_batch=frames,
        total_frames=args.updates * frames,
        auto_register_policy_transforms=False,  # the environment has the transform already
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
        log_interval=frames - 1,  # more than so many frames lie between two lines: every update
        progress_bar=False,
    )
    # The advantage comes first, while rows and steps are two dimensions: flattened, all rows would be one long episode.
    advantage = GAE(gamma=0.99, lmbda=0.95, value_network=value, average_gae=True)
    trainer.register_op("batch_process", torch.no_grad()(advantage))
    # As many rows as an update collects: each update's replace the last one's, whose likelihoods are another policy's.
    rows = LazyTensorStorage(frames)
    buffer = TensorDictReplayBuffer(storage=rows, sampler=SamplerWithoutReplacement(), batch_size=frames // 4)
    replay = ReplayBufferTrainer(buffer, flatten_tensordicts=True)
    trainer.register_op("batch_process", replay.extend)
    trainer.register_op("process_optim_batch", replay.sample)
    LogScalar(("next", "reward"), "reward", include_std=False).register(trainer)
    LogScalar(("next", "success"), "success", include_std=False).register(trainer)
    trainer.train()
    print("mean reward of each update:", *(f"{reward:.2f}" for reward in trainer._log_dict["reward"]))
    lw.save_actor(actor, "runs/torchrl_trainer/policy.safetensors")  # Trainer's own files do not hold the plans
    print(lw.evaluate(actor, tasks=TASK, episodes_per_task=5, seed=1_000, progress=False).table())


if __name__ == "__main__":
    main()
