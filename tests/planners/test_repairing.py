"""try_plan and repair_plans: a plan runs in the simulator, and its model reads how it fared."""

from contextlib import contextmanager
from functools import partial

import pytest
from fake_server import PLANS, FakeServer, asked_for, completion, serving, shipped

import lw_torchrl as lw
from lw_torchrl.language.formats import PLAN_FORMATS
from lw_torchrl.planners.prompts import write_structured
from lw_torchrl.planners.repairing import plan_facts, repair_plans, try_plan

NEVER = "the robot's gripper is open and the robot's gripper is closed"
ANSWER = """def reach(robot):
    if check("the robot's gripper is not near the reach target"):
        robot.place("gripper at the reach target")
    if check("the moon is full"):
        robot.howl()
"""


def plan_with(task, change):
    """Return the shipped plan of a task after a change of its (condition, skill) pairs."""
    pairs = [(str(step.condition), step.skill) for step in PLANS[task].steps]
    return lw.ConditionalPlan.from_pairs(task, change(pairs))


@pytest.fixture(autouse=True)
def _short_episodes(monkeypatch):
    """End an episode in which a plan fails after 100 steps; plans that succeed take fewer."""
    monkeypatch.setattr("lw_torchrl.planners.repairing.evaluate", partial(lw.evaluate, max_steps=100))


@pytest.fixture
def planner(tmp_path):
    """Serve answers and yield a planner that requests them."""

    @contextmanager
    def planner(respond, **options):
        server = FakeServer(respond)
        with serving(server) as address:
            yield lw.OpenAIPlanner("m", base_url=address, cache=tmp_path / "kept", **options), server

    return planner


def test_a_step_that_never_fires_is_named():
    plan = plan_with("push", lambda pairs: [pairs[0], (NEVER, pairs[0][1]), *pairs[1:]])
    check = try_plan(lw.encode_plan(plan, "basic_py"), "push", "basic_py", episodes=2)
    assert check.never == (1,)
    assert check.expert.true[1] == check.own.true[1] == 0.0
    assert check.success == 1.0
    assert "Step 2 never fires" in str(check)
    assert "succeeds in 100% of episodes" in str(check)


def test_states_where_no_condition_holds_are_named():
    plan = lw.ConditionalPlan("push", PLANS["push"].steps[:2])
    check = try_plan(lw.encode_plan(plan, "basic_py"), "push", "basic_py", episodes=2)
    episode, first, last = max(check.expert.gaps, key=lambda gap: gap[2] - gap[1])
    assert 0 < first < last
    assert f"No condition holds in steps {first} to {last} of the expert's episode {episode}." in str(check)


def test_mapped_and_dropped_steps_are_printed():
    printed = str(try_plan(ANSWER, "reach", "basic_py", episodes=1))
    assert "hold the gripper at the reach target   <- '" in printed
    assert "the moon is full" in printed
    assert str(try_plan("I cannot.", "reach", "chain_md")).startswith("reach: no plan: ")


def test_the_facts_describe_a_failure():
    plan = plan_with("push", lambda pairs: [pairs[0], (NEVER, pairs[1][1]), *pairs[2:]])
    facts = plan_facts(try_plan(lw.encode_plan(plan, "basic_py"), "push", "basic_py", episodes=2), lw.TASKS["push"])
    assert f"step 2, '{NEVER}', held at no time" in facts
    assert "of 2 failed episodes" in facts
    assert "The robot's gripper came within " in facts
    assert "cm of the puck, and ended" in facts
    assert facts.endswith("with this corrected.")


@pytest.mark.slow
def test_a_plan_is_repaired(planner, tmp_path):
    def respond(body):  # with one step of the plan, and with the whole plan after a report
        plan = PLANS[asked_for(body)]
        reported = any(message["role"] == "assistant" for message in body["messages"])
        plan = plan if reported else plan_with(plan.task, lambda pairs: pairs[:1])
        return completion(lw.encode_plan(plan, "chain_py"))

    with planner(respond) as (model, server):
        first = model.plans(["push", "reach"], out=tmp_path / "plans", progress=False)
        repairs = repair_plans(model, first, episodes=2, out=tmp_path / "plans", progress=False)
        again = repair_plans(model, first, episodes=2, progress=False)
    push, reach = repairs
    assert [check.success for check in push.checks] == [0.0, 1.0]
    assert len(reach.answers) == 1, "the only step of its plan is its first"
    assert len(server.requests) == 3, "the second time, all answers are cached"
    assert [repair.answers[-1].text for repair in again] == [repair.answers[-1].text for repair in repairs]
    _, _, answer, facts = server.requests[-1]["messages"]
    assert (answer["role"], answer["content"], facts["role"]) == ("assistant", first[0].raw, "user")
    assert "succeeded in 0% of episodes" in facts["content"]
    assert "stuck in step 1" in facts["content"]
    assert lw.planners.FilePlanner(tmp_path / "plans", "m-round1").recorded == (("chain_py", "push", 0),)


def test_rounds_limit_the_requests(planner):
    with planner(lambda body: completion("I cannot do that.")) as (model, server):
        (repair,) = repair_plans(model, model.plans("push", progress=False), rounds=2, episodes=1, progress=False)
    assert len(repair.answers) == 3
    assert "no plan was found" in server.requests[-1]["messages"][-1]["content"]


def test_the_report_says_that_the_json_was_cut_off(planner):
    whole = write_structured(PLANS["push"], PLAN_FORMATS["chain_py"].style)
    cut = completion(whole[: whole.index('"skill"', 900)], "length")
    with planner(lambda body: cut, constrain=True) as (model, server):
        first = model.plans("push", progress=False)
        (repair,) = repair_plans(model, first, rounds=1, episodes=1, enough=1.0, progress=False)
    facts = server.requests[1]["messages"][-1]["content"]
    for part in ("too long: the answer was cut off at max_tokens.", "line 1: the answer ends or is not JSON from here"):
        assert part in facts
    assert "ends or is not JSON from here" in str(repair.checks[0])


def test_answers_and_facts_must_agree(planner):
    with planner(shipped) as (model, _):
        answers = [*model.plans("push", progress=False), *model.plans("push", format="basic_py", progress=False)]
        with pytest.raises(ValueError, match=r"answers .*basic_py, chain_py"):
            model.revise(answers, ["a", "b"])
        with pytest.raises(ValueError, match=r"answers .*facts .*2 reports"):
            model.revise(answers[:1], ["a", "b"])
