"""Re-run episodes exactly as they were run; with nothing replaced, a re-run is the null control."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from operator import itemgetter
from typing import Any, NamedTuple

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import nn
from torchrl.envs import RenameTransform

from lw_torchrl.envs.episodes import FinishedEpisode
from lw_torchrl.evaluation.diagnose.findings import Difference, Misled
from lw_torchrl.evaluation.rollout import rollout
from lw_torchrl.language.plans import Plans
from lw_torchrl.language.tasks import Task, task_id

EpisodeId = tuple[str, int]  # task, episode
_KEYS: list[NestedKey] = ["observation", "task_id", "episode", "action", ("next", "success"), ("next", "reward")]
_TRUE = "true_observation"  # the environment's own, before any transform or module changes it


class Perception:
    """A context that records the observations that a policy is shown, or corrects them.

    A module that changes the observation for a policy inside it is looked through; a function is not.
    """

    def __init__(self, actor: Any, correct: bool = False) -> None:
        self.actor, self.correct = actor, correct
        self.misled: dict[tuple[int, int], Misled] = {}  # by (task id, episode), where an observation was wrong
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
        self._now = args[0].select(_TRUE, "task_id", "episode", "_step", strict=False).clone()

    def _look(self, module: nn.Module, args: tuple[Any, ...]) -> None:
        given = args[0] if args and isinstance(args[0], TensorDictBase) else None
        shown = None if given is None else given.get("observation", None)
        true = None if self._now is None else self._now.get(_TRUE, None)
        if given is None or self._now is None or shown is None or true is None or shown.shape != true.shape:
            return
        error = (shown - true).abs()
        for row in (error.amax(-1) > 0).logical_and(self._now.get("_step")).nonzero().flatten().tolist():
            which = int(self._now.get("task_id")[row]), int(self._now.get("episode")[row])
            largest = Misled(float(error[row].max()), int(error[row].argmax()))
            self.misled[which] = max(self.misled.get(which, largest), largest, key=lambda one: (one.error, one.number))
        if self.correct:
            given.set("observation", true.clone())


def _innermost(actor: nn.Module) -> list[nn.Module]:
    """Return the modules that map an observation to an action and contain no other such module."""

    def acts(module: nn.Module) -> bool:
        return "observation" in getattr(module, "in_keys", ()) and "action" in getattr(module, "out_keys", ())

    inside = [module for module in actor.modules() if acts(module)]
    return [one for one in inside if not any(other is not one and acts(other) for other in one.modules())] or [actor]


@dataclass(frozen=True)
class Rerun:
    """The settings under which episodes were run, and are run again."""

    tasks: Mapping[str, Task]
    env_options: Mapping[str, Any]
    noise_scale: float
    num_envs: int | None
    device: str | torch.device | None
    progress: bool

    def __call__(
        self,
        label: str,
        which: Sequence[EpisodeId],
        actor: Any,
        plans: Plans,
        evaluator: Any = None,
        longer: int = 1,
        wrap: Callable[[Any], Any] | None = None,
    ) -> dict[EpisodeId, FinishedEpisode]:
        """Return the episodes, each up to its first success, with ``longer`` times the time limit."""
        wanted = {task: [k for _, k in listed] for task, listed in groupby(sorted(which), itemgetter(0))}
        episodes: dict[EpisodeId, FinishedEpisode] = {}

        def keep(one: FinishedEpisode) -> None:
            episodes[one.task, one.episode] = one

        rollout(
            f"again with {label}",
            actor,
            {task: self.tasks[task] for task in wanted},
            wanted,
            keep,
            plans=plans,
            evaluator=evaluator,
            num_envs=None if self.num_envs is None else max(len(wanted), self.num_envs),
            env_options={**self.env_options, "max_steps": self.env_options["max_steps"] * longer},
            keys=_KEYS,
            optional=["qaf", "skill_weights"],
            noise_scale=self.noise_scale,
            after_success=0,
            first=RenameTransform(["observation"], [_TRUE], create_copy=True),
            wrap=wrap,
            device=self.device,
            progress=self.progress,
        )
        return episodes


class NullControl(NamedTuple):
    """Failed episodes after a plain re-run."""

    episodes: Mapping[EpisodeId, FinishedEpisode]
    misled: Mapping[EpisodeId, Misled]  # episodes in which the policy was shown a wrong state
    differs: Mapping[EpisodeId, Difference]  # the first difference of episodes that went another way

    def succeeds(self, which: EpisodeId) -> bool:
        return self.episodes[which].first_success is not None

    def share(self, task: str) -> float:
        """Return the share of a task's failed episodes that succeed in the re-run."""
        succeeded = [one.first_success is not None for (of, _), one in self.episodes.items() if of == task]
        return sum(succeeded) / len(succeeded)


def null_control(
    rerun: Rerun, failed: Mapping[EpisodeId, TensorDictBase], actor: Any, plans: Plans, evaluator: Any
) -> NullControl:
    """Re-run the failed episodes; raise :class:`ValueError` if one does not begin as it did."""
    with Perception(actor) as seen:
        episodes = rerun("nothing replaced", list(failed), actor, plans, evaluator)
    differs = {}
    for which, steps in failed.items():
        again = episodes[which].steps
        if not torch.equal(again.get("observation")[0], steps.get("observation")[0]):
            begins = f"does not begin as episode {which[1]} of seed={rerun.env_options['seed']} does"
            remedy = "give the seed and the engine that it was run with, and the episode from its first state on"
            raise ValueError(f"rollouts: episode {which[1]} of {which[0]!r} {begins}; {remedy}")
        if (first := difference(steps, again)) is not None:
            differs[which] = first
    numbers = {(task_id(task), k): (task, k) for task, k in failed}
    return NullControl(episodes, {numbers[one]: misled for one, misled in seen.misled.items()}, differs)


def difference(steps: TensorDictBase, again: TensorDictBase) -> Difference | None:
    """Return the first difference between two runs of an episode, or None."""
    both = min(len(steps), len(again))
    states = (steps.get("observation")[:both] != again.get("observation")[:both]).any(-1)
    if not states.any():
        return None if len(steps) == len(again) else Difference("length", both - 1, len(steps), len(again))
    first = int(states.int().argmax())
    executed = steps.get(("next", "executed_action"), steps.get("action", None))
    if executed is None:
        return Difference("states", first)
    error = (executed[:first] - again.get("action")[:first]).abs().amax(-1)
    if not (error > 0).any():
        return Difference("environment", first)
    at = int((error > 0).int().argmax())
    return Difference("actions", at, size=float(error[at]))
