"""How evaluations run episodes: what stands between environment and actor, which explores nothing."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, nullcontext
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import nn
from torchrl.envs import Compose, EnvBase, Transform, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from lw_torchrl._progress import Progress
from lw_torchrl.envs.episodes import FinishedEpisode, policy_of, run_episodes
from lw_torchrl.envs.language_world_env import LanguageWorldEnv
from lw_torchrl.language.plans import Plans
from lw_torchrl.modules.networks import evaluating
from lw_torchrl.modules.policy import transform_of
from lw_torchrl.modules.query_evaluator import QueryEvaluator

ROWS = 256  # stepped together; more hardly make a step of all of them cheaper per row, and cost memory
Acts = Callable[[TensorDictBase], TensorDictBase]


def make_env(actor: Any, plans: Plans | None, base: LanguageWorldEnv, evaluator: Any = None) -> EnvBase:
    """The environment with what must run before the actor: the answers to the plans' queries, and behind them an
    evaluator that is a transform, or what a module reads."""
    if isinstance(evaluator, Transform):
        evaluator = evaluator.clone()  # a transform has one environment
    else:
        evaluator = evaluator.transform() if isinstance(evaluator, QueryEvaluator) else None
    before = [one for one in (transform_of(actor, plans), evaluator) if one is not None]
    return TransformedEnv(base, before[0] if len(before) == 1 else Compose(*before)) if before else base


class AnsweredBy(nn.Module):
    """A policy that acts on an evaluator's answers, which take the place of ``qaf``."""

    def __init__(self, actor: Acts, evaluator: Acts) -> None:
        super().__init__()
        self.actor, self.evaluator = actor, evaluator

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        answered = self.evaluator(tensordict)
        if isinstance(self.evaluator, QueryEvaluator):
            answered.set("qaf", answered.get("qaf_logits") > 0)
        return self.actor(answered)


def answered_by(actor: Any, evaluator: Any) -> Any:
    """The actor behind an evaluator that is a module or a function; a transform belongs into the environment."""
    return actor if evaluator is None or isinstance(evaluator, Transform) else AnsweredBy(actor, evaluator)


@contextmanager
def running(
    what: str,
    env: EnvBase,
    actor: Any,
    episodes: Mapping[str, Sequence[int]],
    *,
    noise_scale: float = 0.0,
    device: str | torch.device | None = None,
    progress: bool = False,
    wrap: Callable[[Acts], Acts] = lambda policy: policy,
    **options: Any,
) -> Iterator[Iterator[FinishedEpisode]]:
    """The episodes of :func:`run_episodes` as they finish; the environment is closed with the block.

    Args:
        what: the work, for the progress bar.
        noise_scale: standard deviation of the noise on each of an action's numbers.
        wrap: puts something around the policy.
        options: further ones of :func:`run_episodes`.
    """
    noise = (noise_scale,) * env.action_spec.shape[-1]
    bar = Progress(what, sum(map(len, episodes.values())) * env.max_steps, "step", show=progress)
    mode = evaluating(actor) if isinstance(actor, nn.Module) else nullcontext()
    options |= {"noise": (lambda _: noise) if noise_scale else None, "on_progress": bar.update}
    with closing(env), mode, bar, torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        yield run_episodes(env, wrap(policy_of(actor, device)), episodes, **options)
