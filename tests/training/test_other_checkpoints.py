"""A checkpoint has one writer, and the checkpoint of another training is refused and left unchanged."""

import importlib.metadata
from dataclasses import replace

import pytest
import torch
from small_training import CONFIG, PLANS, make_actor, make_descriptor_actor, make_trainer
from torchrl.data import RandomSampler
from torchrl.envs import Compose

import lw_torchrl as lw
from lw_torchrl._util.tensor_files import read_tensors, write_tensors
from lw_torchrl.training.checkpoint import training_file


@pytest.fixture(scope="module")
def long_demos(tmp_path_factory):
    """Demonstrations with steps after the first success."""
    root = tmp_path_factory.mktemp("long") / "demos"
    lw.collect_demonstrations(["push", "reach"], episodes_per_task=1, root=root, max_steps=100, progress=False)
    return root


@pytest.fixture(scope="module")
def checkpoint(demos, tmp_path_factory):
    path = tmp_path_factory.mktemp("checkpoint") / "checkpoint.safetensors"
    make_trainer(demos, path).train()
    return path


def assert_refused(path, message, make):
    content = path.read_bytes()
    with pytest.raises(ValueError, match=message) as caught:
        make()
    assert path.read_bytes() == content
    assert path.stem in str(caught.value)


ACTORS = {
    r"width \(16, now 32\)": lambda: make_actor(1, width=32),
    r"latent_size \(4, now 5\)": lambda: make_actor(1, latent_size=5),
    r"kind \('differences', now 'raw'\)": lambda: make_actor(1, kind="raw"),
    "plans;": lambda: make_actor(plans={task: PLANS[task] for task in ("push", "reach")}),
    "class": make_descriptor_actor,
}


@pytest.mark.parametrize("difference", ACTORS)
def test_a_checkpoint_of_another_architecture_is_refused(demos, checkpoint, difference):
    actor = ACTORS[difference]()
    before = {name: value.clone() for name, value in actor.state_dict().items()}
    message = f"a different architecture: its actor differs in .*{difference}"
    assert_refused(checkpoint, message, lambda: make_trainer(demos, checkpoint, actor=actor))
    assert all(torch.equal(value, before[name]) for name, value in actor.state_dict().items())


def test_a_checkpoint_of_another_configuration_is_refused(demos, checkpoint):
    values = dict(batch_size=6, learning_rate=1e-3, loss_function="l1", seed=1, steps=13, weight_decay=0.0)
    message = "a different configuration: its training differs in " + ".* ".join(values)
    assert_refused(checkpoint, message, lambda: make_trainer(demos, checkpoint, config=replace(CONFIG, **values)))


def test_a_checkpoint_of_other_demonstrations_is_refused(checkpoint, tmp_path):
    root = tmp_path / "demos"
    lw.collect_demonstrations(["push", "reach"], episodes_per_task=1, root=root, max_steps=15, seed=8, progress=False)
    message = r"its data differs in episodes_per_task .*, seed \(0, now 8\);"
    assert_refused(checkpoint, message, lambda: make_trainer(root, checkpoint))


CHANGES = [(dict(label="unclipped"), "label"), (dict(after_success=0), "rows")]
CHANGES += [(dict(sampler=RandomSampler), "sampler"), (dict(plans=PLANS), "transforms")]
CHANGES += [(dict(yaw=0.2), "transforms"), (dict(yaw=None), "transforms")]


@pytest.mark.parametrize(("change", "difference"), CHANGES)
def test_a_checkpoint_of_other_samples_is_refused(long_demos, tmp_path, change, difference):
    path = tmp_path / "c.safetensors"

    def trainer(label="expert", after_success=None, sampler=lw.TaskBalancedSampler, yaw=0.1, plans=None):
        augmentations = [] if yaw is None else [lw.RandomYaw(yaw, plans=plans)]
        transform = Compose(lw.QAFTransform(PLANS), *augmentations)
        options = {"label": label, "after_success": after_success, "sampler": sampler(), "transform": transform}
        replay = lw.LanguageWorldExperienceReplay(long_demos, **options)
        return lw.BehavioralCloningTrainer(make_actor(), replay, CONFIG, checkpoint=path, progress=False)

    trainer().save()
    trainer()
    assert_refused(path, f"a different configuration: its replay differs in {difference}", lambda: trainer(**change))


def test_a_file_of_another_program_or_without_a_state_is_refused(demos, checkpoint, tmp_path):
    path, state, content = tmp_path / "thesis.tex", tmp_path / "thesis.training.tex", b"years of work\n"
    path.write_bytes(content)
    assert_refused(path, "exists, but its training state .* does not", lambda: make_trainer(demos, path))
    state.write_bytes(content)
    assert_refused(state, "corrupted or not a .safetensors file", lambda: make_trainer(demos, path))
    path = tmp_path / "checkpoint.safetensors"
    description, tensors = read_tensors(training_file(checkpoint))
    del description["state"]
    write_tensors(training_file(path), description, tensors)
    assert_refused(training_file(path), "the file holds no valid state", lambda: make_trainer(demos, path))


def test_one_training_at_a_time_writes_a_checkpoint(demos, tmp_path, holding, monkeypatch):
    path = tmp_path / "policy.safetensors"
    trainer, late = make_trainer(demos, path), make_trainer(demos, path)
    release = holding(path)
    with pytest.raises(ValueError, match=f"checkpoint: another training is writing to '{path}'"):
        trainer.train()
    assert not path.exists()
    release()
    trainer.train()
    again = path.read_bytes()
    with pytest.raises(ValueError, match=r"checkpoint: .* was written by another training"):
        late.train()
    assert path.read_bytes() == again
    assert {file.name for file in tmp_path.iterdir()} == {"policy.safetensors", "policy.training.safetensors"}
    assert make_trainer(demos, path).steps == CONFIG.steps
    real = importlib.metadata.version
    other = lambda name: "9.9.9" if name == "torch" else real(name)  # noqa: E731
    monkeypatch.setattr("lw_torchrl._util.reproducibility.version", other)
    with pytest.warns(UserWarning, match=r"with other versions \(torch .*, now 9.9.9\)") as caught:
        make_trainer(demos, path)
    assert len(caught) == 1
