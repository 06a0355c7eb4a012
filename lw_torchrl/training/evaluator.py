"""QueryEvaluatorTrainer: train a network on the exact answers to queries, from observations or from pictures."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict
from hashlib import blake2b
from typing import Any, Unpack

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from lw_torchrl._util.checks import check_value, typed
from lw_torchrl._util.devices import place
from lw_torchrl.modules.describe import describe
from lw_torchrl.modules.image_query_evaluator import ImageQueryEvaluator
from lw_torchrl.modules.query_evaluator import ClauseEvaluator, Clauses
from lw_torchrl.training.checkpoint import check_can_be_saved
from lw_torchrl.training.labelled_queries import (
    ImageQueryEvaluatorConfig,
    LabelledQueries,
    QueryEvaluatorConfig,
    TaskQueries,
)
from lw_torchrl.training.loop import Training, TrainingOptions, make_optimizer
from lw_torchrl.training.minibatches import Minibatches

_MOST_WEIGHT = 20.0  # maximum weight of a rare answer, as a multiple of the median weight


class _StateQueries:
    """A source of minibatches of (state, clause) pairs, equally many for each predicate and truth value."""

    def __init__(self, evaluator: ClauseEvaluator, tasks: list[TaskQueries]) -> None:
        self.observation = torch.cat([task.observation for task in tasks])
        self.clauses = evaluator.code([(task.task, clause) for task in tasks for clause in task.clauses])
        # Each (predicate, truth) group lists its (row, clause) pairs, as int32 to save memory.
        predicate = 2 * self.clauses.predicate.to(torch.uint8)
        groups: dict[int, list[Tensor]] = {}
        row = first = 0
        for task in tasks:
            rows, clauses = task.truth.shape
            code = predicate[first : first + clauses] + task.truth
            for number in code.unique().tolist():
                pairs = (code == number).nonzero().int()
                groups.setdefault(number, []).append(pairs + torch.tensor([row, first], dtype=torch.int32))
            row, first = row + rows, first + clauses
        parts = [torch.cat(groups[number]) for number in sorted(groups)]
        self.pairs, self.sizes = torch.cat(parts), torch.tensor([len(part) for part in parts])
        self.starts = self.sizes.cumsum(0) - self.sizes
        self.truths = torch.tensor([number % 2 == 1 for number in sorted(groups)])
        self.digest = _digest((self.observation, self.pairs, self.sizes))

    def draw(self, size: int) -> TensorDict:
        """Draw the indices of B states and clauses, and the clauses' truth, (B,) each, on the CPU."""
        # Begin at a random group, so that a batch with fewer pairs than there are groups does not favor any group.
        group = (torch.arange(size) + torch.randint(len(self.sizes), ())) % len(self.sizes)
        place = (torch.rand(size, dtype=torch.float64) * self.sizes[group]).long()
        row, clause = self.pairs[self.starts[group] + place].long().unbind(-1)
        return TensorDict(row=row, clause=clause, truth=self.truths[group])

    def rows(self, drawn: TensorDictBase) -> TensorDictBase:
        """Return ``observation`` (B, 39) float32, ``clauses`` (B, 1) and the clauses' ``truth`` (B, 1) float32 for a
        batch from :meth:`draw`, on the device of the batch."""
        truth, clauses = drawn["truth"][:, None].float(), self.clauses.pick(drawn["clause"][:, None])
        return TensorDict(observation=self.observation[drawn["row"]], truth=truth, clauses=_as_tensordict(clauses))

    def to(self, device: torch.device) -> None:
        """Move the states and clauses to a device."""
        self.observation, self.clauses = self.observation.to(device), Clauses(*(t.to(device) for t in self.clauses))

    @staticmethod
    def loss(network: Any, batch: TensorDictBase, config: Any) -> Tensor:
        logits = network(batch["observation"], Clauses(**batch["clauses"]))
        return nn.functional.binary_cross_entropy_with_logits(logits, batch["truth"])


class _PictureQueries:
    """A source of minibatches of images, equally many per task, with the clauses and object positions of each image."""

    def __init__(self, evaluator: ImageQueryEvaluator, tasks: list[TaskQueries]) -> None:
        for task in tasks:
            evaluator.check_seen(task.view("pixels"))
        self.tasks = tasks
        self.pixels, self.truths = [task.view("pixels") for task in tasks], [task.truth for task in tasks]
        self.clauses = [evaluator.code([(task.task, clause) for clause in task.clauses]) for task in tasks]
        self.weights = [_answer_weights(task) for task in tasks]
        self.positions = [_known_positions(task, evaluator.names) for task in tasks]
        self.digest = _digest(part for task in tasks for part in (task.observation, task.truth, task.view("pixels")))

    def draw(self, size: int) -> TensorDict:
        """Draw the indices of about ``size`` states in total, equally many of each task, on the CPU."""
        each = max(1, size // len(self.tasks))
        return TensorDict({task.task.name: torch.randint(len(task.observation), (each,)) for task in self.tasks})

    def rows(self, drawn: TensorDictBase) -> TensorDictBase:
        """Return a nested TensorDict for each task, for a result of :meth:`draw` and on the device of that result."""
        batch = TensorDict()
        for number, (task, pixels, truth) in enumerate(zip(self.tasks, self.pixels, self.truths, strict=True)):
            rows, clauses = drawn[task.task.name], self.clauses[number]
            objects, positions, known = self.positions[number]
            every = torch.arange(len(clauses.predicate), device=rows.device).expand(len(rows), -1)
            batch[task.task.name] = TensorDict(
                pixels=pixels[rows],
                truth=truth[rows].float(),
                weights=self.weights[number].gather(0, truth[rows].long()),
                clauses=_as_tensordict(clauses.pick(every)),
                objects=objects,
                positions=positions[rows],
                known=known,
            )
        return batch

    def to(self, device: torch.device) -> None:
        """Move the pictures, answers and clauses to a device."""
        for name in ("pixels", "truths", "weights"):
            setattr(self, name, [tensor.to(device) for tensor in getattr(self, name)])
        self.clauses = [Clauses(*(table.to(device) for table in clauses)) for clauses in self.clauses]
        self.positions = [(a.to(device), b.to(device), c.to(device)) for a, b, c in self.positions]

    @staticmethod
    def loss(network: Any, batch: TensorDictBase, config: Any) -> Tensor:
        """Return the weighted loss of the answers plus the loss of the objects' positions, averaged over tasks."""
        losses = []
        for states in batch.values():
            places, _ = network.places(states["pixels"], network.names.weight)
            logits = network.judge_at(places, Clauses(**states["clauses"]))
            errors = nn.functional.binary_cross_entropy_with_logits(logits, states["truth"], reduction="none")
            answers = (errors * states["weights"]).sum() / states["weights"].sum()
            located, known = places.index_select(1, states["objects"]), states["known"]
            # Errors are measured in units of 5 cm, so that both terms have about the same size.
            errors = nn.functional.smooth_l1_loss(located / 0.05, states["positions"] / 0.05, reduction="none")
            losses.append(answers + config.position_weight * (errors * known).sum() / (known.sum() * len(errors)))
        return torch.stack(losses).mean()


def _as_tensordict(clauses: Clauses) -> TensorDict:
    return TensorDict(dict(zip(Clauses._fields[:7], clauses[:7], strict=True)))


def _known_positions(queries: TaskQueries, names: tuple[str, ...]) -> tuple[Tensor, Tensor, Tensor]:
    """Return the indices (n,) int64 of a task's objects in ``names``, the values (R, n, 4) float32, and a mask (n, 4).

    The four values are an object's coordinates and its opening (how far the object is open). The mask is 1 for values
    that are known.
    """
    own = [name for name in queries.task.object_names if name in names]
    positions, openings = queries.task.positions(queries.observation), queries.task.openings
    values, known = torch.zeros(len(queries.observation), len(own), 4), torch.ones(len(own), 4)
    for number, name in enumerate(own):
        values[:, number, :3] = positions[name]
        known[number, 3] = name in openings
        if name in openings:
            values[:, number, 3] = queries.observation[:, openings[name]]
    return torch.tensor([names.index(name) for name in own], dtype=torch.int64), values, known


def _answer_weights(queries: TaskQueries) -> Tensor:
    """Return weights (2, Q) float32 for a clause's false and true answers, to balance predicates and truth values."""
    true, predicates = queries.truth.double().mean(0), [clause.predicate for clause in queries.clauses]
    weights = torch.zeros(2, len(predicates))
    for predicate in {*predicates}:
        own = torch.tensor([other == predicate for other in predicates])
        for value, share in ((0, (1 - true)[own].sum()), (1, true[own].sum())):
            weights[value, own] = float(1.0 / share) if share > 0 else 0.0
    return weights.clamp(max=_MOST_WEIGHT * weights.median().item())


def _digest(tensors: Iterable[Tensor]) -> str:
    digest = blake2b(digest_size=8)
    for tensor in tensors:
        digest.update(tensor.contiguous().numpy().tobytes())
    return digest.hexdigest()


class QueryEvaluatorTrainer(Training):
    """A trainer that fits an evaluator of observations or pictures to the exact answers to all base queries of tasks.

    A base query is a single clause, such as "the gripper is near the puck". A minibatch of observations holds equally
    many (state, clause) pairs of each predicate and truth value. A minibatch of pictures holds equally many states of
    each task, with all clauses of the task; weights in the loss balance predicates and truth values.

    Args:
        evaluator: the evaluator, trained in place; the evaluator's plans do not affect training.
        data: the queries and their answers, some of which are held out.
        config: the config from which ``data`` was built; pictures require an :class:`ImageQueryEvaluatorConfig`.
        device: the device to train on, see :class:`BehavioralCloningTrainer`; states and pictures are kept there.
        **options: keyword arguments of :class:`~lw_torchrl.training.loop.Training`, which also lists their errors.
            :func:`load_evaluator` reads the checkpoint.

    Raises:
        TypeError: the evaluator reads pictures, and ``config`` is not an :class:`ImageQueryEvaluatorConfig`.
        ValueError: all data are held out, or the evaluator reads pictures and the data have no pictures.

    Example:
        >>> import lw_torchrl as lw, tempfile
        >>> root, plans = tempfile.mkdtemp(), lw.load_plans("MT10")
        >>> _ = lw.collect_demonstrations("reach", episodes_per_task=2, root=root, max_steps=40, progress=False)
        >>> replay = lw.LanguageWorldExperienceReplay(root, label="executed")
        >>> config = lw.training.QueryEvaluatorConfig(steps=200, batch_size=64, held_out_pairs=0.0)
        >>> data = lw.training.LabelledQueries(replay, config)
        >>> lw.training.QueryEvaluatorTrainer(lw.modules.StateQueryEvaluator(plans), data, config).train() < 0.65
        True

        From pictures:

        >>> lw.data.add_pictures(root, "corner", every=5, progress=False)
        >>> replay.add_column("pixels", lw.data.load_pictures(replay, "corner", every=5))
        >>> config = lw.training.ImageQueryEvaluatorConfig(steps=2, batch_size=4, held_out_pairs=0.0)
        >>> data = lw.training.LabelledQueries(replay, config)
        >>> evaluator = lw.modules.ImageQueryEvaluator(plans, cameras="corner")
        >>> lw.training.QueryEvaluatorTrainer(evaluator, data, config).train() < 100.0
        True
    """

    part = "evaluator"

    @typed
    def __init__(
        self,
        evaluator: ClauseEvaluator,
        data: LabelledQueries,
        config: QueryEvaluatorConfig | None = None,
        *,
        device: str | torch.device | None = None,
        **options: Unpack[TrainingOptions],
    ) -> None:
        config = config or QueryEvaluatorConfig()
        options.setdefault("title", "training the evaluator")
        super().__init__(config, **options)
        self.evaluator, self.module, self.networks = evaluator, evaluator, [evaluator]
        self.device = place(evaluator, device)
        if not (tasks := data.parts["training"]):
            raise ValueError("data must hold states and queries to train on, but all are held out")
        queries: _StateQueries | _PictureQueries
        if isinstance(evaluator, ImageQueryEvaluator):
            check_value("config", config, ImageQueryEvaluatorConfig)
            queries = _PictureQueries(evaluator, tasks)
        else:
            queries = _StateQueries(evaluator, tasks)
        self._loss = queries.loss
        queries.to(self.device)
        self.minibatches = [Minibatches(queries, config.batch_size, config.seed, self.device)]
        trained = [parameter for parameter in evaluator.parameters() if parameter.requires_grad]
        self.optimizer = make_optimizer([(trained, config.learning_rate)], config, self.device)
        if self.checkpoint is not None:
            check_can_be_saved(evaluator, "evaluator")
            described = data.describe() | {"labels": queries.digest}
            self.description = {"evaluator": describe(evaluator), "training": asdict(config), "data": described}
        self.resume()

    def losses(self, batch: TensorDictBase) -> Mapping[str, Tensor]:
        return {"loss": self._loss(self.evaluator.network, batch, self.config)}
