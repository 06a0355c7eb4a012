"""Compare a policy's actions with those of scripts in the same states: is a fault in one step, or in every step?"""

from collections.abc import Iterable
from typing import Any, NamedTuple

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torch.nn.functional import pad
from torchrl.envs.utils import ExplorationType, set_exploration_type

from lw_torchrl._devices import device_of
from lw_torchrl.evaluation.diagnose.scripts import Scripts
from lw_torchrl.evaluation.diagnose.states import OTHER, EpisodeStates
from lw_torchrl.modules.networks import evaluating
from lw_torchrl.modules.policy import draws, plans_of

_OFTEN, _BRIEF = 0.4, 5  # the smallest share of a step's states that is often; fewer states decide nothing
_SAME = 0.02  # actions that differ by less count as equal to the script's
_HALF = 0.5  # the share of the error that a fault may leave unexplained, and that counts in other steps


class ScriptComparison(NamedTuple):
    """A policy's actions in T states, and those of the scripted skills of the active steps."""

    done: Tensor  # (T, A) float32
    wanted: Tensor  # (T, A) float32, infinite where the active step has no script
    active: Tensor  # (T,) int64, the active step, -1 for none

    def followed_by(self, other: "ScriptComparison | None") -> "ScriptComparison":
        """Append another episode's states."""
        if other is None:
            return self
        return ScriptComparison(*(torch.cat(both) for both in zip(self, other, strict=True)))

    def part(self, numbers: Tensor) -> "ScriptComparison":
        """Select some of the action's numbers, (A,) bool."""
        return ScriptComparison(self.done[:, numbers], self.wanted[:, numbers], self.active)

    @property
    def gaps(self) -> Tensor:
        """The largest difference on any axis, (T,) float32; 0 where no step is active."""
        return (self.done - self.wanted).abs().amax(-1).masked_fill(self.active < 0, 0.0)

    def unlike(self) -> Tensor:
        """Return (T,) bool: where actions are not those of scripts."""
        return self.gaps > _SAME

    def far(self, steps: Iterable[int]) -> float:
        """Return the largest share, over these steps, of a step's states whose actions are far from the scripts'."""
        stays = [self.active == step for step in steps]
        shares = [float((self.gaps[stay] > OTHER).float().mean()) for stay in stays if stay.sum() >= _BRIEF]
        return max(shares, default=0.0)

    def often_far(self, steps: Iterable[int]) -> bool:
        """Return whether :meth:`far` is large; :meth:`seldom_far` whether it is small."""
        return self.far(steps) > _OFTEN

    def seldom_far(self, steps: Iterable[int]) -> bool:
        return self.far(steps) < _OFTEN / 2

    def in_other_steps(self, step: int) -> bool | None:
        """Return whether the fault of a step is in the other steps too; None if that cannot be decided.

        The fault is read off the axis with the largest error, as a factor of the script's action or as a shift. It is
        in the other steps if it explains at least half of their error. It is undecided if neither describes the step's
        error, if the fault would not show in the other steps, or if these are half as far off in another way.
        """
        known = self.wanted.isfinite().all(-1) & (self.active >= 0)
        inside, others = known & (self.active == step), known & (self.active != step)
        if min(int(inside.sum()), int(others.sum())) < _BRIEF:
            return None
        axis = int((self.done - self.wanted)[inside].square().mean(0).argmax())
        done, wanted = self.done[:, axis], self.wanted[:, axis]
        factor = (done * wanted)[inside].sum() / wanted[inside].square().sum().clamp(min=_SAME**2)
        faults = [factor * wanted, wanted + (done - wanted)[inside].mean()]
        faults = [fault for fault in faults if _off(done - fault, inside) < _HALF * _off(done - wanted, inside)]
        faults = [fault for fault in faults if _off(fault - wanted, others) > _SAME]
        off = _off(done - wanted, others)
        if any(_off(done - fault, others) < _HALF * off for fault in faults):
            return True
        return None if not faults or off > _HALF * _off(done - wanted, inside) else False


def _off(values: Tensor, where: Tensor) -> float:
    return float(values[where].square().mean().sqrt())


def compare_with_scripts(actor: Any, seen: EpisodeStates, scripts: Scripts) -> ScriptComparison | None:
    """Compare them in an episode; return None if the policy draws its actions, or reads keys that were not recorded."""
    keys = [key for key in getattr(actor, "in_keys", ()) if key != "qaf"]
    plans = plans_of(actor)
    is_known = isinstance(actor, TensorDictModuleBase) and not draws(actor)
    if not is_known or any(seen.steps.get(key, None) is None for key in keys):
        return None
    states = seen.steps.select(*keys).clone()
    if "qaf" in actor.in_keys and plans is not None:
        states.set("qaf", pad(seen.given, (0, plans.num_steps - seen.given.shape[1])))
    with torch.no_grad(), evaluating(actor), set_exploration_type(ExplorationType.DETERMINISTIC):
        action = actor(states.to(device_of(actor))).get("action").cpu()
    program = scripts.program(seen.steps.get("observation"), seen.steps.get("task_id"))[:, : seen.weights.shape[1]]
    wanted = (seen.weights.unsqueeze(-1) * program).sum(-2)
    unscripted = ~torch.tensor(scripts.known[seen.task])[seen.active]
    return ScriptComparison(action, wanted.masked_fill(unscripted.unsqueeze(-1), torch.inf), seen.active)
