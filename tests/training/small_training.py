"""Small trainings that can be stopped at a step, and all of their state to compare."""

from __future__ import annotations

import torch

from lw_torchrl.data import LanguageWorldExperienceReplay, TaskBalancedSampler, collect_demonstrations
from lw_torchrl.language.plan_files import load_plans
from lw_torchrl.modules import MLPDecoder, PlanConditionedActor, SkillEncoder
from lw_torchrl.training import BehavioralCloningConfig, BehavioralCloningTrainer
from lw_torchrl.transforms import QAFTransform

CONFIG = BehavioralCloningConfig(steps=12, batch_size=8, checkpoint_every=5, learning_rate=1e-2)
PLANS = load_plans("MT10")


def collect_demos(root):
    collect_demonstrations(
        ["push", "reach"], episodes_per_task=2, root=root, max_steps=15, noise_scale=0.2, progress=False
    )
    return root


def make_replay(root, sampler=None):
    return LanguageWorldExperienceReplay(root, sampler=sampler or TaskBalancedSampler(), transform=QAFTransform(PLANS))


def make_actor(seed=0, plans=PLANS, **options):
    torch.manual_seed(seed)
    small = {"skill_encoder": SkillEncoder(4, width=8), "decoder": MLPDecoder(width=16, depth=1)}
    return PlanConditionedActor(plans, **{**small, **options})


class Stopping(BehavioralCloningTrainer):
    """Stops, as Ctrl-C does, when it gets to a step."""

    stop_at: int | None = None

    def step(self):
        if self.steps == self.stop_at:
            raise KeyboardInterrupt
        return super().step()


def make_trainer(root, checkpoint=None, *, actor=None, config=CONFIG, sampler=None, stop_at=None, **options):
    actor = make_actor() if actor is None else actor
    trainer = Stopping(actor, make_replay(root, sampler), config, checkpoint=checkpoint, progress=False, **options)
    trainer.stop_at = stop_at
    return trainer


def flat(value, path=()):
    """Every tensor and number of a nested state."""
    if isinstance(value, dict):
        return {key: leaf for name in value for key, leaf in flat(value[name], (*path, str(name))).items()}
    if isinstance(value, (list, tuple)):
        return flat(dict(enumerate(value)), path)
    return {path: value.detach().clone() if isinstance(value, torch.Tensor) else value}


def everything(trainer):
    found = flat(
        {
            "actor": dict(trainer.actor.state_dict()),
            "optimizer": trainer.optimizer.state_dict(),
            "schedule": trainer.schedule.state_dict(),
            "state": trainer.states[0].state_dict(trainer.steps),
        }
    )
    return found | {("next batch",): trainer.replay.sample(8)["observation"]}


def assert_same(found, expected):
    assert found.keys() == expected.keys()
    for key, value in expected.items():
        if isinstance(value, torch.Tensor):
            assert torch.equal(found[key], value), key
        elif isinstance(value, float) and isinstance(found[key], torch.Tensor):
            assert found[key].item() == value, key
        else:
            assert found[key] == value, key
            assert type(found[key]) is type(value), key  # an integer stays one
