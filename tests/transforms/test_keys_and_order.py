"""Keys of transforms can be renamed, and transforms in a wrong order are refused."""

import pytest
import torch
from tensordict import TensorDict
from torchrl import envs as o
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import Compose, SerialEnv, StepCounter, TransformedEnv

import lw_torchrl as lw

PLANS = lw.load_plans("MT10")
NESTED = {"in_keys": [("robot", "state"), ("robot", "task")], "out_keys": [("plan", "truth")]}


def make_env() -> lw.LanguageWorldEnv:
    return lw.LanguageWorldEnv(["push", "reach"], num_envs=2, seed=0, max_steps=5, num_threads=1)


def queries(**options) -> lw.QAFTransform:
    return lw.QAFTransform(PLANS, **options)


def norm(key="observation", out="observation") -> o.ObservationNorm:
    return o.ObservationNorm(loc=0.0, scale=2.0, in_keys=[key], out_keys=[out])


def rows(number: int = 6) -> TensorDict:
    observation, following = torch.rand(2, number, 39)
    ids = torch.tensor([lw.task_id("push"), lw.task_id("reach")]).repeat(number // 2)
    sample = TensorDict({"observation": observation, "task_id": ids, "action": torch.rand(number, 4)}, [number])
    return sample.set("next", TensorDict({"observation": following}, [number]))


MOVED = {"observation": "state", "task_id": "task", "action": "move"}


def nested(sample: TensorDict) -> TensorDict:
    result = TensorDict({("robot", new): sample[old].clone() for old, new in MOVED.items()}, sample.batch_size)
    return result.set(("next", "robot", "state"), sample["next", "observation"].clone())


def test_nested_keys_on_a_sample():
    sample = rows()
    plain, moved = queries()(sample.clone()), queries(**NESTED)(nested(sample))
    assert torch.equal(moved["plan", "truth"], plain["qaf"])
    assert torch.equal(moved["next", "plan", "truth"], plain["next", "qaf"])
    assert "qaf" not in moved.keys(True)


def turned(sample: TensorDict, **keys) -> TensorDict:
    torch.manual_seed(0)
    return lw.RandomYaw(0.5, **keys)(sample.clone())


def test_random_yaw_with_renamed_keys():
    sample = rows()
    expected = turned(sample)
    keys = [("robot", "state"), ("robot", "move"), ("robot", "expert"), ("robot", "unclipped")]
    result = turned(nested(sample), in_keys=keys)
    beside = turned(sample, out_keys=["turned", "turned_action", "turned_expert", "turned_wish"])
    assert (beside.select(*sample.keys(True, True)) == sample).all()
    for key, inside, outside in (
        ("observation", ("robot", "state"), "turned"),
        (("next", "observation"), ("next", "robot", "state"), ("next", "turned")),
        ("action", ("robot", "move"), "turned_action"),
    ):
        assert torch.equal(result[inside], expected[key])
        assert torch.equal(beside[outside], expected[key])


BEFORE = {
    "ObservationNorm": norm,
    "VecNormV2": lambda: o.VecNormV2(in_keys=["observation"]),
    "Compose": lambda: Compose(StepCounter(), norm()),
    "next": lambda: norm(("next", "observation"), ("next", "observation")),
    "renamed": lambda: Compose(norm("observation", "raw"), o.RenameTransform(["raw"], ["observation"])),
}


@pytest.mark.filterwarnings("ignore:Support of VecNormV2 for containers with non-empty batch-size")
@pytest.mark.parametrize("name", BEFORE)
def test_transforms_that_change_the_observation_before_qaf_are_refused(name):
    message = r"(ObservationNorm|VecNormV2) changes .* before QAFTransform reads it.* put QAFTransform before"
    if name == "renamed":
        message = "changes 'raw' before QAFTransform reads it"
    with pytest.raises(ValueError, match=message):
        Compose(BEFORE[name](), queries())
    env, around = make_env(), {"auto_unwrap": False}
    for build in (
        lambda: TransformedEnv(env, Compose(BEFORE[name](), queries())),
        lambda: TransformedEnv(env, BEFORE[name]()).append_transform(queries()),
        lambda: TransformedEnv(TransformedEnv(env, BEFORE[name](), **around), queries(), **around),
    ):
        if name != "next":
            with pytest.raises(ValueError, match=message):
                build()
    env.close()


def test_random_yaw_before_qaf_or_a_transform_inserted_before_it_later_is_refused():
    env = TransformedEnv(make_env(), queries())
    env.insert_transform(0, norm())
    with pytest.raises(ValueError, match="ObservationNorm changes 'observation' before QAFTransform reads it"):
        env.rollout(2)
    env.close()
    with pytest.raises(ValueError, match="QAFTransform before RandomYaw"):
        Compose(lw.RandomYaw(0.5), queries())
    with pytest.raises(ValueError, match="QAFTransform before RandomYaw"):
        TensorDictReplayBuffer(storage=LazyTensorStorage(6), transform=Compose(lw.RandomYaw(0.5), queries()))


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_half_precision_observations_are_refused(dtype):
    replay = TensorDictReplayBuffer(storage=LazyTensorStorage(6), batch_size=6)
    replay.append_transform(o.DTypeCastTransform(torch.float32, dtype))
    replay.append_transform(queries())
    replay.extend(rows())
    with pytest.raises(ValueError, match="observation"):
        replay.sample()
    precise = rows()
    precise["observation"] = precise["observation"].double()
    assert queries()(precise)["qaf"].dtype == torch.bool


def test_qaf_in_workers_before_a_normaliser_and_around_workers_that_have_not_started():
    inside = SerialEnv(2, lambda: TransformedEnv(make_env(), Compose(queries(), norm())))
    for env in (TransformedEnv(inside, StepCounter()), TransformedEnv(SerialEnv(2, make_env), queries())):
        assert env.reset()["qaf"].shape[:2] == (2, 2)
        env.close()
