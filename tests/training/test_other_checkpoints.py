"""A checkpoint of another training, or none, is refused and left alone."""

from __future__ import annotations

import pytest
import torch
from small_training import CONFIG, PLANS, collect_demos, make_actor, make_descriptor_actor, make_trainer
from torchrl.data import RandomSampler
from torchrl.envs import Compose

from lw_torchrl._util.tensor_files import read_tensors, write_tensors
from lw_torchrl.data import LanguageWorldExperienceReplay, TaskBalancedSampler, collect_demonstrations
from lw_torchrl.training import BehavioralCloningConfig, BehavioralCloningTrainer
from lw_torchrl.training.checkpoint import training_file
from lw_torchrl.transforms import QAFTransform, RandomYaw


@pytest.fixture(scope="module")
def demos(tmp_path_factory):
    return collect_demos(tmp_path_factory.mktemp("trainer") / "demos")


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """Demonstrations that come to an end: steps follow the first success."""
    root = tmp_path_factory.mktemp("whole") / "demos"
    collect_demonstrations(["push", "reach"], episodes_per_task=1, root=root, max_steps=100, progress=False)
    return root


@pytest.fixture(scope="module")
def checkpoint(demos, tmp_path_factory):
    path = tmp_path_factory.mktemp("checkpoint") / "checkpoint.safetensors"
    make_trainer(demos, path).train()
    return path


def refused(path, message, make):
    content = path.read_bytes()
    with pytest.raises(ValueError, match=message) as caught:
        make()
    assert path.read_bytes() == content
    assert path.stem in str(caught.value)


@pytest.mark.parametrize(
    ("options", "differs"),
    [
        (dict(width=32), r"\S*network.module.options.width \(16, now 32\)"),
        (dict(depth=2), r"\S*network.module.options.depth \(1, now 2\)"),
        (dict(latent_size=5), r"\S*encoder.module.options.latent_size \(4, now 5\)"),
        (dict(kind="raw"), r"\S*features.options.kind \('differences', now 'raw'\)"),
    ],
)
def test_a_checkpoint_of_another_architecture_is_refused(demos, checkpoint, options, differs):
    actor = make_actor(1, **options)
    before = {name: value.clone() for name, value in actor.state_dict().items()}
    refused(
        checkpoint,
        f"of another architecture, its actor differs in {differs}; choose another file, or delete it",
        lambda: make_trainer(demos, checkpoint, actor=actor),
    )
    assert all(torch.equal(value, before[name]) for name, value in actor.state_dict().items())


def test_a_checkpoint_of_other_plans_or_another_kind_is_refused(demos, checkpoint):
    plans = {task: plan for task, plan in PLANS.items() if task in ("push", "reach")}
    refused(
        checkpoint,
        r"of another architecture, its actor differs in plans;",
        lambda: make_trainer(demos, checkpoint, actor=make_actor(plans=plans)),
    )
    refused(
        checkpoint,
        "of another architecture, its actor differs in class",
        lambda: make_trainer(demos, checkpoint, actor=make_descriptor_actor()),
    )


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("steps", 13),
        ("batch_size", 6),
        ("learning_rate", 1e-3),
        ("loss_function", "l1"),
        ("seed", 1),
        ("weight_decay", 0.0),
    ],
)
def test_a_checkpoint_of_another_configuration_is_refused(demos, checkpoint, name, value):
    config = BehavioralCloningConfig(**{**vars(CONFIG), name: value})
    refused(
        checkpoint,
        rf"of another configuration, its training differs in {name} \({vars(CONFIG)[name]!r}, now {value!r}\);",
        lambda: make_trainer(demos, checkpoint, config=config),
    )


def test_a_checkpoint_of_other_demonstrations_is_refused(checkpoint, tmp_path):
    root = tmp_path / "demos"
    collect_demonstrations(["push", "reach"], episodes_per_task=1, root=root, max_steps=15, seed=8, progress=False)
    refused(
        checkpoint,
        r"its data differs in episodes_per_task \(.*, now 1\), noise_scale \(.*\), seed \(0, now 8\);",
        lambda: make_trainer(root, checkpoint),
    )


@pytest.mark.parametrize(
    ("change", "differs"),
    [
        (dict(label="executed"), "label"),
        (dict(label="unclipped"), "label"),
        (dict(after_success=0), "rows"),
        (dict(sampler=RandomSampler), "sampler"),
        (dict(yaw=0.2), "transforms"),
        (dict(yaw=None), "transforms"),
        (dict(plans=PLANS), "transforms"),
    ],
)
def test_a_checkpoint_of_rows_shown_in_another_way_is_refused(root, tmp_path, change, differs):
    path = tmp_path / "c.safetensors"

    def trainer(label="expert", after_success=None, sampler=TaskBalancedSampler, yaw=0.1, plans=None):
        turned = Compose(QAFTransform(PLANS), *([] if yaw is None else [RandomYaw(yaw, plans=plans)]))
        replay = LanguageWorldExperienceReplay(
            root, label=label, after_success=after_success, sampler=sampler(), transform=turned
        )
        return BehavioralCloningTrainer(make_actor(), replay, CONFIG, checkpoint=path, progress=False)

    trainer().save()
    trainer()
    refused(path, f"of another configuration, its replay differs in {differs}", lambda: trainer(**change))


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 not quite", b"years of work\n"])
def test_a_foreign_file_is_refused(demos, tmp_path, content):
    path = tmp_path / "thesis.tex"
    path.write_bytes(content)
    refused(path, "checkpoint: .* exists, but not its training state", lambda: make_trainer(demos, path))
    state = tmp_path / "thesis.training.tex"
    state.write_bytes(content)
    refused(state, "cannot be read: it is damaged or not a .safetensors file", lambda: make_trainer(demos, path))


def test_a_training_state_without_its_state_is_refused(demos, checkpoint, tmp_path):
    path = tmp_path / "checkpoint.safetensors"
    description, tensors = read_tensors(training_file(checkpoint))
    del description["state"]
    write_tensors(training_file(path), description, tensors)
    refused(training_file(path), "does not fit, .*it holds no state", lambda: make_trainer(demos, path))
