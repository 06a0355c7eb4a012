"""DescriptorConditionedActor: conditioned on the task's description and on nothing else of the task."""

import pytest
import torch
from small_actors import action_of, letters, make_descriptor, make_rows
from tensordict import TensorDict

from lw_torchrl.language.tasks import MT50, TASKS, task_id
from lw_torchrl.language.text import encode_texts


def state(*shape, seed=0):
    return make_rows(*shape, seed=seed, answered=False)


def decoded(actor, vector, observation):
    latent = actor.latent.encoder(vector / vector.square().mean().sqrt())  # root mean square 1
    return actor.decoder.network(torch.cat((latent, actor.features(observation)), -1))


@pytest.mark.parametrize("encoder", [None, letters])
def test_action_by_hand(encoder):
    actor, rows = make_descriptor(text_encoder=encoder), state(8)
    output = action_of(actor, rows)
    assert (actor.in_keys, actor.out_keys) == (["task_id", "observation"], ["task_latent", "features", "action"])
    assert torch.equal(action_of(actor, rows.reshape(2, 4)), output.reshape(2, 4, 4))
    for row in range(8):
        vector = (encoder or encode_texts)([TASKS[MT50[rows["task_id"][row]]].description])[0]
        torch.testing.assert_close(output[row], decoded(actor, vector, rows["observation"][row]))


@pytest.mark.parametrize("condition", ["description", "one-hot"])
def test_each_task_has_its_own_action(condition):
    actor = make_descriptor("MT50", condition=condition)
    rows = TensorDict(observation=torch.rand(1, 39).expand(50, 39), task_id=torch.arange(50), batch_size=[50])
    assert len({tuple(action) for action in action_of(actor, rows).tolist()}) == 50


def test_weights_do_not_depend_on_the_known_tasks():
    one, other = make_descriptor("reach"), make_descriptor("MT10", seed=1)
    other.load_state_dict(one.state_dict())
    rows = state(3).set("task_id", torch.full((3,), task_id("reach")))
    assert torch.equal(action_of(one, rows), action_of(other, rows))
    with pytest.raises(ValueError, match=r"task_id.*: push"):
        one(rows.set("task_id", torch.full((3,), task_id("push"))))


@pytest.mark.parametrize("rows", [1, 4])
@pytest.mark.parametrize("batch", [[], None])
def test_task_ids_may_be_a_column(rows, batch):
    actor, data = make_descriptor(), state(rows)
    expected = action_of(actor, data)
    observation, column = data["observation"], data["task_id"].unsqueeze(-1)
    moved = TensorDict(observation=observation, task_id=column, batch_size=[rows] if batch is None else batch)
    assert torch.equal(action_of(actor, moved), expected)
    assert torch.equal(actor(observation=observation, task_id=column)[-1], expected)
    in_time = TensorDict(observation=observation.unsqueeze(1), task_id=column, batch_size=moved.batch_size)
    assert torch.equal(action_of(actor, in_time), expected.unsqueeze(1))
