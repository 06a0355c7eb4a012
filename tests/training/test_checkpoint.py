"""Checkpoints: load_actor makes the very same policy, and says what is wrong with a file."""

from __future__ import annotations

import shutil
import threading
import zipfile
from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torch.nn.utils import prune
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

from lw_torchrl.data import TaskBalancedSampler
from lw_torchrl.language import text
from lw_torchrl.language.plan_files import load_plans
from lw_torchrl.language.plans import ConditionalPlan, Plans
from lw_torchrl.language.skills import load_skills
from lw_torchrl.language.tasks import MT10, TASKS, task_id
from lw_torchrl.modules import (
    ActorEnsemble,
    DescriptorConditionedActor,
    PlanConditionedActor,
    ScriptedSkillActor,
    StateQueryEvaluator,
)
from lw_torchrl.training import (
    BehavioralCloningConfig,
    BehavioralCloningTrainer,
    load_actor,
    load_evaluator,
    save_actor,
    save_evaluator,
)
from lw_torchrl.training.files import read_description

SMALL = dict(latent_size=4, width=16, depth=1, encoder_width=8)
PLANS = load_plans("MT10")


def counted(texts):
    return torch.tensor([[float(text.count(letter)) for letter in "aeiou"] for text in texts])


def make_rows(rows=40, seed=0):
    generator = torch.Generator().manual_seed(seed)
    ids = torch.tensor([task_id(task) for task in ("push", "reach")]).repeat(rows // 2)
    return TensorDict(
        {
            "observation": torch.rand(rows, 39, generator=generator),
            "task_id": ids,
            "qaf": torch.rand(rows, PLANS.num_steps, generator=generator) > 0.5,
            "action": torch.rand(rows, 4, generator=generator) - 0.5,
        },
        [rows],
    )


def train(actor, path):
    replay = TensorDictReplayBuffer(storage=LazyTensorStorage(40), sampler=TaskBalancedSampler())
    replay.extend(make_rows())
    config = BehavioralCloningConfig(steps=5, batch_size=8)
    BehavioralCloningTrainer(actor, replay, config, checkpoint=path, progress=False).train()
    return actor


def own_plans():
    pairs = [("the gripper is open", "move the gripper to the reach target"), ("the gripper is closed", 'say "well"')]
    return Plans([ConditionalPlan.from_pairs("push", pairs[:1]), ConditionalPlan.from_pairs("reach", pairs)])


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    path = tmp_path_factory.mktemp("checkpoint") / "checkpoint.zip"
    torch.manual_seed(0)
    return path, train(PlanConditionedActor(PLANS, **SMALL), path)


@pytest.mark.parametrize(
    "options",
    [
        dict(mix="actions", features="raw"),
        dict(mix="latents", features="both", feature_noise=0.5),
        dict(latent_size=7, width=9, depth=2, encoder_width=5, encoder_depth=2),
    ],
)
def test_load_actor_makes_the_same_policy(tmp_path, options):
    torch.manual_seed(1)
    actor = train(PlanConditionedActor(PLANS, **{**SMALL, **options}), tmp_path / "c.zip")
    loaded = load_actor(tmp_path / "c.zip")
    assert isinstance(loaded, PlanConditionedActor)
    assert loaded.config == actor.config
    assert loaded.plans == actor.plans
    assert not loaded.training
    state = make_rows(seed=1).exclude("action")
    expected, found = actor.eval()(state.clone()), loaded(state.clone())
    for key in actor.out_keys:
        assert torch.equal(found[key], expected[key])


def test_the_baseline_loads_too(tmp_path):
    actor = train(DescriptorConditionedActor("MT10", **SMALL), tmp_path / "c.zip")
    loaded = load_actor(tmp_path / "c.zip")
    assert isinstance(loaded, DescriptorConditionedActor)
    assert loaded.tasks == MT10
    state = make_rows(seed=1).exclude("action")
    assert torch.equal(loaded(state.clone())["action"], actor(state.clone())["action"])


def test_plans_and_text_encoder_of_ones_own(tmp_path):
    """The plans are in the file; the encoder is handed over again."""
    actor = PlanConditionedActor(own_plans(), text_encoder=counted, **SMALL)
    rows = make_rows()
    replay = TensorDictReplayBuffer(storage=LazyTensorStorage(40), sampler=TaskBalancedSampler())
    replay.extend(rows.set("qaf", rows["qaf"][:, :2]))
    config = BehavioralCloningConfig(steps=5, batch_size=8)
    BehavioralCloningTrainer(actor, replay, config, checkpoint=tmp_path / "c.zip", progress=False).train()
    loaded = load_actor(tmp_path / "c.zip", text_encoder=counted)
    assert loaded.plans == own_plans()
    state = rows.exclude("action")
    assert torch.equal(loaded(state.clone())["action"], actor(state.clone())["action"])


def test_a_folder_is_no_policy(tmp_path):
    with pytest.raises(ValueError, match="is a folder; a policy is one file"):
        load_actor(tmp_path)


def test_another_text_encoder_is_found_out(saved, tmp_path):
    """Of another dimension, and, what no shape tells, of the same one."""
    with pytest.raises(ValueError, match=r"cannot be made .text_encoder gives vectors of shape"):
        load_actor(saved[0], text_encoder=counted)
    few = PlanConditionedActor(PLANS, text_encoder=lambda texts: torch.ones(len(texts), 3), **SMALL)
    save_actor(few, tmp_path / "few.zip")
    with pytest.raises(ValueError, match="its texts have 3 numbers each: text_encoder must be the one that gave them"):
        load_actor(tmp_path / "few.zip")
    path = tmp_path / "own.zip"
    save_actor(PlanConditionedActor(own_plans(), text_encoder=counted, **SMALL), path)
    for other in (
        lambda texts: counted(texts).flip(-1),
        lambda texts: counted([one.replace("e", "a") for one in texts]),
    ):
        with pytest.raises(ValueError, match="text_encoder is not the one that the policy was made with"):
            load_actor(path, text_encoder=other)
    load_actor(path, text_encoder=lambda texts: counted(texts) * 3.0)  # the same after scaling


def own_words(evaluator=None):
    return PlanConditionedActor(own_plans(), evaluator=evaluator, **SMALL)


NOT_SHIPPED = {
    "a plan": own_words,
    "a description": lambda: DescriptorConditionedActor(
        [replace(TASKS["reach"], description="Bring the hand over to the red spot.")], **SMALL
    ),
    "an ensemble": lambda: ActorEnsemble([own_words(), own_words()]),
    "an evaluator's plan": lambda: own_words(StateQueryEvaluator(own_plans(), structure=False, width=8, depth=1)),
}


@pytest.mark.parametrize("make", NOT_SHIPPED.values(), ids=NOT_SHIPPED)
def test_texts_that_are_not_shipped_load_in_a_new_process(make, tmp_path):
    """The text model that encodes them, far larger than the policy, is made while the file is loaded."""
    save_actor(make(), tmp_path / "own.zip")
    text._sentence_transformer.cache_clear()  # as in a new process
    load_actor(tmp_path / "own.zip")
    assert text._sentence_transformer.cache_info().misses


def test_an_evaluator_that_reads_texts_loads_in_a_new_process(tmp_path):
    gripper, target = TASKS["reach"].objects
    ball = replace(TASKS["reach"], objects=(gripper, replace(target, name="red ball")))
    plans = Plans([ConditionalPlan.from_pairs(ball, [("the gripper is not near the red ball", "glide over")])])
    save_evaluator(StateQueryEvaluator(plans, structure=False, width=8, depth=1), tmp_path / "evaluator.zip")
    text._sentence_transformer.cache_clear()
    load_evaluator(tmp_path / "evaluator.zip", plans)
    assert text._sentence_transformer.cache_info().misses


def test_what_another_thread_makes_meanwhile_is_none_of_its_business(tmp_path):
    """Loading bounds the modules that it makes itself; neither thread notices the other."""
    save_actor(PlanConditionedActor(own_plans(), text_encoder=counted, **SMALL), tmp_path / "own.zip")
    made = []

    def beside(texts):
        thread = threading.Thread(target=lambda: made.append(nn.Linear(1000, 1000)))
        thread.start()
        thread.join()
        return counted(texts)

    load_actor(tmp_path / "own.zip", text_encoder=beside)
    assert made
    nn.Linear(1000, 1000)


def test_the_encoder_of_a_policy_on_descriptions_is_found_out_too(tmp_path):
    save_actor(DescriptorConditionedActor("MT10", text_encoder=counted, **SMALL), tmp_path / "own.zip")
    with pytest.raises(ValueError, match="text_encoder is not the one that the policy was made with"):
        load_actor(tmp_path / "own.zip", text_encoder=lambda texts: counted(texts).flip(-1))


def test_what_cannot_be_loaded_is_refused_before_training(tmp_path):
    module = TensorDictModule(nn.Linear(39, 4), in_keys=["observation"], out_keys=["action"])
    with pytest.raises(TypeError, match="actor must be a Policy to be kept in a file, got TensorDictModule"):
        train(module, tmp_path / "c.zip")
    with pytest.raises(TypeError, match="actor must be a Policy"):
        save_actor(module, tmp_path / "c.zip")
    assert not list(tmp_path.iterdir())


def pruned(actor):
    prune.random_unstructured(actor.head.network[0], "weight", 0.5)
    return actor


def reconfigured(actor):
    actor.config["width"] = 32
    return actor


def not_finite(actor):
    nn.init.constant_(actor.head.network[0].bias, float("inf"))
    return actor


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (PlanConditionedActor.double, r"must be torch.float32 of shape .*, got torch.float64"),
        (pruned, "must have the keys"),
        (reconfigured, r"must be torch.float32 of shape \(32, .*, got torch.float32 of shape \(16, "),
        (not_finite, "head.network.0.bias must be finite"),
    ],
)
def test_what_loading_would_refuse_is_not_saved(tmp_path, change, message):
    actor = change(PlanConditionedActor(PLANS, **SMALL))
    for keep in (save_actor, train):
        with pytest.raises(ValueError, match=f"actor cannot be kept in a file, .*{message}"):
            keep(actor, tmp_path / "c.zip")
    assert not list(tmp_path.iterdir())


def test_looking_whether_it_can_be_saved_draws_no_random_numbers(tmp_path):
    actor = PlanConditionedActor(PLANS, **SMALL)
    before = torch.get_rng_state()
    save_actor(actor, tmp_path / "c.zip")
    assert torch.equal(torch.get_rng_state(), before)


@pytest.mark.parametrize("name", ["format", "version", "state", "sha256"])
def test_what_a_file_says_itself_cannot_be_said_about_it(tmp_path, name):
    with pytest.raises(ValueError, match=f"about must not be named {name}, which a policy file says itself"):
        save_actor(PlanConditionedActor(PLANS, **SMALL), tmp_path / "c.zip", **{name: 3})
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("value", [{1: "a", "1": "b"}, float("nan")])
def test_what_cannot_be_read_again_is_not_written(tmp_path, value):
    with pytest.raises(ValueError, match=r"names '1' more than once|JSON"):
        save_actor(PlanConditionedActor(PLANS, **SMALL), tmp_path / "c.zip", note=value)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("other", [lambda actor: actor, lambda actor: actor.with_plans(PLANS)])
def test_members_that_share_their_weights_are_saved_with_them(tmp_path, other):
    actor = PlanConditionedActor(PLANS, **SMALL)
    ensemble = ActorEnsemble([actor, other(actor)])
    save_actor(ensemble, tmp_path / "c.zip")
    loaded = load_actor(tmp_path / "c.zip")
    assert all(torch.equal(value, loaded.state_dict()[name]) for name, value in ensemble.state_dict().items())


def test_plans_with_scripted_skills_are_a_policy_file_too(tmp_path):
    actor = ScriptedSkillActor(PLANS, "mix")
    save_actor(actor, tmp_path / "scripted.zip")
    loaded = load_actor(tmp_path / "scripted.zip")
    state = make_rows(seed=1).exclude("action")
    assert torch.equal(loaded(state.clone())["action"], actor(state.clone())["action"])
    with pytest.raises(TypeError, match="with skills of your own cannot be saved"):
        save_actor(ScriptedSkillActor(PLANS, skills=load_skills()), tmp_path / "own.zip")


def test_the_loaded_actor_outlives_the_file(saved, tmp_path):
    path = tmp_path / "copy.zip"
    shutil.copy(saved[0], path)
    loaded = load_actor(path)
    path.unlink()
    state = make_rows(seed=1).exclude("action")
    assert torch.equal(loaded(state.clone())["action"], saved[1](state.clone())["action"])
    loaded(state)["action"].sum().backward()
    torch.optim.SGD(loaded.parameters(), 0.1).step()


def test_a_checkpoint_holds_no_pickle(saved):
    with zipfile.ZipFile(saved[0]) as archive:
        assert {name.rpartition(".")[2] for name in archive.namelist()} == {"json", "safetensors"}


def test_the_description_says_how_it_was_made(saved):
    found = read_description(saved[0])
    assert found["actor"]["kind"] == "PlanConditionedActor"
    assert found["actor"]["options"] == saved[1].config
    assert set(found["actor"]["plans"]) == set(MT10)
    assert found["training"]["steps"] == 5
    assert found["data"] is None


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"checkpoint: no file .*nowhere.zip"):
        load_actor(tmp_path / "nowhere.zip")


def refused(path, message):
    content = path.read_bytes()
    with pytest.raises(ValueError, match=message) as caught:
        load_actor(path)
    assert str(path) in str(caught.value)
    assert path.read_bytes() == content


@pytest.mark.parametrize("content", [b"", b"\x80\x04K\x01.", b"PK\x03\x04", b"words"])
def test_a_foreign_file_is_refused(tmp_path, content):
    path = tmp_path / "c.zip"
    path.write_bytes(content)
    refused(path, "damaged or none of ours")


def test_a_torch_file_is_refused_and_not_unpickled(tmp_path):
    class Evil:
        def __reduce__(self):
            return (shutil.copy, (str(tmp_path / "c.zip"), str(tmp_path / "executed")))

    torch.save({"weights": Evil()}, tmp_path / "c.zip")
    refused(tmp_path / "c.zip", "damaged or none of ours")
    assert not (tmp_path / "executed").exists()


def rewrite(source, target, change):
    """Copy an archive, each file's bytes through ``change(name, bytes)``; None leaves the file out."""
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(target, "w") as new:
        for name in old.namelist():
            content = change(name, old.read(name))
            if content is not None:
                new.writestr(name, content)


DAMAGE = {
    "no description": lambda name, content: None if "description" in name else content,
    "no weights": lambda name, content: None if "weights" in name else content,
    "half a description": lambda name, content: content[:50] if "description" in name else content,
    "another description": lambda name, content: b"[1, 2]" if "description" in name else content,
    "an actor of no kind": lambda name, content: content.replace(b"PlanConditionedActor", b"ElephantActor"),
    "plans of no task": lambda name, content: content.replace(b"def reach(", b"def raech("),
    "an unknown option": lambda name, content: content.replace(b'"depth"', b'"depht"'),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_a_damaged_checkpoint_is_refused(saved, tmp_path, name):
    path = tmp_path / "c.zip"
    rewrite(saved[0], path, DAMAGE[name])
    refused(path, "checkpoint: ")


def test_flipped_bits_in_the_weights_are_found(saved, tmp_path):
    content = bytearray(saved[0].read_bytes())
    with zipfile.ZipFile(saved[0]) as archive:
        info = archive.getinfo("weights.safetensors")
    middle = info.header_offset + len(info.filename) + 30 + info.file_size // 2
    content[middle] ^= 0xFF
    path = tmp_path / "c.zip"
    path.write_bytes(bytes(content))
    refused(path, "checkpoint: ")
