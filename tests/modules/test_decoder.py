"""Decoders: MLPDecoder, GaussianDecoder, and Decode, which makes any network a part of an actor."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torch import nn

from lw_torchrl.modules import Decode, GaussianDecoder, MLPDecoder
from lw_torchrl.modules.decoder import LEAST_STD
from lw_torchrl.modules.parts import materialize


def linears(module):
    return [(m.in_features, m.out_features) for m in module.modules() if isinstance(m, nn.Linear)]


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"width": 7, "depth": 2}, [(10, 7), (7, 7), (7, 4)]),
        ({"width": 7, "depth": 0}, [(10, 4)]),
        ({"width": (8, 5), "actions": 3}, [(10, 8), (8, 5), (5, 3)]),
    ],
)
def test_width_and_depth_set_the_layers(options, expected):
    decoder = MLPDecoder(**options)
    assert decoder(torch.rand(2, 10)).shape == (2, options.get("actions", 4))
    assert linears(decoder) == expected
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
