"""A policy acts on an environment's fake data, which TorchRL makes to find out what it writes."""

from __future__ import annotations

import pytest
import torch
from torchrl.collectors import Collector
from torchrl.envs import ParallelEnv, SerialEnv, StepCounter, TransformedEnv, UnsqueezeTransform
from torchrl.envs.utils import check_env_specs

import lw_torchrl as lw

PLANS = lw.load_plans("MT10")


def make(tasks=("push", "reach")):
    return TransformedEnv(lw.LanguageWorldEnv(tasks, num_envs=3), lw.QAFTransform(PLANS))


MAKERS = {
    "one": make,
    "counted": lambda: make().append_transform(StepCounter()),
    "serial": lambda: SerialEnv(2, make),
    "serial of different tasks": lambda: SerialEnv(2, [make, lambda: make(("door-open", "drawer-close", "push"))]),
    "parallel": lambda: ParallelEnv(2, make, mp_start_method="fork"),
}


@pytest.mark.parametrize("name", MAKERS)
@pytest.mark.parametrize(
    "policy",
    [lw.PlanConditionedActor, lw.ScriptedSkillActor, lambda plans: lw.DescriptorConditionedActor(tuple(plans))],
    ids=["plan", "scripted", "description"],
)
@pytest.mark.slow
def test_a_policy_acts_on_fake_data(name, policy):
    env = MAKERS[name]()
    fake = env.fake_tensordict()
    assert policy(PLANS)(fake)["action"].shape == (*env.batch_size, 4)
    if name == "one":
        assert fake["task_id"].tolist() == [lw.task_id(task) for task in ("push", "reach", "push")]
        assert torch.equal(fake["task_id"], fake["next", "task_id"])
    check_env_specs(env)
    env.close()


def test_a_transform_may_change_the_shape_of_task_id():
    """TorchRL's transforms assign a spec's shape; Collector and ParallelEnv act on the fake data."""
    base = lw.LanguageWorldEnv(["push", "reach"], num_envs=3)
    env = TransformedEnv(base, UnsqueezeTransform(-1, in_keys=["task_id"], out_keys=["column"]))
    ids = base.observation_spec["task_id"].zero()
    assert torch.equal(env.fake_tensordict()["column"], ids.unsqueeze(-1))
    check_env_specs(env)
    spec = env.observation_spec["column"]
    assert torch.equal(spec.expand(2, 3, 1).zero(), ids.reshape(3, 1).expand(2, 3, 1))
    collector = Collector(env, frames_per_batch=6, total_frames=6, trajs_per_batch=None)
    assert [batch["column"].shape for batch in collector] == [(3, 2, 1)]
    collector.shutdown()


def test_the_ids_follow_every_change_of_shape():
    spec = make().observation_spec["task_id"]
    ids = spec.zero()
    assert torch.equal(spec.clone().zero(), ids)
    assert torch.equal(spec.expand(2, 3).zero(), ids.expand(2, 3))
    assert torch.equal(spec.unsqueeze(0).zero(), ids.unsqueeze(0))
    assert torch.equal(spec.unsqueeze(0).squeeze(0).zero(), ids)
    assert torch.equal(spec[1:].zero(), ids[1:])
    assert torch.equal(spec.reshape(3, 1).zero(), ids.reshape(3, 1))
    assert torch.equal(spec.unflatten(0, (3, 1)).zero(), ids.reshape(3, 1))
    assert torch.equal(spec.to("cpu").zero(), ids)
    assert torch.equal(spec.zero((2,)), ids.expand(2, 3))
