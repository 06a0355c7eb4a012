"""The episode runner: exactly the requested episodes of an actor, for evaluation, re-runs and recordings."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing, nullcontext
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torch import nn
from torchrl.envs import Compose, EnvBase, Transform, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from lw_torchrl._util.checks import unknown_name
from lw_torchrl._util.progress import Progress
from lw_torchrl.envs.episodes import FinishedEpisode, policy_of, read_action, run_episodes
from lw_torchrl.envs.language_world_env import LanguageWorldEnv
from lw_torchrl.language.plans import AnyPlans, Plans, as_plans
from lw_torchrl.language.tasks import Task, TaskList
from lw_torchrl.modules.parts import evaluating
from lw_torchrl.modules.policy import plans_of, transform_of
from lw_torchrl.modules.query_evaluator import QueryEvaluator
from lw_torchrl.suites.suite import Suite, find_suite, listed_tasks

ROWS = 256  # environments stepped together; more are hardly cheaper per row, and cost memory
Acts = Callable[[TensorDictBase], TensorDictBase]


def rollout(
    label: str,
    actor: Any,
    tasks: Mapping[str, Task],
    episodes: Mapping[str, Sequence[int]],
    on_episode: Callable[[FinishedEpisode], object],
    *,
    plans: Plans | None = None,
    evaluator: Any = None,
    num_envs: int | None = None,
    env_options: Mapping[str, Any],
    keys: Sequence[NestedKey] = ("action", ("next", "success"), ("next", "reward")),
    optional: Iterable[NestedKey] | Callable[[EnvBase], Iterable[NestedKey]] = (),
    noise_scale: float = 0.0,
    after_success: int | None = None,
    place: NestedKey | None = None,
    first: Transform | None = None,
    wrap: Callable[[Any], Any] | None = None,
    device: str | torch.device | None = None,
    progress: bool = False,
) -> None:
    """Run each listed episode once, in eval mode and without exploration, and pass it to ``on_episode`` as it finishes.

    Arguments without a description are those of :func:`evaluate`, which also describes what an episode depends on.

    Args:
        label: title of the progress bar.
        tasks: name to task.
        episodes: name of a task to indices of its episodes.
        env_options: further arguments of :class:`LanguageWorldEnv`: ``seed``, ``suite``, ``max_steps``.
        keys: keys to record in each step; :class:`ValueError` if neither environment nor policy writes one.
        optional: more keys, or a function from the environment to them, recorded if they are written.
        after_success: end an episode N steps after its first success; None for never.
        place: a key for the index of each row's episode in its task's list.
        first: a transform that runs before all others.
        wrap: called with the actor; returns the policy that acts instead.
    """
    most = len(tasks) * max(map(len, episodes.values()))  # more rows would be idle
    rows = min(most, len(tasks) * max(1, ROWS // len(tasks))) if num_envs is None else min(num_envs, most)
    base = LanguageWorldEnv(list(tasks.values()), num_envs=rows, strict=True, **env_options)
    env = _with_transforms(base, first, transform_of(actor, plans), _transform_of_evaluator(evaluator))
    more = [unravel_key(key) for key in (optional(env) if callable(optional) else optional)]
    written = {unravel_key(key) for part in (actor, evaluator) for key in getattr(part, "out_keys", ())} | _written(env)
    recorded = list(dict.fromkeys([*map(unravel_key, keys), *(key for key in more if key in written)]))
    acting = actor if wrap is None else wrap(actor)
    if evaluator is not None and not isinstance(evaluator, Transform):
        acting = EvaluatorInFront(evaluator, acting)
    noise = (noise_scale,) * env.action_spec.shape[-1]
    bar = Progress(label, sum(map(len, episodes.values())) * env.max_steps, "step", show=progress)
    mode = evaluating(acting) if isinstance(acting, nn.Module) else nullcontext()
    with closing(env), mode, bar, torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        for episode in run_episodes(
            env,
            _checked(policy_of(acting, device), env, recorded),
            episodes,
            keys=recorded,
            noise=(lambda _: noise) if noise_scale else None,
            after_success=after_success,
            place=place,
            on_progress=bar.update,
        ):
            on_episode(episode)


def _with_transforms(base: EnvBase, *transforms: Transform | None) -> EnvBase:
    present = [transform for transform in transforms if transform is not None]
    return TransformedEnv(base, present[0] if len(present) == 1 else Compose(*present)) if present else base


def _transform_of_evaluator(evaluator: Any) -> Transform | None:
    """Return the transform to run after the exact answers: the evaluator itself, or the transform that it needs."""
    if isinstance(evaluator, Transform):
        return evaluator.clone()  # a transform belongs to one environment
    return evaluator.transform() if isinstance(evaluator, QueryEvaluator) else None


def _written(env: EnvBase) -> set[NestedKey]:
    """Return the keys that an environment writes, before a step and after it."""
    specs = env.full_observation_spec, env.full_reward_spec, env.full_done_spec
    names = {unravel_key(key) for spec in specs for key in spec.keys(True, True)}
    return names | {unravel_key(("next", key)) for key in names}


def _checked(policy: Acts, env: EnvBase, keys: Iterable[NestedKey]) -> Acts:
    """Return ``policy`` with its action checked, and at the first call that it and the environment write ``keys``."""
    by_env, size = _written(env), env.action_spec.shape[-1]
    unseen = [key for key in keys if key not in by_env]

    def run(tensordict: TensorDictBase) -> TensorDictBase:
        tensordict = policy(tensordict)
        read_action(tensordict, size)
        while unseen:
            if (key := unseen.pop()) not in tensordict.keys(True):
                written = tensordict.exclude("_step").keys(True, True)
                raise unknown_name("also_record", key, [*dict.fromkeys([*written, *sorted(by_env, key=str)])])
        return tensordict

    return run


class EvaluatorInFront(nn.Module):
    """A policy after an evaluator, whose answers replace ``qaf``."""

    def __init__(self, evaluator: Acts, actor: Acts) -> None:
        super().__init__()
        self.evaluator, self.actor = evaluator, actor

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return self.actor(self.evaluator(tensordict))


def actor_plans(actor: Any, plans: AnyPlans | None) -> Plans | None:
    """Return the plans whose conditions are answered: ``plans``, or the actor's own; different ones are an error."""
    own = plans_of(actor)
    if plans is None:
        return own
    answered = as_plans(plans)
    if own is not None and (different := answered.differences(own)):
        how = "pass plans=None, or evaluate actor.with_plans(plans)"
        raise ValueError(f"plans differ from the actor's own for {', '.join(different)}; {how}")
    return own or answered


def suite_tasks(
    tasks: TaskList, plans: Plans | None, suite: str | Suite | None = None
) -> tuple[Suite, dict[str, Task]]:
    """Return the suite, and the tasks by name; a name that the suite lacks stands for the task of the plan."""
    tasks = listed_tasks(tasks)
    chosen = find_suite(tasks, suite)
    own = {} if plans is None else {plan.task: plan.definition for plan in plans.values()}
    return chosen, chosen.named_tasks(tasks, {name: task for name, task in own.items() if name not in chosen.tasks})
