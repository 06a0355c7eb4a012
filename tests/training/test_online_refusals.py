"""OnlineTrainer: what it refuses to train on, and to go on with."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from small_online import CONFIG, PLANS, collect_demos, configure, make_actor, make_online, make_replay

import lw_torchrl as lw
from lw_torchrl.training.algorithms import PPOConfig, TD3Config
from lw_torchrl.training.checkpoint import POLICY


@pytest.fixture(scope="module")
def demos(tmp_path_factory):
    return collect_demos(tmp_path_factory.mktemp("online") / "demos")


def test_what_cannot_be_trained_on_is_refused(demos):
    actor, push = make_actor(), PLANS["push"]
    other = lw.Plans([*(PLANS[task] for task in PLANS if task != "push"), replace(push, steps=push.steps[:1])])
    with pytest.raises(ValueError, match=r"method must be one of 'advantage', 'td3', .* did you mean 'td3'"):
        make_online(demos, "td4", config=CONFIG)
    plain = lw.LanguageWorldExperienceReplay(demos, transform=actor.transform())
    with pytest.raises(ValueError, match=r"replay must be .* that grows: give it grow="):
        make_online(demos, replay=plain)
    with pytest.raises(ValueError, match="sampler must be CoLearningSampler"):
        make_online(demos, replay=make_replay(demos, actor, sampler=lw.TaskBalancedSampler()))
    with pytest.raises(ValueError, match=r"gamma must be the replay buffer's, 0.9, got 0.99"):
        make_online(demos, replay=make_replay(demos, actor, gamma=0.9))
    with pytest.raises(ValueError, match=r"batch_size of the replay buffer must be None or .* 8, got 10"):
        make_online(demos, replay=make_replay(demos, actor, batch_size=10))
    with pytest.raises(ValueError, match="replay must end at success"):
        make_online(demos, replay=make_replay(demos, actor, terminate_on_success=False))
    with pytest.raises(ValueError, match="QAFTransform must have the actor's plans"):
        make_online(demos, replay=make_replay(demos, actor, transform=lw.QAFTransform(other)))
    with pytest.raises(TypeError, match="actor must be one that can have a distribution, got ScriptedSkillActor"):
        make_online(demos, "sac", actor=lw.ScriptedSkillActor(PLANS))
    value, qvalue = lw.PlanConditionedValue(PLANS), lw.PlanConditionedQValue(PLANS)
    with pytest.raises(TypeError, match="critic must be a QValue, which judges actions, got PlanConditionedValue"):
        make_online(demos, "td3", critic=value)
    with pytest.raises(TypeError, match=r"critic must be a Value, of states alone, .* got a QValue"):
        make_online(demos, "advantage", critic=qvalue)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"frames": 0}, "frames must be at least 1, got 0"),
        ({"frames": 241}, "frames must be a multiple of rows, 4, got 241; the nearest is 240"),
        ({"utd": -0.1}, "utd must be"),
        ({"utd": math.nan}, "utd must be"),
        ({"gamma": 1.5}, "gamma must be from 0 to 1, got 1.5"),
        ({"warm_up": -1}, "warm_up must be at least 0"),
        ({"exploration_hold": 0}, "exploration_hold must be at least 1"),
        ({"distance": "l3"}, "distance must be one of"),
        ({"stuck_exploration": -1.0}, "stuck_exploration must be finite and at least 0"),
    ],
)
def test_a_wrong_configuration_is_named(options, message):
    with pytest.raises(ValueError, match=message):
        replace(CONFIG, **options)
    with pytest.raises(TypeError, match="rows must be an integer"):
        replace(CONFIG, rows=2.5)


def test_another_training_is_not_gone_on_with(demos, tmp_path):
    path = tmp_path / "checkpoint.safetensors"
    make_online(demos, checkpoint=path, config=replace(CONFIG, frames=60)).train()
    short = replace(CONFIG, frames=60)
    for given, message in (
        ({"config": replace(short, utd=0.2)}, "its online differs in utd"),
        ({"config": configure("sac", frames=60), "method": "sac"}, "its actor differs|its online differs"),
        ({"config": short, "actor": make_actor(seed=1)}, "start"),
        ({"config": short, "replay": make_replay(demos, make_actor(), n_steps=2)}, "its replay differs in n_steps"),
        ({"config": short, "replay": make_replay(demos, make_actor(), reward="cost")}, "its replay differs in reward"),
    ):
        with pytest.raises(ValueError, match=message):
            make_online(demos, **{"checkpoint": path, **given})


def test_a_method_reads_its_own_configuration_and_no_others(demos, tmp_path):
    with pytest.raises(
        TypeError, match="of the method 'td3' must be of class TD3Config, got SACConfig, which is of 'sac'"
    ):
        make_online(demos, "td3", config=configure("sac"))
    with pytest.raises(TypeError, match="of the method 'td3' must be of class TD3Config, got ResidualConfig"):
        make_online(demos, "td3", config=configure("residual"))
    with pytest.raises(TypeError, match="beta"):
        replace(CONFIG, beta=1.0)
    common = lw.OnlineConfig(frames=60, rows=4, batch_size=8)
    assert make_online(demos, "td3", config=common).config == TD3Config(frames=60, rows=4, batch_size=8)
    assert lw.OnlineTrainer(make_actor(), make_replay(demos, make_actor()), method="ppo").config == PPOConfig()


def test_a_checkpoint_that_lists_what_other_methods_read_is_gone_on_with(demos, tmp_path):
    path, config = tmp_path / "checkpoint.safetensors", configure(frames=60)
    trainer = make_online(demos, checkpoint=path, config=config)
    trainer.train()
    said = trainer.described | {"online": {**trainer.described["online"], "beta": 2.0, "gae_lambda": 0.95}}
    POLICY.write(path, said, trainer.contents(), trainer.state_dict())
    assert make_online(demos, checkpoint=path, config=config).round == 1


@pytest.mark.parametrize("damage", ["round", "learner", "replay", "history", "optimizer", "nan"])
def test_a_damaged_state_is_refused(demos, tmp_path, damage):
    path, config = tmp_path / "checkpoint.safetensors", replace(CONFIG, frames=60)
    trainer = make_online(demos, checkpoint=path, config=config)
    trainer.train()
    state = trainer.state_dict()
    if damage == "round":
        state["round"] = 9
    elif damage == "learner":
        state["learner"]["tensors"].popitem()
    elif damage == "replay":
        state["replay"] = {}
    elif damage == "history":
        state["history"] = [{"frames": "many"}]
    elif damage == "optimizer":
        state["learner"]["optimizers"]["actor"]["param_groups"][0]["lr"] = 1e9
    else:
        name = next(name for name in state["learner"]["tensors"] if name.startswith("qvalue_network_params"))
        state["learner"]["tensors"][name] = state["learner"]["tensors"][name] * math.nan
    POLICY.write(path, trainer.described, trainer.contents(), state)
    with pytest.raises(ValueError, match="does not fit, it is of another architecture or damaged"):
        make_online(demos, checkpoint=path, config=config)
