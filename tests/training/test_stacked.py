"""Many actors trained at once: each fares as it would alone."""

import pytest
import torch
from speed import first_fast
from torchrl.envs import Compose

import lw_torchrl as lw

TASKS = ("push", "reach", "window-open")
PLANS = lw.load_plans("MT10")
CONFIG = lw.BehavioralCloningConfig(steps=100, batch_size=30, seed=5)


@pytest.fixture(scope="module")
def demos(tmp_path_factory):
    root = tmp_path_factory.mktemp("stacked") / "demos"
    lw.collect_demonstrations(TASKS, episodes_per_task=2, root=root, max_steps=100, progress=False)
    return root


def replay(demos):
    turned = Compose(lw.QAFTransform(PLANS), lw.RandomYaw(0.3))
    return lw.LanguageWorldExperienceReplay(demos, sampler=lw.TaskBalancedSampler(), transform=turned, after_success=20)


def make(kind, seed):
    torch.manual_seed(seed)
    if kind == "plan":
        return lw.PlanConditionedActor(PLANS, width=32)
    if kind == "focused plan":
        return lw.PlanConditionedActor(PLANS, width=32, focus=True, swap_unmentioned=0.5)
    return lw.DescriptorConditionedActor(TASKS, width=32, condition=kind)


@pytest.mark.parametrize("kind", first_fast(["plan", "focused plan", "description", "one-hot"]))
def test_every_loss_is_the_one_it_has_alone(demos, kind):
    together = lw.training.StackedBehavioralCloning(
        [make(kind, seed) for seed in range(3)], [replay(demos) for _ in range(3)], CONFIG, progress=False
    )
    losses = torch.stack([together.step() for _ in range(CONFIG.steps)])
    assert losses[-10:].mean() < losses[:10].mean() / 2
    for number in range(3):
        config = lw.BehavioralCloningConfig(**{**vars(CONFIG), "seed": CONFIG.seed + number})
        alone = lw.BehavioralCloningTrainer(make(kind, number), replay(demos), config, progress=False)
        own = torch.tensor([alone.step() for _ in range(CONFIG.steps)])
        assert (losses[:, number] - own).abs().max() < 1e-5


def test_the_actors_get_their_weights(demos):
    actors = [make("plan", seed) for seed in range(2)]
    config = lw.BehavioralCloningConfig(steps=3, batch_size=30)
    trainer = lw.training.StackedBehavioralCloning(actors, [replay(demos) for _ in range(2)], config, progress=False)
    before = [actor.head.network[0].weight.clone() for actor in actors]
    assert trainer.train().shape == (2,)
    for number, actor in enumerate(actors):
        assert not actor.training
        assert not torch.equal(actor.head.network[0].weight, before[number])
        stacked = trainer._parameters["actor.head.network.0.weight"][number]
        assert torch.equal(actor.head.network[0].weight, stacked)
    assert actors[0].encoder.features.mean.any()


def test_what_it_refuses(demos):
    with pytest.raises(ValueError, match="replays must be as many as actors, at least one, got 1 and 2"):
        lw.training.StackedBehavioralCloning([make("plan", 0), make("plan", 1)], [replay(demos)])
    ahead = lw.LanguageWorldExperienceReplay(demos, prefetch=1, batch_size=10)
    with pytest.raises(ValueError, match="replay must not prefetch"):
        lw.training.StackedBehavioralCloning([make("one-hot", 0)], [ahead], CONFIG)
    odd = lw.PlanConditionedActor(PLANS, width=16)
    with pytest.raises(ValueError, match="actors must be of one architecture"):
        lw.training.StackedBehavioralCloning([make("plan", 0), odd], [replay(demos), replay(demos)])
    broken = make("plan", 0)
    torch.nn.init.constant_(broken.head.network[0].weight, float("nan"))
    trainer = lw.training.StackedBehavioralCloning([make("plan", 0), broken], [replay(demos), replay(demos)], CONFIG)
    with pytest.raises(ValueError, match="the loss of actor 1 is nan at step 0"):
        trainer.step()


@pytest.mark.parametrize(
    ("options", "different"), [(dict(squash=False), "squash"), (dict(features="both"), "features")]
)
def test_actors_of_other_options_are_refused(demos, options, different):
    """Of the same shapes, they would be trained as the first one is."""
    actors = [lw.PlanConditionedActor(PLANS, width=32), lw.PlanConditionedActor(PLANS, width=32, **options)]
    with pytest.raises(ValueError, match=f"actors must be of one architecture, 0 and 1 differ in {different}"):
        lw.training.StackedBehavioralCloning(actors, [replay(demos), replay(demos)], CONFIG)


def test_what_comes_twice_is_refused(demos):
    actor, rows = make("plan", 0), replay(demos)
    for other in (actor, actor.with_plans(PLANS)):
        with pytest.raises(ValueError, match="actors must have weights of their own"):
            lw.training.StackedBehavioralCloning([actor, other], [rows, replay(demos)], CONFIG)
    sharing = lw.LanguageWorldExperienceReplay(demos, sampler=rows.sampler, transform=lw.QAFTransform(PLANS))
    for other in (rows, sharing):
        with pytest.raises(ValueError, match="replays must be different buffers, each with a sampler of its own"):
            lw.training.StackedBehavioralCloning([actor, make("plan", 1)], [rows, other], CONFIG)


def test_a_checkpoint_is_of_all_its_actors(demos, tmp_path):
    """Of two trainings whose second actors differ in their plans alone, neither goes on with the other's file."""
    pairs = [(str(step.condition), step.skill) for step in PLANS["reach"].steps]
    others = lw.Plans([*(PLANS[t] for t in PLANS if t != "reach"), lw.ConditionalPlan.from_pairs("reach", pairs[::-1])])

    def trainer(second):
        actors = [make("plan", 0), lw.PlanConditionedActor(second, width=32)]
        answered = lw.LanguageWorldExperienceReplay(
            demos, sampler=lw.TaskBalancedSampler(), transform=lw.QAFTransform(second)
        )
        return lw.training.StackedBehavioralCloning(
            actors, [replay(demos), answered], CONFIG, checkpoint=tmp_path / "c.zip", progress=False
        )

    trainer(PLANS).save()
    trainer(PLANS)
    with pytest.raises(ValueError, match="is of another architecture, its actors differs in 1 "):
        trainer(others)


def test_it_carries_on_from_its_checkpoint(demos, tmp_path):
    def trainer(config, checkpoint=None):
        actors = [make("focused plan", seed) for seed in range(2)]
        replays = [replay(demos) for _ in range(2)]
        return lw.training.StackedBehavioralCloning(actors, replays, config, checkpoint=checkpoint, progress=False)

    config = lw.BehavioralCloningConfig(steps=20, batch_size=30, checkpoint_every=10)
    whole, path = trainer(config), tmp_path / "deep" / "checkpoint.zip"
    losses = torch.stack([whole.step() for _ in range(20)])
    first = trainer(config, path)
    for _ in range(10):
        first.step()
    first.save()
    first.step()  # lost
    second = trainer(config, path)
    assert second.steps == 10
    assert torch.equal(torch.stack([second.step() for _ in range(10)]), losses[10:])
    second.save()
    done = trainer(config, path)
    assert done.train().isnan().all()
    for name, value in whole._parameters.items():
        assert torch.equal(value, done._parameters[name])

    parts = trainer(config)
    for until in (7, 13, None):
        parts.train(until=until)
        assert not parts.actors[1].training
    for name, value in whole._parameters.items():
        assert torch.equal(value, parts._parameters[name])
    with pytest.raises(ValueError, match="until must be at most the configuration's steps, 20, got 21"):
        parts.train(until=21)

    with pytest.raises(ValueError, match="is of another configuration, its training differs in steps"):
        trainer(lw.BehavioralCloningConfig(steps=21, batch_size=30, checkpoint_every=10), path)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(ValueError, match="damaged"):
        trainer(config, path)
