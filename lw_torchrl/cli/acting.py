"""The policy of `lw-torchrl evaluate` and `record`, with its plans and its evaluator."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import arg

import lw_torchrl as lw
from lw_torchrl.cli import options
from lw_torchrl.language.plans import Plans
from lw_torchrl.language.tasks import Task


@dataclass(kw_only=True)
class Acting:
    """Options of a policy that acts: its plans, its evaluator, noise and seed."""

    plans: Annotated[
        options.PlanSources, options.OPTIONAL, arg(help=f"plans to carry out instead of the policy's: {options.PLANS}")
    ] = ()
    suite: options.SuiteName = None
    speed: float = 1.0  # scale factor on the hand's displacement, for a policy trained on another robot
    select: Literal["first", "random", "mix"] = "first"  # with scripted: which of several true steps acts
    skill_file: options.SkillFile = None
    task_file: options.TaskFile = None
    text_encoder: options.Encoder = None
    evaluator: options.Evaluator = None
    seed: int = 1000  # random seed of initial states, goals and noise (not one that the demonstrations used)
    noise: float = 0.1  # standard deviation of the noise on the executed action
    max_steps: int | None = None  # steps of an episode; None for the suite's, 500 in Meta-World
    stop_at_success: bool = False  # end episodes at their first success; the success rate stays the same
    attribute: bool = False  # re-run failed episodes to say why they failed: a query, the plan, a skill or time
    reference: Annotated[
        tuple[str, ...],
        options.OPTIONAL,
        arg(metavar="SOURCES", help="with --attribute, trusted plans for the re-run, as for --plans"),
    ] = ()
    device: options.Device = "cpu"

    def choose(self, names: tuple[str, ...]) -> list[str]:
        """Read --suite and --task-file, and return the tasks that ``names`` stand for."""
        options.use_one_thread()
        self.in_suite = options.read_suite(self.suite, names)
        self.known: Mapping[str, Task] = options.read_tasks(self.task_file, names, self.suite)
        return options.select_tasks(names, self.known, self.in_suite) if names else []

    @cached_property
    def own_plans(self) -> Plans | None:
        return options.read_plans(self.plans, self.known) if self.plans else None

    @property
    def run(self) -> dict[str, Any]:
        """The arguments of an episode that library functions share."""
        run = {"seed": self.seed, "noise_scale": self.noise, "suite": self.in_suite, "device": self.device}
        return run | ({} if self.max_steps is None else {"max_steps": self.max_steps})

    @property
    def trusted_plans(self) -> Plans | None:
        return options.read_plans(self.reference, self.known) if self.reference else None

    def policy(self, who: str, tasks: list[str]) -> tuple[Any, Plans | None, Any]:
        """Return a policy, the plans to show, and the evaluator in front of the policy."""
        policy, plans = self._policy(who, tasks)
        if self.evaluator is None:
            return policy, plans, None
        if (own := lw.modules.plans_of(policy)) is None:
            raise ValueError(f"--evaluator requires a policy with plans; {who} has none")
        evaluator = read_evaluator(self.evaluator, own, self.text_encoder)
        evaluator.answers = "hard"  # the policy was trained on exact answers
        return policy, plans, evaluator

    def _policy(self, who: str, tasks: list[str]) -> tuple[Any, Plans | None]:
        from lw_torchrl.data.collect import suite_expert
        from lw_torchrl.data.collection_policy import BEHAVIOURS, SegmentActor, behaviour_of
        from lw_torchrl.modules.wrappers import TransferredActor
        from lw_torchrl.suites.suite import find_suite
        from lw_torchrl.training.checkpoint import demonstration_seeds

        suite, plans = self.in_suite, self.own_plans
        if who in BEHAVIOURS:
            suite = find_suite(tasks) if suite is None else suite
            if (shown := plans or suite.plans) is not None:
                shown.require(tasks)
                shown = Plans({task: shown[task] for task in tasks})
            if who == "expert":
                return suite_expert(suite, tasks), shown
            if shown is None:
                raise ValueError(f"suite {suite.name!r} has no plans for {who} to follow; give some by --plans")
            skills = options.read_skills(self.skill_file, self.known) if self.skill_file else suite.skills
            if who == "scripted":
                return lw.ScriptedSkillActor(shown, self.select, skills=skills), shown
            behaviour = behaviour_of(who, tasks, suite=suite)
            return SegmentActor(behaviour, shown, self.seed, self.max_steps or suite.max_steps, skills=skills), shown
        if is_object(who):
            policy = read_object(who)
            policy = policy if plans is None else _with_plans(policy, plans)
            return policy, lw.modules.plans_of(policy)
        if self.seed in demonstration_seeds(who):
            raise ValueError(f"--seed {self.seed} is the seed of the demonstrations; evaluate on a different one")
        policy = lw.load_actor(who, text_encoder=options.read_encoder(self.text_encoder))
        if suite is not None and lw.modules.layout_of(policy) != suite.layout:
            if (plans := plans or suite.plans) is None:
                raise ValueError(f"suite {suite.name!r} has no plans; give some by --plans")
            policy = TransferredActor(policy, _like(plans, policy), speed=self.speed)
        elif plans is not None:
            policy = _with_plans(policy, plans)
        return policy, lw.modules.plans_of(policy)


def _with_plans(policy: Any, plans: Plans) -> Any:
    return lw.modules.with_plans(policy, _like(plans, policy))


def _like(plans: Plans, policy: Any) -> Plans:
    """Return plans in the form of those that a policy was trained with."""
    from lw_torchrl.language.canonical import canonical_like

    return canonical_like(plans, lw.modules.plans_of(policy))


def is_object(who: str) -> bool:
    """Return whether a policy is named as my_module:policy."""
    return ":" in who and not Path(who).exists()


def read_object(who: str) -> Any:
    """Import the policy of "my_module:policy"."""
    policy = options.import_object("the policy", who)
    if not callable(policy) or isinstance(policy, type):
        raise ValueError(f"the policy {who} must map a TensorDict to a TensorDict, got {policy!r:.80}")
    return policy


def policy_name(who: str) -> str:
    """Return a short name of a policy for labels and file names."""
    return who.partition(":")[2] if is_object(who) else Path(who).stem


def read_evaluator(name: str, plans: Plans, text_encoder: str | None = None) -> lw.QueryEvaluator:
    """Return an evaluator for ``plans``: from a file or "my_module:evaluator", or a new one of a registered class."""
    encoder = options.read_encoder(text_encoder)
    if Path(name).exists() or not (":" in name or name == "StateQueryEvaluator"):
        return lw.training.load_evaluator(name, plans, text_encoder=encoder)
    found: Any = options.import_object("--evaluator", name) if ":" in name else lw.StateQueryEvaluator
    if isinstance(found, lw.QueryEvaluator):
        return found.with_plans(plans)
    if not (isinstance(found, type) and issubclass(found, lw.QueryEvaluator)):
        raise ValueError(f"--evaluator {name} must be a lw.QueryEvaluator or a class of them, got {found!r:.80}")
    return found(plans)
