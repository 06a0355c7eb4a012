"""Transforms on a buffer of demonstrations."""

from __future__ import annotations

import pytest
import torch
from collecting import collect
from torchrl.envs.transforms import Compose, MultiStepTransform, ObservationNorm, Reward2GoTransform, RewardScaling

from lw_torchrl.data import LanguageWorldExperienceReplay


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return collect(tmp_path_factory.mktemp("demos") / "d").root


def opened(root, **options):
    generator = torch.Generator().manual_seed(0)
    return LanguageWorldExperienceReplay(root, label="executed", batch_size=4, generator=generator, **options)


@pytest.mark.parametrize("make", [lambda: MultiStepTransform(3, 0.9), Reward2GoTransform])
def test_transforms_of_written_rows_are_refused(root, make):
    for transform in (make(), Compose(RewardScaling(0.0, 1.0), Compose(make()))):
        with pytest.raises(ValueError, match=f"transform: {type(make()).__name__} does nothing to samples; "):
            opened(root, transform=transform)


def test_an_inverse_on_samples(root):
    replay = opened(root)
    replay.append_transform(ObservationNorm(0.0, 2.0, in_keys=[], in_keys_inv=["observation"]), invert=True)
    assert not torch.equal(replay.sample()["observation"], opened(root).sample()["observation"])
