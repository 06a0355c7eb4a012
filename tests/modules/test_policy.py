"""plans_of, tasks_of, layout_of, transform_of and with_plans on every kind of actor."""

import pytest
import torch
from small_actors import ACTORS, CANONICAL, FALLBACK, PLANS, make_actor, make_descriptor, make_role_actor, make_rows
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.envs import Compose

import lw_torchrl as lw
from lw_torchrl.language.layout import METAWORLD
from lw_torchrl.modules import layout_of, plans_of, tasks_of, transform_of, with_plans
from lw_torchrl.suites import load_suite
from lw_torchrl.transforms import FallbackTurns, QAFTransform

PLAIN = TensorDictModule(nn.Linear(39, 4), in_keys=["observation"], out_keys=["action"])


@pytest.mark.parametrize("name", ACTORS)
def test_plans_tasks_and_layout_of_every_actor(name):
    actor = ACTORS[name]()
    expected = {"roles": CANONICAL, "demonstrated": CANONICAL, "fallback": FALLBACK}.get(name, PLANS)
    expected = None if name in ("description", "one-hot", "normal") else expected
    assert plans_of(actor) == expected
    assert tasks_of(actor) == lw.MT10
    assert layout_of(actor) == METAWORLD


def test_plain_module_has_no_plans_and_no_tasks():
    assert (plans_of(PLAIN), tasks_of(PLAIN), layout_of(PLAIN), transform_of(PLAIN)) == (None, None, METAWORLD, None)
    assert isinstance(transform_of(PLAIN, PLANS), QAFTransform)
    fetch = load_suite("fetch").plans
    assert layout_of(make_actor(fetch)) == fetch.layout


def test_transform_writes_what_the_actor_reads():
    assert transform_of(make_descriptor()) is None
    assert transform_of(ACTORS["evaluator"]()) is None
    fallback = transform_of(make_role_actor(FALLBACK))
    assert isinstance(fallback, Compose)
    assert [type(part) for part in fallback.transforms] == [QAFTransform, FallbackTurns]
    actor = make_actor(in_keys=["truth", ("words", "task"), "state"])
    queries = transform_of(actor)
    rows = make_rows(3, answered=False)
    moved = TensorDict({"state": rows["observation"], ("words", "task"): rows["task_id"]}, [3])
    assert torch.equal(queries(moved)["truth"], transform_of(make_actor())(rows)["qaf"])
    assert "truth_plan" in moved.keys()


@pytest.mark.parametrize("name", [name for name in ACTORS if name not in ("description", "one-hot", "normal")])
def test_with_plans_shares_every_weight(name):
    actor = ACTORS[name]().eval()
    own = {"push": PLANS["push"]}
    if name in ("roles", "fallback", "demonstrated"):
        own = lw.canonical_plans(own, fallback=name == "fallback")
    other = with_plans(actor, own)
    assert (plans_of(other), other.training) == (lw.Plans(own), False)
    assert {id(one) for one in other.parameters()} == {id(one) for one in actor.parameters()}
    rows = make_rows(4, plans=lw.Plans(own), answered=False)
    transforms = [(each, transform_of(each) or nn.Identity()) for each in (actor, other)]
    torch.testing.assert_close(*(each(transform(rows.copy()))["action"] for each, transform in transforms))


def test_actors_that_cannot_follow_other_plans_are_refused():
    with pytest.raises(TypeError, match="with_plans"):
        with_plans(make_descriptor(), PLANS)

    mine = type("Mine", (TensorDictModule,), {})(nn.Linear(39, 4), in_keys=["observation"], out_keys=["action"])
    mine.plans = PLANS
    with pytest.raises(TypeError, match="Mine"):
        with_plans(mine, PLANS)
    sequence = with_plans(TensorDictSequential(PLAIN, make_actor()), {"push": PLANS["push"]})
    assert sequence[0] is PLAIN
