"""Counterfactuals: failed episodes run again with one part of what acted replaced by a sound one."""

import warnings
from collections.abc import Collection, Iterable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass
from itertools import groupby
from operator import itemgetter
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor, nn

from lw_torchrl.envs.episodes import FinishedEpisode
from lw_torchrl.envs.language_world_env import LanguageWorldEnv
from lw_torchrl.evaluation.explanation import EpisodeStates, Scripts, attended, candidates, unlike_scripts
from lw_torchrl.evaluation.failure_records import MendedEpisode
from lw_torchrl.evaluation.running import ROWS, Acts, answered_by, make_env, running
from lw_torchrl.language.plans import Plans
from lw_torchrl.language.task_index import PlanTables
from lw_torchrl.language.tasks import TASKS, Task, task_id
from lw_torchrl.modules.plan_encoder import IN_FORCE
from lw_torchrl.modules.query_evaluator import QueryEvaluator
from lw_torchrl.suites.metaworld.experts import ExpertActor
from lw_torchrl.transforms.qaf import plan_program

EpisodeId = tuple[str, int]  # task, episode
_KEPT: list[NestedKey] = ["observation", "task_id", "episode", "action", ("next", "success"), ("next", "reward")]
_TRIED_STEPS = 3  # in which a skill is replaced, one at a time, before it is in all steps


class TrueAnswers(QueryEvaluator):
    """The query answering function in an evaluator's place: 5 where a condition holds, else -5."""

    def __init__(self, plans: Plans) -> None:
        super().__init__(plans)
        self.program = plan_program(plans)

    def logits(self, *read: Tensor) -> Tensor:
        observation, task = read
        return 10.0 * self.program(observation, task).to(torch.float32) - 5.0


def own_evaluators(actor: Any) -> list[QueryEvaluator]:
    """The evaluators that a policy asks itself; not those that these ask in their turn."""
    if isinstance(actor, QueryEvaluator):
        return [actor]
    children = actor.children() if isinstance(actor, nn.Module) else ()
    return list(dict.fromkeys(found for child in children for found in own_evaluators(child)))


def with_true_answers(actor: Any) -> Any:
    """The policy with the query answering function in the place of its own evaluators; itself if it has none."""
    if not own_evaluators(actor):
        return actor
    other = deepcopy(actor)
    read = {key for evaluator in own_evaluators(actor) for key in evaluator.in_keys} - {"observation", "task_id"}
    for module in list(other.modules()):
        if hasattr(module, "in_keys"):
            module.in_keys = [key for key in module.in_keys if key not in read]  # pictures, say
        if isinstance(module, QueryEvaluator):  # what it asks in its turn goes with it
            continue
        for name, child in list(module.named_children()):
            if isinstance(child, QueryEvaluator):
                setattr(module, name, TrueAnswers(child.plans))
                if "answers" in (config := getattr(module, "config", {})):
                    module.config = {**config, "answers": "logit"}  # exact truth is worth what it is
    return other


class WithScripts(nn.Module):
    """A policy whose attention mixes scripted skills' actions, where it singles any steps out; where the step in force
    has no scripted skill, the action is the expert's."""

    def __init__(self, actor: Acts, plans: Plans, scripts: Scripts, steps: Mapping[EpisodeId, int] | None) -> None:
        super().__init__()
        self.actor, self.scripts = actor, scripts
        self._tables = PlanTables(plans)
        self._known = torch.zeros_like(self._tables.mask)
        for row, task in enumerate(self._tables.index.tasks):
            self._known[row, : len(plans[task].steps)] = torch.tensor(scripts.known[task])
        self._steps = None if steps is None else {(task_id(task), k): step for (task, k), step in steps.items()}
        unscripted = [task for task, known in scripts.known.items() if not all(known) and task in TASKS]
        self._expert = ExpertActor(unscripted) if unscripted else None

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        seen = tensordict.select("observation", "task_id", "episode", "_step", strict=False).clone()
        tensordict = self.actor(tensordict)
        action, task = tensordict.get("action"), seen.get("task_id")
        rows = self._tables.rows(task)
        mask, known = self._tables.mask.to(action.device)[rows], self._known.to(action.device)[rows]
        weights = tensordict.get("skill_weights", None)
        if weights is None:
            truth = tensordict.get("qaf") & mask
            first = torch.where(truth.any(-1), truth.int().argmax(-1), mask.sum(-1) - 1)
            weights = torch.nn.functional.one_hot(first, mask.shape[-1]).float()
        step = attended(weights, mask)
        replaced = step >= 0
        if self._steps is not None:
            which = zip(task.tolist(), seen.get("episode").tolist(), strict=True)
            asked = torch.tensor([self._steps.get(one, -1) for one in which], device=action.device)
            there = weights.gather(-1, asked.clamp(min=0).unsqueeze(-1)).squeeze(-1) > IN_FORCE
            replaced = replaced & there & (asked >= 0)
        scripted = (weights * known).unsqueeze(-1) * self.scripts.program(seen.get("observation"), task)
        proper = scripted.sum(-2).to(action.dtype)
        unknown = ~known.gather(-1, step.clamp(min=0).unsqueeze(-1)).squeeze(-1)
        if self._expert is None:
            replaced = replaced & ~unknown
        elif (needed := replaced & unknown).any():
            expert = self._expert(seen.set("_step", needed).cpu()).get("action").to(action.device)
            proper = torch.where(unknown.unsqueeze(-1), expert, proper)
        return tensordict.set("action", torch.where(replaced.unsqueeze(-1), proper, action))


@dataclass(frozen=True)
class EpisodeRepeater:
    """Runs episodes again as they were run, whatever acts in them."""

    tasks: Mapping[str, Task]
    firsts: Mapping[EpisodeId, Tensor]
    env: Mapping[str, Any]
    noise_scale: float
    max_steps: int
    num_envs: int | None
    device: str | torch.device | None
    progress: bool

    def __call__(
        self, what: str, which: Sequence[EpisodeId], actor: Any, plans: Plans, evaluator: Any = None, longer: int = 1
    ) -> dict[EpisodeId, FinishedEpisode | None]:
        """Each episode up to its first success, None of one that fails again; they may be ``longer`` by this factor."""
        wanted = {task: [k for _, k in listed] for task, listed in groupby(sorted(which), itemgetter(0))}
        rows = len(wanted) * max(1, min(max(map(len, wanted.values())), ROWS // len(wanted)))
        rows = max(len(wanted), min(rows, self.num_envs or rows))
        tasks = [self.tasks[task] for task in wanted]
        base = LanguageWorldEnv(tasks, num_envs=rows, max_steps=self.max_steps * longer, strict=True, **self.env)
        acts = actor.actor if isinstance(actor, WithScripts) else actor
        env = make_env(acts, plans, base, evaluator)
        found: dict[EpisodeId, FinishedEpisode | None] = {}
        told = [key for key in ("qaf",) if key in env.full_observation_spec.keys()]
        told += [key for key in ("skill_weights",) if key in getattr(acts, "out_keys", ())]
        how: dict[str, Any] = {"noise_scale": self.noise_scale, "device": self.device, "progress": self.progress}
        how |= {"keys": [*_KEPT, *told], "after_success": 0}
        with running(f"again with {what}", env, answered_by(actor, evaluator), wanted, **how) as episodes:
            for one in episodes:
                if not torch.equal(one.steps.get("observation")[0], self.firsts[one.task, one.episode]):
                    raise ValueError(
                        f"rollouts: episode {one.episode} of {one.task!r} does not begin as episode {one.episode} of "
                        f"seed={self.env['seed']} does; give the seed and the engine that it was run with, and the "
                        "episode from its first state on"
                    )
                found[one.task, one.episode] = None if one.first_success is None else one
        return found


class Counterfactuals:
    """Runs the counterfactuals that are worth it, and keeps what each gave."""

    def __init__(
        self, actor: Any, evaluator: Any, reference: Plans | None, scripts: Scripts, repeat: EpisodeRepeater
    ) -> None:
        self.actor, self.evaluator, self.scripts, self.repeat = actor, evaluator, scripts, repeat
        self.plans = plans = scripts.plans
        self.found: dict[str, dict[EpisodeId, FinishedEpisode | None]] = {}  # counterfactual to episodes that it mends
        self.step: dict[EpisodeId, int] = {}  # in which a script mends the episode
        self.reference: Plans | None = None
        self.other = self.other_evaluator = None  # that carry out the reference
        different = [] if reference is None else [reference[task] for task in reference.differences(plans)]
        if not different:
            return
        reference = Plans(different)
        try:
            other = actor.with_plans(reference)
            theirs = evaluator.with_plans(reference) if hasattr(evaluator, "with_plans") else evaluator
            self.other, self.other_evaluator, self.reference = other, theirs, reference
        except (AttributeError, ImportError, RuntimeError, TypeError, ValueError) as error:
            why = f"{type(error).__name__}: {error}"
            warnings.warn(f"reference: the policy cannot carry it out, so no plan is replaced ({why})", stacklevel=4)

    def run(self, seen: Sequence[EpisodeStates], same: Collection[EpisodeId] = ()) -> None:
        """Run all that are worth it."""
        every = [one.which for one in seen]
        wrong = [w for w, one in zip(every, seen, strict=True) if bool((one.given != one.truth).any())]
        with_reference = [w for w in every if self.reference is not None and w[0] in self.reference]
        true = with_true_answers(self.actor)
        can_answer = self.evaluator is not None or true is not self.actor
        if can_answer:
            self._run("query", "true answers", wrong, true, self.plans)
        self._run_skills(seen)
        self._run("plan", "the reference plan", with_reference, self.other, self.reference, self.other_evaluator)
        left = self._unmended(every, "query", "skill", "skills")
        left = [one for one in left if one in same or not self._mends("plan", one)]
        self._run("time", "twice the time", left, self.actor, self.plans, self.evaluator, 2)
        left = self._unmended(left, "time")
        if can_answer:
            pair = [one for one in left if one in wrong]
            self._run("query + skill", "true answers and scripts", pair, self._scripted(true, self.plans), self.plans)
            both, other = [one for one in pair if one in with_reference], with_true_answers(self.other)
            self._run("query + plan", "true answers and the reference plan", both, other, self.reference)
        left = [one for one in self._unmended(left, "query + skill", "query + plan") if one in with_reference]
        other = self._scripted(self.other, self.reference)
        what = "the reference plan and scripts"
        self._run("plan + skill", what, left, other, self.reference, self.other_evaluator)

    def _mends(self, name: str, which: EpisodeId) -> bool:
        return self.found.get(name, {}).get(which) is not None

    def _unmended(self, which: Iterable[EpisodeId], *names: str) -> list[EpisodeId]:
        return [one for one in which if not any(self._mends(name, one) for name in names)]

    def _run(self, name: str, what: str, which: Sequence[EpisodeId], actor: Any, plans: Any, *options: Any) -> None:
        if which and actor is not None and plans is not None:
            self.found.setdefault(name, {}).update(self.repeat(what, which, actor, plans, *options))

    def _scripted(self, actor: Any, plans: Plans | None, steps: Mapping[EpisodeId, int] | None = None) -> Any:
        if actor is None or plans is None:
            return None
        scripts = self.scripts if plans is self.plans else Scripts(plans, self.scripts.table)
        return WithScripts(actor, plans, scripts, steps)

    def _run_skills(self, seen: Sequence[EpisodeStates]) -> None:
        """Scripts in one step, for the likeliest steps in turn, then in all of them."""
        ranked = {}
        for one in seen:
            unlike = unlike_scripts(self.actor, one, self.scripts)
            if unlike is None or unlike.any():
                ranked[one.which] = candidates(one, unlike)
        for turn in range(_TRIED_STEPS):
            which = self._unmended([w for w, steps in ranked.items() if len(steps) > turn], "skill")
            steps = {one: ranked[one][turn] for one in which}
            what = f"scripts in a step ({turn + 1} of up to {_TRIED_STEPS})"
            scripted = self._scripted(self.actor, self.plans, steps)
            self._run("skill", what, which, scripted, self.plans, self.evaluator)
            self.step.update({one: steps[one] for one in which if self._mends("skill", one)})
        which = self._unmended([w for w in ranked if len(self.plans[w[0]].steps) > 1], "skill")
        scripted = self._scripted(self.actor, self.plans)
        self._run("skills", "scripts in all steps", which, scripted, self.plans, self.evaluator)

    def mended(self, name: str, which: EpisodeId, what: str) -> MendedEpisode | None:
        """The episode as it goes with this counterfactual, under the plan that it carries out."""
        episode = self.found[name].get(which)
        plans = self.reference if "plan" in name.split(" + ") and self.reference is not None else self.plans
        return None if episode is None else MendedEpisode(what, plans[which[0]], episode.steps)

    def shares(self) -> dict[str, dict[str, float]]:
        """Task to the share of its failed episodes that each mends, of those it was tried in."""
        found: dict[str, dict[str, float]] = {}
        for name, results in self.found.items():
            for task in {task for task, _ in results}:
                bits = [hit is not None for (of, _), hit in results.items() if of == task]
                found.setdefault(task, {})[name] = sum(bits) / len(bits)
        return found
