"""Losses that imitate the demonstrated rows of a minibatch: against the same, written out."""

from __future__ import annotations

import pytest
import torch
from test_losses import BOUNDS, SMALL, make_actor, make_batch, make_encoder, total
from torchrl.objectives import SACLoss, SoftUpdate, TD3Loss

import lw_torchrl as lw
from lw_torchrl.modules import QValue
from lw_torchrl.objectives.demonstrated import imitation


def make(kind, bc_weight=2.0, seed=0, **options):
    torch.manual_seed(seed)
    actor = make_actor("plan", "tanh_normal" if kind is lw.DemonstratedSACLoss else None).eval()
    critic = QValue(make_encoder("plan"), **SMALL)
    more = BOUNDS if kind in (lw.DemonstratedTD3Loss, TD3Loss) else {}
    loss = kind(actor, critic, **({} if bc_weight is None else {"bc_weight": bc_weight}), **more, **options)
    loss.make_value_estimator(gamma=0.9)
    SoftUpdate(loss, eps=0.9)
    return loss, actor, critic


def values(loss, critic, batch, action):
    """Of each critic: (E, B)."""
    found = []
    for number in range(loss.num_qvalue_nets):
        with loss.qvalue_network_params.detach()[number].to_module(critic):
            found.append(critic(batch.copy().set("action", action))["state_action_value"].squeeze(-1))
    return torch.stack(found)


@pytest.mark.parametrize("shape", [(24,), (24, 1)])
def test_td3s_actor_is_torn_between_values_and_demonstrations(shape):
    loss, actor, critic = make(lw.DemonstratedTD3Loss, bc_weight=0.7)
    batch = make_batch()
    batch["is_target"] = batch["is_target"].view(shape)
    found, about = loss.actor_loss(batch)
    action = actor(batch.copy())["action"]
    value = values(loss, critic, batch, action).mean(0)
    demonstrated = [row for row in range(24) if not batch["is_target"].flatten()[row]]
    assert demonstrated == list(range(12, 24))
    distance = sum(((action[row] - batch["action"][row]) ** 2).sum() for row in demonstrated) / (4 * len(demonstrated))
    expected = -value.mean() / value.abs().mean().detach() + 0.7 * distance
    torch.testing.assert_close(found, expected)
    torch.testing.assert_close(about["bc_loss"], distance.detach())
    torch.testing.assert_close(about["state_action_value_actor"], value.detach())
    torch.testing.assert_close(about["lmbd"], 1 / value.abs().mean().detach())
    found.backward()
    mine = actor.head.network[0].weight.grad.clone()
    actor.zero_grad()
    expected.backward()
    torch.testing.assert_close(actor.head.network[0].weight.grad, mine)
    assert all(p.grad is None for p in loss.qvalue_network_params.parameters()), "critics are trained by theirs alone"


def test_td3s_critics_are_torchrls():
    batch = make_batch()
    ours, _, _ = make(lw.DemonstratedTD3Loss)
    theirs, _, _ = make(TD3Loss, None)
    found = []
    for loss in (ours, theirs):
        torch.manual_seed(3)
        found.append(loss(batch.copy())["loss_qvalue"])
    assert torch.equal(*found)


def test_sacs_actor_is_drawn_to_demonstrations_by_its_mode():
    batch = make_batch()
    batch["action"] = batch["action"].sign()  # where a likelihood explodes
    ours, actor, _ = make(lw.DemonstratedSACLoss, bc_weight=0.7)
    theirs = SACLoss(actor, QValue(make_encoder("plan"), **SMALL))
    theirs.make_value_estimator(gamma=0.9)
    SoftUpdate(theirs, eps=0.9)
    theirs.load_state_dict(ours.state_dict())
    found = []
    for loss in (ours, theirs):
        torch.manual_seed(3)
        found.append(loss.actor_loss(batch.copy()))
    mode = torch.tanh(actor.get_dist_params(batch.copy())["loc"])
    distance = (mode - batch["action"])[12:].square().mean()
    torch.testing.assert_close(found[0][0], found[1][0] + 0.7 * distance)
    torch.testing.assert_close(found[0][1]["bc_loss"], distance.detach())
    assert found[0][0].abs() < 10
    different = []
    for weight in (0.0, 0.7):
        ours.bc_weight = weight
        torch.manual_seed(3)
        different.append(ours(batch.copy())["loss_actor"])
    torch.testing.assert_close(different[1] - different[0], 0.7 * distance)


@pytest.mark.parametrize("kind", [lw.DemonstratedTD3Loss, lw.DemonstratedSACLoss])
def test_without_demonstrations_nothing_is_imitated(kind):
    batch = make_batch()
    batch["is_target"] = torch.ones(24, dtype=torch.bool)
    losses = [total(make(kind, weight)[0], batch) for weight in (0.0, 5.0)]
    assert torch.equal(*losses)
    batch["is_target"] = ~batch["is_target"]
    assert total(make(kind, 5.0)[0], batch) > losses[0]


@pytest.mark.parametrize("kind", [lw.DemonstratedTD3Loss, lw.DemonstratedSACLoss])
def test_keys_are_obeyed(kind):
    batch, (loss, _, _), (other, _, _) = make_batch(), make(kind), make(kind)
    expected = total(loss, batch)
    assert "is_target" in loss.in_keys
    other.set_keys(is_target=("from", "environment"))
    assert ("from", "environment") in other.in_keys
    assert "is_target" not in other.in_keys
    batch["from", "environment"] = batch.pop("is_target")
    assert torch.equal(total(other, batch), expected)
    with pytest.raises(ValueError, match="is_target"):
        loss.set_keys(is_targets="is_target")


def test_a_loss_for_each_row_has_the_same_mean():
    batch = make_batch()
    loss, _, _ = make(lw.DemonstratedTD3Loss)
    each, _, _ = make(lw.DemonstratedTD3Loss, reduction="none")
    found = each.actor_loss(batch)[0]
    assert found.shape == (24,)
    torch.testing.assert_close(found.mean(), loss.actor_loss(batch)[0])


def test_imitation_is_of_demonstrated_rows_alone():
    generator = torch.Generator().manual_seed(0)
    action, other = (torch.rand(7, 4, generator=generator) for _ in range(2))
    is_target = torch.tensor([True, False, True, True, False, True, True])
    found = imitation(action, other, is_target)
    assert (found[is_target] == 0).all()
    torch.testing.assert_close(found.mean(), (action - other)[~is_target].square().mean())


def test_wrong_options_are_named():
    with pytest.raises(ValueError, match="bc_weight"):
        make(lw.DemonstratedTD3Loss, -1.0)
    with pytest.raises(ValueError, match="bc_weight"):
        make(lw.DemonstratedSACLoss, float("nan"))
    with pytest.raises(ValueError, match="alpha is 1 here: give bc_weight"):
        make(lw.DemonstratedTD3Loss, alpha=2.5)
