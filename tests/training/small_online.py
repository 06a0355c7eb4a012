"""Small trainings in the environment, to be stopped and to be compared."""

from __future__ import annotations

from dataclasses import replace

import torch

import lw_torchrl as lw
from lw_torchrl.modules import make_policy
from lw_torchrl.training.algorithms import method_config

TASKS = ["push", "reach"]
PLANS = lw.load_plans("MT10")
SMALL = dict(latent_size=4, width=16, depth=1, encoder_width=8)
NUMBERS = dict(
    frames=240,
    rows=4,
    round_steps=15,
    max_steps=12,
    utd=0.1,
    batch_size=8,
    first_frames=40,
    warm_up=3,
    epochs=2,
    actor_learning_rate=1e-2,
    cloning_learning_rate=1e-2,
)


def configure(method="td3", **numbers):
    """Small numbers of all that a method reads, but those given."""
    config = method_config(method)
    return replace(config, **{name: value for name, value in NUMBERS.items() if hasattr(config, name)} | numbers)


CONFIG = configure()


def collect_demos(root):
    lw.collect_demonstrations(TASKS, episodes_per_task=1, root=root, max_steps=15, noise_scale=0.2, progress=False)
    return root


def make_actor(method="pcbc", seed=0, **options):
    torch.manual_seed(seed)
    return make_policy(method, PLANS, **{**SMALL, **options})


def make_replay(root, actor, **options):
    given = dict(
        label="executed",
        reward="dense_cost",
        terminate_on_success=True,
        n_steps=3,
        gamma=0.99,
        grow=150,  # less than what comes
        sampler=lw.CoLearningSampler("grown"),
        transform=actor.transform(),
    )
    return lw.LanguageWorldExperienceReplay(root, **{**given, **options})


def make_online(root, method="td3", checkpoint=None, *, actor=None, config=None, replay=None, **options):
    config = configure(method) if config is None else config
    actor = make_actor() if actor is None else actor
    replay = make_replay(root, actor) if replay is None else replay
    return lw.OnlineTrainer(
        actor, replay, config, method=method, checkpoint=checkpoint, progress=False, num_threads=1, **options
    )


def everything(trainer):
    """Tensors and numbers of a training, by name."""
    state = trainer.state_dict()
    found = {name: state[name] for name in ("round", "drawn", "episodes", "learner", "history")}
    more = {"policy": trainer.policy.state_dict(), "rows": trainer.replay[:]["observation"]}
    if trainer.replay.storage.num_grown:
        more["next batch"] = trainer.replay.sample(8)["observation"]
    return found | more
