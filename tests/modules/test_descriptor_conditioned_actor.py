"""DescriptorConditionedActor: conditioned on the task's description and on nothing else of the task."""

from __future__ import annotations

import warnings

import pytest
import torch
from small_actors import action_of, letters, make_descriptor, make_rows
from tensordict import TensorDict
from torchrl.objectives import BCLoss

import lw_torchrl as lw
from lw_torchrl.language.tasks import MT50, TASKS, task_id
from lw_torchrl.language.text import encode_texts
from lw_torchrl.modules import ObservationFeatures, TaskLatent


def state(*shape, seed=0):
    return make_rows(*shape, seed=seed, answered=False)


def decoded(actor, vector, observation):
    latent = actor.latent.encoder(vector / vector.square().mean().sqrt())  # root mean square 1
    return actor.decoder.network(torch.cat((latent, actor.features(observation)), -1))


@pytest.mark.parametrize("kind", ["raw", "differences", "relative", "both"])
@pytest.mark.parametrize("shape", [(), (5,), (3, 4)])
def test_it_writes_an_action_on_any_leading_shape(kind, shape):
    actor = make_descriptor(features=ObservationFeatures(kind))
    out = actor(state(*shape))
    assert (actor.in_keys, actor.out_keys) == (["task_id", "observation"], ["task_latent", "features", "action"])
    assert (out["action"].shape, out["action"].dtype) == ((*shape, 4), torch.float32)
    assert out["action"].abs().max() < 1


@pytest.mark.parametrize("encoder", [None, letters])
def test_the_action_by_hand(encoder):
    actor, rows = make_descriptor(text_encoder=encoder), state(8)
    found = action_of(actor, rows)
    for row in range(8):
        vector = (encoder or encode_texts)([TASKS[MT50[rows["task_id"][row]]].description])[0]
        torch.testing.assert_close(found[row], decoded(actor, vector, rows["observation"][row]))


@pytest.mark.parametrize("condition", ["description", "one-hot"])
def test_each_task_has_its_own_action(condition):
    actor = make_descriptor("MT50", condition=condition)
    rows = TensorDict(observation=torch.rand(1, 39).expand(50, 39), task_id=torch.arange(50), batch_size=[50])
    assert len({tuple(action) for action in action_of(actor, rows).tolist()}) == 50


def test_the_weights_do_not_depend_on_the_known_tasks():
    one, other = make_descriptor("reach"), make_descriptor("MT10", seed=1)
    other.load_state_dict(one.state_dict())
    rows = state(3).set("task_id", torch.full((3,), task_id("reach")))
    assert torch.equal(action_of(one, rows), action_of(other, rows))
    with pytest.raises(ValueError, match=r"tasks this actor was not made for.*: push"):
        one(rows.set("task_id", torch.full((3,), task_id("push"))))


@pytest.mark.parametrize("shape", [(3, 5), (10,), ()])
def test_a_text_encoder_that_returns_another_number_of_vectors_is_refused(shape):
    with pytest.raises(ValueError, match=r"text_encoder must give \(10, E\)"):
        make_descriptor(text_encoder=lambda texts: torch.zeros(shape))


def test_the_latent_is_a_part_of_its_own():
    latent = TaskLatent("MT10", in_keys=[("words", "task")], out_keys=["c"])
    rows = TensorDict({("words", "task"): state(4)["task_id"]}, [4])
    assert latent(rows)["c"].shape == (4, latent.latent_size)
    own = lw.Task("touch", "Touch the puck.", TASKS["push"].objects)
    assert TaskLatent([own]).tasks == ("touch",)


@pytest.mark.parametrize("rows", [1, 4])
@pytest.mark.parametrize("batch", [[], None])
def test_task_ids_in_a_column(rows, batch):
    actor, was = make_descriptor(), state(rows)
    wanted = action_of(actor, was)
    column = was["task_id"].unsqueeze(-1)
    given = TensorDict(observation=was["observation"], task_id=column, batch_size=[rows] if batch is None else batch)
    assert torch.equal(action_of(actor, given), wanted)
    assert torch.equal(actor(observation=was["observation"], task_id=column)[-1], wanted)
    in_time = TensorDict(observation=was["observation"].unsqueeze(1), task_id=column, batch_size=given.batch_size)
    assert torch.equal(action_of(actor, in_time), wanted.unsqueeze(1))


def test_bc_loss_trains_every_weight():
    actor = make_descriptor()
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*target_actor_network_params.*")
        loss = BCLoss(actor, loss_function="l2")
    batch = state(128)
    batch["action"] = torch.stack([(batch["task_id"] % 3 - 1).float() * 0.8] * 4, -1)
    optimizer, values = torch.optim.Adam(loss.parameters(), 1e-2), []
    for _ in range(80):
        value = loss(batch.clone())["loss_bc"]
        optimizer.zero_grad()
        value.backward()
        assert values or all(parameter.grad.abs().sum() > 0 for parameter in actor.parameters())
        optimizer.step()
        values.append(value.item())
    assert values[-1] < 0.2 * values[0]
