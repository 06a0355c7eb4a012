"""``lw-torchrl evaluate``: success rates of trained policies, experts and scripted plans."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import OmitArgPrefixes, Positional, arg

import lw_torchrl as lw
from lw_torchrl._util.checks import counted
from lw_torchrl._util.files import locked, write_json
from lw_torchrl.cli import options
from lw_torchrl.cli.acting import Acting, is_object, policy_name
from lw_torchrl.cli.options import Output
from lw_torchrl.language.plans import Plans

_TASKS = "MT10, MT50, a suite, or names of tasks; by default those of --plans or of the demonstrations"


@dataclass(kw_only=True)
class Evaluate:
    """Evaluate a policy, and write the success rates, a figure and a recording.

    With --suite, a policy that was trained on another robot runs in that suite, with its plans.

    Example: lw-torchrl evaluate runs/mt10.safetensors --out runs/mt10

    Example: lw-torchrl evaluate scripted --tasks MT50 --episodes 50 --noise 0
    """

    policy: Positional[Annotated[str, arg(metavar="POLICY", help=f"who acts: {options.WHO}")]]
    tasks: Annotated[tuple[str, ...], options.OPTIONAL, arg(help=_TASKS)] = ()
    episodes: int = 20  # episodes of each task
    num_envs: int | None = None  # environments stepped together; does not change the result
    out: Path | None = None  # folder for results.json, success.png, rollout.rrd, failures.png and plan_use.json
    json: options.Json = False
    acting: OmitArgPrefixes[Acting] = field(default_factory=Acting)

    def run(self) -> Output:
        from lw_torchrl.data.collection_policy import BEHAVIOURS
        from lw_torchrl.training.checkpoint import demonstrated_tasks

        acting = self.acting
        tasks, suite = acting.choose(self.tasks), acting.in_suite
        if not tasks and self.policy in BEHAVIOURS:
            tasks = list(acting.own_plans or (lw.MT10 if suite is None else suite.plans or suite.tasks))
        policy, plans, evaluator = acting.policy(self.policy, tasks)
        if not tasks:
            demonstrated = set() if acting.plans or is_object(self.policy) else demonstrated_tasks(self.policy)
            tasks = _default_tasks(policy, demonstrated, suite)
        use = lw.evaluation.PlanUse(plans) if plans and isinstance(policy, lw.ScriptedSkillActor) else None
        watching: dict[str, Any] = {"also_record": ["qaf", "skill_weights"], "on_episode": use} if use else {}
        more: dict[str, Any] = {
            "attribute": acting.attribute,
            "reference": acting.trusted_plans,
            "evaluator": evaluator,
        }
        result = lw.evaluate(
            policy, tasks=tasks, episodes_per_task=self.episodes, stop_at_success=acting.stop_at_success,
            num_envs=self.num_envs, **acting.run, **more, **watching,
        )  # fmt: skip
        output = Output(self.json)
        _show_use(output, result, use, plans) if use and plans else output.result(result)
        if acting.attribute:
            failures = [failure.to_json() for failure in result.failures or ()]
            output.show("failures", failures, f"\n{result.failure_table()}")
        if self.out is not None:
            with locked(self.out, "out", folder=True, wait=True):
                self._write(self.out, result, policy, use, evaluator)
            print(f"written to {self.out}")
        return output

    def _write(self, out: Path, result: lw.EvaluationResult, policy: Any, use: Any, evaluator: Any) -> None:
        from lw_torchrl.record.rollouts import run_recorded, write_recording
        from lw_torchrl.training.checkpoint import policy_file

        plans = lw.modules.plans_of(policy)
        origin: dict[str, Any] = {"plans": None if plans is None else plans.fingerprint}
        for name, file in (("checkpoint", policy_file(self.policy)), ("evaluator", Path(self.acting.evaluator or ""))):
            origin[name] = file if file.is_file() else None
        result.save(out / "results.json", **origin)
        lw.plot_success(result, out / "success.png", title=f"{self.policy}, {self.episodes} episodes a task")
        if use is not None:
            write_json(out / "plan_use.json", {task: one.to_json() for task, one in use.tasks().items()})
        if self.acting.attribute:
            lw.evaluation.plot_failures(result, out / "failures.png", title=self.policy)
        recorded = run_recorded(policy, result.config["tasks"][:3], evaluator=evaluator, **self.acting.run)
        label: dict[str, Any] = {"seed": self.acting.seed, "policy": policy_name(self.policy)}
        write_recording(out / "rollout.rrd", recorded, plans, suite=self.acting.in_suite, **label)


def _show_use(output: Output, result: lw.EvaluationResult, use: lw.evaluation.PlanUse, plans: Plans) -> None:
    """Print the result and, for each plan step, how often it was true, chosen, or the last one of a failed episode."""
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
    """Return the policy's demonstrated tasks, or all its tasks if none is recorded, that a suite simulates."""
    from lw_torchrl.suites.suite import known_suite

    if (known := lw.modules.tasks_of(policy)) is None:
        raise ValueError("--tasks is required: the policy has neither tasks nor plans")
    chosen = [task for task in known if task in demonstrated] or list(known)
    tasks = [task for task in chosen if (known_suite(task) if suite is None else task in suite.tasks)]
    if not tasks:
        hint = "name others by --tasks, or the suite that has them: --import my_module or --suite my_module:suite"
        raise ValueError(f"no simulator has the policy's tasks, {', '.join(chosen)}; {hint}")
    if len(tasks) < len(known):
        print(f"evaluating {counted(len(tasks), 'task')} of the policy's {len(known)}; choose others by --tasks")
    return tasks
