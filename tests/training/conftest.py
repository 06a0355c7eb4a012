"""What the tests of cloning share: demonstrations, and a training that nothing disturbed."""

from __future__ import annotations

import pytest
from small_training import collect_demos, everything, make_trainer


@pytest.fixture(scope="module")
def demos(tmp_path_factory):
    return collect_demos(tmp_path_factory.mktemp("trainer") / "demos")


@pytest.fixture(scope="module")
def undisturbed(demos):
    trainer = make_trainer(demos)
    trainer.train()
    return everything(trainer)
