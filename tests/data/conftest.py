"""Datasets that several test files read."""

import pytest
from collecting import collect

from lw_torchrl.data.dataset import load_rows


@pytest.fixture(scope="session")
def dataset(tmp_path_factory):
    """Three episodes each of push and reach, every second one with noise."""
    return collect(tmp_path_factory.mktemp("dataset") / "demos")


@pytest.fixture(scope="session")
def other_dataset(tmp_path_factory):
    """As many rows, of another seed."""
    return collect(tmp_path_factory.mktemp("other_dataset") / "demos", seed=6)


@pytest.fixture(scope="session")
def rows(dataset):
    return load_rows(dataset)


@pytest.fixture
def both(dataset, other_dataset):
    return [dataset.root, other_dataset.root]
