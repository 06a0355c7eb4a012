"""What a replay buffer of demonstrations refuses, and a training on any buffer, since it would go wrong silently."""

import inspect
import warnings
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torchrl.data import TensorDictReplayBuffer
from torchrl.data.replay_buffers.samplers import PrioritizedSampler, RandomSampler, SliceSampler
from torchrl.envs import Compose, MultiStepTransform, Transform

from lw_torchrl._versions import SIMULATORS, package_versions
from lw_torchrl.data.dataset import Demonstrations
from lw_torchrl.data.rewards import REWARDS, RewardName, check_reward
from lw_torchrl.data.samplers import GroupSampler
from lw_torchrl.data.storage import DeviceStorage, device_of_rows
from lw_torchrl.data.trajectories import Columns
from lw_torchrl.language.value_checks import finite
from lw_torchrl.modules.critics import Value
from lw_torchrl.modules.policy import plans_of

_OF_SAMPLERS = ("index", "is_target")  # keys of samples that are no columns
# What a transform overrides that acts on rows as they are written, or in an environment.
_ELSEWHERE = ("inv", "_inv_call", "_inv_apply_transform", "_call", "_step", "_reset")


def _refusal(transform: Transform) -> str | None:
    """Why a transform is of no use to samples; None for one whose forward accesses a stand-in for a sample."""
    if all(getattr(type(transform), name) is getattr(Transform, name) for name in _ELSEWHERE):
        return None  # it has only a forward, which may count samples, say: it is not called for a trial
    accessed: list[str] = []

    class Sample:
        def __getattribute__(self, name: str) -> Any:
            accessed.append(name)
            raise LookupError

    try:
        inspect.unwrap(type(transform).forward)(transform, Sample())
    except (RuntimeError, ValueError) as error:  # of those that only work in an environment
        return None if accessed else f"refuses samples ({str(error) or 'it only works in an environment'})"
    except Exception:  # it is no sample
        return None
    return "would do nothing to samples, which its forward hands back: it acts in an environment, or on rows written"


def check_transform(transform: Any) -> None:
    """Raise for a transform that would do nothing to samples, or refuse each of them."""
    if isinstance(transform, Compose):
        for part in transform:
            check_transform(part)
    elif isinstance(transform, Transform) and (why := _refusal(transform)):
        instead = "leave it out; what it makes of the rows may be a column of your own, add_column"
        if isinstance(transform, MultiStepTransform):
            instead = f"leave it out and give n_steps={transform.n_steps}, gamma={transform.gamma}"
        raise ValueError(f"transform: {type(transform).__name__} {why}; {instead}")


def check_label(label: str, parts: Sequence[Demonstrations]) -> None:
    """Raise :class:`ValueError` if an expert's actions are asked for, and another one acted."""
    others = sorted({part.config.behaviour for part in parts if part.config.policy.kind != "expert"})
    if others and label != "executed":
        who = ", ".join(others)
        raise ValueError(f"label={label!r} is what the expert wanted, and {who} acted here: take label='executed'")


def check_apart(roots: Sequence[Path]) -> None:
    """Raise :class:`ValueError` if two of the folders are one, whose rows would come twice."""
    first: dict[Path, Path] = {}
    for root in roots:
        if (before := first.setdefault(root.resolve(), root)) is not root:
            same = f"{str(before)!r} and {str(root)!r} are one; episodes= says which to show of each"
            raise ValueError(f"root must hold each folder once, {same}")


def check_behaviours(parts: Sequence[Demonstrations]) -> None:
    """Raise :class:`ValueError` if one label stands for two behaviours."""
    first: dict[str, Demonstrations] = {}
    for part in parts:
        label, policy = part.config.behaviour, part.config.policy
        before = first.setdefault(label, part)
        if before.config.policy.acts != policy.acts:
            two = f"{before.config.policy} in {str(before.root)!r} and {policy} in {str(part.root)!r}"
            raise ValueError(f"root: {label!r} stands for two behaviours, {two}; rename one in its metadata.json")


def warn_of_simulators(parts: Sequence[Demonstrations], grows: bool) -> None:
    """Warn if episodes of different simulators come together; with ``grows``, the installed one among them."""
    made = [(repr(str(part.root)), part.versions) for part in parts]
    made += [("the rows to come", package_versions())] if grows else []
    for name in SIMULATORS:
        first: dict[str, str] = {}  # version to who was made with it
        for who, versions in made:
            if name in versions:
                first.setdefault(versions[name], who)
        if len(first) > 1:
            told = ", ".join(f"{version} for {who}" for version, who in first.items())
            what = f"root: the episodes are of different simulators, {name} {told}: an action leads elsewhere in each"
            warnings.warn(what, stacklevel=3)


def check_growing(sampler: Any, options: Mapping[str, Any]) -> None:
    """Raise for what a buffer that grows cannot do, or would do wrong silently."""
    if options.get("prefetch"):
        raise ValueError(f"prefetch={options['prefetch']} draws batches before the newest rows come: leave it out")
    if options.get("shared"):
        raise ValueError("shared=True: a buffer that grows is of one process")
    if isinstance(sampler, SliceSampler) and not sampler._fetch_traj:
        instead = "give it traj_key=('collector', 'traj_ids')"
        raise ValueError(f"sampler: a SliceSampler by end_key joins cut trajectories; {instead}")


def check_rows(reward: RewardName, terminate_on_success: bool, rows: Columns) -> None:
    """Raise if rows have another reward, or other ends, than the demonstrations."""
    success = rows["next", "success"]
    check_reward(reward, rows["next", "reward"], success)
    if not torch.equal(rows["next", "terminated"], success & terminate_on_success):
        at = "terminated at success" if terminate_on_success else "never terminated"
        same = f"give the environment the same terminate_on_success, here {terminate_on_success}"
        raise ValueError(f"batch: rows must be {at}, as the demonstrations are; {same}")


def admit_rows(reward: RewardName, terminate_on_success: bool, rows: Columns) -> Columns:
    """A collector's rows with the demonstrations' reward; raises as :func:`check_rows`."""
    made = REWARDS[reward]
    check_rows(made.source, terminate_on_success, rows)
    return {**rows, ("next", "reward"): made.of(rows["next", "reward"], rows["next", "success"])}


def check_column(name: Any, values: Any, rows: int, there: Iterable[str], transform: Transform) -> None:
    """Raise unless ``values`` can be a new column of so many rows, beside those that are ``there``."""
    if not isinstance(name, str) or not isinstance(values, Tensor):
        raise TypeError(f"add_column takes a name and a tensor, got {type(name).__name__} and {type(values).__name__}")
    written = {key for part in transform.modules() if isinstance(part, Transform) for key in part.out_keys or ()}
    if name in {*there, *_OF_SAMPLERS, *written}:
        raise ValueError(f"name must be new, samples have {name!r} already")
    if values.dim() == 0 or len(values) != rows:
        raise ValueError(f"values must be of {rows} rows, got a tensor of shape {tuple(values.shape)}")
    if not finite(values):
        raise ValueError(f"values must hold finite numbers, got NaN or infinity for {name!r}")


def check_minibatches(networks: Iterable[Any], replay: TensorDictReplayBuffer, size: int) -> None:
    """Raise :class:`ValueError` unless networks can be trained on a buffer's minibatches, and training be resumed: the
    buffer answers the queries of their plans, and draws neither ahead, nor on a device, nor by priorities."""
    for network in networks:
        own = plans_of(network)
        for answered in map(plans_of, replay.transform):
            if own is not None and answered is not None and (different := answered.differences(own)):
                name = "critic" if isinstance(network, Value) else "actor"
                what = f"the {name}'s plans, they differ for {', '.join(different)}; use {name}.transform()"
                raise ValueError(f"replay's QAFTransform must have {what}")
    if replay._prefetch:
        raise ValueError("replay must not prefetch: batches drawn ahead would be lost when training is resumed")
    if replay.batch_size not in (None, size):
        wanted = f"None or the configuration's, {size}, got {replay.batch_size}"
        raise ValueError(f"batch_size of the replay buffer must be {wanted}")
    rows, sampler = replay.storage, replay.sampler
    if isinstance(sampler, PrioritizedSampler):
        raise ValueError("replay: nothing here gives rows new priorities, so a PrioritizedSampler draws them all alike")
    ours = isinstance(sampler, GroupSampler) or (isinstance(rows, DeviceStorage) and type(sampler) is RandomSampler)
    if not ours and (device := device_of_rows(rows)).type != "cpu":
        raise ValueError(
            f"replay: a {type(sampler).__name__} draws on {device}, where its rows are, with a generator of its own; "
            "take a TaskBalancedSampler or a CoLearningSampler, or leave the rows on the CPU: minibatches then go over"
        )


def check_replay(actor: Any, replay: TensorDictReplayBuffer, size: int) -> None:
    """As :func:`check_minibatches`, of what writes ``action``."""
    if "action" not in actor.out_keys:
        raise ValueError(f"actor must write 'action', it writes {', '.join(map(str, actor.out_keys))}")
    check_minibatches([actor], replay, size)
