"""TorchRL's transforms on a buffer of demonstrations: each acts on samples, or is refused by an error that says why."""

from __future__ import annotations

import pytest
import torch
from collecting import collect
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.envs import transforms as t
from torchrl.envs.transforms import Compose, Transform

import lw_torchrl as lw
from lw_torchrl.data import LanguageWorldExperienceReplay
from lw_torchrl.data.replay_checks import check_transform

SEEN = ["observation"]
HAND = TensorDictModule(nn.Linear(39, 3), in_keys=SEEN, out_keys=["hand"])
ACT = {  # what it is made of: what it changes in a sample, which has no sign of it otherwise
    "ActionChunkTransform": lambda: t.ActionChunkTransform(2),
    "ActionScaling": lambda: t.ActionScaling(loc=0.5, scale=2.0),
    "BinarizeReward": lambda: t.BinarizeReward([("next", "reward")], [("next", "binary")]),
    "CatTensors": lambda: t.CatTensors(["observation", "action"], "both"),
    "ClipTransform": lambda: t.ClipTransform(SEEN, low=-0.1, high=0.1),
    "DTypeCastTransform": lambda: t.DTypeCastTransform(torch.float32, torch.float64, in_keys=SEEN),
    "DoubleToFloat": lambda: t.DTypeCastTransform(torch.float32, torch.float16, in_keys=SEEN),
    "ExcludeTransform": lambda: t.ExcludeTransform("episode"),
    "ExpandAs": lambda: t.ExpandAs("episode", "action", "episodes"),
    "FlattenAction": lambda: t.FlattenAction(-1, -1, in_keys=["action"], out_keys=["flat"], action_shape=(4,)),
    "LineariseRewards": lambda: t.LineariseRewards([("next", "reward")], [("next", "sum")]),
    "ModuleTransform": lambda: t.ModuleTransform(module=HAND),
    "ObservationNorm": lambda: t.ObservationNorm(0.0, 2.0, in_keys=SEEN),
    "PermuteTransform": lambda: t.PermuteTransform((-1,), in_keys=SEEN, out_keys=["other"]),
    "RenameTransform": lambda: t.RenameTransform(SEEN, ["state"]),
    "RewardClipping": lambda: t.RewardClipping(-0.5, 0.5, in_keys=SEEN),
    "RewardScaling": lambda: t.RewardScaling(1.0, 2.0, in_keys=[("next", "reward")]),
    "SelectTransform": lambda: t.SelectTransform("observation"),
    "SignTransform": lambda: t.SignTransform(in_keys=SEEN),
    "SqueezeTransform": lambda: t.SqueezeTransform(-1, in_keys=[("next", "reward")]),
    "Stack": lambda: t.Stack(["episode", "task_id"], "ids"),
    "SuccessReward": lambda: t.SuccessReward(("next", "success"), ("next", "bonus")),
    "UnaryTransform": lambda: t.UnaryTransform(SEEN, ["other"], fn=torch.neg),
    "UnsqueezeTransform": lambda: t.UnsqueezeTransform(-1, in_keys=["episode"]),
    "NextStateReconstructor": lambda: t.NextStateReconstructor(["action"], strict=False),
}
IDLE = {
    "ActionDiscretizer": lambda: t.ActionDiscretizer(3),
    "ActionScaling of what is written": lambda: t.ActionScaling(in_keys=[], in_keys_inv=["action"], loc=0.0, scale=2.0),
    "BatchSizeTransform": lambda: t.BatchSizeTransform(batch_size=[4]),
    "CatFrames as inverse": lambda: t.CatFrames(2, dim=-1, in_keys=SEEN, as_inverse=True),
    "ClipTransform of what is written": lambda: t.ClipTransform(in_keys_inv=["action"], low=-1.0, high=1.0),
    "DTypeCastTransform of what is written": lambda: t.DTypeCastTransform(
        torch.float32, torch.float64, in_keys=[], in_keys_inv=["action"]
    ),
    "MacroPrimitiveTransform": t.MacroPrimitiveTransform,
    "MultiAction": t.MultiAction,
    "MultiStepTransform": lambda: t.MultiStepTransform(3, 0.9),
    "NoopResetEnv": t.NoopResetEnv,
    "ObservationNorm of what is written": lambda: t.ObservationNorm(0.0, 2.0, in_keys=[], in_keys_inv=["action"]),
    "PermuteTransform of what is written": lambda: t.PermuteTransform((-1,), in_keys_inv=SEEN),
    "RenameTransform of what is written": lambda: t.RenameTransform([], [], ["action"], ["act"]),
    "Reward2GoTransform": t.Reward2GoTransform,
    "SatelliteAttitudeTransform": t.SatelliteAttitudeTransform,
    "SignTransform of what is written": lambda: t.SignTransform(in_keys_inv=["action"]),
    "SqueezeTransform of what is written": lambda: t.SqueezeTransform(-1, in_keys_inv=["action"]),
    "URScriptPrimitiveTransform": t.URScriptPrimitiveTransform,
    "UnsqueezeTransform of what is written": lambda: t.UnsqueezeTransform(-1, in_keys_inv=["action"]),
}
IN_AN_ENVIRONMENT = {
    "ActionMask": t.ActionMask,
    "AutoResetTransform": t.AutoResetTransform,
    "ConditionalPolicySwitch": lambda: t.ConditionalPolicySwitch(lambda rows: rows, lambda rows: True),
    "ConditionalSkip": lambda: t.ConditionalSkip(lambda rows: True),
    "EndOfLifeTransform": t.EndOfLifeTransform,
    "FrameSkipTransform": lambda: t.FrameSkipTransform(2),
    "InitTracker": t.InitTracker,
    "RandomTruncationTransform": lambda: t.RandomTruncationTransform(2, 4),
    "StepCounter": t.StepCounter,
    "TargetReturn": lambda: t.TargetReturn(1.0),
    "TerminateTransform": lambda: t.TerminateTransform(lambda rows: True),
    "TimeMaxPool": lambda: t.TimeMaxPool(SEEN),
    "Timer": t.Timer,
    "TrajCounter": t.TrajCounter,
    "VecGymEnvTransform": t.VecGymEnvTransform,
}
AT_SAMPLING = {  # TorchRL's own error, or warning, when a sample of rows is drawn
    "BatchSizeTransform": (lambda: t.BatchSizeTransform(reshape_fn=lambda rows: rows.reshape(2, 2)), "shape mismatch"),
    "BurnInTransform": (lambda: t.BurnInTransform([], burn_in=1), "not enough values to unpack"),
    "CatFrames": (lambda: t.CatFrames(2, dim=-1, in_keys=SEEN), "last dimension of the tensordict should be .* 'time'"),
    "Hash": (lambda: t.Hash(["episode"], ["hash"]), "batch dimension mismatch"),
    "MeanActionSelector": (t.MeanActionSelector, "MeanActionSelector._apply_transform is not coded"),
    "PolicyAgeFilter": (lambda: t.PolicyAgeFilter(9, 1, policy_version_key="episode"), "mismatch"),
    "RandomCropTensorDict": (lambda: t.RandomCropTensorDict(2, sample_dim=0), "mismatch"),
    "RNDTransform": (lambda: t.RNDTransform(nn.Linear(39, 2), nn.Linear(39, 2)), "RNDTransform._apply_transform"),
    "VecNorm": (lambda: t.VecNorm(in_keys=SEEN), "The VecNorm class is to be deprecated"),
    "VecNormV2": (lambda: t.VecNormV2(in_keys=SEEN), "VecNormV2._apply_transform is not coded"),
}
NOT_BUILT = {  # another device, pictures, texts, tokens, videos, Ray, a base class, what only checks or tidies up
    *(
        "DeviceCastTransform",
        "Crop",
        "CenterCrop",
        "DecodeVideoTransform",
        "FlattenObservation",
        "GrayScale",
        "Resize",
        "ToTensorImage",
    ),
    *("R3MTransform", "VC1Transform", "VIPRewardTransform", "VIPTransform", "Tokenizer", "ActionTokenizerTransform"),
    *("RayTransform", "Transform", "ObservationTransform", "Compose", "FiniteTensorDictCheck", "RemoveEmptySpecs"),
    *("PinMemoryTransform", "DiscreteActionProjection", "NextObservationDelta", "RewardSum", "TensorDictPrimer"),
    "gSDENoise",
}


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    root = tmp_path_factory.mktemp("demos") / "d"
    collect(root)
    return root


def opened(root, **options):
    generator = torch.Generator().manual_seed(0)
    return LanguageWorldExperienceReplay(root, label="executed", batch_size=4, generator=generator, **options)


def told(sample):
    return {
        key: (leaf.dtype, leaf.device.type, leaf.tolist() if leaf.device.type == "cpu" else None)
        for key, leaf in sample.items(True, True)
    }


def test_every_transform_of_torchrl_is_here():
    tried = {name.split(" ")[0] for table in (ACT, IDLE, IN_AN_ENVIRONMENT, AT_SAMPLING) for name in table}
    theirs = {name for name in t.__all__ if isinstance(cls := getattr(t, name), type) and issubclass(cls, Transform)}
    assert theirs <= tried | NOT_BUILT, theirs - tried - NOT_BUILT


@pytest.mark.parametrize("name", ACT)
def test_what_is_taken_acts(root, name):
    plain, replay = opened(root), opened(root, transform=ACT[name]())
    found, expected = (one.sample() for one in (replay, plain))
    assert found.shape != expected.shape or told(found) != told(expected)


@pytest.mark.parametrize("name", IDLE)
def test_what_would_do_nothing_is_refused(root, name):
    make, replay = IDLE[name], opened(root)
    attach = (
        lambda: opened(root, transform=make()),
        lambda: opened(root, transform=Compose(t.RewardScaling(0.0, 1.0), Compose(make()))),
        lambda: opened(root, transform=make(), grow=9),
        lambda: replay.append_transform(make()),
        lambda: replay.insert_transform(0, make()),
    )
    for one in attach:
        with pytest.raises(
            ValueError, match=f"transform: {name.split(' ')[0]} would do nothing to samples.* leave it out"
        ):
            one()
    assert not len(replay.transform)


@pytest.mark.parametrize("name", IN_AN_ENVIRONMENT)
def test_what_refuses_samples_is_refused_at_once(root, name):
    with pytest.raises(ValueError, match=rf"transform: {name} refuses samples \(.+\); leave it out"):
        opened(root, transform=IN_AN_ENVIRONMENT[name]())


@pytest.mark.parametrize("name", AT_SAMPLING)
def test_what_is_not_made_for_samples_says_so(root, name):
    make, message = AT_SAMPLING[name]
    with pytest.raises((NotImplementedError, RuntimeError, ValueError, Warning), match=message):
        opened(root, transform=make()).sample()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: lw.CorruptQAF(lw.load_plans("MT10"), delay=1), "counts the steps of an environment's episodes"),
        (
            lambda: lw.transforms.CameraTransform("corner2", height=8, width=8),
            "a dataset's are drawn by lw.data.add_pictures",
        ),
    ],
)
def test_so_is_what_we_have_for_environments(root, make, message):
    with pytest.raises(ValueError, match=rf"refuses samples \(.*{message}"):
        opened(root, transform=make())


def test_an_inverse_that_is_asked_for_acts(root):
    replay = opened(root)
    replay.append_transform(t.ObservationNorm(0.0, 2.0, in_keys=[], in_keys_inv=["observation"]), invert=True)
    assert not torch.equal(replay.sample()["observation"], opened(root).sample()["observation"])


def test_a_transform_of_ones_own_is_taken():
    class Counts(Transform):
        samples = 0

        def forward(self, tensordict):
            self.samples += 1
            return tensordict

    for one in (
        Counts(),
        t.Transform(),
        lambda sample: sample,
        None,
        lw.QAFTransform(lw.load_plans("MT10")),
        lw.RandomYaw(0.1),
    ):
        check_transform(one)
