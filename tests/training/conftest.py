"""Fixtures of the cloning tests: demonstrations, and the state of an uninterrupted training."""

import pytest
from small_training import collect_demos, everything, make_trainer


@pytest.fixture(scope="session")
def demos(tmp_path_factory):
    return collect_demos(tmp_path_factory.mktemp("trainer") / "demos")


@pytest.fixture(scope="session")
def uninterrupted(demos):
    trainer = make_trainer(demos)
    trainer.train()
    return everything(trainer)
