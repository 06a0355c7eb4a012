"""Collect experience on several machines with TorchRL's RayCollector; each worker runs different episodes.

pip install 'lw_torchrl[ray]'
python examples/collect_on_ray.py --workers 2 --batches 4
"""

import argparse
from functools import partial

import ray
import torch
from torchrl.collectors.distributed import RayCollector
from torchrl.envs import TransformedEnv

import lw_torchrl as lw

TASKS = ["push", "reach"]


def make_env(worker: tuple[int, int]) -> TransformedEnv:
    env = lw.LanguageWorldEnv(TASKS, max_steps=100, worker=worker)
    return TransformedEnv(env, lw.QAFTransform(lw.load_plans("MT10")))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--batches", type=int, default=4)
    args = parser.parse_args()
    ray.init(num_cpus=args.workers, include_dashboard=False, log_to_driver=False)
    actor = lw.PlanConditionedActor(lw.load_plans("MT10")).stochastic("tanh_normal")
    frames = 100 * len(TASKS)
    collector = RayCollector(
        [partial(make_env, worker=(w, args.workers)) for w in range(args.workers)],
        actor,
        frames_per_batch=frames,
        total_frames=frames * args.batches,
        collector_kwargs={"auto_register_policy_transforms": False},
        remote_configs={"num_cpus": 1, "num_gpus": 0, "memory": 2**30},
    )
    collector.update_policy_weights_()  # send the initial weights to the workers
    for number, batch in enumerate(collector):
        episodes = batch["episode"].unique().tolist()
        print(
            f"batch {number}: {batch.numel()} steps, episodes {episodes}, reward {batch['next', 'reward'].mean():.3f}"
        )
        with torch.no_grad():  # train here, then send the new weights to the workers
            collector.update_policy_weights_()
    collector.shutdown()
    ray.shutdown()


if __name__ == "__main__":
    main()
