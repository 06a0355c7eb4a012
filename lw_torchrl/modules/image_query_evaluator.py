"""ImageQueryEvaluator: a network that evaluates plan conditions from camera pictures."""

from __future__ import annotations

from collections.abc import Sequence
from math import sqrt
from typing import Any

import torch
from torch import Tensor, nn

from lw_torchrl._util.checks import Count, check_choice, typed
from lw_torchrl._util.registry import Registry, is_function
from lw_torchrl._util.rendering import check_cameras
from lw_torchrl.language.plans import Plans
from lw_torchrl.modules.parts import MLP, materialize
from lw_torchrl.modules.query_evaluator import Answers, ClauseEvaluator, ClauseNetwork, Clauses
from lw_torchrl.transforms.observations import CameraTransform

KEYS = 32  # size of the learned vector that represents an object
_KEPT = 16  # number of image features, read at an object's location, that help to estimate its position
_LANDMARKS = 32  # number of landmarks that are located in every picture
_SHARP = 30.0  # scale of the attention scores; with 1, an untrained network would attend to the whole picture
_LARGEST = 512  # maximum height and width of a picture, in pixels


class SmallImageEncoder(nn.Module):
    """A CNN with five convolutions that maps images (n, 3, H, W) float32 in [0, 1] to features (n, 32, H/2, W/2)."""

    def __init__(self) -> None:
        super().__init__()
        self.fine = nn.Sequential(_conv(3, 16, stride=2), _conv(16, 24))
        self.coarse = nn.Sequential(_conv(24, 48, stride=2), _conv(48, 48), _conv(48, 48))
        self.joined = nn.Conv2d(24 + 48, 32, 1, dtype=torch.float32)

    def forward(self, pictures: Tensor) -> Tensor:
        fine = self.fine(pictures - 0.5)
        coarse = nn.functional.interpolate(self.coarse(fine), fine.shape[-2:], mode="bilinear", align_corners=False)
        return self.joined(torch.cat((fine, coarse), -3)).relu()


def _conv(before: int, after: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(before, after, 3, stride, 1, dtype=torch.float32),
        nn.GroupNorm(4, after, dtype=torch.float32),
        nn.ReLU(),
    )


class PointingNetwork(ClauseNetwork):
    """A network that locates objects in pictures and evaluates clauses about the objects' positions.

    For each camera, the network compares an object's learned vector with the image features at every location. A
    softmax over the locations gives the attention. An MLP estimates the object's position in metres and its opening
    from the attended coordinates and features, and from the coordinates of landmarks, which all objects share.

    Source: the spatial softmax of 'Deep spatial autoencoders for visuomotor learning' (Finn et al., 2016).
    """

    numbers = 4

    def __init__(self, encoder: nn.Module, features: int, *, cameras: int, names: int, **trunk: Any) -> None:
        super().__init__(**trunk)
        self.encoder, self.cameras = encoder, cameras
        self.key = nn.Conv2d(features, KEYS, 1, dtype=torch.float32)
        self.seen = nn.Conv2d(features, _KEPT, 1, dtype=torch.float32)
        self.landmarks = nn.Conv2d(features, _LANDMARKS, 1, dtype=torch.float32)
        self.names = nn.Embedding(names, KEYS, dtype=torch.float32)
        self.place = MLP(self.numbers, width=self.width, depth=2)
        materialize(self.place, torch.zeros(1, cameras * (2 + _KEPT + 2 * _LANDMARKS) + KEYS, dtype=torch.float32))

    def forward(self, seen: Tensor, clauses: Clauses) -> Tensor:
        """Return logits (B, Q) of clauses (B, Q) from images (B, H, W·C, 3) uint8, with C camera views side by side."""
        return self.judge_at(self.places(seen, self.names.weight)[0], clauses)

    def judge_at(self, places: Tensor, clauses: Clauses) -> Tensor:
        """Return logits (B, Q) of clauses (B, Q) from the positions and openings of N objects, ``places`` (B, N, 4)."""
        known = torch.cat((places, torch.zeros_like(places[:, :1])), -2)
        first, second = (
            known.gather(-2, which.unsqueeze(-1).expand(*which.shape, self.numbers))
            for which in (clauses.subject, clauses.object)
        )
        return self.judge(first - second, clauses)

    def places(self, seen: Tensor, objects: Tensor) -> tuple[Tensor, Tensor]:
        """Locate objects, given as learned vectors (N, 32) float32, in pictures (B, H, W·C, 3) uint8. Return positions
        in metres and openings (B, N, 4) float32, and the attention over each picture (B, C, N, h, w) float32."""
        rows = len(seen)
        pictures = seen.unflatten(-2, (self.cameras, -1)).permute(0, 2, 4, 1, 3).flatten(0, 1)
        features = self.encoder(pictures.to(torch.float32) / 255.0)
        height, width = features.shape[-2:]
        scores = torch.einsum("nk,bkp->bnp", objects, self.key(features).flatten(-2))
        attention = (_SHARP / sqrt(KEYS) * scores).softmax(-1)
        axes = [torch.linspace(-1.0, 1.0, size, device=seen.device, dtype=features.dtype) for size in (height, width)]
        grid = torch.stack(torch.meshgrid(*axes, indexing="ij")).flatten(-2)
        values = torch.cat((grid.expand(len(features), -1, -1), self.seen(features).flatten(-2)), -2)
        attended = torch.einsum("bnp,bfp->bnf", attention, values)  # (B·C, N, 2 + 16)
        attended = attended.unflatten(0, (rows, self.cameras)).transpose(1, 2).flatten(-2)
        marks = (_SHARP * self.landmarks(features).flatten(-2)).softmax(-1) @ grid.T  # (B·C, 32, 2)
        marks = marks.reshape(rows, 1, -1).expand(-1, len(objects), -1)
        places = self.place(torch.cat((attended, marks, objects.expand(rows, -1, -1)), -1))
        return places, attention.unflatten(0, (rows, self.cameras)).unflatten(-1, (height, width))


IMAGE_ENCODERS = Registry("image encoder", "lw_torchrl.image_encoders", {"small": SmallImageEncoder}, is_function)
"""A registry of functions that create image encoders, which map (n, 3, H, W) float32 in [0, 1] to features
(n, F, h, w). Register a custom encoder so that checkpoints can refer to it by name; its weights may be frozen."""


class ImageQueryEvaluator(ClauseEvaluator):
    """A query evaluator that predicts conditions from camera pictures, with a network trained on exact answers.

    Reads ``pixels`` (B, height, width·C, 3) uint8, C camera images side by side, and ``task_id`` (B,) int64; writes
    ``qaf`` and ``qaf_logits`` (B, S) float32 as :class:`QueryEvaluator` does. See :class:`PointingNetwork` for the
    network. ``transform()`` returns the :class:`CameraTransform` that renders the pictures.

    Args:
        plans, answers, predicates: see :class:`~lw_torchrl.modules.query_evaluator.ClauseEvaluator`, which also lists
            the errors.
        cameras, height, width: see :class:`CameraTransform`; height and width are at most 512 pixels.
        every: render a picture every N time steps; the answers stay the same in between.
        encoder: a name in :data:`IMAGE_ENCODERS`.
        hidden, depth: units per hidden layer and number of hidden layers of the network that evaluates clauses.
        names: the objects that the network can distinguish; None for the objects of the plans' tasks.

    Example:
        >>> import lw_torchrl as lw
        >>> evaluator = lw.modules.ImageQueryEvaluator(lw.load_plans("MT10"))
        >>> evaluator.in_keys, evaluator.transform().shape
        (['pixels', 'task_id'], (64, 128, 3))
    """

    network: PointingNetwork
    seen_dims = 3
    rows_at_once = 16
    """Number of rows per forward pass in a rollout. The number is fixed so that a row's result does not depend on the
    other rows. With 4 rows, some processors round the last row differently."""

    @typed
    def __init__(
        self,
        plans: Plans,
        *,
        cameras: str | Sequence[str] = ("corner", "corner3"),
        height: Count = 64,
        width: Count = 64,
        every: Count = 1,
        encoder: str = "small",
        hidden: Count = 128,
        depth: Count = 3,
        answers: Answers = "soft",
        predicates: Sequence[str] | None = None,
        names: Sequence[str] | None = None,
    ) -> None:
        if names is None:
            names = sorted({name for plan in plans.values() for name in plan.definition.object_names})
        super().__init__(plans, answers=answers, predicates=predicates, names=names)
        self.cameras = check_cameras(cameras, height, width, _LARGEST)
        self.height, self.width, self.every = height, width, every
        self.in_keys = ["pixels", "task_id"]
        image_encoder = IMAGE_ENCODERS[check_choice("encoder", encoder, IMAGE_ENCODERS)]()
        with torch.no_grad():
            _, features, _, _ = image_encoder(torch.zeros(1, 3, height, width, dtype=torch.float32)).shape
        sizes = {"cameras": len(self.cameras), "names": len(self.names), "predicates": len(self.predicates)}
        self.network = PointingNetwork(image_encoder, features, width=hidden, depth=depth, **sizes)
        self.config |= dict(cameras=list(self.cameras), height=height, width=width, every=every, encoder=encoder)
        self.config |= dict(hidden=hidden, depth=depth, names=list(self.names))

    def transform(self) -> CameraTransform:
        """Return a new transform that renders the pictures that this module reads."""
        return CameraTransform(self.cameras, height=self.height, width=self.width, every=self.every)

    def check_seen(self, seen: Tensor) -> None:
        shape = (self.height, self.width * len(self.cameras), 3)
        if seen.shape[-3:] != shape or seen.dtype != torch.uint8:
            raise ValueError(f"pixels must be uint8 (..., {str(shape)[1:-1]}), got {seen.dtype} {tuple(seen.shape)}")
