"""Training and evaluation on a device that records every wait; test_devices.py runs these tests in another process."""

import warnings
from dataclasses import replace
from functools import partial

import pytest
import test_offline_trainer as offline
import torch
from pretend_device import COPIES, MODULE, PRETEND, WAITS, Graph
from small_training import CONFIG, PLANS, assert_same, collect_demos, flat, make_actor, make_descriptor_actor
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from test_losses import LOSSES, make_batch, make_loss, ready, total, trained
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import Compose, TransformedEnv

import lw_torchrl as lw
from benchmarks.paper.stacked import StackedBehavioralCloning
from lw_torchrl._util.devices import check_device
from lw_torchrl.transforms import FallbackTurns

ACTORS = {
    "plan": lambda: make_actor(noise=0.0),
    "noisy plan": lambda: make_actor(noise=0.1),
    "description": lambda: make_descriptor_actor(noise=0.0),
    "one-hot": lambda: make_descriptor_actor(condition="one-hot", noise=0.0),
    "stochastic": lambda: make_actor(noise=0.0).stochastic("normal"),
    "evaluator": lambda: TensorDictSequential(
        seeded(lw.modules.StateQueryEvaluator, PLANS, width=8, depth=1), make_actor(noise=0.0)
    ),
}
SAMPLERS = {
    "balanced": lambda: (lw.TaskBalancedSampler(), None),
    "co-learning": lambda: (lw.CoLearningSampler("push"), None),
    "chosen episodes": lambda: (lw.TaskBalancedSampler(), {"push": 1, "reach": 2}),
    "uniform": lambda: (None, None),
}


def seeded(make, *args, **options):
    torch.manual_seed(0)
    return make(*args, **options)


@pytest.fixture(scope="module")
def demos(tmp_path_factory):
    return collect_demos(tmp_path_factory.mktemp("demos") / "d")


def make_replay(demos, device, sampler="balanced", turned=False):
    drawn, episodes = SAMPLERS[sampler]()
    transform = Compose(lw.QAFTransform(PLANS), *([lw.RandomYaw(0.3)] if turned else []))
    return lw.LanguageWorldExperienceReplay(demos, sampler=drawn, episodes=episodes, transform=transform, device=device)


def make_trainer(demos, device, actor="plan", sampler="balanced", turned=False, checkpoint=None, **config):
    config = replace(CONFIG, **config, qaf_anchor=0.5 if actor == "evaluator" else 0.0)
    replay, options = make_replay(demos, device, sampler, turned), {"checkpoint": checkpoint, "device": device}
    return lw.BehavioralCloningTrainer(ACTORS[actor](), replay, config, progress=False, **options)


def quiet_steps(trainer, number=3):
    """Return the losses of the first steps, of which only the first may wait."""
    losses = [trainer.step()]
    WAITS.clear()
    COPIES.clear()
    losses += [trainer.step() for _ in range(number)]
    assert WAITS == []
    assert trainer._captured.is_captured
    return losses


def weights(trainer):
    return {name: value.detach().cpu() for name, value in trainer.actor.named_parameters()}


def test_waits_are_recorded():
    here = torch.arange(6.0)
    WAITS.clear()
    there = here.to(PRETEND)
    here.to(PRETEND, non_blocking=True)
    assert (len(WAITS), COPIES[-1]) == (1, (6,))
    for wait in (
        *(there.sum().item, there.cpu, there.nonzero, lambda: bool(there.any()), lambda: there[there > 2]),
        *(lambda: torch.equal(there, there), lambda: there[torch.tensor([1, 2])]),
        lambda: torch.tensor([1.0], device=PRETEND),
    ):
        WAITS.clear()
        wait()
        assert WAITS
    for mixed in (lambda: there + here, lambda: here[torch.tensor([1, 2]).to(PRETEND)]):
        with pytest.raises(RuntimeError, match="same device"):
            mixed()


@pytest.mark.parametrize(
    ("actor", "sampler", "turned"),
    [(a, "balanced", False) for a in ACTORS] + [("plan", s, s == "uniform") for s in SAMPLERS if s != "balanced"],
)
def test_step_waits_for_nothing_and_equals_the_cpus(demos, actor, sampler, turned):
    trainer = make_trainer(demos, "pretend", actor, sampler, turned)
    assert (trainer.device, {p.device for p in trainer.actor.parameters()}) == (PRETEND, {PRETEND})
    losses = quiet_steps(trainer)
    indices = 2 if sampler == "co-learning" else 1  # indices, and which rows are the target's
    assert len(COPIES) == 3 * indices, "one copy a batch"
    if turned or actor == "noisy plan":
        return  # random numbers differ between devices
    cpu = make_trainer(demos, "cpu", actor, sampler)
    assert [loss.item() for loss in losses] == [cpu.step().item() for _ in losses]
    assert_same(weights(trainer), weights(cpu))


def n_step_replay(demos, device):
    return lw.LanguageWorldExperienceReplay(demos, device=device, label="executed", n_steps=3, gamma=0.9)


@pytest.mark.parametrize("make", [partial(make_replay, sampler="co-learning"), n_step_replay], ids=["whole", "n steps"])
def test_batch_is_on_the_device(demos, make):
    ours, cpu = make(demos, "pretend"), make(demos, None)
    for replay in (ours, cpu):
        replay.set_rng(torch.Generator().manual_seed(3))
    batch = ours.sample(16)
    assert {value.device for value in batch.values(True, True)} == {batch.device} == {PRETEND}
    assert (batch.cpu() == cpu.sample(16)).all()


def rows_of(demos, device=None, sampler=None):
    """Return TorchRL's own buffer with the rows of the demonstrations."""
    rows = make_replay(demos, None)[:].select("observation", "task_id", "qaf", "qaf_plan", "action")
    mine = TensorDictReplayBuffer(storage=LazyTensorStorage(len(rows), device=device or "cpu"), sampler=sampler)
    mine.extend(rows)
    return mine


def test_rows_on_the_cpu_are_copied_to_the_device(demos):
    options = {"replay": rows_of(demos), "config": CONFIG, "progress": False}
    losses = quiet_steps(lw.BehavioralCloningTrainer(ACTORS["plan"](), device="pretend", **options))
    cpu = lw.BehavioralCloningTrainer(ACTORS["plan"](), **options)
    assert [loss.item() for loss in losses] == [cpu.step().item() for _ in losses]


def test_rows_on_the_device_need_one_of_our_samplers(demos):
    options = {"config": CONFIG, "progress": False, "device": "pretend"}
    with pytest.raises(ValueError, match=r"^replay: .*RandomSampler"):
        lw.BehavioralCloningTrainer(ACTORS["plan"](), rows_of(demos, PRETEND), **options)
    mine = rows_of(demos, PRETEND, lw.TaskBalancedSampler())
    quiet_steps(lw.BehavioralCloningTrainer(ACTORS["plan"](), mine, **options))


def steps_of(demos, device, *parts, actor=None, **options):
    """A trainer whose buffer has further transforms, its first six losses, and the warnings."""
    replay = make_replay(demos, device)
    for part in parts:
        replay.append_transform(part)
    actor = ACTORS["plan"]() if actor is None else actor
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        trainer = lw.BehavioralCloningTrainer(actor, replay, CONFIG, progress=False, device=device, **options)
        losses = [trainer.step().item() for _ in range(6)]
    return trainer, losses, [str(each.message) for each in caught if "CUDA graph" in str(each.message)]


def add_largest(batch):
    return batch.set("largest", torch.full(batch.shape, batch["action"].max().item(), device=batch.device))


def break_capture(batch):
    if Graph.recording is not None:
        raise RuntimeError("not while it is captured")
    return batch


@pytest.mark.parametrize(
    ("part", "capture", "reason"),
    [
        (add_largest, True, "waits for the device"),
        (break_capture, True, "cannot capture the step (RuntimeError: not while it is captured)"),
        (break_capture, None, "on_a_pretend_device.break_capture may change its attributes"),
        (break_capture, False, None),
    ],
)
def test_step_that_cannot_be_captured_runs_as_it_is(demos, part, capture, reason):
    trainer, losses, told = steps_of(demos, "pretend", part, capture=capture)
    assert not trainer._captured.is_captured
    assert (losses, len(told)) == (pytest.approx(steps_of(demos, "cpu", part)[1], rel=1e-5), reason is not None)
    assert reason is None or reason in told[0]


@pytest.mark.parametrize(
    "change",
    [
        lambda trainer: trainer.actor.eval(),
        lambda trainer: setattr(trainer.minibatches[0], "size", 4),
        lambda trainer: trainer.load_state_dict(trainer.state_dict()),
    ],
    ids=["mode", "batch size", "state"],
)
def test_graph_is_captured_again_where_the_step_changes(demos, change):
    trainers = [steps_of(demos, device)[0] for device in ("pretend", "cpu")]
    for trainer in trainers:
        change(trainer)
    losses, expected = ([trainer.step().item() for _ in range(4)] for trainer in trainers)
    assert losses == pytest.approx(expected, rel=1e-5)
    assert trainers[0]._captured.is_captured


@pytest.mark.parametrize("capture", [None, True])
def test_other_classes_are_captured_on_request(demos, capture):
    class Scale(torch.nn.Module):
        def forward(self, observation):
            return 2 * observation

    actor = lw.PlanConditionedActor(PLANS, features=Scale())
    trainer, _, told = steps_of(demos, "pretend", actor=actor, capture=capture)
    assert trainer._captured.is_captured is bool(capture)
    assert ["Scale may change its attributes" in text for text in told] == ([] if capture else [True])


def make_stack(demos, device, checkpoint=None, actor="plan", **config):
    replays, actors = [make_replay(demos, device) for _ in range(3)], [ACTORS[actor]() for _ in range(3)]
    options = {"checkpoint": checkpoint, "progress": False, "device": device}
    return StackedBehavioralCloning(actors, replays, replace(CONFIG, **config), **options)


def test_stacked_trainings_wait_for_nothing(demos):
    stack = make_stack(demos, "pretend")
    losses = quiet_steps(stack)
    assert len(COPIES) == 3, "one copy a step"
    cpu = make_stack(demos, "cpu")
    for loss in losses:
        assert torch.equal(loss.cpu(), cpu.step())
    stack.train()
    assert all(p.device == PRETEND for actor in stack.actors for p in actor.parameters())


def test_losses_are_read_every_100_steps(demos, tmp_path):
    trainer = make_trainer(demos, "pretend", steps=120, checkpoint_every=10_000)
    trainer.step()
    WAITS.clear()
    mean = trainer.train()
    assert len([wait for wait in WAITS if "loop" in wait]) == 3  # at 100, at 120, and at the end
    WAITS[:] = [wait for wait in WAITS if "loop" not in wait]
    assert all("checkpoint" in wait for wait in WAITS), WAITS  # of the weights, at the end
    cpu = make_trainer(demos, "cpu", steps=120, checkpoint_every=10_000)
    cpu.step()
    assert cpu.train() == pytest.approx(mean, rel=1e-5)  # on a GPU the learning rate is float32


@pytest.mark.parametrize("many", [False, True])
def test_nan_is_reported_with_its_step_and_not_written(demos, tmp_path, many):
    make = make_stack if many else make_trainer
    options = {"checkpoint": tmp_path / "c.safetensors", "steps": 30, "checkpoint_every": 10}
    trainer = make(demos, "pretend", **options)
    step, count = trainer.step, [0]

    def breaks():
        count[0] += 1
        if count[0] == 13:
            weights = trainer._parameters if many else dict(trainer.actor.named_parameters())
            name = next(key for key in weights if key.endswith("network.0.weight"))
            weights[name].data[(1, 0) if many else 0].fill_(float("nan"))
        return step()

    trainer.step = breaks
    which = "the loss of actor 1" if many else "the loss"
    with pytest.raises(ValueError, match=f"{which} is nan at step 12: the demonstrations hold NaN, or"):
        trainer.train()
    assert (count[0], make(demos, "pretend", **options).steps) == (20, 10)


@pytest.mark.parametrize("many", [False, True])
def test_training_resumes_bit_for_bit_on_the_same_device(demos, tmp_path, many):
    options = {"actor": "noisy plan", "steps": 12, "checkpoint_every": 5}

    def steps(number, checkpoint=None):
        trainer = (make_stack if many else make_trainer)(demos, "pretend", checkpoint=checkpoint, **options)
        for _ in range(number):
            trainer.step()
        return trainer

    def everything(trainer):
        own = trainer._parameters if many else weights(trainer)
        batches = [one.state_dict() for one in trainer.minibatches]
        state = flat({"weights": own, "minibatches": batches, "optimizer": trainer.optimizer.state_dict()})
        return {key: value.cpu() if isinstance(value, torch.Tensor) else value for key, value in state.items()}

    path = tmp_path / "c.safetensors"
    steps(7, path).save()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert_same(everything(steps(5, path)), everything(steps(12)))


@pytest.mark.parametrize(("begun", "ended"), [("pretend", "cpu"), ("cpu", "pretend")])
def test_training_resumes_on_another_device_with_a_warning(demos, tmp_path, begun, ended):
    path = tmp_path / "c.safetensors"
    first = make_trainer(demos, begun, checkpoint=path)
    for _ in range(7):
        first.step()
    first.save()
    with pytest.warns(UserWarning, match=f"was trained on '{begun}' and resumes on '{ended}'"):
        second = make_trainer(demos, ended, checkpoint=path)
    assert second.steps == 7
    assert_same(weights(second), weights(first))
    assert [second.step().item() for _ in range(3)] == [first.step().item() for _ in range(3)]


def test_file_written_on_the_device_is_loaded_on_the_cpu(demos, tmp_path):
    trainer = make_trainer(demos, "pretend", checkpoint=tmp_path / "c.safetensors")
    trainer.train()
    lw.save_actor(trainer.actor, tmp_path / "p.safetensors")
    for name in ("c.safetensors", "p.safetensors"):
        loaded = lw.load_actor(tmp_path / name)
        assert {tensor.device.type for tensor in loaded.state_dict().values()} == {"cpu"}
        assert_same(dict(loaded.named_parameters()), weights(trainer))


@pytest.mark.parametrize("kind", ["plan", "description", "scripted", "ensemble", "evaluator"])
def test_evaluation_equals_the_cpus(kind):
    class Guess(lw.QueryEvaluator):
        def logits(self, observation, task_id):
            return observation[..., :1].expand(*task_id.shape, self.plans.num_steps)

    made = {
        "scripted": lambda: lw.ScriptedSkillActor(PLANS),
        "ensemble": lambda: lw.modules.ActorEnsemble([ACTORS["plan"](), ACTORS["plan"]()]),
        "evaluator": lambda: TensorDictSequential(Guess(PLANS), make_actor()),
    }
    actor = (ACTORS | made)[kind]()
    options = {"tasks": ["push", "reach"], "episodes_per_task": 2, "seed": 1000, "max_steps": 8, "progress": False}
    expected = lw.evaluate(actor, record_actions=True, **options)
    WAITS.clear()
    for on in ({"device": "pretend"}, {}):  # the actor stays on the device
        result = lw.evaluate(actor, record_actions=True, **on, **options)
        assert [wait for wait in WAITS if "episodes" in wait], "the actor was on the device"
        assert {p.device for p in actor.parameters()} <= {PRETEND}
        assert result == expected
        pairs = zip(result.episodes, expected.episodes, strict=True)
        assert all(torch.equal(one.actions, other.actions) for one, other in pairs)


def make_state(rows=3):
    ids = torch.full((rows,), lw.task_id("push"))
    return lw.QAFTransform(PLANS)(TensorDict({"observation": torch.rand(rows, 39), "task_id": ids}, [rows])).to(PRETEND)


@pytest.mark.parametrize(
    ("key", "value", "problem"),
    [
        ("observation", float("nan"), "observation must hold"),
        ("task_id", -1, "task_id contains tasks"),
        ("qaf_plan", 5, "qaf was computed with plans"),
        ("qaf", 2.0, "qaf must be bool, or numbers from 0 to 1"),
    ],
)
def test_wrong_values_raise_without_waiting(key, value, problem):
    state = make_state()
    if key == "qaf":
        state["qaf"] = state["qaf"].float()
    state[key].fill_(value)
    for reader in [ACTORS["plan"]().to(PRETEND), *([] if "qaf" in key else [lw.QAFTransform(PLANS)])]:
        reader(make_state())
        WAITS.clear()
        with pytest.raises(RuntimeError, match=problem):
            reader(state)
        assert WAITS == []


@pytest.mark.parametrize(
    ("name", "condition"), [*((name, "plan") for name in LOSSES), ("SAC", "description"), ("IQL", "one-hot")]
)
def test_loss_made_on_the_device_equals_the_cpus(name, condition):
    """Networks, their copies, targets and tables are on the device; the state loads on the CPU."""
    here, actor, value = make_loss(name, condition)
    batch = ready(name, make_batch(), actor, value)
    there, _, _ = make_loss(name, condition, device=PRETEND)
    there.load_state_dict(here.state_dict())
    tensors = (*there.parameters(), *there.buffers())
    assert {tensor.device for tensor in tensors if tensor.dim()} == {PRETEND}  # all but gamma and its like
    found = total(there, batch.to(PRETEND))
    found.backward()
    assert (found.device, {p.grad.device for p in trained(there).values()}) == (PRETEND, {PRETEND})
    expected = total(here, batch)
    if name != "REDQ":  # which draws on both
        torch.testing.assert_close(found.cpu(), expected)
    other, _, _ = make_loss(name, condition, seed=1)
    total(other, batch)  # REDQ's state grows at its first call
    other.load_state_dict(there.state_dict())
    assert torch.equal(total(other, batch), expected)


@pytest.mark.parametrize("name", ["bc", "advantage", "value"])  # copies of critics are drawn where they are
def test_losses_over_a_buffer_wait_for_nothing_and_equal_the_cpus(demos, name, monkeypatch):
    originals = {part: getattr(offline, part) for part in ("make_actor", "make_value")}

    def trainer(device):  # losses copy their networks, which must be on the device before
        for part, make in originals.items():
            monkeypatch.setattr(offline, part, lambda *args, make=make, **kw: make(*args, **kw).to(device))
        loss = offline.make_loss(name, noise=0.0)
        return lw.OfflineTrainer(loss, offline.make_replay(demos, device=device), offline.CONFIG, progress=False)

    there, cpu = trainer("pretend"), trainer("cpu")
    assert there.device == PRETEND
    given = [there.step()]
    WAITS.clear()
    given += [there.step() for _ in range(2)]
    assert WAITS == []
    for loss in given:
        assert loss.item() == pytest.approx(cpu.step().item(), rel=1e-5)


def test_environment_waits_once_a_step():
    env = lw.LanguageWorldEnv(["push", "reach"], max_steps=9, device=PRETEND)
    env = TransformedEnv(env, Compose(lw.QAFTransform(PLANS), FallbackTurns()))
    state, action = env.reset(), torch.full((2, 4), 0.5).to(PRETEND)
    for step in range(3):
        WAITS.clear()
        COPIES.clear()
        state = env.step(state.set("action", action))["next"]
        assert step == 0 or (len(WAITS), len(COPIES)) == (1, 1), (WAITS, COPIES)  # a wait for the action


def test_environment_is_on_its_device():
    def make(**device):
        env = lw.LanguageWorldEnv(["push", "reach"], num_envs=2, max_steps=4, **device)
        noise = lw.transforms.CorruptQAF(PLANS, every=2, delay=1, flip=0.3)
        return TransformedEnv(env, Compose(lw.QAFTransform(PLANS), noise, FallbackTurns()))

    rollouts = []
    for env, device in ((make(), torch.device("cpu")), (make().to(PRETEND), PRETEND), (make(device=PRETEND), PRETEND)):
        still = lambda td: td.set("action", torch.full((2, 4), 0.5, device=td.device))  # noqa: E731
        rollout = env.rollout(6, still, break_when_any_done=False)
        assert {value.device for value in rollout.values(True, True)} == {env.device} == {device}
        assert env.action_spec.device == env.full_done_spec.device == device
        rollouts.append(rollout.cpu())
        env.close()
    assert all((rollout == rollouts[0]).all() for rollout in rollouts)


def test_augmentations_are_on_the_rows_device():
    plans = lw.canonical_plans(PLANS, fallback=True)
    swapped, jittered = lw.transforms.SwapUnmentioned(plans, 0.5), lw.transforms.JitterTarget(plans, 0.03)
    augmented = Compose(lw.QAFTransform(plans), swapped, jittered, lw.RandomYaw(0.3, plans=plans, tilt=0.5))
    ids = torch.full((8,), lw.task_id("push"))
    rows = TensorDict(observation=torch.rand(8, 39), action=torch.rand(8, 4), task_id=ids, batch_size=[8]).to(PRETEND)
    augmented(rows)
    WAITS.clear()
    assert ({value.device for value in augmented(rows).values(True, True)}, WAITS) == ({PRETEND}, [])


def test_random_draws_are_the_trainers(demos):
    def drawn():
        return torch.get_rng_state(), MODULE.state

    def losses(before, after):
        for seed in (torch.manual_seed, MODULE.manual_seed):
            seed(before)
        trainer = make_trainer(demos, "pretend", "noisy plan", turned=True)
        for seed in (torch.manual_seed, MODULE.manual_seed):
            seed(after)
        states = drawn()
        values = [trainer.step().item() for _ in range(3)]
        assert all(torch.equal(one, other) for one, other in zip(drawn(), states, strict=True))
        return values

    assert losses(0, 1) == losses(99, 2)


def test_device_names(demos):
    assert {check_device("device", name) for name in ("auto", "pretend", "pretend:0", PRETEND)} == {PRETEND}
    with pytest.raises(ValueError, match=r"device must be .* got 'cuda'"):
        make_trainer(demos, "cuda")
