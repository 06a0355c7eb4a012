"""ObservationFeatures, Concat and decoders: differences by hand, statistics, any network as a part."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from small_actors import make_rows
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn

import lw_torchrl as lw
from lw_torchrl.language.layout import METAWORLD
from lw_torchrl.modules import Concat, Decode, FocusFeatures, GaussianDecoder, MLPDecoder, ObservationFeatures, features
from lw_torchrl.modules.decoder import LEAST_STD
from lw_torchrl.modules.parts import materialize
from lw_torchrl.suites import load_suite


def fit(module, observation, weights=None):
    module.fit(TensorDict(observation=observation, batch_size=observation.shape[:-1]), weights)


def random_observation(*shape, seed=0):
    return torch.rand(*shape, 39, generator=torch.Generator().manual_seed(seed))


def test_differences_by_hand():
    observation = random_observation()
    hand, one, two, goal = (observation[i : i + 3] for i in (0, 4, 11, 36))
    output = features.differences(observation, METAWORLD)
    plain = torch.cat([one - hand, two - hand, goal - hand, two - one, goal - one, goal - two])
    torch.testing.assert_close(output[:18], plain)
    torch.testing.assert_close(output[18:36], torch.tanh(plain / 0.02))
    torch.testing.assert_close(output[36:54], torch.tanh(plain / 0.1))
    assert torch.equal(output[54:], observation[2:4])


def test_differences_to_an_absent_object_are_zero():
    observation = random_observation(2)
    observation[0, 11:14] = 0
    output = features.differences(observation, METAWORLD)[:, :18].reshape(2, 6, 3)
    assert output[0].abs().sum(-1).eq(0).tolist() == [False, True, False, True, False, True]
    assert not output[1].abs().sum(-1).eq(0).any()


@pytest.mark.parametrize(("kind", "same"), [("raw", False), ("differences", False), ("relative", True)])
def test_relative_features_do_not_show_where_the_scene_is(kind, same):
    here = random_observation(20)
    there = here.clone()
    for first in (0, 4, 11, 36):
        there[:, first : first + 3] += torch.tensor([0.1, -0.2, 0.3])
    features = ObservationFeatures(kind)
    assert torch.allclose(features(here), features(there), atol=1e-4) == same


@pytest.mark.parametrize("kind", ["raw", "differences", "relative", "both"])
def test_fitted_rows_have_mean_zero_and_deviation_one(kind):
    features = ObservationFeatures(kind)
    observation = random_observation(40, 25)
    fit(features, observation)
    output = features(observation).reshape(-1, features.width)
    torch.testing.assert_close(output.mean(0), torch.zeros(features.width), atol=1e-4, rtol=0)
    torch.testing.assert_close(output.std(0, unbiased=False), torch.ones(features.width), atol=1e-3, rtol=0)


def test_a_constant_feature_is_centred_and_not_amplified_and_outliers_are_clamped():
    observation, features = random_observation(100), ObservationFeatures("raw")
    observation[:, 20] = 7.0
    fit(features, observation)
    other = torch.full((1, 39), 1e6)
    other[0, 20] = 8.0
    assert features(observation)[:, 20].abs().max() < 1e-5
    torch.testing.assert_close(features(other)[0], torch.where(torch.arange(39) == 20, 1.0, 10.0))


def test_noise_is_added_only_in_training_mode():
    torch.manual_seed(0)
    observation = random_observation(50, 50)
    features = ObservationFeatures("raw", noise=0.3)
    fit(features, observation)
    plain = features.eval()(observation)
    assert torch.equal(features(observation), plain)
    added = features.train()(observation) - plain
    assert added.std().item() == pytest.approx(0.3, rel=0.02)
    assert torch.equal(ObservationFeatures("raw").train()(observation), observation)


def test_weights_count_as_copies_of_rows():
    observation = random_observation(6)
    copies = torch.tensor([1, 2, 1, 3, 1, 0])
    weighted, copied = ObservationFeatures("both"), ObservationFeatures("both")
    fit(weighted, observation, copies / copies.sum())
    fit(copied, observation.repeat_interleave(copies, 0))
    torch.testing.assert_close(weighted.mean, copied.mean)
    torch.testing.assert_close(weighted.std, copied.std)


def test_only_features_with_the_same_meaning_transfer_to_another_layout():
    fetch = load_suite("fetch").plans
    plans = lw.load_plans("MT10")
    features = ObservationFeatures("opening", 0.1)
    fit(features, random_observation(50))
    other = features.with_plans(fetch)
    assert (other.layout, other.noise) == (fetch.layout, 0.1)
    assert other.mean is features.mean
    assert features.with_plans(plans) is features
    with pytest.raises(ValueError, match="transfer"):
        ObservationFeatures("raw").with_plans(fetch)


def test_concatenated_features_keep_their_noise():
    plans = lw.load_plans("MT10")
    parts = ObservationFeatures("raw", 0.5), FocusFeatures(plans)
    module = Concat(*parts)
    rows = make_rows(4).set("skill_weights", torch.rand(4, plans.num_steps))
    assert (module.in_keys, module.width) == (["observation", "skill_weights", "task_id"], 39 + 18)
    output = module.eval()(rows.copy())
    assert set(output.keys()) == {*rows.keys(), "features"}
    for part, columns in zip(parts, (slice(39), slice(39, None)), strict=True):
        assert torch.equal(output["features"][:, columns], part(rows.copy())["features"])
    noisy = module.train()(rows.copy())["features"] - output["features"]
    assert noisy[:, :39].all()
    assert not noisy[:, 39:].any()


def test_concat_of_modules_with_other_keys():
    pictures = TensorDictModule(nn.Flatten(), in_keys=["pixels"], out_keys=["seen"])
    module = Concat(ObservationFeatures("opening"), pictures, out_keys=[("net", "input")])
    rows = TensorDict(observation=random_observation(2), pixels=torch.rand(2, 3, 2), batch_size=[2])
    assert torch.equal(module(rows.copy())["net", "input"][:, 1:], rows["pixels"].flatten(1))
    module.in_keys = [("robot", "state"), "camera"]
    assert (module.parts[0].in_keys, pictures.in_keys) == ([("robot", "state")], ["camera"])
    for wrong in ((), (nn.Linear(3, 3),)):
        with pytest.raises(TypeError, match="parts must be one or more TensorDict modules"):
            Concat(*wrong)


LAYERS = [({"width": 7, "depth": 2}, [(10, 7), (7, 7), (7, 4)]), ({"width": 7, "depth": 0}, [(10, 4)])]
LAYERS += [({"width": (8, 5), "actions": 3}, [(10, 8), (8, 5), (5, 3)])]


@pytest.mark.parametrize(("options", "expected"), LAYERS)
def test_width_and_depth_set_the_layers(options, expected):
    decoder = MLPDecoder(**options)
    assert decoder(torch.rand(2, 10)).shape == (2, options.get("actions", 4))
    assert [(each.in_features, each.out_features) for each in decoder if isinstance(each, nn.Linear)] == expected
    assert decoder.config == {"width": 256, "depth": 3, "actions": 4, "squash": True} | options


def test_squash_keeps_the_action_within_one():
    seen = 100 * torch.randn(50, 10)
    assert MLPDecoder(width=8)(seen).abs().max() <= 1
    assert MLPDecoder(width=8, squash=False)(seen).abs().max() > 1


@settings(max_examples=20, deadline=None)
@given(st.floats(0.015625, 40, width=32), st.booleans())
def test_gaussian_copy_has_the_action_as_mean_and_init_std_everywhere(init_std, squash):
    trained, copy = MLPDecoder(width=8, depth=1), GaussianDecoder(width=8, depth=1, squash=squash, init_std=init_std)
    seen = torch.rand(6, 10)
    for decoder in (trained, copy):
        materialize(decoder, seen)
    copy.copy_from(trained)
    loc, scale = copy(seen)
    torch.testing.assert_close(loc if squash else torch.tanh(loc), trained(seen))
    torch.testing.assert_close(scale, torch.full((6, 4), init_std), rtol=1e-4, atol=1e-5)


def test_standard_deviation_stays_above_its_minimum():
    decoder = GaussianDecoder(width=8, depth=1)
    materialize(decoder, torch.rand(1, 10))
    nn.init.constant_(decoder[-1].bias, -1e4)
    assert (decoder(torch.rand(5, 10))[1] >= LEAST_STD).all()
    with pytest.raises(ValueError, match="init_std"):
        GaussianDecoder(init_std=LEAST_STD)


def test_any_network_becomes_a_part():
    rows = TensorDict(skill_latent=torch.rand(3, 4), features=torch.rand(3, 4), batch_size=[3])
    net = nn.Linear(8, 2)
    part = Decode(net, out_keys=["action"])
    expected = net(torch.cat((rows["skill_latent"], rows["features"]), -1))
    assert torch.equal(part(rows.copy())["action"], expected)
    assert torch.equal(part(rows["skill_latent"], rows["features"]), expected), "called with tensors of one shape"
    with pytest.raises(ValueError, match="out_keys"):
        Decode(net, out_keys=["features"])
