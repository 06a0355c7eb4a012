"""The command ``lw-torchrl evaluate``: measure success rates of trained policies, experts and scripted plans."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import OmitArgPrefixes, Positional, arg

import lw_torchrl as lw
from lw_torchrl._util.checks import Count, Natural, Positive, Scale
from lw_torchrl._util.files import locked, write_json
from lw_torchrl._util.text import counted
from lw_torchrl.cli import options
from lw_torchrl.cli.options import Flag, Maybe, Output
from lw_torchrl.language.nearest import nearest_skill
from lw_torchrl.language.plans import Plans
from lw_torchrl.language.skills import ScriptedSkill, load_skills, skills_for
from lw_torchrl.language.tasks import Task

_PLANS = f"plans that replace the policy's plans: {options.PLANS}"
_REFERENCE = "with --attribute, trusted plans with which failed episodes are re-run; same format as --plans"
_TASKS = "MT10, MT50, a suite, or names of tasks (default: the tasks of --plans or of the demonstrations)"


@dataclass(kw_only=True)
class Rollout:
    """The options shared by `evaluate` and `record`: plans, evaluator, noise and seed."""

    plans: Annotated[options.PlanSources, options.OPTIONAL, arg(help=_PLANS)] = ()
    suite: options.SuiteName = None
    speed: Maybe[Positive] = None
    """with --suite, speed of the new robot's hand as a multiple of the training robot's (default: if the policy
    requests full speed, the new robot moves at its own full speed)"""
    skill_file: options.SkillFile = None
    task_file: options.TaskFile = None
    text_encoder: options.Encoder = None
    evaluator: options.Evaluator = None
    seed: Natural = 1000  # random seed of initial states, goals and noise (use a different one than for demonstrations)
    noise: Scale = 0.1  # standard deviation of the noise on the executed action
    max_steps: Maybe[Count] = None  # maximum time steps per episode (default: the suite's limit, 500 in Meta-World)
    stop_at_success: Flag = False  # end episodes at the first success; the success rate stays the same
    attribute: Flag = False  # find out why episodes failed by re-running them with parts of the policy replaced
    reference: Annotated[tuple[str, ...], options.OPTIONAL, arg(metavar="SOURCES", help=_REFERENCE)] = ()
    device: options.Device = "cpu"

    def choose(self, names: tuple[str, ...]) -> list[str]:
        """Load --suite and --task-file, and return the names of the selected tasks."""
        self.chosen_suite = options.read_suite(self.suite, names)
        self.known: Mapping[str, Task] = options.read_tasks(self.task_file, names, self.suite)
        return options.select_tasks(names, self.known, self.chosen_suite) if names else []

    @cached_property
    def own_plans(self) -> Plans | None:
        return options.read_plans(self.plans, self.known) if self.plans else None

    @property
    def trusted_plans(self) -> Plans | None:
        return options.read_plans(self.reference, self.known) if self.reference else None

    @property
    def arguments(self) -> dict[str, Any]:
        """Keyword arguments for any library function that runs episodes."""
        arguments = {"seed": self.seed, "noise_scale": self.noise, "suite": self.chosen_suite, "device": self.device}
        return arguments | ({} if self.max_steps is None else {"max_steps": self.max_steps})

    def policy(self, name: str, tasks: list[str]) -> tuple[Any, Plans | None, Any]:
        """Return a policy, the plans to show, and the evaluator that runs before the policy (or None)."""
        options.use_one_thread()
        policy, plans = self._policy(name, tasks)
        if self.evaluator is None:
            return policy, plans, None
        if (own := lw.modules.plans_of(policy)) is None:
            raise ValueError(f"--evaluator requires a policy with plans; {name} has none")
        evaluator = options.read_evaluator(self.evaluator, own, self.text_encoder)
        evaluator.answers = "hard"  # the policy was trained on exact (binary) answers
        return policy, plans, evaluator

    def _policy(self, name: str, tasks: list[str]) -> tuple[Any, Plans | None]:
        from lw_torchrl.data.collection_policy import BEHAVIOURS
        from lw_torchrl.language.canonical import canonical_like
        from lw_torchrl.modules.wrappers import TransferredActor
        from lw_torchrl.training.checkpoint import demonstration_seeds

        if name in BEHAVIOURS:
            return self._behaviour(name, tasks)
        suite, plans = self.chosen_suite, self.own_plans
        if options.is_object(name):
            policy = options.read_object(name)
        elif self.seed in demonstration_seeds(name):
            raise ValueError(f"--seed {self.seed} is the seed of the demonstrations; use a different seed")
        else:
            policy = lw.load_actor(name, text_encoder=options.read_encoder(self.text_encoder))
            if suite is not None and lw.modules.layout_of(policy) != suite.layout:  # a policy for another robot
                if (plans := plans or suite.plans) is None:
                    raise ValueError(f"suite {suite.name!r} has no plans; pass plans with --plans")
                plans = canonical_like(plans, lw.modules.plans_of(policy))
                policy, plans = TransferredActor(policy, plans, speed=self.speed), None
        if plans is not None:
            policy = lw.modules.with_plans(policy, canonical_like(plans, lw.modules.plans_of(policy)))
        return policy, lw.modules.plans_of(policy)

    def _behaviour(self, name: str, tasks: list[str]) -> tuple[Any, Plans | None]:
        """Return a scripted policy and the plans to show."""
        from lw_torchrl.data.collect import suite_expert
        from lw_torchrl.data.collection_policy import SegmentActor, behaviour_of
        from lw_torchrl.suites.suite import find_suite

        suite = self.chosen_suite or find_suite(tasks)
        if (plans := self.own_plans or suite.plans) is not None:
            plans.require(tasks)
            plans = Plans({task: plans[task] for task in tasks})
        if name == "expert":
            return suite_expert(suite, tasks), plans
        if plans is None:
            raise ValueError(f"suite {suite.name!r} has no plans for policy {name!r}; pass plans with --plans")
        skills = options.read_skills(self.skill_file, self.known) if self.skill_file else suite.skills
        _check_scripted(plans, skills or load_skills(), self.plans)
        if name == "scripted":
            return lw.ScriptedSkillActor(plans, skills=skills), plans
        behaviour = behaviour_of(name, tasks, suite=suite)
        return SegmentActor(behaviour, plans, self.seed, self.max_steps or suite.max_steps, skills=skills), plans


def _check_scripted(plans: Plans, skills: Mapping[str, ScriptedSkill], sources: tuple[str, ...]) -> None:
    """Raise a ValueError if plan steps have no scripted skill; name these steps and the nearest scripted skills."""
    for task, plan in plans.items():
        own = skills_for(plan.definition, skills)
        texts = {number: step.skill for number, step in enumerate(plan.steps, 1) if step.skill not in skills}
        near = {number: nearest_skill(text, plan.definition, own)[0].text for number, text in texts.items()}
        if faults := [f"step {number} {texts[number]!r} (nearest: {near[number]!r})" for number in texts]:
            name = task.replace("/", "__")
            paths = [Path(source, part) for source in reversed(sources) for part in (f"{name}.plan", "")]
            files = sorted((path for path in paths if path.is_file()), key=lambda path: path.stem != name)
            file = files[0] if files else task
            remedy = f"use the texts of scripted skills: `lw-torchrl plan read {file} --scripted --out my-scripts`"
            raise ValueError(f"{file}: no scripted skill for {', '.join(faults)}; {remedy}")


@dataclass(kw_only=True)
class Evaluate:
    """Evaluate a policy, and write the success rates, a figure and a recording.

    With --suite, a policy that was trained on another robot is transferred to that suite and follows the suite's plans.

    Example: lw-torchrl evaluate runs/mt10.safetensors --out runs/mt10

    Example: lw-torchrl evaluate scripted --tasks MT50 --episodes 50 --noise 0
    """

    policy: Positional[options.Who]
    tasks: Annotated[tuple[str, ...], options.OPTIONAL, arg(metavar="TASKS", help=_TASKS)] = ()
    episodes: Count = 20  # number of episodes of each task
    out: Maybe[Path] = None
    """folder for results.json, success.png, failures.png, plan_use.json and rollout.rrd, which shows the first failed
    episode of the three tasks with most failures (without failures, episode 0 of up to three tasks)"""
    workers: options.Workers = None
    json: options.Json = False
    rollout: OmitArgPrefixes[Rollout] = field(default_factory=Rollout)

    def run(self) -> Output:
        rollout = self.rollout
        tasks, suite = rollout.choose(self.tasks), rollout.chosen_suite
        options.start_workers(self.policy, rollout.device, self.workers, len(tasks) * self.episodes)
        # Import these slow modules only here, while the worker processes start.
        from lw_torchrl.data.collection_policy import BEHAVIOURS
        from lw_torchrl.training.checkpoint import demonstrated_tasks

        if not tasks and self.policy in BEHAVIOURS:
            tasks = list(rollout.own_plans or (lw.MT10 if suite is None else suite.plans or suite.tasks))
        policy, plans, evaluator = rollout.policy(self.policy, tasks)
        if not tasks:
            has_demonstrations = not rollout.plans and not options.is_object(self.policy)
            tasks = _default_tasks(policy, demonstrated_tasks(self.policy) if has_demonstrations else set(), suite)
        use = lw.evaluation.PlanUse(plans) if plans and isinstance(policy, lw.ScriptedSkillActor) else None
        more: dict[str, Any] = {"also_record": ["qaf", "skill_weights"], "on_episode": use} if use else {}
        more |= {"attribute": rollout.attribute, "reference": rollout.trusted_plans, "evaluator": evaluator}
        more |= {"episodes_per_task": self.episodes, "stop_at_success": rollout.stop_at_success}
        more["workers"] = self.workers
        result = lw.evaluate(policy, tasks=tasks, **rollout.arguments, **more)
        output = Output(self.json)
        _show_plan_use(output, result, use, plans) if use and plans else output.result(result)
        if rollout.attribute:
            failures = [failure.to_json() for failure in result.failures or ()]
            output.show("failures", failures, f"\n{result.failure_table()}")
        if self.out is not None:
            with locked(self.out, "out", folder=True, wait=True):
                recorded = self._write(self.out, result, policy, use, evaluator)
            names = ", ".join(f"{task} {episode}" for task, episode in recorded)
            kind = "failed" if result.mean_success < 1 else "successful"
            print(f"written to {self.out}; rollout.rrd shows the {kind} episodes {names}")
        return output

    def _write(self, out: Path, result: lw.EvaluationResult, policy: Any, use: Any, evaluator: Any) -> list[Any]:
        """Write the files and return the recorded episodes, as pairs of task and index."""
        from lw_torchrl.record.rollouts import new_recording, run_recorded
        from lw_torchrl.training.checkpoint import policy_file

        rollout, plans = self.rollout, lw.modules.plans_of(policy)
        origin: dict[str, Any] = {"plans": None if plans is None else plans.fingerprint}
        for name, file in (("checkpoint", policy_file(self.policy)), ("evaluator", Path(rollout.evaluator or ""))):
            origin[name] = file if file.is_file() else None
        result.save(out / "results.json", **origin)
        title = f"{self.policy}, {self.episodes} episodes per task"
        lw.evaluation.plot_success(result, out / "success.png", title=title)
        if use is not None:
            write_json(out / "plan_use.json", {task: counts.to_json() for task, counts in use.tasks().items()})
        if rollout.attribute:
            lw.evaluation.plot_failures(result, out / "failures.png", title=self.policy)
        page: dict[str, Any] = {"seed": rollout.seed, "policy": options.policy_name(self.policy)}
        failures = {(failure.task, failure.episode): failure for failure in result.failures or ()}
        recorded = episodes_to_record(result)
        with new_recording(out / "rollout.rrd") as logger:
            for task, number in recorded:
                run: dict[str, Any] = {"episodes": [number], "evaluator": evaluator, **rollout.arguments}
                (episode,) = run_recorded(policy, task, **run)
                page |= {"suite": rollout.chosen_suite, "failure": failures.get((task, number))}
                lw.log_rollout(logger, episode.steps, plans, **page)
        return recorded


def episodes_to_record(result: lw.EvaluationResult) -> list[tuple[str, int]]:
    """Return the first failed episode of the three tasks that failed most, or episode 0 of three tasks if none failed.

    Episodes are pairs of task and index.
    """
    failed: dict[str, list[int]] = {}
    for episode in result.episodes:
        if not episode.success:
            failed.setdefault(episode.task, []).append(episode.episode)
    worst = sorted(failed, key=lambda task: -len(failed[task]))
    return [(task, failed[task][0]) for task in worst[:3]] or [(task, 0) for task in result.config["tasks"][:3]]


def _show_plan_use(output: Output, result: lw.EvaluationResult, use: lw.evaluation.PlanUse, plans: Plans) -> None:
    """Print the result and, for each plan step, how often its condition held, how often the policy chose the step, and
    in how many failed episodes the policy got stuck in it."""
    steps = {}
    for task, used in use.tasks().items():
        columns = zip(plans[task].steps, used.true, used.chosen, used.stuck, strict=True)
        steps[task] = [dict(skill=step.skill, true=true, chosen=on, stuck=stuck) for step, true, on, stuck in columns]
        print(f"{task}: success {result.success_once[task]:.2f}")
        for row in steps[task]:
            stuck = f", {row['stuck']} of {used.failed} failed episodes end here" if row["stuck"] else ""
            print(f"    true {row['true']:4.0%}  chosen {row['chosen']:4.0%}  {row['skill']}{stuck}")
    output.result(result, steps=steps)


def _default_tasks(policy: Any, demonstrated: set[str], suite: lw.suites.Suite | None) -> list[str]:
    """Return the policy's tasks that have demonstrations (all if none has), except tasks that no suite can simulate."""
    from lw_torchrl.suites.suite import known_suite

    if (known := lw.modules.tasks_of(policy)) is None:
        raise ValueError("--tasks is required: the policy has neither tasks nor plans")
    chosen = [task for task in known if task in demonstrated] or list(known)
    tasks = [task for task in chosen if (known_suite(task) if suite is None else task in suite.tasks)]
    if not tasks:
        hint = "pass other tasks with --tasks, or their suite with --import my_module or --suite my_module:suite"
        raise ValueError(f"no simulator has the policy's tasks ({', '.join(chosen)}); {hint}")
    if len(tasks) < len(known):
        print(f"evaluating {counted(len(tasks), 'task')} of the policy's {len(known)}; use --tasks to choose others")
    return tasks
