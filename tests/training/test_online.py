"""OnlineTrainer: what it does in a round, and that stopped anywhere it ends with the same bits."""

from __future__ import annotations

import signal
import subprocess
import sys
import textwrap
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from small_online import CONFIG, PLANS, collect_demos, configure, everything, make_actor, make_online
from small_training import assert_same, flat
from tensordict import TensorDict
from torchrl.record.loggers import CSVLogger

import lw_torchrl as lw
from lw_torchrl.modules import DescriptorEncoder, QValue
from lw_torchrl.training import LEARNERS
from lw_torchrl.training.algorithms import expert_iteration
from lw_torchrl.training.algorithms.expert_iteration import successful


@pytest.fixture(scope="module")
def demos(tmp_path_factory):
    return collect_demos(tmp_path_factory.mktemp("online") / "demos")


@pytest.fixture(autouse=True)
def each_first_row_succeeds(monkeypatch):
    """So short an episode hardly ever does; expert iteration is then to learn from the first row all the same."""
    monkeypatch.setattr(expert_iteration, "successful", lambda rows: rows[0])


methods = pytest.mark.parametrize("method", LEARNERS)


@methods
@pytest.mark.slow
def test_it_learns_something_and_can_be_kept(demos, tmp_path, method):
    actor = make_actor()
    before = {name: value.clone() for name, value in actor.state_dict().items()}
    trainer = make_online(demos, method, actor=actor, checkpoint=tmp_path / "c.safetensors")
    trainer.train()
    assert [one["frames"] for one in trainer.history] == [60, 120, 180, 240]
    assert all(one["episodes"] >= 4 for one in trainer.history)
    assert all(0.0 <= one["success"] <= 1.0 for one in trainer.history)
    assert trainer.frames == 240
    assert any(name.startswith("loss") for name in trainer.history[-1])
    trained = {name: p for name, p in trainer.policy.named_parameters() if p.requires_grad}
    assert any(not torch.equal(p, before.get(name, torch.zeros_like(p))) for name, p in trained.items())
    in_place = method in ("advantage", "td3", "expert-iteration")
    assert (trainer.policy is actor) == in_place
    if not in_place:
        assert all(torch.equal(value, before[name]) for name, value in actor.state_dict().items())
    loaded = lw.load_actor(tmp_path / "c.safetensors")
    assert_same(dict(loaded.state_dict()), dict(trainer.policy.state_dict()))
    assert not trainer.policy.training


@pytest.fixture(scope="module")
def undisturbed(demos):
    """What each method comes to."""
    known = {}

    def find(method):
        if method not in known:
            trainer = make_online(demos, method)
            trainer.train()
            known[method] = flat(everything(trainer))
        return known[method]

    return find


@pytest.mark.parametrize(
    ("method", "stops"),
    [
        ("td3", [2, 3]),
        ("ppo", [1]),
        *(pytest.param(method, [1], marks=pytest.mark.slow) for method in LEARNERS if method != "ppo"),
    ],
)
def test_stopped_in_a_round_it_ends_with_the_same_bits(demos, undisturbed, tmp_path, method, stops):
    whole = undisturbed(method)
    path = tmp_path / "checkpoint.safetensors"
    for stop in stops:
        trainer = make_online(demos, method, path)
        learner, rounds = trainer.learner, [trainer.round]

        def end_round(*given, learner=learner, rounds=rounds, stop=stop):
            rounds[0] += 1
            if rounds[0] > stop:  # all of the round is done, but for what comes of it
                raise KeyboardInterrupt
            type(learner).end_round(learner, *given)

        learner.end_round = end_round
        torch.manual_seed(stop)  # what else draws in this process must not matter
        with pytest.raises(KeyboardInterrupt):
            trainer.train()
    resumed = make_online(demos, method, path)
    assert resumed.round == stops[-1]
    resumed.train()
    assert_same(flat(everything(resumed)), whole)


def test_ctrl_c_ends_it_between_steps_with_the_last_rounds_checkpoint(demos, undisturbed, tmp_path):
    path = tmp_path / "checkpoint.safetensors"
    trainer = make_online(demos, checkpoint=path)
    learn, calls = trainer.learner.learn, []

    def interrupted(steps):
        calls.append(steps)
        if len(calls) == 5:  # three chunks of five steps are a round
            signal.raise_signal(signal.SIGINT)
        learn(steps)

    trainer.learner.learn = interrupted
    with pytest.raises(KeyboardInterrupt):
        trainer.train()
    assert len(calls) == 5
    resumed = make_online(demos, checkpoint=path)
    assert resumed.round == 1
    resumed.train()
    assert_same(flat(everything(resumed)), undisturbed("td3"))


KILLER = """
    import os, random, signal, sys, time
    import torch
    sys.path.insert(0, sys.argv[3])
    from small_online import everything, make_online
    from small_training import flat
    import lw_torchrl as lw

    root, path = sys.argv[1:3]
    lw.LanguageWorldEnv(["push", "reach"], num_threads=1).close()

    def train(path):
        trainer = make_online(root, checkpoint=path)
        trainer.train()
        return flat(everything(trainer))

    whole = train(None)  # before any child: it takes the time that there is to import and compile
    begun = time.perf_counter()
    train(None)
    work = time.perf_counter() - begun
    draw, kills = random.Random(0), 0
    for _ in range(6):
        child = os.fork()
        if child == 0:
            try:
                train(path)
            except BaseException as error:
                print(repr(error), file=sys.stderr)
                os._exit(1)
            os._exit(0)
        time.sleep(draw.uniform(0.1, 0.5) * work)
        os.kill(child, signal.SIGKILL)
        status = os.waitpid(child, 0)[1]
        assert not os.WIFEXITED(status) or os.WEXITSTATUS(status) == 0
        kills += os.WIFSIGNALED(status)
        if os.path.exists(path):
            lw.load_actor(path)
    resumed = train(path)
    assert resumed.keys() == whole.keys()
    for key, value in whole.items():
        same = torch.equal(resumed[key], value) if isinstance(value, torch.Tensor) else resumed[key] == value
        assert same, key
    print(kills)
"""


@pytest.mark.slow
def test_killed_at_any_moment_the_checkpoint_is_whole_and_training_the_same(demos, tmp_path):
    here = str(Path(__file__).parent)
    command = [
        sys.executable,
        "-W",
        "ignore",
        "-c",
        textwrap.dedent(KILLER),
        str(demos),
        str(tmp_path / "c.safetensors"),
        here,
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=240)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) >= 3


def test_gradient_steps_are_as_many_as_the_ratio_says(demos):
    trainer = make_online(demos, config=replace(CONFIG, utd=0.3))
    trainer.train()
    assert trainer.learner.made == int((240 - 40) * 0.3)
    assert trainer.replay.storage.count == 240


def test_the_critic_is_trained_alone_at_first(demos):
    actor = make_actor()
    before = actor.head.network[0].weight.detach().clone()
    make_online(demos, actor=actor, config=replace(CONFIG, warm_up=10_000)).train()
    assert torch.equal(actor.head.network[0].weight, before)


def test_sacs_actor_learns_from_the_critics_that_judged_it(demos):
    actors = []
    for rate in (0.0, 1.0):
        config = configure("sac", frames=60, utd=0.05, warm_up=0, critic_learning_rate=rate)
        trainer = make_online(demos, "sac", config=config)
        trainer.train()
        assert trainer.learner.made == 1
        actors.append(dict(trainer.policy.state_dict()))
    assert_same(*actors)


def test_expert_iteration_makes_as_many_steps_of_what_succeeded(demos, monkeypatch):
    trainer = make_online(demos, "expert-iteration")
    trainer.train()
    assert trainer.learner.made == int((240 - 40) * 0.1)
    assert trainer.replay.storage.count == 4 * 15
    monkeypatch.setattr(expert_iteration, "successful", lambda rows: None)
    trainer = make_online(demos, "expert-iteration")
    trainer.train()
    assert trainer.learner.made == trainer.replay.storage.count == 0


def test_successful_episodes_are_kept_whole():
    ids = torch.tensor([[0, 0, 0, 4, 4], [1, 1, 5, 5, 5], [2, 2, 2, 2, 2]])
    success = torch.zeros(3, 5, 1, dtype=torch.bool)
    success[0, 2] = success[1, 4] = True
    rows = TensorDict({"collector": {"traj_ids": ids}, "next": {"success": success}}, [3, 5])
    assert successful(rows)["collector", "traj_ids"].tolist() == [0, 0, 0, 5, 5, 5]
    assert successful(rows[2:]) is None


def test_what_is_stored_is_what_was_done_and_where_it_led(demos):
    trainer = make_online(demos, config=replace(CONFIG, frames=120, rows=2, round_steps=20), replay=None)
    trainer.train()
    storage = trainer.replay.storage
    rows = storage[storage.num_joined :]
    assert len(rows) == 120
    ids = rows["collector", "traj_ids"]
    assert len(ids.unique()) == 3 * 2 * 2, "each row's episode of 12 steps, and the 8 that the round cut off"
    for one in ids.unique():
        episode = rows[ids == one]
        assert len(episode) in (8, 12)
        ended = len(episode) == 12  # which the last three rows see, n steps ahead
        assert episode["next", "done"].flatten().tolist() == [False] * (len(episode) - 3) + [ended] * 3
        steps = episode["steps_to_next_obs"].flatten().tolist()
        assert steps == [3] * (len(episode) - 2) + [2, 1], "a cut episode's last rows look as far as there are rows"
        assert torch.equal(episode["next", "observation"][:-3], episode["observation"][3:])
        assert (episode["next", "reward"] <= 0).all()


def test_it_is_logged_by_steps_of_the_environment(demos, tmp_path):
    make_online(demos, logger=CSVLogger("online", log_dir=str(tmp_path))).train()
    logged = tmp_path / "online" / "scalars" / "train"
    assert {"success.csv", "episodes.csv", "loss_actor.csv", "loss_qvalue.csv", "value.csv"} <= {
        path.name for path in logged.iterdir()
    }
    lines = (logged / "episodes.csv").read_text("utf-8").splitlines()
    assert [line.split(",")[0] for line in lines] == ["60", "120", "180", "240"]


@pytest.mark.parametrize("method", ["dc", "one-hot"])
@pytest.mark.parametrize("how", ["td3", "residual", "ppo"])
@pytest.mark.slow
def test_other_conditions_learn_too(demos, method, how):
    trainer = make_online(demos, how, actor=make_actor(method), config=configure(how, frames=120))
    trainer.train()
    assert len(trainer.history) == 2


def test_a_critic_may_be_given(demos):
    critic = QValue(DescriptorEncoder(PLANS, latent_size=4), width=8, depth=1)
    trainer = make_online(demos, critic=critic, config=replace(CONFIG, frames=120))
    trainer.train()
    assert trainer.learner.loss.qvalue_network.heads[0][0].weight.shape[0] == 8
    for method in ("ppo", "expert-iteration"):
        with pytest.raises(ValueError, match=r"critic: .* leave it out"):
            make_online(demos, method, critic=critic)


def test_a_critic_of_other_plans_is_refused(demos):
    others = lw.Plans([lw.ConditionalPlan(plan.task, plan.steps[::-1]) for plan in PLANS.values()])
    with pytest.raises(ValueError, match="replay's QAFTransform must have the critic's plans"):
        make_online(demos, critic=lw.PlanConditionedQValue(others, width=16, depth=1))


def test_critics_see_what_the_start_was_normalised_by(demos):
    actor = make_actor()
    actor.fit_normalization(torch.rand(50, 39))
    loss = make_online(demos, actor=actor).learner.loss
    for params in (loss.qvalue_network_params, loss.target_qvalue_network_params):
        for number in range(2):
            assert torch.equal(params["encoder", "features", "mean"][number], actor.encoder.features.mean)


def test_a_loss_that_is_no_number_is_told(demos):
    with pytest.raises(ValueError, match=r"must be finite|is no number"):
        make_online(demos, config=replace(CONFIG, critic_learning_rate=1e30, actor_learning_rate=1e30)).train()
