"""Keys of transforms can be renamed, and transforms in a wrong order are refused."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import (
    Compose,
    DTypeCastTransform,
    ObservationNorm,
    RenameTransform,
    SerialEnv,
    StepCounter,
    TransformedEnv,
    VecNormV2,
)

import lw_torchrl as lw

PLANS = lw.load_plans("MT10")
NESTED = {"in_keys": [("robot", "state"), ("robot", "task")], "out_keys": [("plan", "truth")]}


def make_env() -> lw.LanguageWorldEnv:
    return lw.LanguageWorldEnv(["push", "reach"], num_envs=2, seed=0, max_steps=5, num_threads=1)


def queries(**options) -> lw.QAFTransform:
    return lw.QAFTransform(PLANS, **options)


def norm(key="observation", out="observation") -> ObservationNorm:
    return ObservationNorm(loc=0.0, scale=2.0, in_keys=[key], out_keys=[out])


def rows(number: int = 6) -> TensorDict:
    observation, following = torch.rand(2, number, 39)
    ids = torch.tensor([lw.task_id("push"), lw.task_id("reach")]).repeat(number // 2)
    sample = TensorDict({"observation": observation, "task_id": ids, "action": torch.rand(number, 4)}, [number])
    return sample.set("next", TensorDict({"observation": following}, [number]))


def nested(sample: TensorDict) -> TensorDict:
    moved = {
        ("robot", "state"): sample["observation"],
        ("robot", "task"): sample["task_id"],
        ("robot", "move"): sample["action"],
        ("next", "robot", "state"): sample["next", "observation"],
    }
    result = TensorDict({}, sample.batch_size)
    for key, value in moved.items():
        result.set(key, value.clone())
    return result


def test_nested_keys_on_a_sample():
    sample = rows()
    plain, moved = queries()(sample.clone()), queries(**NESTED)(nested(sample))
    assert torch.equal(moved["plan", "truth"], plain["qaf"])
    assert torch.equal(moved["next", "plan", "truth"], plain["next", "qaf"])
    assert "qaf" not in moved.keys(True)


def test_random_yaw_with_renamed_keys():
    sample = rows()
    torch.manual_seed(0)
    expected = lw.RandomYaw(0.5)(sample.clone())
    torch.manual_seed(0)
    keys = [("robot", "state"), ("robot", "move"), ("robot", "expert"), ("robot", "unclipped")]
    result = lw.RandomYaw(0.5, in_keys=keys)(nested(sample))
    assert torch.equal(result["robot", "state"], expected["observation"])
    assert torch.equal(result["next", "robot", "state"], expected["next", "observation"])
    assert torch.equal(result["robot", "move"], expected["action"])
    torch.manual_seed(0)
    beside = lw.RandomYaw(0.5, out_keys=["turned", "turned_action", "turned_expert", "turned_wish"])(sample.clone())
    assert torch.equal(beside["observation"], sample["observation"])
    assert torch.equal(beside["action"], sample["action"])
    assert torch.equal(beside["turned"], expected["observation"])
    assert torch.equal(beside["next", "turned"], expected["next", "observation"])
    assert torch.equal(beside["turned_action"], expected["action"])


BEFORE = {
    "ObservationNorm": norm,
    "VecNormV2": lambda: VecNormV2(in_keys=["observation"]),
    "Compose": lambda: Compose(StepCounter(), norm()),
    "next": lambda: norm(("next", "observation"), ("next", "observation")),
    "renamed": lambda: Compose(norm("observation", "raw"), RenameTransform(in_keys=["raw"], out_keys=["observation"])),
}


@pytest.mark.filterwarnings("ignore:Support of VecNormV2 for containers with non-empty batch-size")
@pytest.mark.parametrize("name", BEFORE)
def test_transforms_that_change_the_observation_before_qaf_are_refused(name):
    message = r"(ObservationNorm|VecNormV2) changes .* before QAFTransform reads it.* put QAFTransform before"
    if name == "renamed":
        message = "changes 'raw' before QAFTransform reads it"
    with pytest.raises(ValueError, match=message):
        Compose(BEFORE[name](), queries())
    env = make_env()
    if name != "next":
        with pytest.raises(ValueError, match=message):
            TransformedEnv(env, Compose(BEFORE[name](), queries()))
        with pytest.raises(ValueError, match=message):
            TransformedEnv(env, BEFORE[name]()).append_transform(queries())
        with pytest.raises(ValueError, match=message):
            TransformedEnv(TransformedEnv(env, BEFORE[name](), auto_unwrap=False), queries(), auto_unwrap=False)
    env.close()


def test_transform_inserted_before_qaf_later_is_refused():
    env = TransformedEnv(make_env(), queries())
    env.insert_transform(0, norm())
    with pytest.raises(ValueError, match="ObservationNorm changes 'observation' before QAFTransform reads it"):
        env.rollout(2)
    env.close()


def test_random_yaw_before_qaf_is_refused():
    with pytest.raises(ValueError, match="QAFTransform before RandomYaw"):
        Compose(lw.RandomYaw(0.5), queries())
    with pytest.raises(ValueError, match="QAFTransform before RandomYaw"):
        TensorDictReplayBuffer(storage=LazyTensorStorage(6), transform=Compose(lw.RandomYaw(0.5), queries()))


def test_queries_in_the_workers_may_be_followed_by_a_normaliser():
    env = TransformedEnv(SerialEnv(2, lambda: TransformedEnv(make_env(), Compose(queries(), norm()))), StepCounter())
    assert env.reset()["qaf"].shape[:2] == (2, 2)
    env.close()


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_half_precision_observations_are_refused(dtype):
    replay = TensorDictReplayBuffer(storage=LazyTensorStorage(6), batch_size=6)
    replay.append_transform(DTypeCastTransform(torch.float32, dtype))
    replay.append_transform(queries())
    replay.extend(rows())
    with pytest.raises(ValueError, match="observation"):
        replay.sample()
    precise = rows()
    precise["observation"] = precise["observation"].double()
    assert queries()(precise)["qaf"].dtype == torch.bool


def test_qaf_around_workers_that_have_not_started():
    env = TransformedEnv(SerialEnv(2, make_env), queries())
    assert env.reset()["qaf"].shape[:2] == (2, 2)
    env.close()
