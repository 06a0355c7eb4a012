"""QueryEvaluatorTrainer and ImageQueryEvaluatorTrainer: evaluators learn what the query answering function answers."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import asdict
from hashlib import blake2b
from typing import Any, ClassVar, Unpack

import torch
from torch import Tensor, nn

from lw_torchrl._checks import checked, passes_on
from lw_torchrl._devices import device_of, place
from lw_torchrl.modules.clause_evaluator import ClauseEvaluator
from lw_torchrl.modules.describe import describe
from lw_torchrl.modules.image_query_evaluator import ImageQueryEvaluator
from lw_torchrl.modules.state_query_evaluator import StateQueryEvaluator
from lw_torchrl.training.checkpoint import check_can_be_saved
from lw_torchrl.training.labelled_queries import Asked, ImageQueryEvaluatorConfig, LabelledQueries, QueryEvaluatorConfig
from lw_torchrl.training.loop import Training, TrainingOptions

_MOST_WEIGHT = 20.0  # of a rare truth, by the median


class _StateMinibatches:
    """Pairs of a state and a clause, equally many of each predicate and truth."""

    def __init__(self, evaluator: Any, asked: list[Asked], config: QueryEvaluatorConfig) -> None:
        self.evaluator, self.size = evaluator, config.batch_size
        self.observation = torch.cat([one.observation for one in asked])
        self.clauses = evaluator.code([(one.task, clause) for one in asked for clause in one.clauses])
        names = [clause.predicate for one in asked for clause in one.clauses]
        kinds = sorted({*names})
        kind = torch.tensor([2 * kinds.index(name) for name in names], dtype=torch.uint8)
        groups: list[list[Tensor]] = [[] for _ in range(2 * len(kinds))]
        row = first = 0
        for one in asked:
            rows, clauses = one.truth.shape
            begin, code = torch.tensor([row, first], dtype=torch.int32), kind[first : first + clauses] + one.truth
            for number, group in enumerate(groups):
                group.append((code == number).nonzero().int().add_(begin))
            row, first = row + rows, first + clauses
        parts = [torch.cat(group) for group in groups]
        self.pairs = torch.cat(parts)
        self.sizes = torch.tensor([len(part) for part in parts if len(part)])
        self.starts = self.sizes.cumsum(0) - self.sizes
        self.truths = torch.tensor([number % 2 == 1 for number, part in enumerate(parts) if len(part)])
        self.labels = _digest((self.observation, self.pairs, self.sizes))

    def draw(self, step: int, generator: torch.Generator) -> tuple[Tensor, Any, Tensor]:
        """Observation (B, 39) float32, clauses (B, 1) and their truth (B, 1) float32."""
        group = (torch.arange(self.size) + step * self.size) % len(self.sizes)
        place = (torch.rand(self.size, generator=generator, dtype=torch.float64) * self.sizes[group]).long()
        row, clause = self.pairs[self.starts[group] + place].long().unbind(-1)
        truth = self.truths[group]
        return self.observation[row], self.clauses.pick(clause[:, None]), truth[:, None].float()

    def loss(self, step: int, generator: torch.Generator) -> Tensor:
        observation, clauses, truth = self.draw(step, generator)
        device = device_of(self.evaluator)
        logits = self.evaluator.network(observation.to(device, non_blocking=True), clauses.to(device))
        return nn.functional.binary_cross_entropy_with_logits(logits, truth.to(device, non_blocking=True))


class _PictureMinibatches:
    """States, equally many of each task; of each all clauses are asked, and where its things are."""

    def __init__(self, evaluator: Any, asked: list[Asked], config: QueryEvaluatorConfig) -> None:
        if not isinstance(config, ImageQueryEvaluatorConfig):
            raise TypeError(f"config must be an ImageQueryEvaluatorConfig, got {type(config).__name__}")
        self.evaluator, self.asked, self.config = evaluator, asked, config
        for one in asked:
            evaluator.check_seen(one.seen("pixels"))
        self.coded = [evaluator.code([(one.task, clause) for clause in one.clauses]) for one in asked]
        self.weights = [_answer_weights(one) for one in asked]
        self.positions = [_known_positions(one, evaluator.names) for one in asked]
        self.labels = _digest(tensor for one in asked for tensor in (one.observation, one.truth, one.seen("pixels")))

    def loss(self, step: int, generator: torch.Generator) -> Tensor:
        each = max(1, self.config.batch_size // len(self.asked))
        return torch.stack([self._task_loss(task, each, generator) for task in range(len(self.asked))]).mean()

    def _task_loss(self, task: int, size: int, generator: torch.Generator) -> Tensor:
        asked, network, device = self.asked[task], self.evaluator.network, device_of(self.evaluator)
        coded = self.coded[task]
        rows = torch.randint(len(asked.observation), (size,), generator=generator)
        pixels, truth = asked.seen("pixels")[rows].to(device), asked.truth[rows].to(device)
        weights = self.weights[task].to(device).gather(0, truth.long())
        clauses = coded.pick(torch.arange(len(coded.predicate)).expand(size, -1)).to(device)
        places, _ = network.places(pixels, network.names.weight)
        logits = network.tell(places, clauses)
        which, known, counts = self.positions[task]
        known, counts = known[rows].to(device), counts.to(device)
        error = nn.functional.smooth_l1_loss(places[:, which.to(device)] / 0.05, known / 0.05, reduction="none")
        placed = (error * counts).sum() / (counts.sum() * size)
        errors = nn.functional.binary_cross_entropy_with_logits(logits, truth.float(), reduction="none")
        return (errors * weights).sum() / weights.sum() + self.config.position_weight * placed


def _known_positions(asked: Asked, known: tuple[str, ...]) -> tuple[Tensor, Tensor, Tensor]:
    """A task's things, (n,); where they are, and how far each is open, (R, n, 4); what counts, (n, 4)."""
    names = [name for name in asked.task.object_names if name in known]
    positions, openings = asked.task.positions(asked.observation), asked.task.openings
    found, counts = torch.zeros(len(asked.observation), len(names), 4), torch.ones(len(names), 4)
    for number, name in enumerate(names):
        found[:, number, :3] = positions[name]
        counts[number, 3] = name in openings
        if name in openings:
            found[:, number, 3] = asked.observation[:, openings[name]]
    return torch.tensor([known.index(name) for name in names], dtype=torch.int64), found, counts


def _answer_weights(asked: Asked) -> Tensor:
    """(2, Q) float32, of a clause's false and true answers: each predicate and truth weighs alike."""
    true = asked.truth.double().mean(0)
    names = [clause.predicate for clause in asked.clauses]
    weights = torch.zeros(2, len(names))
    for name in {*names}:
        own = torch.tensor([other == name for other in names])
        for value, share in ((0, (1 - true)[own].sum()), (1, true[own].sum())):
            weights[value, own] = float(1.0 / share) if share > 0 else 0.0
    return weights.clamp(max=_MOST_WEIGHT * weights.median().item())


def _digest(tensors: Iterable[Tensor]) -> str:
    digest = blake2b(digest_size=8)
    for tensor in tensors:
        digest.update(tensor.contiguous().numpy().tobytes())
    return digest.hexdigest()


class QueryEvaluatorTrainer(Training):
    """Trains an evaluator on the answers of the query answering function to all base queries of tasks.

    A minibatch depends only on the seed and the step. It has equally many pairs of a state and a clause of each
    predicate and truth. An evaluator that reads texts is asked half of the clauses negated.

    Args:
        evaluator: it is trained in place; its plans do not matter.
        data: what is asked, and what of it is held out.
        config: how to train, the one that the data were made with.
        device: where to train: "cpu", "cuda", "cuda:1", "mps", or "auto" for a GPU if there is one. The evaluator is
            moved there; None leaves it where it is.
        checkpoint, logger, progress, title: as of :class:`~lw_torchrl.training.loop.Training`, with its errors;
            :func:`load_evaluator` reads the file.

    Raises:
        TypeError: the evaluator is not a :class:`StateQueryEvaluator`.

    Example:
        >>> import lw_torchrl as lw, tempfile
        >>> with tempfile.TemporaryDirectory() as root:
        ...     _ = lw.collect_demonstrations("reach", episodes_per_task=2, root=root + "/demos", max_steps=80)
        ...     replay = lw.LanguageWorldExperienceReplay(root + "/demos", label="executed")
        ...     config = lw.training.QueryEvaluatorConfig(steps=200, batch_size=64, held_out_pairs=0.0)
        ...     data = lw.training.LabelledQueries(replay, config)
        ...     evaluator = lw.StateQueryEvaluator(lw.load_plans("MT10"))
        ...     lw.training.QueryEvaluatorTrainer(evaluator, data, config).train() < 0.65
        True
    """

    part = "evaluator"
    trains: ClassVar[type[ClauseEvaluator]] = StateQueryEvaluator
    minibatches: ClassVar[Callable[..., _StateMinibatches | _PictureMinibatches]] = _StateMinibatches

    @passes_on(Training.__init__)
    @checked
    def __init__(
        self,
        evaluator: ClauseEvaluator,
        data: LabelledQueries,
        config: QueryEvaluatorConfig | None = None,
        *,
        device: str | torch.device | None = None,
        **options: Unpack[TrainingOptions],
    ) -> None:
        if not isinstance(evaluator, self.trains):
            raise TypeError(f"evaluator must be of class {self.trains.__name__}, got {type(evaluator).__name__}")
        config = config or QueryEvaluatorConfig()
        options.setdefault("title", "training the evaluator")
        super().__init__(config, [], **options)
        self.evaluator, self.module, self.networks = evaluator, evaluator, [evaluator]
        self.device = place(evaluator, device)
        if not data.parts["training"]:
            raise ValueError("data must have states and queries to train on, all are held out")
        self._minibatches = type(self).minibatches(evaluator, data.parts["training"], config)
        trained, rate = [one for one in evaluator.parameters() if one.requires_grad], float(config.learning_rate)
        groups = [{"params": trained, "initial_lr": rate}]
        self.optimizer = torch.optim.AdamW(groups, lr=rate, weight_decay=config.weight_decay)
        if self.checkpoint is not None:
            check_can_be_saved(evaluator, "evaluator")
            described = data.describe() | {"labels": self._minibatches.labels}
            self.described = {"evaluator": describe(evaluator), "training": asdict(config), "data": described}
        self.resume()

    def state_dict(self) -> dict[str, Any]:
        return {"step": self.steps, "optimizer": self.optimizer.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.optimizer.load_state_dict(state["optimizer"])
        self.steps = state["step"]

    def step(self) -> Tensor:
        """Train on one minibatch and return its loss, () float32."""
        rate = 0.5 * self.config.learning_rate * (1.0 + math.cos(math.pi * self.steps / self.config.steps))
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        generator = torch.Generator().manual_seed((self.config.seed * 1_000_003 + self.steps) % 2**63)
        return self.descend(self._minibatches.loss(self.steps, generator))

    def train(self) -> float:
        """Train to the last step, from wherever training stands; Ctrl-C ends it between two steps, with a checkpoint.

        Returns:
            The mean loss over the last 100 steps made; NaN if there were none left to make.
        """
        return self.run().mean().item()


class ImageQueryEvaluatorTrainer(QueryEvaluatorTrainer):
    """Trains an evaluator of pictures, as :class:`QueryEvaluatorTrainer` does one of states.

    Each minibatch has equally many states of each task, and is asked all clauses; predicates and truths weigh alike.

    Raises:
        TypeError: the evaluator is no :class:`ImageQueryEvaluator`, or the configuration is of another class.
        ValueError: the rows have no pictures.

    Example:
        >>> import lw_torchrl as lw, tempfile
        >>> with tempfile.TemporaryDirectory() as root:
        ...     _ = lw.collect_demonstrations("reach", episodes_per_task=2, root=root, max_steps=40, progress=False)
        ...     lw.data.add_pictures(root, "corner", every=5)
        ...     replay = lw.LanguageWorldExperienceReplay(root, label="executed")
        ...     replay.add_column("pixels", lw.data.load_pictures(replay, "corner", every=5))
        ...     config = ImageQueryEvaluatorConfig(steps=2, batch_size=4, held_out_pairs=0.0)
        ...     data = lw.training.LabelledQueries(replay, config)
        ...     evaluator = lw.modules.ImageQueryEvaluator(lw.load_plans("MT10"), cameras="corner")
        ...     ImageQueryEvaluatorTrainer(evaluator, data, config).train() < 100.0
        True
    """

    trains = ImageQueryEvaluator
    minibatches = _PictureMinibatches
