"""HeldEvaluator: asked when answers are due and no more, held in between, late if asked; part of policies and files."""

from __future__ import annotations

import pytest
import torch
from pictures import why_no_pictures
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs import Compose, SerialEnv, TransformedEnv, check_env_specs

import lw_torchrl as lw
from lw_torchrl.evaluation.swaps import TrueAnswers, with_true_answers
from lw_torchrl.modules import EVALUATORS
from lw_torchrl.trainers.evaluator_files import write_evaluator

TASKS = ("drawer-open", "reach")
PLANS = lw.Plans({task: lw.load_plans("MT10")[task] for task in TASKS})


def learned(seed=0):
    torch.manual_seed(seed)
    return lw.StateQueryEvaluator(PLANS, width=8, depth=1)


class Counting(lw.QueryEvaluator):
    """The exact answers, with how many rows were asked for them."""

    def __init__(self, plans):
        super().__init__(plans)
        self.exact, self.asked = TrueAnswers(plans), []

    def logits(self, observation, task_id):
        self.asked.append(observation.clone())
        return self.exact.logits(observation, task_id)


def actions(actor, **options):
    settings = {"tasks": TASKS, "episodes_per_task": 2, "seed": 1000, "max_steps": 40, "progress": False}
    result = lw.evaluate(actor, record_actions=True, **settings | options)
    return [one.actions for one in result.episodes]


def assert_same(found, expected):
    for one, other in zip(found, expected, strict=True):
        assert torch.equal(one, other)


def test_asked_at_every_step_it_is_the_one_inside():
    policy = lw.PlanConditionedActor(PLANS, width=8, evaluator=learned())
    held = policy.with_evaluator(lw.HeldEvaluator(policy.evaluator), answers="logit")
    assert held.in_keys == ["observation", "task_id", "qaf_held_logits"]
    assert_same(actions(held), actions(policy))


@pytest.mark.parametrize(("every", "delay"), [(7, 0), (1, 3), (5, 8)])
def test_exact_answers_are_held_as_qaf_transform_holds_them(every, delay):
    scripted = lw.ScriptedSkillActor(PLANS)
    expected = actions(scripted, evaluator=lw.QAFTransform(PLANS, every=every, delay=delay))
    held = lw.HeldEvaluator(TrueAnswers(PLANS), every=every, delay=delay)
    assert_same(actions(scripted.with_evaluator(held)), expected)
    assert_same(actions(scripted, evaluator=held), expected)
    at_once = actions(scripted)
    assert not all(torch.equal(one, other) for one, other in zip(at_once, expected, strict=True))


def test_results_do_not_depend_on_num_envs():
    actor = lw.PlanConditionedActor(PLANS, width=8, evaluator=lw.HeldEvaluator(learned(), every=4))
    assert_same(actions(actor, num_envs=4), actions(actor, num_envs=2))


def test_only_rows_whose_answers_are_due_are_asked():
    inside = Counting(PLANS)
    held = lw.HeldEvaluator(inside, every=3)
    env = TransformedEnv(lw.LanguageWorldEnv(TASKS, num_envs=4, seed=1), held.transform())
    state = env.reset()
    counts = []

    def asked():
        """Different rows since the last look; blocks are filled with copies."""
        rows = torch.cat(inside.asked).unique(dim=0) if inside.asked else torch.zeros(0)
        inside.asked.clear()
        counts.append(len(rows))

    asked()
    for step in range(1, 7):
        moved = torch.tensor([True, True, True, step != 2])  # the last row is a step behind from there on
        state = env.step(env.rand_action(state).set("_step", moved))["next"]
        asked()
    assert counts == [4, 0, 0, 3, 1, 0, 3]
    env.reset(state.set("_reset", torch.tensor([False, True, False, False])))
    asked()
    assert counts[-1] == 1
    env.close()


def test_specs_and_workers():
    env = TransformedEnv(lw.LanguageWorldEnv(TASKS), lw.HeldEvaluator(learned(), every=2).transform())
    check_env_specs(env)
    env.close()
    workers = SerialEnv(2, lambda: lw.LanguageWorldEnv("reach", max_steps=3))
    env = TransformedEnv(workers, lw.HeldEvaluator(learned(), every=2).transform())
    assert env.rollout(7, break_when_any_done=False)["qaf_held_logits"].shape == (2, 1, 7, PLANS.num_steps)
    env.close()


def test_after_load_state_dict_a_reset_is_wanted():
    def make():
        return TransformedEnv(lw.LanguageWorldEnv("reach"), lw.HeldEvaluator(learned(), every=2).transform())

    env, other = make(), make()
    env.reset()
    began = other.reset()
    other.load_state_dict(env.state_dict())
    with pytest.raises(RuntimeError, match=r"since load_state_dict"):
        other.step(other.rand_action(began))
    assert other.reset()["episode"] == 1
    env.close()
    other.close()


def test_policies_and_evaluators_with_it_are_made_again_from_files(tmp_path):
    held = lw.HeldEvaluator(learned(), every=6, delay=2)
    actor = lw.PlanConditionedActor(PLANS, width=8, evaluator=held).eval()
    lw.save_actor(actor, tmp_path / "policy.zip")
    again = lw.load_actor(tmp_path / "policy.zip")
    assert (again.evaluator.every, again.evaluator.delay) == (6, 2)
    assert_same(actions(again), actions(actor))
    lw.save_evaluator(held, tmp_path / "evaluator.zip")
    other = lw.load_evaluator(tmp_path / "evaluator.zip", PLANS)
    scripted = lw.ScriptedSkillActor(PLANS)
    assert_same(actions(scripted.with_evaluator(other)), actions(scripted.with_evaluator(held)))


def test_a_file_that_goes_deeper_and_deeper_is_refused(tmp_path):
    held = lw.HeldEvaluator(learned())

    class Deep(lw.HeldEvaluator):
        def describe(self):
            return {"kind": "HeldEvaluator", "options": {"evaluator": super().describe(), "every": 1, "delay": 0}}

    deep = Deep(learned())
    deep.describe = lambda: {"kind": "HeldEvaluator", "options": {"evaluator": held.describe(), "every": 1}}
    write_evaluator(deep, tmp_path / "deep.zip", {})
    with pytest.raises(ValueError, match=r"a HeldEvaluator cannot hold another"):
        lw.load_evaluator(tmp_path / "deep.zip", PLANS)
    assert "HeldEvaluator" in EVALUATORS


def test_other_plans_share_the_weights_of_the_one_inside():
    held = lw.HeldEvaluator(learned(), every=4, delay=1)
    other = held.with_plans(lw.Plans({"reach": PLANS["reach"]}))
    assert (other.every, other.delay) == (4, 1)
    assert {id(weight) for weight in other.parameters()} == {id(weight) for weight in held.parameters()}


def test_true_answers_take_its_place():
    actor = lw.ScriptedSkillActor(PLANS, evaluator=lw.HeldEvaluator(learned(), every=4))
    assert_same(actions(with_true_answers(actor)), actions(lw.ScriptedSkillActor(PLANS)))
    result = lw.evaluate(
        actor, tasks="drawer-open", episodes_per_task=1, seed=1000, max_steps=150, attribute=True, progress=False
    )
    assert [failure.cause for failure in result.failures] == ["query"]
    assert result.failures[0].evidence["answers_wrong"] > 0.1


def test_it_is_for_acting():
    env = lw.LanguageWorldEnv("reach")
    rows = env.rollout(3).reshape(-1)
    env.close()
    buffer = ReplayBuffer(storage=LazyTensorStorage(3), transform=lw.HeldEvaluator(learned()).transform(), batch_size=2)
    buffer.extend(rows)
    with pytest.raises(ValueError, match=r"train a policy with the evaluator itself"):
        buffer.sample()


def test_a_camera_takes_no_other_pictures():
    if missing := why_no_pictures():
        pytest.skip(missing)
    torch.manual_seed(0)
    eyes = lw.ImageQueryEvaluator(PLANS, cameras="corner", height=16, width=16, hidden=8, depth=1, every=2)
    transform = lw.HeldEvaluator(eyes, every=4).transform()
    assert isinstance(transform, Compose)
    assert transform[0].every == 4
    assert eyes.transform().every == 2
    actor = lw.ScriptedSkillActor(PLANS, evaluator=lw.HeldEvaluator(eyes, every=4))
    four = lw.ImageQueryEvaluator(PLANS, **{**eyes.config, "every": 4})
    four.load_state_dict(eyes.state_dict())
    assert_same(actions(actor, max_steps=10), actions(lw.ScriptedSkillActor(PLANS, evaluator=four), max_steps=10))


def test_what_cannot_be_is_named():
    with pytest.raises(TypeError, match=r"evaluator must be a QueryEvaluator, got QAFTransform"):
        lw.HeldEvaluator(lw.QAFTransform(PLANS))
    with pytest.raises(ValueError, match=r"must not be a HeldEvaluator itself"):
        lw.HeldEvaluator(lw.HeldEvaluator(learned()))
    with pytest.raises(ValueError, match=r"every must be at least 1, got 0"):
        lw.HeldEvaluator(learned(), every=0)
    with pytest.raises(ValueError, match=r"delay must be at least 0, got -1"):
        lw.HeldEvaluator(learned(), delay=-1)


def test_rollouts_without_what_it_reads_are_refused():
    actor = lw.ScriptedSkillActor(PLANS, evaluator=lw.HeldEvaluator(learned(), every=4))
    found = []
    settings = {"seed": 1000, "max_steps": 30, "progress": False}
    lw.evaluate(
        actor,
        tasks="drawer-open",
        episodes_per_task=1,
        also_record=["observation", "task_id", "episode", "qaf"],
        on_episode=found.append,
        **settings,
    )
    with pytest.raises(ValueError, match=r"rollouts must hold qaf_held_logits, which the policy's evaluator reads"):
        lw.attribute_failures([one.steps for one in found], PLANS, actor=actor, noise_scale=0.1, **settings)
