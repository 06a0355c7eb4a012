"""Running episodes again as they were run, whatever acts in them; with nothing replaced it is the null control."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from operator import itemgetter
from typing import Any, NamedTuple

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.envs import RenameTransform, TransformedEnv

from lw_torchrl.envs.episodes import FinishedEpisode
from lw_torchrl.envs.language_world_env import LanguageWorldEnv
from lw_torchrl.evaluation.running import ROWS, answered_by, make_env, running
from lw_torchrl.evaluation.scripts_in_charge import WithScripts
from lw_torchrl.language.plans import Plans
from lw_torchrl.language.tasks import Task, task_id

EpisodeId = tuple[str, int]  # task, episode
_KEPT: list[NestedKey] = ["observation", "task_id", "episode", "action", ("next", "success"), ("next", "reward")]
_TOLD = "told_observation"  # the environment's own, before anything that stands between it and the policy


class Misled(NamedTuple):
    """By how much an observation that a policy was shown was off, at most, and which of its numbers."""

    most: float
    number: int

    @property
    def words(self) -> str:
        off = f"number {self.number} was off by up to {self.most:.2g}"
        return f"the policy was shown another observation than the true one: {off}"


class Perception:
    """Within its block is noted, or put right, what a policy is shown. A module that changes the observation and asks a
    policy inside it is looked through; a function is not.

    Attributes:
        misled: by task's number and episode, where what is shown is not what the environment told.
    """

    def __init__(self, actor: Any, put_right: bool = False) -> None:
        self.actor, self.put_right = actor, put_right
        self.misled: dict[tuple[int, int], Misled] = {}
        self._now: TensorDictBase | None = None
        self._hooks: list[Any] = []

    def __enter__(self) -> "Perception":
        if isinstance(self.actor, nn.Module):
            self._hooks = [self.actor.register_forward_pre_hook(self._begin)]
            self._hooks += [module.register_forward_pre_hook(self._look) for module in _innermost(self.actor)]
        return self

    def __exit__(self, *_: object) -> None:
        for hook in self._hooks:
            hook.remove()

    def _begin(self, module: nn.Module, args: tuple[Any, ...]) -> None:
        self._now = args[0].select(_TOLD, "task_id", "episode", "_step", strict=False).clone()

    def _look(self, module: nn.Module, args: tuple[Any, ...]) -> None:
        given = args[0] if args and isinstance(args[0], TensorDictBase) else None
        shown = None if given is None else given.get("observation", None)
        told = None if self._now is None else self._now.get(_TOLD, None)
        if given is None or self._now is None or shown is None or told is None or shown.shape != told.shape:
            return
        off = (shown - told).abs()
        for row in (off.amax(-1) > 0).logical_and(self._now.get("_step")).nonzero().flatten().tolist():
            which = int(self._now.get("task_id")[row]), int(self._now.get("episode")[row])
            most = Misled(float(off[row].max()), int(off[row].argmax()))
            self.misled[which] = max(self.misled.get(which, most), most)
        if self.put_right:
            given.set("observation", told.clone())


def _innermost(actor: nn.Module) -> list[nn.Module]:
    """The modules that act on an observation and hold no other such."""

    def acts(module: nn.Module) -> bool:
        return "observation" in getattr(module, "in_keys", ()) and "action" in getattr(module, "out_keys", ())

    found = [module for module in actor.modules() if acts(module)]
    return [one for one in found if not any(other is not one and acts(other) for other in one.modules())] or [actor]


@dataclass(frozen=True)
class EpisodeRepeater:
    """Runs episodes again as they were run, whatever acts in them."""

    tasks: Mapping[str, Task]
    env: Mapping[str, Any]
    noise_scale: float
    max_steps: int
    num_envs: int | None
    device: str | torch.device | None
    progress: bool

    def __call__(
        self, what: str, which: Sequence[EpisodeId], actor: Any, plans: Plans, evaluator: Any = None, longer: int = 1
    ) -> dict[EpisodeId, FinishedEpisode]:
        """Each episode, up to its first success; they may be ``longer`` by this factor."""
        wanted = {task: [k for _, k in listed] for task, listed in groupby(sorted(which), itemgetter(0))}
        rows = len(wanted) * max(1, min(max(map(len, wanted.values())), ROWS // len(wanted)))
        rows = max(len(wanted), min(rows, self.num_envs or rows))
        tasks = [self.tasks[task] for task in wanted]
        base = LanguageWorldEnv(tasks, num_envs=rows, max_steps=self.max_steps * longer, strict=True, **self.env)
        acts = actor.actor if isinstance(actor, WithScripts) else actor
        told = RenameTransform(["observation"], [_TOLD], create_copy=True)
        env: Any = make_env(acts, plans, base, evaluator)
        if isinstance(env, TransformedEnv):
            env.insert_transform(0, told)
        else:
            env = TransformedEnv(env, told)
        keys = [*_KEPT, *(["qaf"] if "qaf" in env.full_observation_spec.keys() else [])]
        keys += ["skill_weights"] if "skill_weights" in getattr(acts, "out_keys", ()) else []
        how: dict[str, Any] = {"noise_scale": self.noise_scale, "device": self.device, "progress": self.progress}
        how |= {"keys": keys, "after_success": 0}
        with running(f"again with {what}", env, answered_by(actor, evaluator), wanted, **how) as episodes:
            return {(one.task, one.episode): one for one in episodes}


class NullControl(NamedTuple):
    """Failed episodes run again with nothing replaced.

    Attributes:
        episodes: as they went.
        misled: where the policy was shown another state than the true one.
        differs: the state from which an episode goes another way, and in what, in words; only of those that do.
    """

    episodes: Mapping[EpisodeId, FinishedEpisode]
    misled: Mapping[EpisodeId, Misled]
    differs: Mapping[EpisodeId, tuple[int, str]]

    def succeeds(self, which: EpisodeId) -> bool:
        return self.episodes[which].first_success is not None

    def share(self, task: str) -> float:
        """The share of a task's failed episodes that succeed when they are run again."""
        bits = [one.first_success is not None for (of, _), one in self.episodes.items() if of == task]
        return sum(bits) / len(bits)


def null_control(
    repeat: EpisodeRepeater, failed: Mapping[EpisodeId, TensorDictBase], actor: Any, plans: Plans, evaluator: Any
) -> NullControl:
    """Run the failed episodes again; :class:`ValueError` if one does not begin as it did."""
    with Perception(actor) as seen:
        episodes = repeat("nothing replaced", list(failed), actor, plans, evaluator)
    differs = {}
    for which, steps in failed.items():
        again = episodes[which].steps
        if not torch.equal(again.get("observation")[0], steps.get("observation")[0]):
            raise ValueError(
                f"rollouts: episode {which[1]} of {which[0]!r} does not begin as episode {which[1]} of "
                f"seed={repeat.env['seed']} does; give the seed and the engine that it was run with, and the "
                "episode from its first state on"
            )
        if (found := difference(steps, again)) is not None:
            differs[which] = found
    numbers = {(task_id(task), k): (task, k) for task, k in failed}
    return NullControl(episodes, {numbers[one]: misled for one, misled in seen.misled.items()}, differs)


def difference(steps: TensorDictBase, again: TensorDictBase) -> tuple[int, str] | None:
    """The first state in which two runs of an episode differ, and what differs, in words; None where nothing does."""
    both = min(len(steps), len(again))
    states = (steps.get("observation")[:both] != again.get("observation")[:both]).any(-1)
    if not states.any():
        if len(steps) == len(again):
            return None
        return both - 1, f"the length: it was given {len(steps)} steps and has {len(again)}"
    first = int(states.int().argmax())
    executed = steps.get(("next", "executed_action"), steps.get("action", None))
    if executed is None:
        return first, f"the states, from {first} on; the rollout holds no actions, which would tell more"
    off = _most_off(executed[:first], again.get("action")[:first])
    if off is not None:
        at, size = off
        what = f"the executed actions, from step {at} on, there by {size:.2g}: the noise, or what the policy draws"
        return at, what
    return first, f"the environment: from state {first - 1} the same action leads to another state"


def _most_off(actions: Tensor, others: Tensor) -> tuple[int, float] | None:
    """The first step at which two lists of actions differ, and by how much."""
    off = (actions - others).abs().amax(-1)
    if not (off > 0).any():
        return None
    first = int((off > 0).int().argmax())
    return first, float(off[first])
