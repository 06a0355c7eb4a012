"""Small trainings that can be stopped at a step, and all of their state to compare."""

import torch
from torchrl.record.loggers import Logger

from lw_torchrl.data import LanguageWorldExperienceReplay, TaskBalancedSampler, collect_demonstrations
from lw_torchrl.language.plan_files import load_plans
from lw_torchrl.modules import (
    DescriptorConditionedActor,
    MLPDecoder,
    ObservationFeatures,
    PlanConditionedActor,
    SkillEncoder,
)
from lw_torchrl.training import BehavioralCloningConfig, BehavioralCloningTrainer
from lw_torchrl.transforms import QAFTransform

CONFIG = BehavioralCloningConfig(steps=12, batch_size=8, checkpoint_every=5, learning_rate=1e-2)
PLANS = load_plans("MT10")


def collect_demos(root):
    options = {"episodes_per_task": 2, "max_steps": 15, "noise_scale": 0.2, "progress": False}
    return collect_demonstrations(["push", "reach"], root=root, **options).root


def make_replay(root, sampler=None):
    return LanguageWorldExperienceReplay(root, sampler=sampler or TaskBalancedSampler(), transform=QAFTransform(PLANS))


def make_parts(kind="differences", noise=0.05, *, latent_size=4, width=16, depth=1):
    return {
        "features": ObservationFeatures(kind, noise),
        "skill_encoder": SkillEncoder(latent_size, width=8),
        "decoder": MLPDecoder(width=width, depth=depth),
    }


def make_actor(seed=0, plans=PLANS, **options):
    torch.manual_seed(seed)
    return PlanConditionedActor(plans, **make_parts(**options))


def make_descriptor_actor(tasks="MT10", condition="description", **options):
    torch.manual_seed(0)
    parts = make_parts(**options)
    return DescriptorConditionedActor(tasks, condition=condition, task_encoder=parts.pop("skill_encoder"), **parts)


class StopAt:
    """Raises KeyboardInterrupt, as Ctrl-C does, when a trainer reaches a step."""

    stop_at: int | None = None

    def step(self):
        if self.steps == self.stop_at:
            raise KeyboardInterrupt
        return super().step()


class Stopping(StopAt, BehavioralCloningTrainer):
    pass


def make_trainer(root, checkpoint=None, *, actor=None, config=CONFIG, sampler=None, stop_at=None, **options):
    actor = make_actor() if actor is None else actor
    trainer = Stopping(actor, make_replay(root, sampler), config, checkpoint=checkpoint, progress=False, **options)
    trainer.stop_at = stop_at
    return trainer


class ScalarLog(Logger):
    """Keeps the scalars that are logged."""

    def __init__(self):
        self.scalars = []

    def log_scalar(self, name, value, step=None):
        self.scalars.append((name, step, value))


def flat(value, path=()):
    """Every tensor and number of a nested state, by path."""
    if isinstance(value, dict):
        return {key: leaf for name in value for key, leaf in flat(value[name], (*path, str(name))).items()}
    if isinstance(value, (list, tuple)):
        return flat(dict(enumerate(value)), path)
    return {path: value.detach().clone() if isinstance(value, torch.Tensor) else value}


def everything(trainer):
    minibatches = trainer.minibatches[0].state_dict()
    state = flat([dict(trainer.actor.state_dict()), trainer.optimizer.state_dict(), minibatches])
    with trainer.minibatches[0].drawing(trainer.device):
        return state | {("next batch",): trainer.replay.sample(8)["observation"]}


def assert_same(state, expected):
    assert state.keys() == expected.keys()
    for key, value in expected.items():
        if isinstance(value, torch.Tensor):
            assert torch.equal(state[key], value), key
        elif isinstance(value, float) and isinstance(state[key], torch.Tensor):
            assert state[key].item() == value, key
        else:
            assert state[key] == value, key
            assert type(state[key]) is type(value), key  # an integer stays an integer
