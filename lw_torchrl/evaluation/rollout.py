"""The episode runner: run exactly the requested episodes with an actor, for evaluation, re-runs and recordings."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, nullcontext
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torch import nn
from torchrl.envs import Compose, EnvBase, Transform, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from lw_torchrl._util.checks import unknown_name
from lw_torchrl._util.devices import CPU, check_device, device_of
from lw_torchrl._util.progress import Progress
from lw_torchrl._util.workers import Episodes, spread
from lw_torchrl.envs.episodes import FinishedEpisode, num_rows, policy_of, run_episodes
from lw_torchrl.envs.language_world_env import LanguageWorldEnv
from lw_torchrl.envs.rows import read_action
from lw_torchrl.language.plans import AnyPlans, Plans, as_plans
from lw_torchrl.language.tasks import Task, TaskList
from lw_torchrl.modules.parts import evaluating
from lw_torchrl.modules.policy import draws, plans_of, transform_of
from lw_torchrl.modules.query_evaluator import QueryEvaluator
from lw_torchrl.suites.suite import Suite, find_suite, listed_tasks

ROWS = 256  # number of environments stepped together; more need more memory and hardly reduce the time per row
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
    optional: Iterable[NestedKey] = (),
    noise_scale: float = 0.0,
    after_success: int | None = None,
    place: NestedKey | None = None,
    first: Transform | None = None,
    wrap: Callable[[Any], Any] | None = None,
    device: str | torch.device | None = None,
    progress: bool = False,
    workers: int | None = 1,
) -> None:
    """Run each listed episode once, in eval mode and without exploration, and pass it to ``on_episode``.

    See :func:`evaluate` for the arguments that are not listed here, and for the seeding of episodes.

    Args:
        label: title of the progress bar.
        tasks: a mapping from names to tasks.
        episodes: a mapping from task names to episode indices.
        env_options: further arguments of :class:`LanguageWorldEnv`, such as ``seed``, ``suite`` and ``max_steps``.
        keys: keys to record in each time step; :class:`ValueError` if neither environment nor policy writes a key.
        optional: keys to record if they are written.
        after_success: end an episode N time steps after its first success; None to run every episode to the end.
        place: a key under which to write the position of each row's episode in ``episodes[task]``.
        first: a transform that runs before all others.
        wrap: a function that maps the actor to the policy that acts instead.
        workers: number of processes, see :func:`spread`; side effects of the policy are lost in other processes.
    """
    suite: Suite = env_options["suite"]
    max_steps = env_options.get("max_steps") or suite.max_steps

    def run(part: Episodes, on_steps: Callable[[int], object]) -> Iterator[FinishedEpisode]:
        chosen = [tasks[task] for task in part]
        base = LanguageWorldEnv(chosen, num_envs=num_rows(part, ROWS, num_envs), strict=True, **env_options)
        env = _with_transforms(base, first, transform_of(actor, plans), _transform_of_evaluator(evaluator))
        written = {unravel_key(key) for each in (actor, evaluator) for key in getattr(each, "out_keys", ())}
        more = [key for key in map(unravel_key, optional) if key in written | _written(env)]
        recorded = list(dict.fromkeys([*map(unravel_key, keys), *more]))
        acting = actor if wrap is None else wrap(actor)
        if evaluator is not None and not isinstance(evaluator, Transform):
            acting = EvaluatorInFront(evaluator, acting)
        noise = (noise_scale,) * env.action_spec.shape[-1]
        mode = evaluating(acting) if isinstance(acting, nn.Module) else nullcontext()
        with closing(env), mode, torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            yield from run_episodes(
                env,
                _checked(policy_of(acting, device), env, recorded),
                part,
                keys=recorded,
                noise=(lambda _: noise) if noise_scale else None,
                after_success=after_success,
                place=place,
                on_progress=on_steps,
            )

    on_cpu = (device_of(actor) if device is None else check_device("device", device)) == CPU
    modules = isinstance(actor, nn.Module) and isinstance(evaluator, nn.Module | None)
    # Functions and custom engines may have side effects, which would be lost in worker processes.
    alone = not modules or callable(env_options.get("engine")) or not on_cpu or draws(actor)
    with Progress(label, sum(map(len, episodes.values())) * max_steps, "step", show=progress) as bar:
        limits: dict[str, Any] = {"workers": workers, "max_steps": max_steps, "largest": 2 * ROWS}
        with closing(spread(run, episodes, bar.update, alone=alone, **limits)) as finished:
            for episode in finished:
                on_episode(episode)


def _with_transforms(base: EnvBase, *transforms: Transform | None) -> EnvBase:
    present = [transform for transform in transforms if transform is not None]
    return TransformedEnv(base, present[0] if len(present) == 1 else Compose(*present)) if present else base


def _transform_of_evaluator(evaluator: Any) -> Transform | None:
    """Return a copy of an evaluator that is a transform, the transform that a query evaluator requires, or None."""
    if isinstance(evaluator, Transform):
        return evaluator.clone()  # TorchRL does not allow two environments to share a transform
    return evaluator.transform() if isinstance(evaluator, QueryEvaluator) else None


def _written(env: EnvBase) -> set[NestedKey]:
    """Return the keys that an environment writes, at the root and under "next"."""
    specs = env.full_observation_spec, env.full_reward_spec, env.full_done_spec
    names = {unravel_key(key) for spec in specs for key in spec.keys(True, True)}
    return names | {unravel_key(("next", key)) for key in names}


def _checked(policy: Acts, env: EnvBase, keys: Iterable[NestedKey]) -> Acts:
    """Wrap ``policy`` to check that actions are valid and that the policy or the environment writes each key."""
    by_env, size = _written(env), env.action_spec.shape[-1]
    others = [key for key in keys if key not in by_env]

    def run(tensordict: TensorDictBase) -> TensorDictBase:
        read_action(tensordict := policy(tensordict), size)
        for key in others:
            if key not in tensordict.keys(True):
                raise unknown_name("also_record", key, {*tensordict.exclude("_step").keys(True, True), *by_env})
        return tensordict

    return run


class EvaluatorInFront(nn.Module):
    """A policy that runs an evaluator and then an actor; the evaluator's answers replace ``qaf``."""

    def __init__(self, evaluator: Acts, actor: Acts) -> None:
        super().__init__()
        self.evaluator, self.actor = evaluator, actor

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return self.actor(self.evaluator(tensordict))


def actor_plans(actor: Any, plans: AnyPlans | None) -> Plans | None:
    """Return the plans to evaluate: ``plans`` or, if None, the actor's; raise ValueError if both exist and differ."""
    own = plans_of(actor)
    if plans is None:
        return own
    answered = as_plans(plans)
    if own is not None and (different := answered.differences(own)):
        how = "pass plans=None, or evaluate actor.with_plans(plans)"
        raise ValueError(f"plans differ from the actor's plans for {', '.join(different)}; {how}")
    return own or answered


def suite_tasks(
    tasks: TaskList, plans: Plans | None, suite: str | Suite | None = None
) -> tuple[Suite, dict[str, Task]]:
    """Return the suite and a dict of tasks by name; a name that is not in the suite maps to the plan's own task."""
    tasks = listed_tasks(tasks)
    chosen = find_suite(tasks, suite)
    own = {} if plans is None else {plan.task: plan.definition for plan in plans.values()}
    return chosen, chosen.named_tasks(tasks, {name: task for name, task in own.items() if name not in chosen.tasks})
