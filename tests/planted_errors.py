"""What a user writes, with three mistakes: mypy --strict finds them outside the checkout (test_packaging.py)."""

from __future__ import annotations

import argparse
from pathlib import Path

import torch
from torchrl.envs import TransformedEnv  # type: ignore[import-untyped]

import lw_torchrl as lw

TASKS = ["drawer-open", "reach"]


def collect(root: Path, episodes: int) -> lw.LanguageWorldExperienceReplay:
    """Demonstrations of the tasks, as a buffer that answers the plans' conditions."""
    plans = lw.load_plans("MT10")
    lw.collect_demonstrations(TASKS, episodes_per_task=episodes, root=root, seed=0)
    return lw.LanguageWorldExperienceReplay(
        root, batch_size=50, sampler=lw.TaskBalancedSampler(), transform=lw.QAFTransform(plans)
    )


def train(replay: lw.LanguageWorldExperienceReplay, steps: int) -> lw.PlanConditionedActor:
    """A policy that has imitated the demonstrations."""
    actor = lw.PlanConditionedActor(lw.load_plans("MT10"))
    lw.training.fit_normalization(actor, replay)
    optimizer = torch.optim.AdamW(actor.parameters(), lr=1e-3)
    for _ in range(steps):
        batch = replay.sample()
        loss = (actor(batch.clone())["action"] - batch["action"]).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return actor


def ask(task: str, text: str) -> str:
    """The canonical spelling of a condition."""
    return str(lw.parse_qurey(text, task=task))  # planted


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("runs"))
    out: Path = parser.parse_args().out
    actor = train(collect(out / "demos", 2), 100)
    result = lw.evaluate(actor, tasks=TASKS, episodes_per_task="ten", seed=1_000)  # planted
    print(f"{result.mean_sucess:.2f}", ask("reach", "the gripper is open"))  # planted
    env = TransformedEnv(lw.LanguageWorldEnv(TASKS, seed=1), lw.modules.transform_of(actor))
    print(env.rollout(20, actor.eval())["skill_weights"].shape)
    lw.save_actor(actor, out / "actor.safetensors")


if __name__ == "__main__":
    main()
