"""Re-run failed episodes with the same seed and noise, with zero, one or two parts of the policy replaced."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from operator import itemgetter
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs import RenameTransform, Transform

from lw_torchrl.envs.episodes import FinishedEpisode
from lw_torchrl.envs.seeding import action_noise
from lw_torchrl.evaluation.diagnose.failure import REPLACEMENTS, Difference, MendedEpisode, Misled
from lw_torchrl.evaluation.diagnose.replacements import (
    COMMANDED,
    DECIDED,
    SCRIPTED,
    SHOWN,
    TRUE_OBSERVATION,
    Control,
    EpisodeId,
    Scripts,
    gripper_of,
    with_true_answers,
)
from lw_torchrl.evaluation.diagnose.sentences import replacement_text
from lw_torchrl.evaluation.diagnose.states import OTHER, EpisodeStates, Motion, states_of
from lw_torchrl.evaluation.rollout import rollout
from lw_torchrl.language.canonical import canonical_like
from lw_torchrl.language.plans import Plans
from lw_torchrl.language.tasks import Task
from lw_torchrl.modules.policy import plans_of, with_plans

_KEYS: list[NestedKey] = ["observation", "task_id", "episode", "action", ("next", "success"), ("next", "reward")]
_MEASURED = [TRUE_OBSERVATION, SHOWN, DECIDED, COMMANDED, SCRIPTED]
_EXACT = 1e-4  # smaller differences between observations or between actions are rounding
_SAME_STATE = 1e-6  # smaller differences between two simulations of a state are rounding
_AFTER = 5  # number of states in which a difference between two simulations may grow


@dataclass(frozen=True)
class Rerun:
    """A callable that re-runs episodes with the settings of the original run."""

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
        scripts: Scripts,
        evaluator: Any = None,
        longer: int = 1,
        noise: float | None = None,
        engine: Any = ...,
        **control: Any,
    ) -> dict[EpisodeId, FinishedEpisode]:
        """Re-run episodes, each up to its first success, with ``longer`` times the original time limit.

        ``noise`` is the standard deviation of the noise, None for the original one; ``engine`` replaces the original
        engine; ``control`` goes to :class:`Control`.
        """
        listed = {task: [k for _, k in group] for task, group in groupby(sorted(which), itemgetter(0))}
        episodes: dict[EpisodeId, FinishedEpisode] = {}

        def keep(episode: FinishedEpisode) -> None:
            episodes[episode.task, episode.episode] = episode

        rollout(
            f"re-running with {label}",
            actor,
            {task: self.tasks[task] for task in listed},
            listed,
            keep,
            plans=scripts.plans,
            evaluator=evaluator,
            num_envs=None if self.num_envs is None else max(len(listed), self.num_envs),
            env_options={**self.env_options, "max_steps": self.env_options["max_steps"] * longer}
            | ({} if engine is ... else {"engine": engine}),
            keys=[*_KEYS, *_MEASURED],
            optional=["qaf", "skill_weights"],
            noise_scale=self.noise_scale if noise is None else noise,
            after_success=0,
            first=RenameTransform(["observation"], [TRUE_OBSERVATION], create_copy=True),
            wrap=lambda actor: Control(actor, scripts, **control),
            device=self.device,
            progress=self.progress,
        )
        return episodes

    def noise_of(self, which: EpisodeId, steps: int) -> Tensor:
        """Return the noise (steps, A) that the environment adds to an episode's actions."""
        task, number = which
        size = self.tasks[task].layout.action_size
        drawn = action_noise(self.tasks[task], self.env_options["seed"], number, steps, 1, size)
        return self.noise_scale * torch.from_numpy(drawn)


def difference(steps: TensorDictBase, again: TensorDictBase) -> Difference | None:
    """Return the first difference between two runs of an episode, or None if they are identical."""
    both = min(len(steps), len(again))
    errors = (steps.get("observation")[:both] - again.get("observation")[:both]).abs().amax(-1)
    if not (errors > 0).any():
        return None if len(steps) == len(again) else Difference("length", both - 1, len(steps), len(again))
    first = int((errors > 0).int().argmax())
    executed = steps.get(("next", "executed_action"), steps.get("action", None))
    if first and executed is None:
        return Difference("states", first)
    if first and executed is not None:
        error = (executed[:first] - again.get("action")[:first]).abs().amax(-1)
        if (error > 0).any():
            at = int((error > 0).int().argmax())
            return Difference("actions", at, size=float(error[at]))
    return Difference("environment", first, size=float(errors[first : first + _AFTER].max()))


@dataclass
class Reruns:
    """The re-runs of failed episodes, and what was measured in them."""

    actor: Any
    evaluator: Any
    scripts: Scripts
    reference: Plans | None
    rerun: Rerun
    seen: Mapping[EpisodeId, EpisodeStates]
    plain: dict[EpisodeId, FinishedEpisode] = field(default_factory=dict)  # with nothing replaced
    # For each replacement and each episode it was tried on: the re-run if it succeeded, otherwise None.
    results: dict[str, dict[EpisodeId, FinishedEpisode | None]] = field(default_factory=dict)
    differs: dict[EpisodeId, Difference] = field(default_factory=dict)
    misled: dict[EpisodeId, Misled] = field(default_factory=dict)
    wrapped: dict[EpisodeId, Motion] = field(default_factory=dict)  # decided and commanded actions
    executed: dict[EpisodeId, Motion] = field(default_factory=dict)  # commanded and executed actions
    scripted: dict[EpisodeId, Motion] = field(default_factory=dict)  # scripted and commanded actions
    step: dict[EpisodeId, int] = field(default_factory=dict)  # the plan step in which a script was tried
    # The scripts, the policy and the evaluator for the reference plans that differ from the policy's.
    trusted: tuple[Scripts | None, Any, Any] = (None, None, None)

    def run(self) -> None:
        """Re-run the episodes with each replacement that can still decide the cause of the episode."""
        every, self.trusted = list(self.seen), self._with_reference()
        self.plain = self.rerun("nothing replaced", every, self.actor, self.scripts, self.evaluator)
        for which, states in self.seen.items():
            self._measure(which, states, self.plain[which].steps)
        every = [which for which in every if not self.fails_elsewhere(which)]
        own = set(self.rerun.env_options["suite"].tasks)
        if callable(self.rerun.env_options["engine"]):
            self._try("environment", [w for w in every if w[0] in own], engine=None)
            every = self._unfixed(every, "environment")
        is_sensor = isinstance(self.evaluator, Transform) and "observation" in self.evaluator.out_keys
        evaluator, true = None if is_sensor else self.evaluator, with_true_answers(self.actor)
        self._try("perception", [w for w in every if w in self.misled], evaluator=evaluator, correct=True)
        can_answer = evaluator is not None or true is not self.actor
        wrong = [w for w in every if can_answer and bool((self.seen[w].answers != self.seen[w].truth).any())]
        self._try("query", wrong, true, evaluator=None)
        acts_on = isinstance(self.evaluator, Transform) and bool(self.evaluator.in_keys_inv)
        changed = [w for w in every if w in self.wrapped or (acts_on and w in self.executed)]
        undone = self._try("wrapper", changed, evaluator=None if acts_on else self.evaluator, unwrap=True)
        for which, episode in undone.items():
            if which in self.wrapped:
                self.wrapped[which] = self.wrapped[which].and_also(self._motion(which, episode.steps)[0])
        left = self._unfixed(every, "perception", "query", "wrapper")
        if self.rerun.noise_scale:
            self._try("no noise", left, noise=0.0)
        self._try_scripts(left)
        left = self._unfixed(left, "skill", "gripper", "actuation", "policy")
        trusted, other_actor, other_evaluator = self.trusted
        with_reference = [w for w in left if trusted is not None and w[0] in trusted.plans]
        self._try("plan", with_reference, other_actor, trusted, other_evaluator)
        left = self._unfixed(left, "plan", "no noise")
        self._try("time", left, longer=2)
        # Try pairs only on the episodes that no single replacement fixes.
        left = self._unfixed(left, "time")
        pair, with_reference = [w for w in left if w in wrong], [w for w in left if w in with_reference]
        self._try("query + skill", pair, true, evaluator=None, part="all")
        both = [w for w in pair if w in with_reference]
        self._try("query + plan", both, with_true_answers(other_actor), trusted, None)
        left = self._unfixed(with_reference, "query + skill", "query + plan")
        self._try("plan + skill", left, other_actor, trusted, other_evaluator, part="all")

    def fails_elsewhere(self, which: EpisodeId) -> bool:
        """Return whether the rollout's environment differs, or its plain re-run succeeds."""
        return self.environment_differs(which) or self.plain[which].first_success is not None

    def environment_differs(self, which: EpisodeId) -> bool:
        first = self.differs.get(which)
        return first is not None and first.part == "environment" and (first.size or 0.0) > _SAME_STATE

    def fixes(self, name: str, which: EpisodeId) -> bool:
        return self.results.get(name, {}).get(which) is not None

    def _unfixed(self, episodes: Iterable[EpisodeId], *names: str) -> list[EpisodeId]:
        return [which for which in episodes if not any(self.fixes(name, which) for name in names)]

    def _try(
        self,
        name: str,
        which: Sequence[EpisodeId],
        actor: Any = None,
        scripts: Scripts | None = None,
        evaluator: Any = ...,
        **options: Any,
    ) -> dict[EpisodeId, FinishedEpisode]:
        """Re-run episodes with a replacement and keep the successful re-runs; return all of them."""
        if not which:
            return {}
        evaluator = self.evaluator if evaluator is ... else evaluator
        parts = actor or self.actor, scripts or self.scripts, evaluator
        again = self.rerun(replacement_text(name), which, *parts, **options)
        kept = {w: None if episode.first_success is None else episode for w, episode in again.items()}
        self.results.setdefault(name, {}).update(kept)
        return again

    def _measure(self, which: EpisodeId, states: EpisodeStates, again: TensorDictBase) -> None:
        """Compare what the policy was shown with the true state, and what was done with what was decided."""
        if (first := difference(states.steps, again)) is not None:
            self.differs[which] = first
        error = (again.get(SHOWN) - again.get(TRUE_OBSERVATION)).abs().amax(0)
        if error.max() > _EXACT:
            self.misled[which] = Misled(float(error.max()), int(error.argmax()))
        wrapped, executed, self.scripted[which] = self._motion(which, again)
        if (wrapped.done - wrapped.wanted).abs().max() > _EXACT:
            self.wrapped[which] = wrapped
        if (executed.done - executed.wanted).abs().max() > _EXACT:
            self.executed[which] = executed

    def _motion(self, which: EpisodeId, again: TensorDictBase) -> tuple[Motion, Motion, Motion]:
        """Compare decided with commanded, commanded with executed, and scripted with commanded actions."""
        active = states_of(*which, again, self.scripts.plans, None).active
        commanded = again.get(COMMANDED)
        expected = (commanded + self.rerun.noise_of(which, len(again))).clamp(-1.0, 1.0)
        return (
            Motion(again.get(DECIDED), commanded, active),
            Motion(expected, again.get("action"), active),
            Motion(again.get(SCRIPTED), commanded, active),
        )

    def _try_scripts(self, left: list[EpisodeId]) -> None:
        """Re-run with scripts in control of everything, and where that helps, of the parts that act differently."""
        gripper = gripper_of(self.scripts.plans)
        same = [w for w in left if self.scripted[w].wanted.isfinite().all() and self.unlike(w, gripper | True) == 0.0]
        left = [which for which in left if which not in same]  # scripts would change nothing
        for which, episode in self._try("policy", left, part="all").items():
            if self.fixes("policy", which):
                self.scripted[which] = self.scripted[which].and_also(self._motion(which, episode.steps)[2])
        left = [which for which in left if self.fixes("policy", which)]
        if plans_of(self.actor) is not None:
            for which in left:
                in_all, worst, _ = self.scripted[which].of(~gripper).extent()
                if not in_all and worst >= 0 and not self.by_gripper(which):
                    self.step[which] = worst
            steps = {which: self.step[which] for which in left if which in self.step}
            self._try("skill", list(steps), part="all", steps=steps)
        left = self._unfixed(left, "skill")
        if bool(gripper.any()):
            self._try("gripper", [w for w in left if self.unlike(w, gripper) > 0.0], part="gripper")
            self._try("actuation", [w for w in left if self.unlike(w, ~gripper) > 0.0], part="motion")

    def by_gripper(self, which: EpisodeId) -> bool:
        """Return whether the gripper differs much from the scripts' gripper, and much more than the motion does."""
        gripper = gripper_of(self.scripts.plans)
        return self.unlike(which, gripper) > max(OTHER, 2 * self.unlike(which, ~gripper))

    def unlike(self, which: EpisodeId, entries: Tensor) -> float:
        """Return how far the policy's actions are from the scripts', in the plan step where they differ most."""
        return self.scripted[which].of(entries).error()

    def _with_reference(self) -> tuple[Scripts | None, Any, Any]:
        """Return the scripts, the policy and the evaluator with the reference plans that differ from the policy's."""
        reference = self.reference
        different = [] if reference is None else [reference[task] for task in reference.differences(self.scripts.plans)]
        if not different:
            return None, None, None
        plans, evaluator = Plans(different), self.evaluator
        try:
            other = with_plans(self.actor, canonical_like(plans, plans_of(self.actor)))
            plans = plans_of(other) or plans  # a policy may add plans that the reference lacks
            evaluator = evaluator.with_plans(plans) if hasattr(evaluator, "with_plans") else evaluator
        except (AttributeError, ImportError, RuntimeError, TypeError, ValueError) as error:
            reason = f"{type(error).__name__}: {error}"
            message = f"reference: the policy cannot follow the reference, so no plan is replaced ({reason})"
            warnings.warn(message, stacklevel=5)
            return None, None, None
        return Scripts(plans, self.scripts.table), other, evaluator

    def mended(self, by: str | None, which: EpisodeId) -> MendedEpisode | None:
        """Return the successful re-run of an episode with replacement ``by``; None if there is none."""
        episode = None if by is None else self.results[by].get(which)
        if episode is None or by is None:
            return None
        scripts = self.trusted[0] if "plan" in REPLACEMENTS[by] else None
        plans = (scripts or self.scripts).plans
        return MendedEpisode(by, plans[which[0]], episode.steps.exclude(*_MEASURED))

    def shares(self) -> dict[str, dict[str, float]]:
        """Return, by task and replacement, the fraction of the failed episodes it was tried on that it fixes."""
        shares: dict[str, dict[str, float]] = {}
        for task in {task for task, _ in self.seen}:
            plain = [self.plain[which].first_success is not None for which in self.seen if which[0] == task]
            shares[task] = {"nothing": sum(plain) / len(plain)}
            for name, results in self.results.items():
                if fixed := [episode is not None for (of, _), episode in results.items() if of == task]:
                    shares[task][name] = sum(fixed) / len(fixed)
        return shares
