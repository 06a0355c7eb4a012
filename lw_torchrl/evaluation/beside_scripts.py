"""What a policy does beside what scripts would do in the same states: whether a fault is one step's or every step's."""

from collections.abc import Iterable
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from lw_torchrl._devices import device_of
from lw_torchrl.evaluation.explanation import OTHER, EpisodeStates, Scripts
from lw_torchrl.modules.networks import evaluating

_OFTEN, _BRIEF = 0.4, 5  # the share of a step's states from which something is usual; states that are too few to say
_SAME = 0.02  # how far an action may be from the script's and still be the script's
_HALF = 0.5  # of what actions are off: what a fault that explains it may leave, and what counts in other steps


class BesideScripts(NamedTuple):
    """A policy's actions in T states, and those of the scripted skills of the steps that it is in."""

    done: Tensor  # (T, A) float32
    wanted: Tensor  # (T, A) float32, infinite where the step in force has no script
    in_force: Tensor  # (T,) int64, the step in force, -1 for none

    def followed_by(self, other: "BesideScripts | None") -> "BesideScripts":
        """With another episode's states behind."""
        if other is None:
            return self
        return BesideScripts(*(torch.cat(both) for both in zip(self, other, strict=True)))

    def part(self, numbers: Tensor) -> "BesideScripts":
        """Some of the action's numbers, (A,) bool."""
        return BesideScripts(self.done[:, numbers], self.wanted[:, numbers], self.in_force)

    @property
    def gaps(self) -> Tensor:
        """(T,) float32, how far the actions are apart on some axis, 0 where no step is in force."""
        return (self.done - self.wanted).abs().amax(-1).masked_fill(self.in_force < 0, 0.0)

    def unlike(self) -> Tensor:
        """(T,) bool, where actions are not those of scripts."""
        return self.gaps > _SAME

    def far(self, steps: Iterable[int]) -> float:
        """In what share of its states the actions are far from the scripts', in that of these steps where most are."""
        stays = [self.in_force == step for step in steps]
        shares = [float((self.gaps[stay] > OTHER).float().mean()) for stay in stays if stay.sum() >= _BRIEF]
        return max(shares, default=0.0)

    def often_far(self, steps: Iterable[int]) -> bool:
        """Whether the actions are far from the scripts' in one of these steps of the plan, in a good part of its
        states."""
        return self.far(steps) > _OFTEN

    def seldom_far(self, steps: Iterable[int]) -> bool:
        """Whether there are few such states in each of these steps."""
        return self.far(steps) < _OFTEN / 2

    def in_other_steps(self, step: int) -> bool | None:
        """Whether what is wrong in a step is wrong in the others too. It is read off the axis that is off most, as a
        factor of what scripts do or as a shift, and is there too if the same explains at least half of what is off in
        the other steps. None where neither says what is wrong in the step, it would not show in the others, or these
        are half as far off in another way."""
        known = self.wanted.isfinite().all(-1) & (self.in_force >= 0)
        inside, others = known & (self.in_force == step), known & (self.in_force != step)
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


def beside_scripts(actor: Any, seen: EpisodeStates, scripts: Scripts) -> BesideScripts | None:
    """What a policy does in an episode's states; None where it cannot be asked, since it draws its actions or reads
    what was not recorded."""
    keys = [key for key in getattr(actor, "in_keys", ()) if key != "qaf"]
    if getattr(actor, "draws", True) or any(seen.steps.get(key, None) is None for key in keys):
        return None
    states = seen.steps.select(*keys).clone()
    if "qaf" in actor.in_keys:
        states.set("qaf", pad(seen.given, (0, actor.plans.num_steps - seen.given.shape[1])))
    with torch.no_grad(), evaluating(actor):
        action = actor(states.to(device_of(actor))).get("action").cpu()
    program = scripts.program(seen.steps.get("observation"), seen.steps.get("task_id"))[:, : seen.weights.shape[1]]
    wanted = (seen.weights.unsqueeze(-1) * program).sum(-2)
    unscripted = ~torch.tensor(scripts.known[seen.task])[seen.in_force]
    return BesideScripts(action, wanted.masked_fill(unscripted.unsqueeze(-1), torch.inf), seen.in_force)
