"""TD3 and SAC losses with demonstrations: against the same written out, and TorchRL's."""

import pytest
import torch
from test_losses import BOUNDS, SMALL, make_actor, make_batch, make_trunk, total
from torchrl.objectives import SACLoss, SoftUpdate, TD3Loss

import lw_torchrl as lw
from lw_torchrl.modules import QValue

each_kind = pytest.mark.parametrize("kind", [lw.objectives.DemonstratedTD3Loss, lw.objectives.DemonstratedSACLoss])


def make(kind, bc_weight=2.0, seed=0, **options):
    torch.manual_seed(seed)
    actor = make_actor("plan", "tanh_normal" if kind is lw.objectives.DemonstratedSACLoss else None).eval()
    critic = QValue(make_trunk("plan"), **SMALL)
    more = BOUNDS if kind in (lw.objectives.DemonstratedTD3Loss, TD3Loss) else {}
    loss = kind(actor, critic, **({} if bc_weight is None else {"bc_weight": bc_weight}), **more, **options)
    loss.make_value_estimator(gamma=0.9)
    SoftUpdate(loss, eps=0.9)
    return loss, actor, critic


def values(loss, critic, batch, action):
    """Return the value of each critic, (E, B)."""
    result = []
    for number in range(loss.num_qvalue_nets):
        with loss.qvalue_network_params.detach()[number].to_module(critic):
            result.append(critic(batch.copy().set("action", action))["state_action_value"].squeeze(-1))
    return torch.stack(result)


def seeded(call, batch):
    torch.manual_seed(3)
    return call(batch.copy())


@pytest.mark.parametrize("shape", [(24,), (24, 1)])
def test_td3_actor_loss_by_hand(shape):
    loss, actor, critic = make(lw.objectives.DemonstratedTD3Loss, bc_weight=0.7)
    batch = make_batch()
    batch["is_demonstration"] = batch["is_demonstration"].view(shape)
    result, about = loss.actor_loss(batch)
    action = actor(batch.copy())["action"]
    value = values(loss, critic, batch, action).mean(0)
    distance = sum(((action[row] - batch["action"][row]) ** 2).sum() for row in range(12, 24)) / (4 * 12)
    expected = -value.mean() / value.abs().mean().detach() + 0.7 * distance
    torch.testing.assert_close(result, expected)
    torch.testing.assert_close(about["bc_loss"], distance.detach())
    torch.testing.assert_close(about["state_action_value_actor"], value.detach())
    torch.testing.assert_close(about["lmbd"], 1 / value.abs().mean().detach())
    result.backward()
    mine = actor.decoder.network[0].weight.grad.clone()
    actor.zero_grad()
    expected.backward()
    torch.testing.assert_close(actor.decoder.network[0].weight.grad, mine)
    assert all(p.grad is None for p in loss.qvalue_network_params.parameters()), "critics are not trained"


def test_td3_critic_loss_is_torchrls():
    batch = make_batch()
    ours, _, _ = make(lw.objectives.DemonstratedTD3Loss)
    theirs, _, _ = make(TD3Loss, None)
    assert torch.equal(*(seeded(loss, batch)["loss_qvalue"] for loss in (ours, theirs)))


def test_sac_actor_loss_adds_the_distance_of_the_mode():
    batch = make_batch()
    batch["action"] = batch["action"].sign()  # where a likelihood explodes
    ours, actor, _ = make(lw.objectives.DemonstratedSACLoss, bc_weight=0.7)
    theirs = SACLoss(actor, QValue(make_trunk("plan"), **SMALL))
    theirs.make_value_estimator(gamma=0.9)
    SoftUpdate(theirs, eps=0.9)
    theirs.load_state_dict(ours.state_dict())
    result = [seeded(loss.actor_loss, batch) for loss in (ours, theirs)]
    mode = torch.tanh(actor.get_dist_params(batch.copy())["loc"])
    distance = (mode - batch["action"])[12:].square().mean()
    torch.testing.assert_close(result[0][0], result[1][0] + 0.7 * distance)
    torch.testing.assert_close(result[0][1]["bc_loss"], distance.detach())
    assert result[0][0].abs() < 10
    different = []
    for weight in (0.0, 0.7):
        ours.bc_weight = weight
        different.append(seeded(ours, batch)["loss_actor"])
    torch.testing.assert_close(different[1] - different[0], 0.7 * distance)


@each_kind
def test_without_demonstrations_nothing_is_imitated(kind):
    batch = make_batch()
    batch["is_demonstration"] = torch.zeros(24, dtype=torch.bool)
    losses = [total(make(kind, weight)[0], batch) for weight in (0.0, 5.0)]
    assert torch.equal(*losses)
    batch["is_demonstration"] = ~batch["is_demonstration"]
    assert total(make(kind, 5.0)[0], batch) > losses[0]


@each_kind
def test_is_demonstration_key_can_be_renamed(kind):
    batch, (loss, _, _), (other, _, _) = make_batch(), make(kind), make(kind)
    expected = total(loss, batch)
    other.set_keys(is_demonstration=("from", "environment"))
    assert {*loss.in_keys} ^ {*other.in_keys} == {"is_demonstration", ("from", "environment")}
    batch["from", "environment"] = batch.pop("is_demonstration")
    assert torch.equal(total(other, batch), expected)
    with pytest.raises(ValueError, match="is_demonstration"):
        loss.set_keys(is_demonstrations="is_demonstration")


@each_kind
def test_reductions(kind):
    batch, result = make_batch(), {}
    for reduction in ("mean", "sum", "none"):
        more = {"scalar_output_mode": "exclude"} if kind is lw.objectives.DemonstratedSACLoss else {}
        result[reduction] = seeded(make(kind, reduction=reduction, **more)[0].actor_loss, batch)[0]
    torch.testing.assert_close(result["sum"], result["mean"] * 24)
    torch.testing.assert_close(result["none"].sum(), result["sum"])
    assert result["none"].shape == (24,)


def test_action_spec_with_a_batch_dimension_is_refused():
    env = lw.LanguageWorldEnv("reach", num_envs=4)
    for kind in (lw.objectives.DemonstratedTD3Loss, lw.objectives.DemonstratedSACLoss):
        actor, critic = make_actor("plan"), QValue(make_trunk("plan"), **SMALL)
        with pytest.raises(ValueError, match="action_spec"):
            kind(actor, critic, action_spec=env.action_spec)
    assert make(lw.objectives.DemonstratedSACLoss, action_spec=env.action_spec_unbatched)[0].target_entropy == -4
    assert make(lw.objectives.DemonstratedSACLoss, action_spec=env.full_action_spec)[0].target_entropy == -4
    env.close()
