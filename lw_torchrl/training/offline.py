"""OfflineTrainer: any of TorchRL's losses, or of ours, over a buffer, in steps that resume bit for bit."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from hashlib import sha256
from typing import Any, Literal, Unpack

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch.nn.utils import clip_grad_norm_
from torchrl.data import TensorDictReplayBuffer
from torchrl.envs import MultiStepTransform
from torchrl.objectives import LossModule, SoftUpdate

from lw_torchrl._checks import Count, Positive, Probability, Scale, check_fields, checked, passes_on
from lw_torchrl.data.replay_checks import check_minibatches
from lw_torchrl.objectives.reduction import with_n_steps
from lw_torchrl.training.descriptions import describe_data, describe_replay, plain_options
from lw_torchrl.training.loop import READ_EVERY, ReplayState, Training, TrainingOptions, make_schedule
from lw_torchrl.training.normalization import fit_untrained

_INSTEAD = {"loss_actor_bc"}  # minimised in place of another entry: in CQL's first steps of the actor


@dataclass(frozen=True)
class OfflineConfig:
    """How a loss is trained over a buffer, by AdamW. What is not said here is as of :class:`BehavioralCloningConfig`.

    Attributes:
        learning_rate: of the loss's actor, at the start.
        critic_learning_rate: of everything else that it trains.
        target_eps: how much of target networks stays at a step, where the loss has any.
        normalize: first take the features' statistics from the buffer; False for networks trained before on others.
        max_grad_norm: the actor's gradients, and those of all else, are clipped to it.
    """

    steps: Count = 5000
    batch_size: Count = 250
    learning_rate: Scale = 1e-3
    critic_learning_rate: Scale = 5e-4
    weight_decay: Scale = 1e-4
    target_eps: Probability = 0.995
    schedule: Literal["cosine", "constant"] = "cosine"
    normalize: bool = True
    max_grad_norm: Positive = 1.0
    seed: int = 0
    checkpoint_every: Count = 1000

    def __post_init__(self) -> None:
        check_fields(self)


class OfflineTrainer(Training):
    """Trains what a loss holds on a buffer's minibatches: a step minimises the sum of the loss's ``loss_`` entries,
    each of which reaches its own network alone, and moves its targets. CQL's ``loss_actor_bc`` is left out.

    Args:
        loss: of ``torchrl.objectives`` or ``lw_torchrl.objectives``, with its value estimator; networks are trained in
            place, on the device where they are, in train mode, and are in eval mode afterwards.
        replay: samples with what the loss reads.
        config, checkpoint, logger, progress, title: as of :class:`~lw_torchrl.training.loop.Training`, with its errors.

    Attributes:
        last: the means over the last 100 steps of what the loss gives, by name.

    Raises:
        ValueError: a buffer that answers the queries of other plans, or draws by priorities; a loss whose value
            estimator has another gamma than the buffer's n steps, that gives no mean, or CQL's with a Lagrange
            multiplier; networks that were trained with other statistics, where ``normalize``.
        TypeError: the loss is none of TorchRL's kind.

    Example:
        >>> import lw_torchrl as lw, tempfile
        >>> plans = lw.load_plans("MT10")
        >>> with tempfile.TemporaryDirectory() as root:
        ...     _ = lw.collect_demonstrations("reach", episodes_per_task=1, root=root + "/data", policy="random")
        ...     options = {"label": "executed", "n_steps": 5, "gamma": 0.99, "transform": lw.QAFTransform(plans)}
        ...     replay = lw.LanguageWorldExperienceReplay(root + "/data", **options)
        ...     loss = lw.objectives.ExpectileValueLoss(lw.PlanConditionedValue(plans)).make_value_estimator(gamma=0.99)
        ...     trainer = lw.OfflineTrainer(loss, replay, lw.OfflineConfig(steps=5, batch_size=16), progress=False)
        ...     trainer.train()
        >>> sorted(trainer.last)
        ['loss_value', 'value']

    Source: ``torchrl.trainers.Trainer``, without an environment.
    """

    @passes_on(Training.__init__)
    @checked
    def __init__(
        self,
        loss: LossModule,
        replay: TensorDictReplayBuffer,
        config: OfflineConfig | None = None,
        **options: Unpack[TrainingOptions],
    ) -> None:
        check_loss(loss, replay)
        config = config or OfflineConfig()
        super().__init__(config, [replay], **options)
        self.loss, self.module, self.replay, self.networks = loss, loss, replay, networks_of(loss)
        self.device = next(loss.parameters()).device
        check_minibatches(self.networks, replay, config.batch_size)
        getattr(loss, "target_entropy", None)  # SAC's is a buffer from the first time on that it is asked for
        self.states = [ReplayState(replay, config.seed)]
        delayed = any(name.startswith("target_") and name.endswith("_params") for name, _ in loss.named_children())
        self.targets = SoftUpdate(loss, eps=config.target_eps) if delayed else None
        trained = [(name, parameter) for name, parameter in loss.named_parameters() if parameter.requires_grad]
        actor = [parameter for name, parameter in trained if name.startswith("actor_network_params")]
        others = [parameter for name, parameter in trained if not name.startswith("actor_network_params")]
        rates = (actor, config.learning_rate), (others, config.critic_learning_rate)
        groups = [{"params": group, "lr": float(rate)} for group, rate in rates if group]
        self.optimizer = torch.optim.AdamW(groups, weight_decay=config.weight_decay, fused=True)
        self.schedule = make_schedule(config.schedule, self.optimizer, config.steps)
        self.last: dict[str, float] = {}
        self._given: deque[Mapping[str, Tensor]] = deque(maxlen=READ_EVERY)
        if self.checkpoint is not None:
            self.described = {"loss": describe_loss(loss), "training": asdict(config)}
            self.described |= {"data": describe_data(replay), "replay": describe_replay(replay)}
        if config.normalize:
            fit_untrained(loss, replay)
        self.resume()

    def contents(self) -> dict[str, Tensor]:
        """The live tensors of the loss; target networks and statistics among them."""
        return {**dict(self.loss.named_parameters()), **dict(self.loss.named_buffers())}

    def step(self) -> TensorDictBase:
        """Train on one minibatch and return what the loss gives, detached."""
        (state,) = self.states
        with state.drawing(self.device):
            batch = state.minibatch(self.config.batch_size, self.device)
            found = self.loss(with_n_steps(self.loss, batch))
        self.descend(sum_of_losses(found))
        if self.targets is not None:
            self.targets.step()
        self._given.append(found.detach())
        return found.detach()

    def clip_gradients(self) -> None:
        for group in self.optimizer.param_groups:
            clip_grad_norm_(group["params"], self.config.max_grad_norm)

    def means(self, losses: Tensor) -> dict[str, float]:
        """Of what the loss gave since they were last asked for."""
        given = list(self._given)
        self._given.clear()
        names = [name for name, value in given[0].items() if value.numel() == 1]
        self.last = {name: float(torch.stack([one[name].reshape(()) for one in given]).mean()) for name in names}
        return self.last

    def train(self) -> None:
        """Train to the last step, from wherever training stands; Ctrl-C as in :class:`BehavioralCloningTrainer`."""
        self._given.clear()
        self.run()


def networks_of(loss: LossModule) -> list[nn.Module]:
    """The networks that a loss holds, without their parameters."""
    found = (getattr(loss, name.removesuffix("_params"), None) for name, _ in loss.named_children())
    return [network for network in found if isinstance(network, nn.Module)]


def check_loss(loss: LossModule, replay: TensorDictReplayBuffer) -> None:
    """Raise unless a loss can be trained on a buffer; a value estimator that TorchRL would make later is made."""
    if not isinstance(loss, LossModule):
        raise TypeError(f"loss must be a LossModule, got {type(loss).__name__}; compile one by loss.compile()")
    if getattr(loss, "reduction", "mean") == "none":
        raise ValueError("loss must give the mean of its rows, got reduction='none'")
    if getattr(loss, "with_lagrange", False):
        raise ValueError("loss: with_lagrange=True takes from the critics what loss_cql adds; give with_lagrange=False")
    summed = [part.gamma for part in replay.transform if isinstance(part, MultiStepTransform)]
    shown = next(iter(summed), getattr(replay, "gamma", None))  # None where ``next`` is one step ahead
    if shown is None or loss.default_value_estimator is None:
        return
    own = getattr(loss.value_estimator, "gamma", None)
    if own is not None and abs(float(own) - shown) > 1e-6:
        raise ValueError(
            f"loss: its value estimator's gamma must be that of the replay buffer's n steps, {shown}, got "
            f"{float(own):.6g}; call loss.make_value_estimator(gamma={shown})"
        )


def sum_of_losses(found: Mapping[str, Any]) -> Tensor:
    """What is minimised: the sum of the loss's ``loss_`` entries, without those that replace another."""
    terms = [value for name, value in found.items() if name.startswith("loss_") and name not in _INSTEAD]
    if not terms:
        raise ValueError(f"loss must give entries that begin with 'loss_', it gives {', '.join(found.keys())}")
    return torch.stack(terms).sum()


def describe_loss(loss: LossModule) -> dict[str, Any]:
    """What tells a loss from another, its trained weights aside: its class and options, the kinds of its networks, and
    a digest of what no training changes, plans and texts among it."""
    digest = sha256()
    for name, tensor in sorted(loss.named_buffers()):
        fixed = not name.startswith("target_") and not name.endswith(("features.mean", "features.std"))
        digest.update(f"{name} {tuple(tensor.shape)}".encode())
        if fixed:
            digest.update(tensor.detach().cpu().contiguous().numpy().tobytes())
    return {
        "class": type(loss).__name__,
        "options": plain_options(loss),
        "networks": [type(network).__name__ for network in networks_of(loss)],
        "shapes": {name: list(parameter.shape) for name, parameter in loss.named_parameters()},
        "fixed": digest.hexdigest(),
    }
