"""repair_plans: a model is told what became of its plan, and its next one is carried out, too."""

from __future__ import annotations

import pytest
from fake_server import PLANS, FakeServer, asked_for, completion, serving

import lw_torchrl as lw
from benchmarks.plan_comparison import compare_plans
from lw_torchrl.language.formats import PLAN_FORMATS
from lw_torchrl.language.formats.structured import write_structured
from lw_torchrl.language.tasks import TASKS
from lw_torchrl.planners.checking import check_plan
from lw_torchrl.planners.repairing import plan_facts, repair_plans


def without_its_end(plan):
    pairs = [(str(one.condition), one.skill) for one in plan.steps]
    return lw.ConditionalPlan.from_pairs(plan.definition, pairs[:1])


def learns(body):
    """A model that writes half a plan, and the whole of it once it was told what became of that."""
    plan = PLANS[asked_for(body)]
    told = [message for message in body["messages"] if message["role"] == "assistant"]
    return completion(lw.encode_plan(plan if told else without_its_end(plan), "chain_py"))


@pytest.fixture
def planner(tmp_path, monkeypatch):
    monkeypatch.setenv("NO_PROXY", "*")
    monkeypatch.delenv("OPENAI_API_KEY", raising=False)

    def make(server, **options):
        return lw.OpenAIPlanner("m", base_url=server, cache=tmp_path / "kept", **options)

    return make


@pytest.mark.slow
def test_a_plan_is_repaired_by_what_became_of_it(planner, tmp_path):
    server = FakeServer(learns)
    with serving(server) as address:
        asked = planner(address)
        first = asked.plans(["push", "reach"], out=tmp_path / "plans", progress=False)
        found = repair_plans(asked, first, rounds=3, episodes=2, out=tmp_path / "plans", progress=False)
        requests = len(server.requests)
        again = repair_plans(asked, first, rounds=3, episodes=2, progress=False)
    push, reach = found
    assert [check.success for check in push.checks] == [0.0, 1.0]
    assert push.best == 1
    assert len(reach.answers) == 1, "the only step of its plan is its first"
    assert requests == 3
    assert len(server.requests) == 3, "what was answered is not asked for again"
    assert [one.answers[-1].text for one in again] == [one.answers[-1].text for one in found]
    system, user, said, facts = server.requests[-1]["messages"]
    assert [message["role"] for message in (system, user, said, facts)] == ["system", "user", "assistant", "user"]
    assert said["content"] == first[0].raw
    assert "succeeded in 0% of episodes" in facts["content"]
    assert "stuck in step 1" in facts["content"]
    compared = compare_plans(tmp_path / "plans", episodes=2, progress=False)
    assert compared.models == ("m", "m-round1")
    assert compared.rates("m-round1", "chain_py") == {"push": [1.0]}


def test_a_model_that_learns_nothing_is_asked_so_many_times(planner):
    server = FakeServer(lambda body: completion("I cannot do that."))
    with serving(server) as address:
        asked = planner(address)
        first = asked.plans("push", progress=False)
        (found,) = repair_plans(asked, first, rounds=2, episodes=1, progress=False)
    assert len(found.answers) == 3
    assert found.best == 0
    assert "no plan was found" in server.requests[-1]["messages"][-1]["content"]


@pytest.mark.slow
def test_a_model_is_told_where_its_json_was_cut_off(planner):
    """The text in the format, made of the JSON, has no trace of it."""
    whole = write_structured(PLANS["push"], PLAN_FORMATS["chain_py"].style)
    server = FakeServer(lambda body: completion(whole[: whole.index('"skill"', 900)], "length"))
    with serving(server) as address:
        asked = planner(address, constrain=True)
        (found,) = repair_plans(
            asked, asked.plans("push", progress=False), rounds=1, episodes=1, enough=1.0, progress=False
        )
    told = server.requests[1]["messages"][-1]["content"]
    assert "The answer is too long: it was cut off at max_tokens." in told
    assert "In the answer, line 1: the answer ends or is no JSON from here" in told
    assert "ends or is no JSON from here" in str(found.checks[0])
    assert "it was cut off at max_tokens" in plan_facts(
        check_plan("", "push", "basic_py"), TASKS["push"], ["it was cut off at max_tokens", "the server lies"]
    )


def test_the_facts_say_what_is_needed_to_mend_a_plan():
    plan = PLANS["push"]
    pairs = [(str(one.condition), one.skill) for one in plan.steps]
    pairs[1] = ("the robot's gripper is open and the robot's gripper is closed", pairs[1][1])
    text = lw.encode_plan(lw.ConditionalPlan.from_pairs("push", pairs), "basic_py")
    facts = plan_facts(check_plan(text, "push", "basic_py", episodes=2), TASKS["push"])
    assert "step 2, 'the robot's gripper is open and the robot's gripper is closed', held at no time" in facts
    assert "of 2 failed episodes" in facts
    assert "The robot's gripper came within " in facts
    assert "cm of the puck, and ended" in facts
    assert facts.endswith("with this mended.")


def test_what_is_refused(planner, tmp_path):
    with serving(FakeServer()) as address:
        asked = planner(address)
        answers = [*asked.plans("push", progress=False), *asked.plans("push", format="basic_py", progress=False)]
        with pytest.raises(ValueError, match="of one format, each with its facts, got 2 answers of basic_py, chain_py"):
            asked.revise(answers, ["a", "b"])
        with pytest.raises(ValueError, match="got 1 answer of chain_py and 2 facts"):
            asked.revise(answers[:1], ["a", "b"])
        with pytest.raises(ValueError, match="rounds must be at least 1"):
            repair_plans(asked, answers[:1], rounds=0)
