"""python -m benchmarks.evaluators: measure the success of policies with learned query evaluators, and after tuning."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from tensordict.nn import TensorDictSequential

import lw_torchrl as lw
from benchmarks.evaluator_report import condition_drift, drift_table, write_report
from benchmarks.figures import markdown_table
from lw_torchrl._util.files import read_toml, write_text
from lw_torchrl.cli.demo import DemoConfig
from lw_torchrl.evaluation import EvaluationResult
from lw_torchrl.modules import transform_of
from lw_torchrl.modules.query_evaluator import evaluators_of

RECIPE = DemoConfig(demonstrations_per_task=10)
WHO = ("expert", "scripted", "noisy-30", "random")


@dataclass(frozen=True)
class Arguments:
    """Train few-shot policies for MT10, and evaluate them with exact answers, with learned evaluators, and after tuning
    policy and evaluator together. If the command is stopped, run it again to resume.
    """

    seeds: tuple[int, ...] = (0, 1, 2)
    """Random seeds of demonstrations, labelled states, weights and minibatches."""
    plans: tuple[str, ...] = ("MT10",)
    """Plans for the tasks: MT10, a .plan or .json file, a folder, or a .toml file with a program for each task. With
    several sources, all policies learn from the same demonstrations and use the same evaluators."""
    labels: tuple[float, ...] = (1.0, 0.01)
    """Fractions of the labelled states to train evaluators on."""
    wrong: float | None = None
    """Also tune an evaluator that was trained on all labels and then corrupted by noise on its weights. This is the
    fraction of wrong answers to the conditions of MT10's shipped plans, in the states of the demonstrations."""
    tasks: tuple[str, ...] = lw.MT10
    policy_steps: int = RECIPE.training_steps
    """Number of minibatches to train a policy."""
    steps: int = 6000
    """Number of minibatches to train an evaluator."""
    tuning_steps: int = 2000
    """Number of minibatches to tune policy and evaluator."""
    tuning_rate: float = 3e-4
    """Initial learning rate of the tuning."""
    anchors: tuple[float, ...] = (0.0, 0.1)
    """Values of `qaf_anchor`; policies are tuned once with each."""
    episodes: int = 20
    """Number of evaluation episodes per task."""
    evaluation_seed: int = 1000
    """Random seed of the evaluation (use a different one than for demonstrations and labels)."""
    quick: bool = False
    """Run two tasks, few steps and one seed as a test; the numbers are meaningless."""
    out: Path = Path("runs/evaluators")


def demonstrations(
    root: Path, tasks: Sequence[str], seed: int, max_steps: int = 500
) -> lw.LanguageWorldExperienceReplay:
    """Collect the recipe's demonstrations, or the missing part of them, and open them as a replay buffer."""
    lw.collect_demonstrations(
        tasks,
        episodes_per_task=RECIPE.demonstrations_per_task,
        root=root,
        seed=seed,
        noise_scale=RECIPE.demonstration_noise,
        noise_hold=RECIPE.noise_hold,
        redraw_failures=True,
        max_steps=max_steps,
    )
    sampler = lw.TaskBalancedSampler(exact=True)
    return lw.LanguageWorldExperienceReplay(root, sampler=sampler, after_success=RECIPE.after_success)


def evaluated(file: Path, actor: Any, tasks: Sequence[str], episodes: int, seed: int) -> EvaluationResult:
    """Evaluate an actor, or read the result from the file if it exists."""
    if file.is_file():
        return EvaluationResult.load(file)
    result = lw.evaluate(
        actor,
        tasks=tasks,
        episodes_per_task=episodes,
        seed=seed,
        noise_scale=RECIPE.evaluation_noise,
        stop_at_success=True,
    )
    file.parent.mkdir(parents=True, exist_ok=True)
    result.save(file)
    return result


def in_front(evaluator: lw.QueryEvaluator, actor: Any) -> TensorDictSequential:
    """Return a policy that acts on an evaluator's answers, which are hard like the exact answers used in training."""
    evaluator.answers = "hard"
    return TensorDictSequential(evaluator, actor)


def load_plans(source: str) -> lw.Plans:
    """Load plans, or programs from a .toml file that maps tasks to texts."""
    if Path(source).suffix != ".toml":
        return lw.load_plans(source)
    programs = read_toml(Path(source), ValueError)
    return lw.Plans([lw.ConditionalPlan.from_program(text, task) for task, text in programs.items()])


def wrong_rate(policy: Any, states: Any) -> float:
    """Return the fraction of wrong answers to conditions by an evaluator, or by the evaluator in a policy."""
    return 1.0 - float(np.mean([drift.agreement for drift in condition_drift(policy, states)]))


def add_noise(evaluator: Any, states: Any, rate: float, seed: int) -> None:
    """Add normal noise to the weights of an evaluator so that the fraction ``rate`` of its answers is wrong. The errors
    are systematic: equal states get equal answers."""
    generator = torch.Generator().manual_seed(seed)
    weights = {name: value.clone() for name, value in evaluator.network.state_dict().items()}
    noise = {name: torch.randn(value.shape, generator=generator) * value.std() for name, value in weights.items()}
    low, high = 0.0, 4.0
    for _ in range(12):
        scale = (low + high) / 2
        evaluator.network.load_state_dict({name: value + scale * noise[name] for name, value in weights.items()})
        low, high = (low, scale) if wrong_rate(evaluator, states) > rate else (scale, high)


class Bench:
    """The policies and evaluators of one seed and one source of plans. Each is made once and stored in a file."""

    def __init__(self, args: Arguments, seed: int, source: str) -> None:
        self.args, self.seed, self.shared = args, seed, args.out / f"seed{seed}"
        self.folder = self.shared / Path(source).stem
        self.plans = load_plans(source)

    def demonstrations(self) -> lw.LanguageWorldExperienceReplay:
        return demonstrations(self.shared / "demonstrations", self.args.tasks, self.seed)

    def policy(self) -> Any:
        """The few-shot policy, trained on exact answers."""
        replay = self.demonstrations()
        replay.append_transform(lw.QAFTransform(self.plans))
        torch.manual_seed(self.seed)
        actor = lw.PlanConditionedActor(self.plans)
        config = lw.BehavioralCloningConfig(steps=self.args.policy_steps, batch_size=RECIPE.batch_size, seed=self.seed)
        lw.BehavioralCloningTrainer(actor, replay, config, checkpoint=self.folder / "policy.safetensors").train()
        return lw.load_actor(self.folder / "policy.safetensors")

    def evaluator(self, share: float) -> Any:
        """Train an evaluator on the answers in a fraction ``share`` of the states, and print its report."""
        roots = [self.shared / "states" / who for who in WHO]
        for who, root in zip(WHO, roots, strict=True):
            noise = (0.0, 0.1, 0.2) if who == "expert" else 0.0
            lw.collect_demonstrations(
                self.args.tasks, episodes_per_task=5, root=root, policy=who, noise_scale=noise, seed=self.seed
            )
        most = lw.training.QueryEvaluatorConfig(held_out_pairs=0.0, seed=self.seed, steps=self.args.steps)
        config = replace(most, states_per_task=max(1, round(share * most.states_per_task)))
        states = lw.LanguageWorldExperienceReplay(roots, label="executed")
        labelled = lw.training.LabelledQueries(states, config)
        torch.manual_seed(self.seed)
        evaluator = lw.modules.StateQueryEvaluator(lw.load_plans("MT10"))  # the network does not depend on the plans
        file = self.shared / f"evaluator-{share:g}.safetensors"
        lw.training.QueryEvaluatorTrainer(evaluator, labelled, config, checkpoint=file).train()
        held_out = labelled if config == most else lw.training.LabelledQueries(states, most)
        report = write_report(evaluator, held_out, file.with_suffix(".json"), most=2)
        number = labelled.describe()["states"]["training"]
        print(f"seed {self.seed}, {number} labelled states:\n{report}", flush=True)
        return lw.training.load_evaluator(file, self.plans)

    def wrong_evaluator(self, rate: float) -> Any:
        """Return an evaluator that was trained on all answers and then corrupted by noise."""
        evaluator = self.evaluator(1.0)
        shipped = evaluator.with_plans(lw.load_plans("MT10"))  # shares its weights
        add_noise(shipped, self.demonstrations()[:], rate, self.seed)
        return evaluator

    def tuned(self, name: str, actor: Any, anchor: float) -> Any:
        """Tune a policy, and its evaluator if it has one, with the imitation loss on the demonstrations."""
        replay = self.demonstrations()
        if (transform := transform_of(actor)) is not None:
            replay.append_transform(transform)
        config = lw.BehavioralCloningConfig(
            steps=self.args.tuning_steps,
            batch_size=RECIPE.batch_size,
            learning_rate=self.args.tuning_rate,
            normalize=False,
            seed=self.seed,
            qaf_anchor=anchor,
        )
        file = self.folder / f"{name}.safetensors"
        lw.BehavioralCloningTrainer(actor, replay, config, checkpoint=file).train()
        if evaluators_of(actor):
            drifts = condition_drift(actor, replay[:])
            table = f"{wrong_rate(actor, replay[:]):.3f} of the answers are wrong\n{drift_table(drifts, most=8)}"
            write_text(file.with_suffix(".txt"), table)
            print(f"seed {self.seed}, {name}, conditions in the demonstrations' states:\n{table}", flush=True)
        return lw.load_actor(file)

    def success(self, name: str, actor: Any) -> EvaluationResult:
        file = self.folder / "results" / f"{name}.json"
        return evaluated(file, actor, self.args.tasks, self.args.episodes, self.args.evaluation_seed)

    def run(self) -> Iterable[tuple[str, EvaluationResult]]:
        """Yield the rows of the table: the source of the answers, and the result."""
        policy = self.policy()
        yield "query answering function", self.success("qaf", policy)
        if self.args.labels:
            yield "the same, tuned as long", self.success("qaf-tuned", self.tuned("qaf-tuned", self.policy(), 0.0))
        for share in self.args.labels:
            evaluator = self.evaluator(share)
            told = f"evaluator, {100 * share:g}% of the labels"
            yield told, self.success(f"evaluator-{share:g}", in_front(evaluator, policy))
            for anchor in self.args.anchors:
                name = f"evaluator-{share:g}-tuned-{anchor:g}"
                fresh = lw.training.load_evaluator(self.shared / f"evaluator-{share:g}.safetensors", self.plans)
                begun = in_front(fresh, self.policy())
                yield f"{told}, tuned, anchor {anchor:g}", self.success(name, self.tuned(name, begun, anchor))
        if self.args.wrong is not None:
            name, told = f"wrong-{self.args.wrong:g}", f"evaluator, {100 * self.args.wrong:g}% wrong"
            wrong = in_front(self.wrong_evaluator(self.args.wrong), policy)
            print(f"seed {self.seed}, {name}: {wrong_rate(wrong, self.demonstrations()[:]):.3f} wrong", flush=True)
            yield told, self.success(name, wrong)
            for anchor in self.args.anchors:
                begun = in_front(self.wrong_evaluator(self.args.wrong), self.policy())
                file = f"{name}-tuned-{anchor:g}"
                yield f"{told}, tuned, anchor {anchor:g}", self.success(file, self.tuned(file, begun, anchor))
            begun = in_front(self.wrong_evaluator(self.args.wrong), self.policy().requires_grad_(False))
            tuned = self.tuned(f"{name}-tuned-alone", begun, 0.0)
            yield f"{told}, tuned, the policy fixed", self.success(f"{name}-tuned-alone", tuned)


def table(found: dict[tuple[str, str], list[EvaluationResult]]) -> str:
    """Return a table with the mean success over seeds, and the difference from exact answers, for each row."""
    rows = []
    for (plans, name), results in found.items():
        exact = np.array([result.mean_success for result in found[plans, "query answering function"]])
        means = np.array([result.mean_success for result in results])
        by_seed = ", ".join(f"{mean:.3f}" for mean in means)
        rows.append([plans, name, f"{means.mean():.3f}", by_seed, f"{(means - exact[: len(means)]).mean():+.3f}"])
    return markdown_table(["plans", "answers", "mean", "by seed", "to exact answers"], rows)


def main(args: Arguments) -> None:
    if args.quick:
        args = replace(args, tasks=args.tasks[:2], seeds=args.seeds[:1], episodes=2)
        args = replace(args, policy_steps=300, steps=200, tuning_steps=50)
    found: dict[tuple[str, str], list[EvaluationResult]] = {}
    for seed in args.seeds:
        for source in args.plans:
            for name, result in Bench(args, seed, source).run():
                found.setdefault((Path(source).stem, name), []).append(result)
                print(f"seed {seed}, {source}, {name}: {result.mean_success:.3f}", flush=True)
        write_text(args.out / "table.md", table(found))
    print(f"\n{table(found)}\nwritten to {args.out / 'table.md'}")


if __name__ == "__main__":
    torch.set_num_threads(1)
    main(tyro.cli(Arguments))
