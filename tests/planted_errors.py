"""What a user writes, with six mistakes: mypy --strict finds them outside the checkout (test_packaging.py)."""

from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torchrl.envs import TransformedEnv  # type: ignore[import-untyped]

import lw_torchrl as lw
from lw_torchrl.language.relations import RELATIONS, Comparison
from lw_torchrl.modules import METHODS, Features, SkillEncoder

TASKS = ["drawer-open", "reach"]
PLANS = lw.load_plans("MT10")


def train(root: Path) -> lw.PlanConditionedActor:
    lw.collect_demonstrations(TASKS, episodes_per_task=2, root=root, seed=0)
    parts = lw.TaskBalancedSampler(), lw.QAFTransform(PLANS)
    replay = lw.LanguageWorldExperienceReplay(root, batch_size=50, sampler=parts[0], transform=parts[1])
    actor = lw.PlanConditionedActor(PLANS)
    lw.training.fit_normalization(actor, replay)
    optimizer = torch.optim.AdamW(actor.parameters(), lr=1e-3)
    for _ in range(100):
        batch = replay.sample()
        (actor(batch.clone())["action"] - batch["action"]).square().mean().backward()
        optimizer.step()
    return actor


def ask(task: str, text: str) -> str:
    return str(lw.parse_qurey(text, task=task))  # planted


actor = train(Path("runs/demos"))
result = lw.evaluate(actor, tasks=TASKS, episodes_per_task="ten", seed=1_000)  # planted
print(f"{result.mean_sucess:.2f}", ask("reach", "the gripper is open"))  # planted
env = TransformedEnv(lw.LanguageWorldEnv(TASKS, seed=1), lw.modules.transform_of(actor))
print(env.rollout(20, actor.eval())["skill_weights"].shape)
lw.save_actor(actor, "runs/actor.safetensors")


def small(plans: lw.Plans) -> lw.PlanConditionedActor:
    return lw.PlanConditionedActor(plans, skill_encoder=SkillEncoder(64))


class Flat(lw.QueryEvaluator):
    def logits(self, observation: Tensor, task_id: Tensor) -> Tensor:
        return torch.zeros(*task_id.shape, self.plans.num_steps)


class Hand(Features):
    width = 3

    def compute(self, tensordict: Any) -> Tensor:
        hand: Tensor = tensordict["observation"][..., :3]
        return hand


class Texts(Features):
    def compute(self, tensordict: Any) -> list[str]:  # planted
        return ["near"]


METHODS["small"] = small
METHODS["words"] = "my_module:words"
METHODS["linear"] = 64  # planted
RELATIONS["far from"] = (Comparison("xyz", ">", 0.3),)
RELATIONS["near to"] = Comparison("xyz", "<", 0.3)  # planted
features = Hand(0.05, ["observation"])
actor = lw.PlanConditionedActor(PLANS, skill_encoder=SkillEncoder(64), features=features, decoder=nn.Identity())
evaluator = Flat(PLANS)
