"""On-policy learning with TorchRL's own loss: what was sampled is what is learned from."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDictBase
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import nn
from torchrl.envs import EnvBase, ExplorationType, ParallelEnv, SerialEnv, TransformedEnv, set_exploration_type
from torchrl.modules import IndependentNormal, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import ClipPPOLoss

import lw_torchrl as lw

STEPS = 5


def make_env() -> lw.LanguageWorldEnv:
    return lw.LanguageWorldEnv("reach", num_envs=3, seed=0, max_steps=50, num_threads=1)


def make_transformed() -> TransformedEnv:
    return TransformedEnv(make_env(), lw.QAFTransform(lw.load_plans("MT10")))


ENVS = {
    "plain": make_env,
    "transformed": make_transformed,
    "serial": lambda: SerialEnv(2, make_transformed),
    "parallel": lambda: ParallelEnv(2, make_transformed, mp_start_method="fork"),
    "outside": lambda: TransformedEnv(SerialEnv(2, make_env), lw.QAFTransform(lw.load_plans("MT10"))),
}


def stochastic_actor(distribution: str) -> ProbabilisticActor:
    network = nn.Sequential(nn.Linear(39, 8), NormalParamExtractor())
    options = {"low": -3.0, "high": 3.0} if distribution == "tanh_normal" else {}
    return ProbabilisticActor(
        TensorDictModule(network, in_keys=["observation"], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal if distribution == "tanh_normal" else IndependentNormal,
        distribution_kwargs=options,
        return_log_prob=True,
    )


def sampled(env: EnvBase, actor: ProbabilisticActor) -> tuple[TensorDictBase, torch.Tensor]:
    """A rollout, and the actions as the policy sampled them."""
    kept = []

    def policy(tensordict: TensorDictBase) -> TensorDictBase:
        tensordict = actor(tensordict)
        kept.append(tensordict["action"].clone())
        return tensordict

    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        rollout = env.rollout(STEPS, policy)
    return rollout, torch.stack(kept, -2)


@pytest.mark.filterwarnings("ignore:No explicit `?device")
@pytest.mark.parametrize("distribution", ["normal", "tanh_normal"])
@pytest.mark.parametrize("name", ENVS)
def test_before_an_update_the_ratio_is_one(name, distribution):
    torch.manual_seed(0)
    env = ENVS[name]()
    actor = stochastic_actor(distribution)
    rollout, actions = sampled(env, actor)
    env.close()
    assert torch.equal(rollout["action"], actions)
    outside = actions.abs() > 1
    assert outside.float().mean() > 0.1, "the test says nothing where nothing leaves the range"
    assert torch.equal(rollout["next", "executed_action"], actions.clamp(-1, 1))
    loss = ClipPPOLoss(actor, ValueOperator(nn.Linear(39, 1), in_keys=["observation"]))
    data = rollout.reshape(-1)
    data["advantage"] = torch.randn(*data.batch_size, 1)
    data["value_target"] = torch.randn(*data.batch_size, 1)
    found = loss(data)
    assert found["clip_fraction"] == 0
    assert found["kl_approx"].abs() < 1e-4  # other rows a batch round differently
    torch.testing.assert_close(found["ESS"], torch.tensor(1.0), rtol=1e-5, atol=0)  # of the batch
