"""Offline runs: learn advantages and policies from mixtures of behaviours, and write tables of the results."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import Tensor
from torchrl.objectives import CQLLoss, IQLLoss, LossModule, TD3BCLoss

from benchmarks.figures import markdown_table
from benchmarks.paper import recipes
from benchmarks.paper.actors import Parts
from benchmarks.paper.comparison import compare, plot_methods, write_summary
from benchmarks.paper.offline_losses import L1CQLLoss, L1IQLLoss, L1TD3BCLoss
from benchmarks.paper.recipes import OfflineMethod, OfflineRecipe, OfflineTable, Portion
from benchmarks.paper.runs import Dataset, Run, Work, kept_policy, own_tasks, plain
from lw_torchrl._util.checks import check_choice
from lw_torchrl._util.files import locked
from lw_torchrl._util.tensor_files import read_tensors, write_tensors
from lw_torchrl.data import BEHAVIOURS, LanguageWorldExperienceReplay, TaskBalancedSampler
from lw_torchrl.evaluation import EvaluationResult
from lw_torchrl.language.plans import Plans
from lw_torchrl.modules import ObservationFeatures, QValue, Value, descriptor_trunk, plan_trunk
from lw_torchrl.objectives import AdvantageWeightedLoss, ExpectileValueLoss, standardize_by_task
from lw_torchrl.training import OfflineConfig, OfflineTrainer
from lw_torchrl.training.checkpoint import check_description
from lw_torchrl.training.cloning import bc_loss
from lw_torchrl.transforms import QAFTransform

CONDITIONS: Mapping[str, str] = {"pcbc": "plan", "dc": "description", "one-hot": "one-hot"}
"""The input that a network is conditioned on, as named in folders and tables, for each name in :data:`METHODS`."""
_SEEDS = 100  # number of seeds reserved for each behaviour, so that no two behaviours share initial states
_CHUNK = 20_000  # number of rows whose advantages are computed at once
_FORMAT = {"format": "lw_torchrl.advantages", "version": 1}


@dataclass(frozen=True)
class BehaviourDataset(Dataset):
    """A dataset of the episodes of one portion, which several mixtures share."""

    tasks: str  # a name of :data:`TASK_SETS`
    portion: Portion  # the behaviour and the number of episodes
    seed: int  # seed of the experiment, from 0 to 99
    max_steps: int = 500  # maximum number of steps per episode

    @property
    def folder(self) -> Path:
        return Path("data") / self.tasks / f"{self.portion.behaviour}-x{self.portion.episodes}-seed{self.seed}"

    @property
    def options(self) -> dict[str, Any]:
        behaviour = self.portion.behaviour
        seed = _SEEDS * list(BEHAVIOURS).index(behaviour) + self.seed
        found = {"tasks": recipes.TASK_SETS[self.tasks], "policy": behaviour, "max_steps": self.max_steps}
        return {**found, "episodes_per_task": self.portion.episodes, "seed": seed, **recipes.NOISE[behaviour]}


@dataclass(frozen=True)
class _Learned:
    """A base class of advantages and policies that are learned from a mixture."""

    tasks: str  # a name of :data:`TASK_SETS`
    mixture: str  # a name of :data:`MIXTURES`
    seed: int  # seed of the data, the initial weights and the minibatches
    recipe: OfflineRecipe = field(default_factory=OfflineRecipe)  # the hyperparameters
    max_steps: int = 500  # maximum number of steps per episode

    def __post_init__(self) -> None:
        check_choice("tasks", self.tasks, recipes.TASK_SETS)
        check_choice("mixture", self.mixture, recipes.MIXTURES)
        if not 0 <= self.seed < 100:
            raise ValueError(f"seed must be from 0 to 99, got {self.seed}")

    @property
    def group(self) -> Path:
        """The folder of everything that is learned from the same mixture for the same tasks."""
        return Path(self.tasks) / self.mixture

    @property
    def datasets(self) -> tuple[BehaviourDataset, ...]:
        portions = recipes.MIXTURES[self.mixture]
        return tuple(BehaviourDataset(self.tasks, one, self.seed, self.max_steps) for one in portions)

    def own_plans(self, plans: Plans) -> Plans:
        return Plans([plans[task] for task in recipes.TASK_SETS[self.tasks]])

    def describe(self, plans: Plans) -> dict[str, Any]:
        """Return everything on which the result depends, as JSON."""
        data = [asdict(dataset.portion) | recipes.NOISE[dataset.portion.behaviour] for dataset in self.datasets]
        own = self.own_plans(plans)
        return plain(asdict(self) | {"plans": own.fingerprint, "data": data} | own_tasks(own))

    def _replay(self, plans: Plans, out: Path, n_steps: bool, **options: Any) -> LanguageWorldExperienceReplay:
        recipe, roots = self.recipe, [out / dataset.folder for dataset in self.datasets]
        if n_steps:
            options |= {"n_steps": recipe.n_steps, "gamma": recipe.gamma if recipe.n_steps > 1 else None}
        options |= {"label": "executed", "terminate_on_success": True, "reward": recipe.reward}
        sampler, transform = TaskBalancedSampler(exact=True), QAFTransform(plans)
        return LanguageWorldExperienceReplay(roots, sampler=sampler, transform=transform, **options)

    def _config(self, steps: int) -> OfflineConfig:
        return OfflineConfig(steps=steps, batch_size=self.recipe.batch_size, seed=self.seed)


@dataclass(frozen=True)
class Advantages(_Learned):
    """The advantage of each row of a mixture, from a value network trained on it; see :class:`OfflineRun`."""

    critic: str = "pcbc"

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choice("critic", self.critic, CONDITIONS)

    @property
    def folder(self) -> Path:
        return self.group / "advantages" / CONDITIONS[self.critic] / f"seed{self.seed}"

    def make(self, plans: Plans, out: Path, progress: bool) -> dict[str, Tensor]:
        """Return ``advantage`` (R, 1) float32, standardized per task; it is learned once and stored in a file."""
        file = out / self.folder / "advantages.safetensors"
        described = _FORMAT | {"run": self.describe(plans)}
        with locked(file, "out", wait=True):
            if not file.is_file():
                for dataset in self.datasets:
                    dataset.collect(out, progress)
                self._learn(file, described, self.own_plans(plans), out, progress)
        try:
            stored, advantages = read_tensors(file)
        except ValueError as error:
            raise ValueError(f"out: {str(file)!r} is corrupted ({error}); delete it to learn it again") from error
        check_description(file, described, stored)
        return advantages

    def _learn(self, file: Path, described: dict[str, Any], plans: Plans, out: Path, progress: bool) -> None:
        recipe = self.recipe
        torch.manual_seed(self.seed)
        value = Value(_trunk(self.critic, plans, noise=0.02), ensemble=2, width=recipe.width, depth=recipe.critic_depth)
        loss = ExpectileValueLoss(value, expectile=recipe.expectile).make_value_estimator(gamma=recipe.gamma)
        replay = self._replay(plans, out, n_steps=True)
        checkpoint, config = file.with_name("checkpoint.safetensors"), self._config(recipe.value_steps)
        title = f"value by {CONDITIONS[self.critic]}, {self.mixture}"
        OfflineTrainer(loss, replay, config, checkpoint=checkpoint, progress=progress, title=title).train()
        starts = range(0, len(replay), _CHUNK)
        chunks = [replay[start : min(start + _CHUNK, len(replay))] for start in starts]
        advantages = torch.cat([loss.advantage(chunk) for chunk in chunks])
        found = standardize_by_task(advantages, torch.cat([chunk["task_id"] for chunk in chunks]))
        write_tensors(file, described, {"advantage": found})
        checkpoint.unlink()


@dataclass(frozen=True)
class OfflineRun(_Learned, Run):
    """A run that learns a policy from a mixture and evaluates it."""

    method: str = "advantage"  # a name of :data:`OFFLINE_METHODS`
    actor: str = "pcbc"  # the conditioning of the policy, a name of :data:`METHODS`
    critic: str = "pcbc"  # the conditioning of the critic, if the method has one
    episodes: int = 20  # evaluation episodes per task

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choice("method", self.method, recipes.OFFLINE_METHODS)
        for name in ("actor", "critic"):
            check_choice(name, getattr(self, name), CONDITIONS)

    @property
    def how(self) -> OfflineMethod:
        return recipes.OFFLINE_METHODS[self.method]

    @property
    def label(self) -> str:
        if not self.how.critic or self.critic == self.actor:
            return f"{self.method}, {CONDITIONS[self.actor]}"
        return f"{self.method}, {CONDITIONS[self.actor]}, critic {CONDITIONS[self.critic]}"

    @property
    def folder(self) -> Path:
        return self.group / self.label.replace(", ", "-").replace(" ", "-") / f"seed{self.seed}"

    @property
    def scope(self) -> tuple[str, ...]:
        return recipes.TASK_SETS[self.tasks]

    @property
    def advantages(self) -> Advantages | None:
        """The advantages that weight the rows; None if the method does not weight rows by advantage."""
        if self.how.loss != "advantage":
            return None
        return Advantages(self.tasks, self.mixture, self.seed, self.recipe, self.max_steps, self.critic)

    def describe(self, plans: Plans) -> dict[str, Any]:
        without = {"episodes"} if self.how.critic else {"episodes", "critic"}
        described = {key: value for key, value in super().describe(plans).items() if key not in without}
        return described | {"how": plain(asdict(self.how))}

    def learn(self, work: Work) -> tuple[TensorDictModuleBase, dict[str, Any]]:
        def train(checkpoint: Path) -> dict[str, Any]:
            recipe, own = self.recipe, self.own_plans(work.plans)
            learns_values = self.how.critic and self.advantages is None
            replay = self._replay(own, work.out, learns_values, keep=self.how.keep)
            if (advantages := self.advantages) is not None:
                replay.add_column("advantage", advantages.make(work.plans, work.out, work.progress)["advantage"])
            torch.manual_seed(self.seed)
            actor = _actor(self.actor, own, recipe, DISTRIBUTIONS[self.how.loss])
            loss = _make_loss(self, actor, own)
            if learns_values:
                loss.make_value_estimator(gamma=recipe.gamma)
            options: dict[str, Any] = {"checkpoint": checkpoint, "progress": work.progress, "title": self.label}
            OfflineTrainer(loss, replay, self._config(recipe.steps), **options).train()
            return {"actor": actor, "replay": replay}

        return kept_policy(work.out / self.folder / "policy.safetensors", {"run": self.describe(work.plans)}, train), {}

    def evaluate(self, policy: TensorDictModuleBase, work: Work) -> tuple[EvaluationResult, dict[str, Any]]:
        return self.rollouts(policy, work, max_steps=self.max_steps), {}


def _actor(condition: str, plans: Plans, recipe: OfflineRecipe, distribution: Any) -> TensorDictModuleBase:
    """Return an actor. An actor with a distribution keeps the noise of its features."""
    parts = Parts(feature_noise=recipe.feature_noise, width=recipe.width, depth=recipe.depth)
    actor: Any = parts.actor(condition, plans)
    if distribution is not None:
        actor = actor.stochastic(distribution)
        actor.trunk.features.noise = recipe.feature_noise
    return actor  # type: ignore[no-any-return]


def _trunk(condition: str, plans: Plans, noise: float = 0.0) -> TensorDictSequential:
    """Return the trunk of a critic, with the same parts as in actors with the same conditioning."""
    features = ObservationFeatures(noise=noise)
    if condition == "pcbc":
        return plan_trunk(plans, features=features)
    return descriptor_trunk(
        [plan.definition for plan in plans.values()], condition=CONDITIONS[condition], features=features
    )  # type: ignore[arg-type]


DISTRIBUTIONS = {
    "advantage": None, "bc": None, "td3-bc": None, "td3-bc-l1": None, "iql": "normal", "iql-l1": "normal",
    "cql": "tanh_normal", "cql-l1": "tanh_normal",
}  # fmt: skip
"""The action distribution that each loss requires of its actor, by the loss's name."""


def _make_loss(run: OfflineRun, actor: TensorDictModuleBase, plans: Plans) -> LossModule:
    recipe, name = run.recipe, run.how.loss
    if name == "bc":
        return bc_loss(actor, recipe.distance)
    if name == "advantage":
        weighted: dict[str, Any] = {"beta": recipe.beta, "max_weight": recipe.max_weight}
        return AdvantageWeightedLoss(actor, loss_function=recipe.distance, **weighted)
    critic: dict[str, Any] = {"width": recipe.width, "depth": recipe.critic_depth}
    # The order in which networks are created determines their initial weights.
    value = Value(_trunk(run.critic, plans), **critic) if name in ("iql", "iql-l1") else None
    q = QValue(_trunk(run.critic, plans), **critic)
    pair: dict[str, Any] = {"num_qvalue_nets": 2, "loss_function": "l2"}
    if name == "iql":
        return IQLLoss(actor, q, value, expectile=recipe.expectile, temperature=recipe.temperature, **pair)
    if name == "iql-l1":
        weights: dict[str, Any] = {"temperature": recipe.beta, "max_weight": recipe.max_weight}
        return L1IQLLoss(actor, q, value, expectile=recipe.expectile, **weights, **pair)
    if name in ("td3-bc", "td3-bc-l1"):
        kind, alpha = (TD3BCLoss, recipe.alpha) if name == "td3-bc" else (L1TD3BCLoss, recipe.alpha_l1)
        return kind(actor, q, bounds=(-1.0, 1.0), alpha=alpha, delay_actor=True, **pair)
    # TorchRL adds the sampled actions as rows. With one or with ten samples, each soft maximum is over three actions.
    options: dict[str, Any] = {"loss_function": "l2", "min_q_weight": recipe.cql_weight, "num_random": 1}
    return CQLLoss(actor, q, **options) if name == "cql" else L1CQLLoss(actor, q, alpha=recipe.alpha_l1, **options)


def offline_runs(
    table: OfflineTable, seeds: Iterable[int], recipe: OfflineRecipe, episodes: int, max_steps: int = 500
) -> list[OfflineRun]:
    """Return a run for each row of a table and each seed."""
    return [
        OfflineRun(table.tasks, mixture, seed, recipe, max_steps, *row, episodes)
        for mixture, rows in table.rows.items()
        for row in rows
        for seed in seeds
    ]


def write_table(
    name: str, runs: Sequence[OfflineRun], results: Mapping[OfflineRun, EvaluationResult], out: Path
) -> str:
    """Write a table as Markdown, numbers and figure to ``out``; return its first part, to print."""
    mixtures = dict.fromkeys(run.mixture for run in runs)
    compared = {one: compare((run, results[run]) for run in runs if run.mixture == one) for one in mixtures}
    rows = []
    for label in dict.fromkeys(run.label for run in runs):
        means = [str(one.summaries[label].mean) if label in one.summaries else "" for one in compared.values()]
        rows.append([label, *means])
    head = markdown_table(["method, conditioned on", *compared], rows)
    about = "Brackets are 95 % intervals, Student's t over seeds."
    parts = [f"# {name}: {runs[0].tasks} tasks, mean success", head, about]
    for mixture, one in compared.items():
        portions = ", ".join(f"{part.episodes} {part.behaviour}" for part in recipes.MIXTURES[mixture])
        parts += [f"## {mixture}: of each task {portions}", one.headline(), one.per_task()]
    numbers = {mixture: one.to_json() for mixture, one in compared.items()}
    write_summary(out / name, "\n\n".join(parts) + "\n", numbers)
    plot_methods({mixture: one.summaries for mixture, one in compared.items()}, out / f"{name}.png")
    return head
