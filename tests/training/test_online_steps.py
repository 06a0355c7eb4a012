"""Training of one step of a plan in the environment: the rest acts as before, without noise; resumed, the same bits."""

from __future__ import annotations

import pytest
import torch
from hostile_files import parts, rebuild, refuses
from small_online import collect_demos, configure, everything, make_actor, make_online
from small_training import assert_same, flat

import lw_torchrl as lw

OFTEN = dict(exploration=0.5, gripper_exploration=1.0, max_steps=40, round_steps=40, frames=320)


@pytest.fixture(scope="module")
def demos(tmp_path_factory):
    return collect_demos(tmp_path_factory.mktemp("steps") / "demos")


def make_residual(steps, seed=0):
    base = make_actor(seed=seed)
    torch.manual_seed(seed + 1)
    return lw.ResidualActor(base, scale=0.5, steps=steps, width=16, depth=1)


def test_a_residual_is_trained_itself_and_its_base_is_not(demos):
    actor = make_residual({"push": [0]})
    before = {name: value.clone() for name, value in actor.state_dict().items()}
    trainer = make_online(demos, "residual", actor=actor)
    trainer.train()
    assert trainer.policy is actor
    for name, value in actor.state_dict().items():
        assert torch.equal(value, before[name]) == (not name.startswith("network.")), name


def rows_that_came(trainer):
    """With the answers to the plans' queries."""
    return trainer.replay[:][trainer.replay.storage.num_joined :]


@pytest.mark.parametrize("method", ["residual", "td3"])
@pytest.mark.parametrize("steps", [{"push": [0]}, {"push": [0, 1, 2, 3], "reach": [0]}])
@pytest.mark.slow
def test_what_is_done_outside_of_the_steps_is_what_the_base_does_without_noise(demos, steps, method):
    actor = make_residual(steps)
    trainer = make_online(demos, method, actor=actor, config=configure(method, **OFTEN))
    trainer.train()
    rows = rows_that_came(trainer)
    state = rows.select("observation", "task_id", "qaf").copy()
    with torch.no_grad():
        found, base = actor.eval()(state.copy()), actor.base(state.copy())
    still = found["action_corrected"].squeeze(-1) == 0
    assert still.any()
    assert not still.all()
    torch.testing.assert_close(rows["action"][still], base["action"][still], atol=1e-5, rtol=0)  # of other batches
    there = (rows["action"] - base["action"])[~still].abs()
    assert there.mean() > 0.1, "the noise and the correction"


def test_without_steps_there_is_noise_everywhere(demos):
    base = make_actor()
    torch.manual_seed(1)
    actor = lw.ResidualActor(base, width=16, depth=1)
    trainer = make_online(demos, "residual", actor=actor, config=configure("residual", **OFTEN, first_frames=10_000))
    trainer.train()
    rows = rows_that_came(trainer)
    with torch.no_grad():
        expected = actor.base(rows.select("observation", "task_id", "qaf").copy())["action"]
    assert ((rows["action"] - expected).abs().max(-1).values > 1e-3).all()


@pytest.mark.slow
def test_stopped_in_a_round_it_ends_with_the_same_bits(demos, tmp_path):
    steps = {"push": [0, 1], "reach": [0]}
    whole = make_online(demos, "residual", actor=make_residual(steps))
    whole.train()
    path = tmp_path / "checkpoint.safetensors"
    trainer = make_online(demos, "residual", path, actor=make_residual(steps))
    learner, rounds = trainer.learner, []

    def end_round(*given):
        rounds.append(1)
        if len(rounds) > 2:
            raise KeyboardInterrupt
        type(learner).end_round(learner, *given)

    learner.end_round = end_round
    with pytest.raises(KeyboardInterrupt):
        trainer.train()
    resumed = make_online(demos, "residual", path, actor=make_residual(steps))
    assert resumed.round == 2
    resumed.train()
    assert_same(flat(everything(resumed)), flat(everything(whole)))
    again = lw.load_actor(path)
    assert again.steps == {"push": [0, 1], "reach": [0]}
    assert_same(dict(again.state_dict()), dict(whole.policy.state_dict()))


def test_a_training_of_another_step_is_not_gone_on_with(demos, tmp_path):
    path, short = tmp_path / "checkpoint.safetensors", configure("residual", frames=60)
    make_online(demos, "residual", path, actor=make_residual({"push": [0]}), config=short).train()
    for steps in ({"push": [1]}, {"push": [0, 1]}, {"reach": [0]}):
        with pytest.raises(ValueError, match="its actor differs"):
            make_online(demos, "residual", path, actor=make_residual(steps), config=short)


@pytest.mark.slow
def test_the_other_tasks_of_the_policy_fare_exactly_as_before(demos):
    actor = make_residual({"push": [0, 1]})
    start = make_actor()
    start.load_state_dict(actor.base.state_dict())
    make_online(demos, "residual", actor=actor, config=configure("residual", actor_learning_rate=0.1)).train()
    given = dict(episodes_per_task=2, seed=5, max_steps=30, record_actions=True, progress=False)
    for tasks, same in ((["reach", "drawer-close"], True), (["push"], False)):
        was, now = (lw.evaluate(policy, tasks=tasks, **given) for policy in (start, actor))
        for one, other in zip(was.episodes, now.episodes, strict=True):
            assert (one.success, one.first_success) == (other.success, other.first_success) or not same
            assert torch.equal(one.actions, other.actions) == same


HOSTILE = [{"push": [9]}, {"push": [-1]}, {"push": ["0"]}, {"puhs": [0]}, {"push": [True]}, {}, "x", [[0]], {"push": 0}]


@pytest.mark.parametrize("steps", HOSTILE, ids=str)
def test_a_file_that_says_steps_that_are_not_there_is_refused(tmp_path, steps):
    lw.save_actor(make_residual({"push": [0]}), tmp_path / "good.safetensors")
    description, groups = parts(tmp_path / "good.safetensors")
    description["actor"]["options"]["steps"] = steps
    rebuild(tmp_path / "c.safetensors", description, groups)
    refuses(tmp_path / "c.safetensors", training=False)


def test_a_file_whose_base_knows_no_plans_has_no_steps(tmp_path):
    lw.save_actor(lw.ResidualActor(make_actor("dc"), width=16, depth=1), tmp_path / "good.safetensors")
    description, groups = parts(tmp_path / "good.safetensors")
    description["actor"]["options"]["steps"] = {"push": [0]}
    rebuild(tmp_path / "c.safetensors", description, groups)
    refuses(tmp_path / "c.safetensors", training=False)
