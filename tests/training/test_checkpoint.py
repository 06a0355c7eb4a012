"""Policy files: load_actor rebuilds the same policy, and refuses damaged files and files of other kinds."""

import shutil
from dataclasses import replace

import pytest
import torch
from safetensors.torch import load_file, save_file
from small_training import PLANS, assert_same, make_parts
from tensordict import TensorDict
from torch import nn
from torch.nn.utils import prune
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

import lw_torchrl as lw
from lw_torchrl._util.reproducibility import package_versions
from lw_torchrl._util.tensor_files import read_tensors, write_tensors
from lw_torchrl.language import text
from lw_torchrl.language.skills import load_skills
from lw_torchrl.modules import ActorEnsemble
from lw_torchrl.modules.describe import describe
from lw_torchrl.training import save_evaluator
from lw_torchrl.training.checkpoint import read_description


def small(plans=PLANS, **options):
    return lw.PlanConditionedActor(plans, **make_parts(), **options)


def count_vowels(texts):
    return torch.tensor([[float(text.count(letter)) for letter in "aeiou"] for text in texts])


def make_rows(plans=PLANS, rows=40, seed=0):
    torch.manual_seed(seed)
    task_id = torch.tensor([lw.task_id(task) for task in ("push", "reach")]).repeat(rows // 2)
    columns = {"observation": torch.rand(rows, 39), "task_id": task_id, "qaf": torch.rand(rows, plans.num_steps) > 0.5}
    return TensorDict({**columns, "action": torch.rand(rows, 4) - 0.5}, [rows])


def train(actor, path, plans=PLANS):
    replay = TensorDictReplayBuffer(storage=LazyTensorStorage(40), sampler=lw.TaskBalancedSampler())
    replay.extend(make_rows(plans))
    config = lw.BehavioralCloningConfig(steps=5, batch_size=8)
    lw.BehavioralCloningTrainer(actor, replay, config, checkpoint=path, progress=False).train()
    return actor


PAIRS = [("the gripper is open", "move the gripper to the reach target"), ("the gripper is closed", 'say "well"')]
OWN = lw.Plans([lw.ConditionalPlan.from_pairs("push", PAIRS[:1]), lw.ConditionalPlan.from_pairs("reach", PAIRS)])


def act(actor, plans=PLANS):
    return actor(make_rows(plans, seed=1).exclude("action"))["action"]


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    path = tmp_path_factory.mktemp("checkpoint") / "policy.safetensors"
    torch.manual_seed(0)
    return path, train(small(), path)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "c.safetensors"


# ---- the same policy


def test_custom_plans_are_stored_and_the_text_encoder_is_passed_again(path):
    actor = train(small(OWN, text_encoder=count_vowels), path, OWN)
    loaded = lw.load_actor(path, text_encoder=count_vowels)
    assert loaded.plans == OWN
    assert torch.equal(act(loaded, OWN), act(actor, OWN))
    lw.load_actor(path, text_encoder=lambda texts: count_vowels(texts) * 3.0)  # the same after scaling
    for encoder in (lambda texts: count_vowels(texts).flip(-1), lambda texts: torch.ones(len(texts), 3), None):
        with pytest.raises(ValueError, match="text_encoder"):
            lw.load_actor(path, text_encoder=encoder)


@pytest.mark.parametrize("kind", ["ensemble of plans", "description"])
def test_policies_with_texts_that_are_not_shipped_load_in_a_new_process(kind, path):
    other = replace(lw.TASKS["reach"], description="Bring the hand over to the red spot.")
    is_description = kind == "description"
    actor = lw.modules.DescriptorConditionedActor([other]) if is_description else ActorEnsemble([small(OWN)])
    lw.save_actor(actor, path)
    text._sentence_transformer.cache_clear()  # as in a new process
    lw.load_actor(path)
    assert text._sentence_transformer.cache_info().misses


@pytest.mark.parametrize("other", [lambda actor: actor, lambda actor: actor.with_plans(PLANS)])
def test_an_ensemble_whose_members_share_weights_is_rebuilt(path, other):
    actor = small()
    ensemble, before = ActorEnsemble([actor, other(actor)]), torch.get_rng_state()
    lw.save_actor(ensemble, path)
    assert torch.equal(torch.get_rng_state(), before), "saving draws no random numbers"
    assert_same(dict(lw.load_actor(path).state_dict()), dict(ensemble.state_dict()))


def test_scripted_skills_are_rebuilt_unless_they_are_custom(path, tmp_path):
    actor = lw.ScriptedSkillActor(PLANS, "mix")
    lw.save_actor(actor, path)
    assert torch.equal(act(lw.load_actor(path)), act(actor))
    with pytest.raises(TypeError, match="custom skills"):
        lw.save_actor(lw.ScriptedSkillActor(PLANS, skills=load_skills()), tmp_path / "own.safetensors")


def test_a_loaded_actor_outlives_the_file_and_can_be_trained(saved, path):
    shutil.copy(saved[0], path)
    loaded = lw.load_actor(path)
    path.write_bytes(b"")
    action = act(loaded)
    assert torch.equal(action, act(saved[1]))
    action.sum().backward()
    torch.optim.SGD(loaded.parameters(), 0.1).step()


def test_any_reader_reads_the_weights_and_the_description_records_architecture_training_and_versions(saved, path):
    weights = load_file(saved[0])
    assert all(torch.equal(value, weights[name]) for name, value in saved[1].state_dict().items())
    description = read_description(saved[0])
    assert description["actor"] == describe(saved[1])
    assert (description["training"]["steps"], description["data"]) == (5, None)
    lw.save_actor(saved[1], path, note={"mine": [1, 2]})
    description = read_description(path)
    assert (description["note"], description["versions"]) == ({"mine": [1, 2]}, package_versions())


# ---- refused before it is written


UNSAVED = {
    "got torch.float64": lambda network: network.double(),
    "module.decoder.network.0.weight": lambda network: prune.random_unstructured(network[0], "weight", 0.5),
    "decoder.network.0.bias must be finite": lambda network: nn.init.constant_(network[0].bias, float("inf")),
}


@pytest.mark.parametrize("message", UNSAVED)
def test_an_actor_that_could_not_be_loaded_is_not_saved(tmp_path, path, message):
    actor = small()
    UNSAVED[message](actor.decoder.network)
    for write in (lw.save_actor, train):
        with pytest.raises(ValueError, match=f"actor cannot be saved, .*{message}"):
            write(actor, path)
    assert not list(tmp_path.iterdir())


# ---- other files and damaged ones


def assert_refused(path, message):
    with pytest.raises(ValueError, match=message) as caught:
        lw.load_actor(path)
    assert str(caught.value).startswith("checkpoint: ")
    assert str(path) in str(caught.value)


def test_files_of_another_kind_are_refused(saved, tmp_path, path):
    assert_refused(tmp_path, "cannot be read: the path is a folder")
    for content in (b"", b"\x80\x04K\x01.", b"PK\x03\x04", b"words"):
        path.write_bytes(content)
        assert_refused(path, "cannot be read: the file is corrupted or not a .safetensors file")
    save_file({"weight": torch.ones(2)}, path)
    assert_refused(path, "not written by lw_torchrl")
    assert_refused(saved[0].with_name("policy.training.safetensors"), "must hold a policy .*'lw_torchrl.training'")
    save_evaluator(lw.modules.StateQueryEvaluator(PLANS, width=8), path)
    assert_refused(path, "must hold a policy .*'lw_torchrl.evaluator'")


def test_a_pickle_is_not_loaded(tmp_path, path):
    class Evil:
        def __reduce__(self):
            return (shutil.copy, (str(path), str(tmp_path / "executed")))

    torch.save({"weights": Evil()}, path)
    assert_refused(path, "not a .safetensors file")
    assert not (tmp_path / "executed").exists()


NAN = torch.tensor([float("nan"), 0.0, 0.0, 0.0])
CHANGES = {
    "other options": ("decoder", "width", 32, r"of shape \(32, .* got .* \(16, "),
    "an unknown option": ("decoder", "depht", 1, "depht"),
    "an unknown class": (None, "class", "ElephantActor", "'ElephantActor'"),
    "a plan that cannot be parsed": ("plans", "reach", "def raech(", "plan of 'reach' must be an object"),
    "NaN": ("tensors", "module.decoder.network.2.bias", NAN, "must be finite"),
    "another dtype": ("tensors", "module.decoder.network.2.bias", NAN.double(), "got torch.float64"),
    "another tensor": ("tensors", "more", NAN, "but differ in .*more"),
}


@pytest.mark.parametrize(("inside", "name", "value", "message"), CHANGES.values(), ids=CHANGES)
def test_weights_that_do_not_fit_the_description_are_refused(saved, path, inside, name, value, message):
    description, tensors = read_tensors(saved[0])
    actor = description["actor"]
    decoder = actor["options"]["decoder"]["module"]["options"]["network"]["module"]["options"]
    described = {None: actor, "decoder": decoder, "plans": actor["plans"][0], "tensors": tensors}[inside]
    described[name] = value
    write_tensors(path, description, tensors)
    assert_refused(path, f"the actor in .* cannot be rebuilt .*{message}")


def test_a_flipped_bit_is_detected(path):
    lw.save_actor(small(), path)
    content = path.read_bytes()
    for place in range(len(content) // 3, len(content), len(content) // 7):
        path.write_bytes(content[:place] + bytes([content[place] ^ 0x10]) + content[place + 1 :])
        assert_refused(path, "is corrupted")
