"""Policies that see canonical plans: of anybody's words, without a text model, refused where the rules are others."""

import json
import subprocess
import sys

import pytest
import torch
from lw_torchrl.language.canonical_steps import read_canonical, step_vectors
from tensordict import TensorDict

import lw_torchrl as lw
from lw_torchrl.language.canonical import RULES
from lw_torchrl.training.checkpoint import read_description, text_vectors

MT10, MT50 = lw.load_plans("MT10"), lw.load_plans("MT50")
SMALL = {"width": 8, "depth": 1, "latent_size": 4, "encoder_width": 8}
KINDS = {
    "roles": {"roles": True, "features": "none"},
    "canonical": {"canonical": True},
    "focus": {"canonical": True, "focus": True},
}
MINE = lw.ConditionalPlan.from_pairs(
    "coffee-pull",
    [
        ("the gripper is not above the mug", "put gripper over mug"),
        ("the gripper is near the mug", "grab it"),
        ("the gripper is near the mug", "bring the mug to the goal"),
    ],
)


def refuse(texts):
    pytest.fail(f"a text encoder was asked for {texts}")


def make(plans=MT10, kind="roles", **options):
    torch.manual_seed(0)
    options = {"text_encoder": refuse, "feature_noise": 0.0, **SMALL, **KINDS[kind], **options}
    return lw.PlanConditionedActor(plans, **options).eval()


def make_state(actor, rows=12):
    ids = torch.tensor([lw.task_id(task) for task in actor.tasks])[torch.arange(rows) % len(actor.tasks)]
    state = TensorDict(observation=torch.rand(rows, 39), task_id=ids).auto_batch_size_()
    return actor.transform()(state)


@pytest.mark.parametrize("kind", KINDS)
def test_its_plans_are_the_canonical_ones_and_no_text_is_read(kind):
    actor = make(MT50, kind)
    assert actor.encoder.written == MT50
    assert actor.encoder.canonical == {task: read_canonical(plan) for task, plan in MT50.items()}
    assert actor.plans.fingerprint == lw.Plans([read_canonical(plan).plan for plan in MT50.values()]).fingerprint
    assert actor.encoder.trust == {task: read_canonical(plan).trust for task, plan in MT50.items()}
    assert text_vectors(actor) == {}
    assert actor(make_state(actor))["action"].shape == (12, 4)


def test_without_it_plans_are_as_written():
    actor = lw.PlanConditionedActor(MT10, **SMALL)
    assert (actor.plans, actor.encoder.canonical, actor.encoder.trust) == (MT10, {}, {})
    assert actor.encoder.written is actor.plans


def test_steps_of_one_kind_have_one_latent_in_every_task():
    encoder = make(MT50).encoder
    tables, plans = encoder.attention.tables, encoder.canonical
    for task in ("push", "coffee-pull", "shelf-place"):
        vectors = encoder.text_vectors[encoder.skill_index[tables.index.row(task)]]
        for number, vector in enumerate(step_vectors(plans[task])):
            assert torch.equal(vectors[number] > 0, torch.tensor(vector) > 0)
    approach = [encoder.skill_index[tables.index.row(task), 0].item() for task in ("push", "coffee-pull")]
    assert approach[0] == approach[1]


def test_answers_of_plans_as_written_are_refused_and_it_is_said_what_to_do():
    actor = make()
    state = TensorDict(observation=torch.rand(3, 39), task_id=torch.full((3,), lw.task_id("drawer-open")))
    wrong = lw.QAFTransform(MT10)(state.auto_batch_size_())
    with pytest.raises(
        ValueError, match=r"for drawer-open: give QAFTransform actor\.plans, which with roles are canon"
    ):
        actor(wrong)


@pytest.mark.parametrize("kind", KINDS)
def test_somebody_s_words(kind):
    actor = make(MT10, kind)
    other = actor.with_plans({"coffee-pull": MINE})
    assert other.encoder.written["coffee-pull"] == MINE
    assert other.plans["coffee-pull"] == read_canonical(MINE).plan
    assert other.encoder.trust["coffee-pull"] < 0.75
    assert other.head is actor.head
    assert other.encoder.texts is actor.encoder.texts
    state = make_state(other)
    assert other(state)["skill_weights"].shape == (12, 4)
    ours = actor.with_plans({"coffee-pull": MT50["coffee-pull"]})
    if kind == "roles":  # ours has the same motion, things and points
        away = torch.rand(12, 39) * 0.1
        away[:, 0] += 0.3  # far to the side
        state = TensorDict(observation=away, task_id=state["task_id"]).auto_batch_size_()
        done = [one(one.transform()(state.clone()))["action"] for one in (other, ours)]
        torch.testing.assert_close(*done, atol=0.02, rtol=0)


PROGRAM = """
import json, sys
sys.modules["sentence_transformers"] = None
import lw_torchrl as lw, torch
from lw_torchrl.language import text

def refuse(*_, **__):
    raise SystemExit("a text was encoded")

for name in ("encoded", "default_text_encoder", "shipped"):
    if hasattr(text, name):
        setattr(text, name, refuse)
actor = lw.load_actor(sys.argv[1])
torch.manual_seed(0)
env = lw.LanguageWorldEnv("coffee-pull", seed=3)
state = actor(actor.transform()(env.reset()))
words = [one.skill for one in actor.encoder.written["coffee-pull"].steps]
print(json.dumps([state["action"].tolist(), actor.encoder.trust, words]))
"""


def test_trained_on_plans_in_ones_own_words_it_acts_in_a_new_process_without_a_text_model(tmp_path):
    lw.collect_demonstrations("coffee-pull", episodes_per_task=1, root=tmp_path / "demos", max_steps=60, progress=False)
    actor = make({"coffee-pull": MINE})
    replay = lw.LanguageWorldExperienceReplay(tmp_path / "demos", transform=actor.transform())
    config = lw.BehavioralCloningConfig(steps=3, batch_size=8)
    lw.BehavioralCloningTrainer(
        actor, replay, config, checkpoint=tmp_path / "policy.safetensors", progress=False
    ).train()
    lw.save_actor(actor, tmp_path / "policy.safetensors")
    command = [sys.executable, "-c", PROGRAM, str(tmp_path / "policy.safetensors")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=240)
    assert done.returncode == 0, done.stderr
    action, trust, words = json.loads(done.stdout)
    env = lw.LanguageWorldEnv("coffee-pull", seed=3)
    ours = actor.eval()(actor.transform()(env.reset()))["action"]
    env.close()
    torch.testing.assert_close(torch.tensor(action), ours)
    assert trust == actor.encoder.trust
    assert words == [step.skill for step in MINE.steps]


@pytest.mark.parametrize("kind", KINDS)
def test_a_file_keeps_the_plans_as_written_and_the_rules(kind, tmp_path):
    actor = make({"coffee-pull": MINE}, kind)
    lw.save_actor(actor, tmp_path / "policy.safetensors")
    said = read_description(tmp_path / "policy.safetensors")["actor"]
    assert said["rules"] == RULES
    assert lw.Plans.from_json(said["plans"]).fingerprint == actor.encoder.written.fingerprint
    loaded, state = lw.load_actor(tmp_path / "policy.safetensors", text_encoder=refuse), make_state(actor)
    assert torch.equal(loaded(state.clone())["action"], actor(state.clone())["action"])


@pytest.mark.parametrize("kind", KINDS)
def test_a_file_of_other_rules_is_refused(kind, tmp_path, monkeypatch):
    actor = make(MT10, kind)
    described = actor.describe()
    before = {name: value for name, value in described.items() if name != "rules"}
    with pytest.raises(
        ValueError, match=f"those before version 1 of the rules for canonical plans, here is {RULES}: train"
    ):
        lw.PlanConditionedActor.from_description(before, refuse)
    lw.save_actor(actor, tmp_path / "policy.safetensors")
    monkeypatch.setattr("lw_torchrl.modules.plan_encoder.RULES", RULES + 1)
    made = f"trained with version {RULES} of the rules for canonical plans, here is {RULES + 1}: train it"
    with pytest.raises(ValueError, match=made):
        lw.load_actor(tmp_path / "policy.safetensors")


def test_a_file_with_roles_from_before_is_refused(tmp_path, monkeypatch):
    """Such a file has no rules, options without "canonical" and roles of 9 features."""
    actor = make(text_encoder=None, features="opening")
    del actor.config["canonical"], actor.encoder.config["canonical"], actor.config["decided_gripper"]
    monkeypatch.setattr("lw_torchrl.training.checkpoint.check_can_be_saved", lambda actor: actor)
    described = actor.encoder.describe
    monkeypatch.setattr(actor.encoder, "describe", lambda: {k: v for k, v in described().items() if k != "rules"})
    lw.save_actor(actor, tmp_path / "policy.safetensors")
    assert "rules" not in read_description(tmp_path / "policy.safetensors")["actor"]
    with pytest.raises(ValueError, match=r"those before version 1 of the rules for canonical plans.*: train it again"):
        lw.load_actor(tmp_path / "policy.safetensors")


def test_an_evaluator_answers_the_canonical_conditions(tmp_path):
    for plans in (MT50, make(MT50).plans):
        actor = make(MT50, "canonical", evaluator=lw.StateQueryEvaluator(plans, width=8, depth=1))
        assert actor.evaluator.plans.fingerprint == actor.plans.fingerprint
    state = make_state(make(MT50)).exclude("qaf", "qaf_plan")
    lw.save_actor(actor, tmp_path / "policy.safetensors")
    loaded = lw.load_actor(tmp_path / "policy.safetensors", text_encoder=refuse)
    assert torch.equal(loaded(state.clone())["action"], actor(state.clone())["action"])
    mine = actor.with_plans({"coffee-pull": MINE})
    assert mine.evaluator.plans.fingerprint == mine.plans.fingerprint
    asked = make({"coffee-pull": MINE}, "canonical")
    asked = asked.with_evaluator(lw.StateQueryEvaluator(asked.plans, width=8, depth=1))
    assert asked.encoder.written["coffee-pull"] == MINE
    with pytest.raises(ValueError, match="evaluator must be of the actor's plans"):
        make(MT50, "canonical", evaluator=lw.StateQueryEvaluator(MT10, width=8, depth=1))


def test_canonical_is_a_flag():
    with pytest.raises(TypeError, match="canonical must be"):
        make(kind="canonical", canonical="yes")
