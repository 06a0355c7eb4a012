"""fit_normalization reaches every network of a loss, including its targets and copies."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, ListStorage, RandomSampler, TensorDictReplayBuffer
from torchrl.objectives import CQLLoss, DDPGLoss, IQLLoss, REDQLoss, SACLoss, TD3Loss

import lw_torchrl as lw
from lw_torchrl.modules import MLPDecoder, ObservationFeatures, RoleFeatures
from lw_torchrl.training import fit_normalization
from lw_torchrl.training.normalization import check_contacts

pytestmark = pytest.mark.filterwarnings("ignore:No target network updater")
PLANS = lw.load_plans("MT10")


@pytest.fixture(scope="module")
def replay():
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(50), batch_size=8)
    buffer.extend(TensorDict(observation=torch.randn(50, 39) * 3 + 1, batch_size=[50]))
    return buffer


@pytest.fixture(scope="module")
def expected(replay):
    features = {kind: ObservationFeatures(kind) for kind in ("differences", "raw")}
    for each in features.values():
        each.fit(replay[:])
    return features


def make(kind="differences", distribution=None):
    actor = lw.PlanConditionedActor(PLANS, features=ObservationFeatures(kind), decoder=MLPDecoder(width=8, depth=1))
    actor = actor if distribution is None else actor.stochastic(distribution)
    critics = (lw.PlanConditionedQValue, lw.PlanConditionedValue)
    return actor, *(critic(PLANS, features=ObservationFeatures(kind), width=8, depth=1) for critic in critics)


def losses(kind):
    yield DDPGLoss(*make(kind)[:2], delay_actor=True)
    yield TD3Loss(*make(kind)[:2], bounds=(-torch.ones(4), torch.ones(4)))
    for loss in (SACLoss, REDQLoss, lambda actor, q: CQLLoss(actor, q, action_spec=actor.spec["action"])):
        yield loss(*make(kind, "tanh_normal")[:2])
    yield IQLLoss(*make(kind, "normal"))


@pytest.mark.parametrize("kind", ["differences", "raw"])
def test_statistics_reach_all_networks_of_a_loss(replay, expected, kind):
    for loss in losses(kind):
        fit_normalization(loss, replay)
        statistics = {name: value for name, value in loss.state_dict().items() if name.endswith(("mean", "std"))}
        assert len(statistics) >= 6, type(loss)  # two each of actor and critic, and of the targets
        for name, value in statistics.items():
            fitted = getattr(expected[kind], name.rpartition(".")[2])
            assert torch.equal(value, fitted.expand_as(value)), (type(loss), name)


def test_rows_may_be_in_a_list_and_in_double_precision(replay, expected):
    rows = TensorDict(observation=replay[:]["observation"].double()).auto_batch_size_(1)
    rows["task_id"] = torch.tensor([lw.task_id("push")] * 10 + [lw.task_id("reach")] * 40)
    means = []
    for storage in (LazyTensorStorage(50), ListStorage(50)):
        buffer = TensorDictReplayBuffer(storage=storage, sampler=lw.CoLearningSampler("push"), batch_size=8)
        with pytest.raises(ValueError, match="replay must hold rows"):
            fit_normalization(make()[0], buffer)
        buffer.extend(rows)
        features = ObservationFeatures()
        fit_normalization(features, buffer)
        means.append(features.mean.clone())
        buffer.set_sampler(RandomSampler())
        fit_normalization(features, buffer)
        torch.testing.assert_close(features.std, expected["differences"].std)
    assert torch.equal(*means)
    assert not torch.allclose(means[0], expected["differences"].mean)


def test_role_features_in_a_loss_are_fitted_with_their_contact_points():
    plans = lw.canonical_plans(PLANS)
    generator = torch.Generator().manual_seed(0)
    rows = TensorDict(observation=0.1 * torch.rand(200, 39, generator=generator)).auto_batch_size_(1)
    rows["task_id"] = torch.full((200,), lw.task_id("push"))
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(200), batch_size=8)
    buffer.extend(rows)
    expected = RoleFeatures(plans)
    expected.fit(rows)
    actor = lw.PlanConditionedActor(plans, features=RoleFeatures(plans))
    loss = TD3Loss(actor, lw.PlanConditionedQValue(plans, features=RoleFeatures(plans)), bounds=(-1.0, 1.0))
    with pytest.raises(ValueError, match="RoleFeatures needs contact points"):
        check_contacts(loss)
    fit_normalization(loss, buffer)
    check_contacts(loss)
    assert torch.equal(actor.features.contact, expected.contact)
    assert expected.demonstrated.any()
    contact = loss.qvalue_network_params["trunk", "module", "features", "contact"]
    assert torch.equal(contact, expected.contact.expand_as(contact))
