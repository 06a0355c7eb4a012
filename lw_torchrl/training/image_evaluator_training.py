"""ImageQueryEvaluatorTrainer: an ImageQueryEvaluator learns what the query answering function answers."""

from __future__ import annotations

from dataclasses import dataclass
from hashlib import blake2b

import torch
from torch import Tensor, nn

from lw_torchrl._checks import check_scale
from lw_torchrl.language.named_objects import GRIPPER
from lw_torchrl.language.observation import OPENING
from lw_torchrl.modules.image_query_evaluator import ImageQueryEvaluator
from lw_torchrl.training.evaluator_training import QueryEvaluatorTrainer
from lw_torchrl.training.labelled_queries import Asked, LabelledQueries, QueryEvaluatorConfig

_MOST_WEIGHT = 20.0  # of a rare truth, by the median


@dataclass(frozen=True)
class ImageQueryEvaluatorConfig(QueryEvaluatorConfig):
    """How an evaluator of pictures is trained, as :class:`QueryEvaluatorConfig`, but that a minibatch is of states.

    Attributes:
        batch_size: states in a minibatch, each asked all clauses of its task.
        position_weight: of the error in the things' positions, in units of 5 cm, and in how far the gripper is open, in
            the loss, of an evaluator with ``structure``: the simulator knows them. 0 to learn from answers alone.
    """

    steps: int = 4000
    batch_size: int = 48
    learning_rate: float = 1e-3
    every: int = 5
    position_weight: float = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        check_scale("position_weight", self.position_weight)


class ImageQueryEvaluatorTrainer(QueryEvaluatorTrainer):
    """Trains an evaluator of pictures on the answers of the query answering function to all base queries of tasks.

    A minibatch has equally many states of each task; of each state all clauses are asked, and each predicate and truth
    weighs alike. Arguments, errors and files are as for :class:`QueryEvaluatorTrainer`.

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
    evaluator: ImageQueryEvaluator
    config: ImageQueryEvaluatorConfig

    def _gather(self, data: LabelledQueries) -> None:
        """Of each task its clauses, the weight of each answer, and where its things are."""
        if not isinstance(self.config, ImageQueryEvaluatorConfig):
            raise TypeError(f"config must be an ImageQueryEvaluatorConfig, got {type(self.config).__name__}")
        self._asked = data.parts["training"]
        if not self._asked:
            raise ValueError("data must have states and queries to train on, all are held out")
        for one in self._asked:
            self.evaluator.check_seen(one.seen("pixels"))
        coded = [self.evaluator.code([(one.task, clause) for clause in one.clauses]) for one in self._asked]
        self._coded = [clauses for clauses, _ in coded]
        self._vectors_of = [vectors for _, vectors in coded]
        self._weights = _weights(self._asked)
        self._places = [self._known(one) for one in self._asked]
        digest = blake2b(digest_size=8)
        for one in self._asked:
            for tensor in (one.observation, one.truth, one.seen("pixels")):
                digest.update(tensor.contiguous().numpy().tobytes())
        self._digest = digest.hexdigest()

    def _known(self, asked: Asked) -> tuple[Tensor, Tensor, Tensor]:
        """The things of a task, (n,) int64; where they are, (R, n, 4) float32; and what of that counts, (n, 4)."""
        names = [name for name in asked.task.object_names if name in self.evaluator.names]
        positions, number = asked.task.positions(asked.observation), self.evaluator.names.index
        known = torch.zeros(len(asked.observation), len(names), 4)
        counts = torch.ones(len(names), 4)
        for place, name in enumerate(names):
            known[:, place, :3] = positions[name]
            known[:, place, 3] = asked.observation[:, OPENING]
            counts[place, 3] = name == GRIPPER
        return torch.tensor([number(name) for name in names], dtype=torch.int64), known, counts

    def _loss(self) -> Tensor:
        generator = torch.Generator().manual_seed((self.config.seed * 1_000_003 + self.done) % 2**63)
        each = max(1, self.config.batch_size // len(self._asked))
        losses = [self._loss_of(task, each, generator) for task in range(len(self._asked))]
        return torch.stack(losses).mean()

    def _loss_of(self, task: int, size: int, generator: torch.Generator) -> Tensor:
        """Of so many states of a task."""
        asked, network = self._asked[task], self.evaluator.network
        rows = torch.randint(len(asked.observation), (size,), generator=generator)
        pixels, truth = asked.seen("pixels")[rows], asked.truth[rows]
        clauses = self._coded[task].pick(torch.arange(len(self._coded[task].predicate)).expand(size, -1))
        placed = torch.zeros(())
        if self.evaluator.names:
            places, _ = network.places(pixels, network.names.weight)
            logits = network.tell(places, clauses)
            which, known, counts = self._places[task]
            error = nn.functional.smooth_l1_loss(places[:, which] / 0.05, known[rows] / 0.05, reduction="none")
            placed = (error * counts).sum() / (counts.sum() * size)
        else:
            logits = network(pixels, clauses, self._vectors_of[task])
            truth = torch.cat((truth, ~truth), -1)
        weights = self._weights[task].gather(0, asked.truth[rows].long())
        if not self.evaluator.names:
            weights = torch.cat((weights, weights), -1)
        errors = nn.functional.binary_cross_entropy_with_logits(logits, truth.float(), reduction="none")
        return (errors * weights).sum() / weights.sum() + self.config.position_weight * placed


def _weights(asked: list[Asked]) -> list[Tensor]:
    """For each task (2, Q) float32, the weight of a clause's false and true answers, by which each predicate and truth
    weighs alike."""
    found = []
    for one in asked:
        true = one.truth.double().mean(0)
        names = [clause.predicate for clause in one.clauses]
        weights = torch.zeros(2, len(names))
        for name in {*names}:
            own = torch.tensor([other == name for other in names])
            for value, share in ((0, (1 - true)[own].sum()), (1, true[own].sum())):
                weights[value, own] = float(1.0 / share) if share > 0 else 0.0
        found.append(weights.clamp(max=_MOST_WEIGHT * weights.median().item()))
    return found
