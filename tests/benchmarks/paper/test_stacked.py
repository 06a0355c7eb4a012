"""Many actors trained at once learn what each would learn separately."""

import pytest
import torch
from speed import first_fast
from torchrl.envs import Compose

import lw_torchrl as lw
from benchmarks.paper.stacked import StackedBehavioralCloning
from lw_torchrl.modules import Concat, FocusFeatures, MLPDecoder, ObservationFeatures
from lw_torchrl.transforms import SwapUnmentioned

TASKS = ("push", "reach", "window-open")
PLANS = lw.load_plans("MT10")
CONFIG = lw.BehavioralCloningConfig(steps=100, batch_size=30, seed=5)


@pytest.fixture(scope="module")
def demos(tmp_path_factory):
    root = tmp_path_factory.mktemp("stacked") / "demos"
    lw.collect_demonstrations(TASKS, episodes_per_task=2, root=root, max_steps=100, progress=False)
    return root


def replay(demos, kind="focused plan"):
    swapped = [SwapUnmentioned(PLANS, 0.5)] if kind == "focused plan" else []
    turned = Compose(lw.QAFTransform(PLANS), lw.RandomYaw(0.3), *swapped)
    return lw.LanguageWorldExperienceReplay(demos, sampler=lw.TaskBalancedSampler(), transform=turned, after_success=20)


def make(kind, seed):
    """An actor without noise, whose draws one call for all actors does not make alike."""
    torch.manual_seed(seed)
    features, decoder = ObservationFeatures(), MLPDecoder(width=32)
    if kind in ("description", "one-hot"):
        return lw.modules.DescriptorConditionedActor(TASKS, condition=kind, features=features, decoder=decoder)
    if kind == "focused plan":
        features = Concat(features, FocusFeatures(PLANS))
    return lw.PlanConditionedActor(PLANS, features=features, decoder=decoder)


def stack(demos, number=2, config=CONFIG, kind="focused plan", checkpoint=None):
    actors, replays = [make(kind, seed) for seed in range(number)], [replay(demos, kind) for _ in range(number)]
    return StackedBehavioralCloning(actors, replays, config, checkpoint=checkpoint, progress=False)


@pytest.mark.parametrize("kind", first_fast(["plan", "focused plan", "description", "one-hot"]))
def test_losses_are_those_of_separate_trainings(demos, kind):
    together = stack(demos, 3, kind=kind)
    losses = torch.stack([together.step() for _ in range(CONFIG.steps)])
    assert losses[-10:].mean() < losses[:10].mean() / 2
    for number in range(3):
        config = lw.BehavioralCloningConfig(**{**vars(CONFIG), "seed": CONFIG.seed + number})
        alone = lw.BehavioralCloningTrainer(make(kind, number), replay(demos, kind), config, progress=False)
        own = torch.tensor([alone.step() for _ in range(CONFIG.steps)])
        assert (losses[:, number] - own).abs().max() < 1e-5
