"""DescriptorConditionedActor: conditioned on the task's description and on nothing else of the task."""

from __future__ import annotations

import warnings

import pytest
import torch
from tensordict import TensorDict
from torchrl.objectives import BCLoss

from lw_torchrl.language.tasks import MT10, MT50, TASKS, task_id
from lw_torchrl.language.text import encode_texts
from lw_torchrl.modules import DescriptorConditionedActor

SMALL = dict(latent_size=6, width=16, depth=1, encoder_width=12)


def make_actor(tasks="MT10", seed=0, **options):
    torch.manual_seed(seed)
    return DescriptorConditionedActor(tasks, **{**SMALL, **options}).eval()


def unit(vector):
    """A text's vector as the actors read it: numbers of size 1."""
    return vector / vector.square().mean().sqrt()


def make_state(*shape, seed=0):
    generator = torch.Generator().manual_seed(seed)
    ids = torch.tensor([task_id(task) for task in MT10])
    chosen = ids[torch.randint(10, tuple(shape), generator=generator)]
    return TensorDict({"observation": torch.rand(*shape, 39, generator=generator), "task_id": chosen}, shape)


def decoded(actor, vector, observation):
    return actor.head(torch.cat((actor.encoder.texts(vector), actor.encoder.features(observation)), -1))


def counted(texts):
    return torch.tensor([[float(text.count(letter)) for letter in "aeiou"] for text in texts])


@pytest.mark.parametrize("features", ["raw", "differences", "relative", "both"])
@pytest.mark.parametrize("shape", [(), (5,), (3, 4)])
def test_it_writes_an_action_on_any_leading_shape(features, shape):
    actor = make_actor(features=features)
    out = actor(make_state(*shape))
    assert (actor.in_keys, actor.out_keys) == (["observation", "task_id"], ["action"])
    assert out["action"].shape == (*shape, 4)
    assert out["action"].dtype == torch.float32
    assert out["action"].abs().max() < 1


def test_the_action_by_hand():
    actor = make_actor()
    state = make_state(8)
    found = actor(state.clone())["action"]
    for row in range(8):
        vector = encode_texts([TASKS[MT50[state["task_id"][row]]].description])[0]
        torch.testing.assert_close(found[row], decoded(actor, unit(vector), state["observation"][row]))


def test_the_task_makes_a_difference_and_every_known_task_works():
    actor = make_actor("MT50")
    state = TensorDict({"observation": torch.rand(1, 39).expand(50, 39), "task_id": torch.arange(50)}, [50])
    actions = actor(state)["action"]
    assert len({tuple(action) for action in actions.tolist()}) == 50


def test_the_weights_do_not_depend_on_which_tasks_it_knows():
    one, other = make_actor("reach"), make_actor("MT10")
    assert one.state_dict().keys() == other.state_dict().keys()
    assert {key.split(".")[0] for key in one.state_dict()} == {"encoder", "head"}
    other.load_state_dict(one.state_dict())
    state = TensorDict({"observation": torch.rand(3, 39), "task_id": torch.full((3,), task_id("reach"))}, [3])
    assert torch.equal(one(state.clone())["action"], other(state.clone())["action"])


def test_a_text_encoder_of_ones_own():
    actor = make_actor(text_encoder=counted)
    assert next(actor.encoder.texts.parameters()).shape[1] == 5
    state = make_state(4)
    vector = counted([TASKS[MT50[state["task_id"][0]]].description])[0]
    torch.testing.assert_close(actor(state.clone())["action"][0], decoded(actor, unit(vector), state["observation"][0]))


@pytest.mark.parametrize("shape", [(3, 5), (10,), ()])
def test_a_text_encoder_that_gives_another_number_of_vectors_is_refused(shape):
    with pytest.raises(ValueError, match=r"text_encoder must give \(10, E\)"):
        make_actor(text_encoder=lambda texts: torch.zeros(shape))


@pytest.mark.parametrize("features", ["opening", "none"])
def test_one_that_would_see_nothing_of_the_scene_is_refused(features):
    with pytest.raises(ValueError, match=f"features='{features}' shows nothing of where .*; only plans with roles"):
        make_actor(features=features)


def test_bc_loss_trains_it_and_the_gradient_reaches_every_weight():
    actor = make_actor()
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*target_actor_network_params.*")
        loss = BCLoss(actor, loss_function="l2")
    batch = make_state(128)
    batch["action"] = torch.stack([(batch["task_id"] % 3 - 1).float() * 0.8] * 4, -1)
    optimizer = torch.optim.Adam(loss.parameters(), 1e-2)
    values = []
    for step in range(80):
        value = loss(batch.clone())["loss_bc"]
        optimizer.zero_grad()
        value.backward()
        if step == 0:
            assert all(parameter.grad.abs().sum() > 0 for parameter in actor.parameters())
        optimizer.step()
        values.append(value.item())
    assert values[-1] < 0.2 * values[0]
    assert (actor(batch.exclude("action"))["action"] - batch["action"]).square().mean() < 0.1


def test_the_normalisation_is_saved_with_the_actor():
    actor, other = make_actor(seed=0), make_actor(seed=1)
    actor.fit_normalization(make_state(50)["observation"] * 3 + 1)
    other.load_state_dict(actor.state_dict())
    state = make_state(6)
    assert torch.equal(other(state.clone())["action"], actor(state.clone())["action"])
    assert actor.encoder.features.mean.abs().sum() > 0


def poke(index, value):
    def change(tensor):
        tensor = tensor.clone()
        tensor[index] = value
        return tensor

    return change
