"""HeldEvaluator: files keep it, a stranger's are refused, and so are wrong arguments."""

import json
import zipfile

import pytest
import torch
from held_evaluators import PLANS, evaluated, learned, letters, same
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

import lw_torchrl as lw
from benchmarks.evaluator_report import condition_drift
from lw_torchrl._tensor_archive import write_archive
from lw_torchrl.training.behavioral_cloning import EvaluatorAnchor

# --- files ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("structure", [True, False])
def test_files_keep_it(structure, tmp_path):
    held = lw.HeldEvaluator(learned(structure=structure, text_encoder=letters), every=5, delay=2)
    actor = lw.PlanConditionedActor(PLANS, width=8, text_encoder=letters).with_evaluator(held)
    lw.save_actor(actor, tmp_path / "policy.zip")
    again = lw.load_actor(tmp_path / "policy.zip", text_encoder=letters)
    assert again.evaluator.describe() == held.describe()
    assert same(evaluated(again)[0], evaluated(actor)[0])
    lw.training.save_evaluator(held, tmp_path / "evaluator.zip")
    other = lw.training.load_evaluator(tmp_path / "evaluator.zip", PLANS, text_encoder=letters)
    assert (other.every, other.delay) == (5, 2)
    assert same(other.state_dict().values(), held.state_dict().values())
    if not structure:
        with pytest.raises(ValueError, match="text_encoder is not the one"):
            lw.training.load_evaluator(
                tmp_path / "evaluator.zip", PLANS, text_encoder=lambda texts: letters(texts).flip(-1)
            )


def hostile(options, nest=0):
    found = {"kind": "StateQueryEvaluator", "options": {"width": 8, "depth": 1}}
    for _ in range(nest):
        found = {"kind": "HeldEvaluator", "options": {"evaluator": found}}
    return {"kind": "HeldEvaluator", "options": {"evaluator": found, **options}}


@pytest.mark.parametrize(
    "described",
    [
        hostile({}, nest=1),
        hostile({}, nest=150),
        hostile({"every": 0}),
        hostile({"every": "2"}),
        hostile({"every": 2**16 + 1}),
        hostile({"delay": 10**9}),
        hostile({"delay": -1}),
        hostile({"nonsense": 1}),
        hostile({"evaluator": None}),
        hostile({"evaluator": {"kind": "os", "options": {}}}),
        hostile({"evaluator": [1]}),
        {"kind": "HeldEvaluator", "options": {}},
    ],
    ids=lambda described: json.dumps(described)[-60:],
)
def test_a_strangers_file_is_refused(described, tmp_path):
    held = lw.HeldEvaluator(learned())
    lw.training.save_evaluator(held, tmp_path / "good.zip")
    with zipfile.ZipFile(tmp_path / "good.zip") as archive:
        description = json.loads(archive.read("description.json"))
    groups = {"weights": held.state_dict(), "texts": {}}
    for name, one in (("good", description["evaluator"]), ("bad", described)):
        kept = {key: value for key, value in description.items() if key != "sha256"} | {"evaluator": one}
        write_archive(tmp_path / f"{name}.zip", kept, groups)
    assert lw.training.load_evaluator(tmp_path / "good.zip", PLANS).every == 1
    with pytest.raises(ValueError, match="cannot be made"):
        lw.training.load_evaluator(tmp_path / "bad.zip", PLANS)


# --- bad input -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: lw.HeldEvaluator(PLANS), TypeError, "evaluator must be a QueryEvaluator, got Plans"),
        (lambda: lw.HeldEvaluator(lw.HeldEvaluator(learned())), ValueError, r"no HeldEvaluator: hold the one inside"),
        (lambda: lw.HeldEvaluator(learned(), every=0), ValueError, "every must be at least 1, got 0"),
        (lambda: lw.HeldEvaluator(learned(), every=2.5), TypeError, "every must be an integer, got 2.5"),
        (lambda: lw.HeldEvaluator(learned(), delay=-1), ValueError, "delay must be at least 0, got -1"),
        (lambda: lw.HeldEvaluator(learned(), delay=10**6), ValueError, "delay must be at most 65536 steps"),
    ],
)
def test_wrong_arguments_are_named(make, error, message):
    with pytest.raises(error, match=message):
        make()


def rows():
    return TensorDict(observation=torch.rand(6, 39), task_id=torch.full((6,), lw.task_id("reach")), batch_size=6)


def test_a_replay_buffer_is_refused():
    held = lw.HeldEvaluator(learned(), every=2)
    replay = TensorDictReplayBuffer(storage=LazyTensorStorage(6), transform=held.transform(), batch_size=6)
    replay.extend(rows())
    with pytest.raises(ValueError, match=r"HeldEvaluator\(every=2, delay=0\).*do not tell: train a policy with the"):
        replay.sample()


def test_rows_without_held_answers_say_what_writes_them():
    actor = lw.ScriptedSkillActor(PLANS, evaluator=lw.HeldEvaluator(learned()))
    with pytest.raises(ValueError, match=r"without qaf_held_logits: HeldEvaluator.transform\(\) writes it"):
        actor(rows())
    for ask in (actor.evaluator, lambda found: condition_drift(actor, found), EvaluatorAnchor(actor)):
        with pytest.raises(ValueError, match=r"in an environment; of rows of a replay buffer ask the evaluator inside"):
            ask(rows())


def test_two_of_them_in_one_environment_are_refused():
    held = lw.HeldEvaluator(learned())
    actor = lw.ScriptedSkillActor(PLANS, evaluator=held)
    with pytest.raises(ValueError, match="two HeldEvaluators write 'qaf_held_logits'"):
        evaluated(actor, evaluator=held)
    with pytest.raises(ValueError, match="members must have no HeldEvaluator"):
        lw.modules.ActorEnsemble([actor, actor])
