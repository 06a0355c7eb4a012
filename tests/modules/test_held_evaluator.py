"""HeldEvaluator: what it asks when, and that it holds answers as QAFTransform does."""

from __future__ import annotations

import pytest
import torch
from held_evaluators import PLANS, ROWS, evaluated, learned, same
from pictures import why_no_pictures
from random_states import PLANS as STATES_PLANS
from random_states import RandomStates
from torch import nn
from torchrl.envs import Compose, SerialEnv, TransformedEnv, check_env_specs

import lw_torchrl as lw
from benchmarks.evaluator_report import condition_drift
from lw_torchrl._devices import BLOCK
from lw_torchrl.evaluation.counterfactuals import TrueAnswers, own_evaluators, with_true_answers
from lw_torchrl.record.rollouts import run_recorded


class Spy(lw.QueryEvaluator):
    """Exact answers; keeps how many rows it was asked about, and in which mode."""

    def __init__(self, plans):
        super().__init__(plans)
        self.exact, self.seen = TrueAnswers(plans), []
        self.weight = nn.Parameter(torch.ones(()))

    def logits(self, *read):
        self.seen.append((len(read[1]), self.training, torch.is_grad_enabled()))
        return self.weight * self.exact.logits(*read)


# --- what it answers -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["pcbc", "scripted", "outside"])
def test_at_every_step_it_is_what_it_holds(kind):
    evaluator, actor = learned(), lw.PlanConditionedActor(PLANS, width=8)
    if kind == "outside":
        runs = [evaluated(actor, evaluator=one) for one in (evaluator, lw.HeldEvaluator(evaluator))]
    elif kind == "scripted":
        held = lw.HeldEvaluator(evaluator)
        runs = [evaluated(lw.ScriptedSkillActor(PLANS, evaluator=one)) for one in (evaluator, held)]
    else:
        policy = actor.with_evaluator(evaluator, answers="tanh")
        runs = [evaluated(one) for one in (policy, policy.with_evaluator(lw.HeldEvaluator(evaluator), answers="tanh"))]
    assert same(runs[0][0], runs[1][0])


@pytest.mark.parametrize(
    ("every", "delay"), [(1, 0), *(pytest.param(*one, marks=pytest.mark.slow) for one in ((5, 0), (1, 3))), (5, 2)]
)
def test_exact_answers_are_held_as_those_of_qaf_transform(every, delay):
    actor = lw.ScriptedSkillActor(PLANS)
    transform = lw.QAFTransform(PLANS, every=every, delay=delay)
    held = lw.HeldEvaluator(TrueAnswers(PLANS), every=every, delay=delay)
    expected, truth = evaluated(actor, evaluator=transform, max_steps=30, also_record=["qaf"])
    found, answers = evaluated(actor, evaluator=held, max_steps=30, also_record=["qaf", "qaf_held_logits"])
    inside, _ = evaluated(actor.with_evaluator(held), max_steps=30)
    assert same(found, expected)
    assert same(inside, expected)
    for which, steps in truth.items():
        assert torch.equal(steps["qaf"], answers[which]["qaf"])
        assert torch.equal(steps["qaf"], answers[which]["qaf_held_logits"] == 5.0)
    exact, _ = evaluated(actor, max_steps=30)
    assert same(found, exact) == ((every, delay) == (1, 0))


def both(env, every, delay, evaluator=None):
    """The environment with held answers of a transform and of an evaluator."""
    held = lw.HeldEvaluator(evaluator or TrueAnswers(STATES_PLANS), every=every, delay=delay)
    return TransformedEnv(
        env, Compose(lw.QAFTransform(STATES_PLANS, every=every, delay=delay), held.transform().clone())
    )


@pytest.mark.parametrize(("every", "delay"), [(1, 0), (3, 0), (2, 3)])
def test_any_masks_of_steps_and_resets(every, delay):
    env, drawn = both(RandomStates(ROWS), every, delay), torch.Generator().manual_seed(every)
    state = env.reset()
    for step in range(40):
        mask = torch.rand(ROWS, generator=drawn) < 0.6
        if step % 7 == 6 and mask.any():
            state = env.reset(state.set("_reset", mask))
        else:
            state = env.step(state.set("action", torch.zeros(ROWS, 4)).set("_step", mask))["next"]
        assert torch.equal(state["qaf"], state["qaf_held_logits"] > 0)


@pytest.mark.parametrize("place", ["inside", "outside"])
def test_workers_of_a_serial_env(place):
    if place == "inside":
        env = SerialEnv(2, [lambda: both(RandomStates(2, 5), 3, 1), lambda: both(RandomStates(2, 6, first=2), 3, 1)])
    else:
        env = both(SerialEnv(2, [lambda: RandomStates(2, 5), lambda: RandomStates(2, 6, first=2)]), 3, 1)
    rollout = env.rollout(25, break_when_any_done=False)
    env.close()
    for part in (rollout, rollout["next"]):
        assert torch.equal(part["qaf"], part["qaf_held_logits"] > 0)


def test_a_single_environment_and_its_specs():
    held = lw.HeldEvaluator(learned(), every=3, delay=1)
    env = TransformedEnv(lw.LanguageWorldEnv("reach", batch_size=(), max_steps=4), held.transform())
    check_env_specs(env)
    rollout = env.rollout(9, break_when_any_done=False)
    env.close()
    assert rollout["qaf_held_logits"].shape == (9, PLANS.num_steps)
    assert rollout["qaf_held_logits"].dtype == torch.float32
    assert torch.equal(rollout["qaf_held_logits"][1], rollout["qaf_held_logits"][0])


# --- what it asks --------------------------------------------------------------------------------------------------


def test_it_asks_about_the_rows_that_are_due_and_no_others():
    spy = Spy(STATES_PLANS).train()
    transform = lw.HeldEvaluator(spy, every=3).transform()
    asked, ask = [], transform.ask
    transform.ask = lambda rows: asked.append(len(rows)) or ask(rows)
    env = TransformedEnv(RandomStates(ROWS), transform)
    state = env.reset()
    assert asked == [ROWS]
    steps = torch.zeros(ROWS, dtype=torch.int64)
    for mask in ([1, 1, 1, 0], [1, 1, 0, 0], [1, 1, 0, 0], [0, 0, 1, 0], [0, 0, 1, 1], [1, 0, 0, 1], [0, 0, 0, 1]):
        moved, before = torch.tensor(mask, dtype=torch.bool), len(asked)
        state = env.step(state.set("action", torch.zeros(ROWS, 4)).set("_step", moved))["next"]
        steps += moved
        due = int((moved & (steps % 3 == 0)).sum())
        assert asked[before:] == ([due] if due else [])
    env.reset(state.set("_reset", torch.tensor([False, True, True, False])))
    assert asked == [ROWS, 2, 1, 1, 2]
    assert spy.seen == [(BLOCK, False, False)] * len(asked), "padded blocks, in eval mode, without gradients"
    assert spy.training
    assert spy.exact.training


def test_blocks_are_of_one_size_however_many_rows():
    spy = Spy(STATES_PLANS)
    env = TransformedEnv(RandomStates(BLOCK + 6), lw.HeldEvaluator(spy).transform())
    env.reset()
    assert [rows for rows, *_ in spy.seen] == [BLOCK, BLOCK]


def test_results_do_not_depend_on_num_envs():
    held = lw.HeldEvaluator(learned(), every=4, delay=1)
    actor = lw.PlanConditionedActor(PLANS, width=8).with_evaluator(held, answers="logit")
    runs = [evaluated(actor, num_envs=n, episodes_per_task=3, also_record=["qaf_held_logits"]) for n in (2, 4, 6)]
    for actions, seen in runs[1:]:
        assert same(actions, runs[0][0])
        assert all(torch.equal(seen[one]["qaf_held_logits"], runs[0][1][one]["qaf_held_logits"]) for one in seen)


def test_weights_that_change_are_asked_as_they_are():
    spy = Spy(STATES_PLANS)
    env = TransformedEnv(RandomStates(ROWS), lw.HeldEvaluator(spy).transform())
    before = env.reset()["qaf_held_logits"]
    with torch.no_grad():
        spy.weight *= 2
    assert before.abs().unique().tolist() == [5.0]
    assert env.reset()["qaf_held_logits"].abs().unique().tolist() == [10.0]
    assert not [name for name in env.transform.state_dict() if "weight" in name]


# --- with the rest -------------------------------------------------------------------------------------------------


def test_after_a_loaded_state_a_reset_is_wanted():
    env = TransformedEnv(RandomStates(2), lw.HeldEvaluator(TrueAnswers(STATES_PLANS), every=2).transform())
    state = env.reset()
    env.load_state_dict(env.state_dict())
    with pytest.raises(RuntimeError, match=r"not since load_state_dict.*reset the environment"):
        env.step(state.set("action", torch.zeros(2, 4)))


def test_true_answers_take_its_place_and_nothing_inside_it():
    held = lw.HeldEvaluator(Spy(PLANS), every=20)
    actor = lw.PlanConditionedActor(PLANS, width=8).with_evaluator(held, answers="hard")
    assert own_evaluators(actor) == [held]
    true = with_true_answers(actor)
    assert true.in_keys == ["observation", "task_id"]
    assert isinstance(true.evaluator, TrueAnswers)
    assert own_evaluators(true) == [true.evaluator]
    assert isinstance(actor.evaluator.evaluator, Spy)
    expected, _ = evaluated(actor.with_evaluator(TrueAnswers(PLANS), answers="logit"))
    assert same(evaluated(true)[0], expected)


def test_late_answers_are_what_failed():
    """A plan that is carried out with exact answers, and not with those of the reset."""
    held = lw.HeldEvaluator(TrueAnswers(PLANS), every=500)
    actor = lw.ScriptedSkillActor(PLANS, evaluator=held)
    run = {"tasks": "drawer-open", "episodes_per_task": 1, "seed": 7, "max_steps": 80, "progress": False}
    [failure] = lw.evaluate(actor, attribute=True, stop_at_success=True, **run).failures
    assert failure.cause == "query"
    assert failure.counterfactuals["query"] is True


def test_recordings_have_both_truths():
    actor = lw.ScriptedSkillActor(PLANS, evaluator=lw.HeldEvaluator(TrueAnswers(PLANS), every=4))
    [episode] = run_recorded(actor, "drawer-open", seed=7, max_steps=30)
    exact = lw.QAFTransform(PLANS)(episode.steps.select("observation", "task_id"))["qaf"]
    believed = episode.steps["qaf_logits"] > 0
    assert torch.equal(believed, exact[torch.arange(30) // 4 * 4])
    assert not torch.equal(believed, exact)
    agreement = [one.agreement for one in condition_drift(actor, episode.steps)]
    assert min(agreement) < 1.0


def test_other_plans_share_its_weights():
    drawer = lw.Plans({"drawer-open": PLANS["drawer-open"]})
    actor = lw.ScriptedSkillActor(PLANS, evaluator=lw.HeldEvaluator(learned(), every=3, delay=1).eval())
    other = actor.with_plans(drawer).evaluator
    assert (other.every, other.delay, other.training) == (3, 1, False)
    assert {id(one) for one in other.parameters()} == {id(one) for one in actor.parameters()}
    made = actor.evaluator.made_for(drawer)
    assert (made.every, made.evaluator.config) == (3, actor.evaluator.evaluator.config)
    assert not {id(one) for one in made.parameters()} & {id(one) for one in actor.parameters()}


# --- pictures ------------------------------------------------------------------------------------------------------


SMALL = {"height": 16, "width": 24, "hidden": 8, "depth": 1}


@pytest.mark.parametrize(("own", "every", "drawn"), [(1, 4, 4), (2, 4, 4), (4, 4, 4), (8, 4, 8), (2, 3, 2)])
def test_cameras_draw_what_is_looked_at(own, every, drawn):
    eyes = lw.modules.ImageQueryEvaluator(PLANS, every=own, **SMALL)
    camera, asks = lw.HeldEvaluator(eyes, every=every, delay=1).transform().transforms
    assert (camera.every, asks.every, asks.delay) == (drawn, every, 1)
    assert asks.in_keys == ["pixels", "task_id"]
    assert eyes.transform().every == own


class TestPictures:
    @pytest.fixture(autouse=True)
    def _needs_open_gl(self):
        if missing := why_no_pictures():
            pytest.skip(missing)

    @pytest.mark.parametrize("inside", [True, pytest.param(False, marks=pytest.mark.slow)])
    def test_at_every_step_it_is_what_it_holds(self, inside):
        torch.manual_seed(0)
        eyes, actor = lw.modules.ImageQueryEvaluator(PLANS, **SMALL), lw.PlanConditionedActor(PLANS, width=8)
        settings = {"episodes_per_task": 1, "max_steps": 6}
        runs = []
        for one in (eyes, lw.HeldEvaluator(eyes)):
            if inside:
                runs.append(evaluated(actor.with_evaluator(one, answers="logit"), **settings)[0])
            else:
                runs.append(evaluated(actor, evaluator=one, **settings)[0])
        assert same(*runs)

    def test_the_answers_are_of_the_pictures_of_steps_that_are_due(self):
        torch.manual_seed(0)
        eyes, actor = lw.modules.ImageQueryEvaluator(PLANS, **SMALL), lw.PlanConditionedActor(PLANS, width=8)
        held = actor.with_evaluator(lw.HeldEvaluator(eyes, every=4), answers="logit")
        keys = ["pixels", "task_id", "qaf_held_logits"]
        _, seen = evaluated(held, episodes_per_task=1, also_record=keys)
        for steps in seen.values():
            logits = steps["qaf_held_logits"]
            assert torch.equal(logits, logits[torch.arange(12) // 4 * 4])
            assert not torch.equal(logits[0], logits[4])
            with torch.no_grad():
                assert torch.allclose(logits, eyes.eval()(steps)["qaf_logits"], atol=1e-4)


def test_rollouts_without_what_it_reads_are_refused():
    """They had been told by the exact answers: no failure was a query's."""
    actor = lw.ScriptedSkillActor(PLANS, evaluator=lw.HeldEvaluator(lw.StateQueryEvaluator(PLANS, width=8), every=4))
    found = []
    settings = {"seed": 1000, "max_steps": 30, "progress": False}
    lw.evaluate(
        actor,
        tasks=PLANS,
        episodes_per_task=1,
        also_record=["observation", "task_id", "episode", "qaf"],
        on_episode=found.append,
        **settings,
    )
    with pytest.raises(ValueError, match=r"rollouts must hold qaf_held_logits, which the policy's evaluator reads"):
        lw.attribute_failures([one.steps for one in found], PLANS, actor=actor, noise_scale=0.1, **settings)
