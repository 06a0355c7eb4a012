"""Every loss of TorchRL with our actors and critics, without adapters or patches."""

import copy
import os
import warnings
from functools import partial

import pytest
import torch
from tensordict import TensorDict
from torchrl import objectives as o
from torchrl.envs import ExplorationType, TransformedEnv, set_exploration_type
from torchrl.objectives.value import GAE

import lw_torchrl as lw
from lw_torchrl._util.devices import device_of
from lw_torchrl.modules import MLPDecoder, ObservationFeatures, QValue, Value, descriptor_trunk, plan_trunk
from lw_torchrl.objectives import with_n_steps

PLANS = lw.load_plans("MT10")
SMALL = dict(width=16, depth=1)
BOUNDS = {"bounds": (-torch.ones(4), torch.ones(4))}
quantiles = lambda q: QValue(q.trunk, quantiles=5, **SMALL).to(device_of(q))  # noqa: E731
DETERMINISTIC = {
    "BC": lambda actor, q, v: o.BCLoss(actor),
    "DDPG": lambda actor, q, v: o.DDPGLoss(actor, q),
    "TD3": lambda actor, q, v: o.TD3Loss(actor, q, **BOUNDS),
    "TD3+BC": lambda actor, q, v: o.TD3BCLoss(actor, q, **BOUNDS),
    "demonstrated TD3": lambda actor, q, v: lw.objectives.DemonstratedTD3Loss(actor, q, **BOUNDS),
}
STOCHASTIC = {
    "BC, likelihood": lambda actor, q, v: o.BCLoss(actor),
    "DT": lambda actor, q, v: o.DTLoss(actor),
    "online DT": lambda actor, q, v: o.OnlineDTLoss(actor),
    "SAC": lambda actor, q, v: o.SACLoss(actor, q),
    "demonstrated SAC": lambda actor, q, v: lw.objectives.DemonstratedSACLoss(actor, q),
    "REDQ": lambda actor, q, v: o.REDQLoss(actor, q),
    "CrossQ": lambda actor, q, v: o.CrossQLoss(actor, q),
    "IQL": lambda actor, q, v: o.IQLLoss(actor, q, v),
    "CQL": lambda actor, q, v: o.CQLLoss(actor, q, action_spec=actor.spec["action"]),
    "TQC": lambda actor, q, v: o.TQCLoss(actor, quantiles(q), num_qvalue_nets=2),
}
ON_POLICY = {
    "A2C": lambda actor, q, v: o.A2CLoss(actor, v),
    "Reinforce": lambda actor, q, v: o.ReinforceLoss(actor, v),
    "PPO": lambda actor, q, v: o.ClipPPOLoss(actor, v),
    "PPO, KL": lambda actor, q, v: o.KLPENPPOLoss(actor, v),
}
LOSSES = DETERMINISTIC | STOCHASTIC | ON_POLICY
CONDITIONS = ("plan", "description", "one-hot")


def make_actor(condition, distribution=None, noise=0.05, **options):
    parts = {"decoder": MLPDecoder(**SMALL), "features": ObservationFeatures(noise=noise), **options}
    kind = partial(lw.modules.DescriptorConditionedActor, condition=condition)
    actor = lw.PlanConditionedActor(PLANS, **parts) if condition == "plan" else kind("MT10", **parts)
    return actor if distribution is None else actor.stochastic(distribution)


def make_trunk(condition, noise=0.0):
    features = ObservationFeatures(noise=noise)
    if condition == "plan":
        return plan_trunk(PLANS, features=features)
    return descriptor_trunk("MT10", condition=condition, features=features)


def make_loss(name, condition, distribution="tanh_normal", seed=0, device="cpu", **noise):
    torch.manual_seed(seed)
    actor = make_actor(condition, None if name in DETERMINISTIC else distribution, **noise)
    q = QValue(make_trunk(condition, **noise), **SMALL)
    v = Value(make_trunk(condition, **noise), **SMALL)
    for network in (actor, q, v):
        network.to(device)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*target_actor_network_params.*")  # BCLoss about itself
        loss = LOSSES[name](actor, q, v)
    if name not in ("BC", "BC, likelihood", "DT", "online DT"):
        loss.make_value_estimator(gamma=0.9)
    if name in ("DDPG", "TD3", "TD3+BC", "SAC", "REDQ", "IQL", "CQL", "TQC", "demonstrated TD3", "demonstrated SAC"):
        o.SoftUpdate(loss, eps=0.9)
    return loss, actor, v


def make_batch(rows=24, seed=0):
    generator = torch.Generator().manual_seed(seed)
    ids = torch.tensor([lw.task_id(task) for task in PLANS])[torch.randint(10, (rows,), generator=generator)]
    flag = torch.zeros(rows, 1, dtype=torch.bool)

    def state(**more):
        return TensorDict(observation=torch.rand(rows, 39, generator=generator), task_id=ids, **more)

    following = state(reward=torch.rand(rows, 1, generator=generator), done=flag, terminated=flag)
    batch = state(action=torch.rand(rows, 4, generator=generator) * 2 - 1, next=following)
    batch["is_demonstration"] = torch.arange(rows) >= rows // 2
    batch["action"][:6] = torch.tensor([1.0, -1.0, 0.5, 1.0])  # as half of what experts do
    return lw.QAFTransform(PLANS)(batch.auto_batch_size_(1))


def ready(name, batch, actor, value):
    """Add what on-policy losses read: the actor's own actions, and the advantage."""
    if name in ON_POLICY:
        with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
            actor(batch)
        batch = GAE(gamma=0.9, lmbda=0.9, value_network=value)(batch.unsqueeze(0)).squeeze(0)
    return batch


def total(loss, batch):
    torch.manual_seed(7)
    return sum(value for key, value in loss(batch.copy()).items() if key.startswith("loss"))


def trained(loss):
    return {name: p for name, p in loss.named_parameters() if p.requires_grad}


@pytest.mark.parametrize("mode", ["train", "eval"])
@pytest.mark.parametrize("condition", ["plan", "description", pytest.param("one-hot", marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", LOSSES)
def test_gradients_reach_every_parameter_and_a_step_lowers_the_loss(name, condition, mode):
    loss, actor, value = make_loss(name, condition)
    getattr(loss, mode)()
    getattr(actor, mode)()
    batch = ready(name, make_batch(), actor, value)
    before = total(loss, batch)
    before.backward()
    missed = [key for key, p in trained(loss).items() if p.grad is None or not p.grad.abs().sum() > 0]
    assert not missed
    assert all(p.grad.isfinite().all() for p in trained(loss).values())
    with torch.no_grad():
        norm = torch.stack([p.grad.square().sum() for p in trained(loss).values()]).sum().sqrt()
        for p in trained(loss).values():
            p -= 1e-3 * p.grad / norm
    assert total(loss, batch) < before


@pytest.mark.parametrize("distribution", ["tanh_normal", "normal"])
@pytest.mark.parametrize("name", [*STOCHASTIC, *ON_POLICY])
def test_loss_is_finite_at_the_action_bounds(name, distribution):
    loss, actor, value = make_loss(name, "plan", distribution)
    batch = ready(name, make_batch(), actor, value)
    if name not in ON_POLICY:
        batch["action"] = batch["action"].sign()
    result = total(loss, batch)
    result.backward()
    assert result.isfinite()
    assert all(p.grad.isfinite().all() for p in trained(loss).values())


COMPILING = pytest.mark.filterwarnings(  # PyTorch warns about itself when it compiles
    "ignore:torch._dynamo.config.inline_inbuilt_nn_modules:FutureWarning",
    "ignore:.*LeafSpec:FutureWarning",
    "ignore:.*Function.* should not be instantiated",  # by TorchRL's tanh
    "ignore:.*torch.jit:DeprecationWarning",
)


def assert_one_graph_with_the_same_gradients(loss, values):
    """Compare a loss with itself compiled; ``values(run)`` returns the loss's value and other results of a run."""
    torch._dynamo.reset()
    results = []
    for run in (loss, torch.compile(loss, fullgraph=True, backend="eager")):
        loss.zero_grad()
        result = values(run)
        result[0].backward()
        results.append([*result, *(p.grad.clone() for p in loss.parameters() if p.grad is not None)])
    assert len(results[0]) > 5
    assert all(torch.equal(one, other) for one, other in zip(*results, strict=True))


QUICK = ("BC",)  # to compile; the others take five to ten seconds each
ONE_FAST = ["plan", *(pytest.param(condition, marks=pytest.mark.slow) for condition in ("description", "one-hot"))]
TYPICAL = (*QUICK, "DT", "TD3", "SAC", "IQL", "PPO")
ONE_GRAPH = [name for name in LOSSES if name != "PPO, KL"]  # its coefficient depends on the divergence of each batch
ALL = "LW_TORCHRL_COMPILE_ALL" in os.environ  # the 54, about ten minutes


@COMPILING
@pytest.mark.parametrize("condition", ONE_FAST)
@pytest.mark.parametrize("name", [n if n in QUICK else pytest.param(n, marks=pytest.mark.slow) for n in ONE_GRAPH])
def test_compiled_loss_is_one_graph_with_the_same_gradients(name, condition):
    if name not in (TYPICAL if condition == "plan" else TYPICAL[:2]) and not ALL:
        pytest.skip("LW_TORCHRL_COMPILE_ALL compiles every loss on every condition")
    loss, actor, value = make_loss(name, condition)
    batch = ready(name, make_batch(), actor, value)
    assert_one_graph_with_the_same_gradients(loss, lambda run: [total(run, batch)])


@COMPILING
@pytest.mark.slow
@pytest.mark.parametrize("condition", CONDITIONS)
def test_compiled_kernels_differ_only_by_rounding(condition):
    torch._dynamo.reset()
    loss, _, _ = make_loss("BC", condition, noise=0.0)
    expected = total(loss, make_batch())
    torch.testing.assert_close(total(torch.compile(loss, fullgraph=True), make_batch()), expected)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
@pytest.mark.parametrize("condition", CONDITIONS)
@pytest.mark.parametrize("name", LOSSES)
def test_loss_moves_to_a_gpu_and_back(name, condition):
    loss, actor, value = make_loss(name, condition)
    batch = ready(name, make_batch(), actor, value)
    expected = total(loss, batch)
    before = copy.deepcopy(loss.state_dict())
    loss.to("cuda")
    assert {tensor.device.type for tensor in (*loss.parameters(), *loss.buffers())} == {"cuda"}
    there = total(loss, batch.to("cuda"))
    there.backward()
    assert there.is_cuda
    assert there.isfinite()
    loss.to("cpu")
    loss.load_state_dict(before)
    assert torch.equal(total(loss, batch), expected)


CRITICS = ("DDPG", "TD3", "TD3+BC", "SAC", "REDQ", "CrossQ", "IQL", "CQL", "demonstrated TD3", "demonstrated SAC")


@pytest.mark.parametrize("name", CRITICS)
def test_targets_are_discounted_by_the_number_of_steps(name):
    """Without rewards, a target is the next value times the discount to the power of the steps."""
    loss, _, _ = make_loss(name, "plan")
    estimator, seen = loss.value_estimator, []
    estimate = type(estimator).value_estimate

    def note(rows, **options):
        zero = torch.zeros_like(rows["next", "reward"])
        rows = rows.copy().set("next", rows["next"].copy().set("reward", zero))
        seen.append(estimate(estimator, rows, **{**options, "next_value": torch.ones_like(zero)}).reshape(-1))
        return zero

    estimator.value_estimate = note
    batch = make_batch()
    steps = batch["steps_to_next_obs"] = torch.arange(24) % 5 + 1
    loss(with_n_steps(loss, batch))
    torch.testing.assert_close(seen[0], 0.9 ** steps.float())


def test_ppo_ratio_is_one_before_an_update():
    """Also with clipping, since the environment leaves the action as it was drawn."""
    for distribution in ("tanh_normal", "normal"):
        actor = make_actor("plan").stochastic(distribution, init_std=1.5)
        value = Value(actor.trunk, **SMALL)
        queries = lw.modules.transform_of(actor)
        env = TransformedEnv(lw.LanguageWorldEnv(["push", "reach"], num_envs=4, seed=0), queries)
        with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
            data = env.rollout(20, actor)
        env.close()
        if distribution == "normal":
            assert (data["action"].abs() > 1).any()
        data = GAE(gamma=0.9, lmbda=0.9, value_network=value)(data)
        result = o.ClipPPOLoss(actor, value, normalize_advantage=False)(data.reshape(-1))
        assert result["clip_fraction"] == 0
        torch.testing.assert_close(result["ESS"], torch.tensor(1.0))
        torch.testing.assert_close(result["kl_approx"], torch.tensor(0.0), atol=1e-6, rtol=0)
