"""ImageQueryEvaluator: a network that answers plans' conditions from cameras' pictures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from lw_torchrl._checks import check_choice, check_int, checked
from lw_torchrl._rendering import check_cameras
from lw_torchrl.language.plans import Plans
from lw_torchrl.language.text import TextEncoder
from lw_torchrl.modules.clause_evaluator import ClauseEvaluator
from lw_torchrl.modules.pointing_network import PointingNetwork, SmallImageEncoder
from lw_torchrl.transforms.camera import CameraTransform

IMAGE_ENCODERS: dict[str, Callable[[], nn.Module]] = {"small": SmallImageEncoder}
"""What makes an encoder of pictures, by name: a module from (n, 3, H, W) float32 in [0, 1] to a map of features
(n, F, h, w). Put yours here, one that is frozen with ``requires_grad_(False)`` too, to have it in files."""

_LARGEST = 512


class ImageQueryEvaluator(ClauseEvaluator):
    """Answers conditions from pictures, trained on the query answering function's answers, which it never asks.

    Reads ``pixels`` (B, height, width·C, 3) uint8, of C cameras side by side, and ``task_id`` (B,) int64; writes
    ``qaf_logits`` (B, S) float32, positive where a condition of the row's plan holds, -1e4 beyond its last step. A
    condition's clauses are answered one by one, by pointing at the things that they name, see
    :class:`~lw_torchrl.modules.pointing_network.PointingNetwork`. ``transform()`` is the :class:`CameraTransform` that
    takes its pictures.

    Args:
        plans: whose conditions it answers.
        cameras, height, width: as for :class:`CameraTransform`; at most 512 pixels.
        every: steps from one picture to the next when it acts; in between its answers stay.
        encoder: a name in :data:`IMAGE_ENCODERS`.
        structure: a clause is read as the query language parses it, its things by name. False: all that is known of a
            clause is its text's vector.
        hidden, depth: hidden layers of what judges differences.
        predicates: with ``structure``, the relations and predicates that it can tell; None for all that there are.
        names: with ``structure``, the things that it can tell; None for those of the plans' tasks.
        text_encoder: without ``structure``, texts to vectors (n, E) float32; None for the sentence encoder.

    Raises:
        ValueError: a wrong option; a plan asks for a predicate or a thing that it cannot tell; at call time, pictures
            of another size, or a task_id without a plan.
        ImportError: without ``structure``, the extra ``[text]`` is not installed and there is no ``text_encoder``.

    Example:
        >>> import lw_torchrl as lw
        >>> plans = lw.load_plans("MT10")
        >>> actor = lw.ScriptedSkillActor(plans, evaluator=lw.modules.ImageQueryEvaluator(plans))
        >>> actor.in_keys
        ['observation', 'task_id', 'pixels']
        >>> actor.transform().shape
        (64, 128, 3)

    Source: paper section 'Differentiability and Optimization', which names a visual question answering model.
    """

    network: PointingNetwork
    seen_dims = 3
    rows_at_once = 4
    """As many rows are evaluated together when it acts, whatever else there is, so that results hang on no other."""

    @checked
    def __init__(
        self,
        plans: Plans,
        *,
        cameras: str | Sequence[str] = ("corner", "corner3"),
        height: int = 64,
        width: int = 64,
        every: int = 1,
        encoder: str = "small",
        structure: bool = True,
        hidden: int = 128,
        depth: int = 3,
        predicates: Sequence[str] | None = None,
        names: Sequence[str] | None = None,
        text_encoder: TextEncoder | None = None,
    ) -> None:
        if not structure and names is not None:
            raise ValueError("names is for structure=True; without, an evaluator reads texts alone")
        if structure and names is None:
            names = sorted({name for plan in plans.values() for name in plan.definition.object_names})
        super().__init__(
            plans, structure=structure, predicates=predicates, names=names or (), text_encoder=text_encoder
        )
        self.cameras, self.every = check_cameras(cameras, height, width), check_int("every", every, minimum=1)
        if max(height, width) > _LARGEST:
            raise ValueError(f"height and width must be at most {_LARGEST} pixels, got {height} and {width}")
        self.height, self.width = height, width
        self.in_keys = ["pixels", "task_id"]
        check_choice("encoder", encoder, IMAGE_ENCODERS)
        eye = IMAGE_ENCODERS[encoder]()
        self.network = PointingNetwork(
            eye,
            _features(eye, encoder, height, width),
            cameras=len(self.cameras),
            names=len(self.names),
            width=hidden,
            depth=depth,
            predicates=len(self.predicates),
            text_size=self.text_size,
        )
        self.config: dict[str, Any] = {
            "cameras": list(self.cameras),
            "height": height,
            "width": width,
            "every": self.every,
            "encoder": encoder,
            "structure": structure,
            "hidden": hidden,
            "depth": depth,
        }
        if structure:
            self.config |= {"predicates": list(self.predicates), "names": list(self.names)}

    def transform(self) -> CameraTransform:
        """A new one, which takes its pictures."""
        return CameraTransform(self.cameras, height=self.height, width=self.width, every=self.every)

    def check_seen(self, seen: Tensor) -> None:
        shape = (self.height, self.width * len(self.cameras), 3)
        if seen.shape[-3:] != shape or seen.dtype != torch.uint8:
            raise ValueError(
                f"pixels must be uint8 of shape (..., {', '.join(map(str, shape))}), pictures by "
                f"{', '.join(self.cameras)} side by side, got {seen.dtype} of shape {tuple(seen.shape)}; "
                "evaluator.transform() takes them"
            )


@torch.no_grad()
def _features(eye: nn.Module, name: str, height: int, width: int) -> int:
    """F, of an encoder's map of features, at which it is looked once."""
    found = eye(torch.zeros(1, 3, height, width))
    if not isinstance(found, Tensor) or found.dim() != 4 or len(found) != 1 or not found.is_floating_point():
        shape = tuple(found.shape) if isinstance(found, Tensor) else type(found).__name__
        raise ValueError(
            f"encoder {name!r} must give a map of features (n, F, h, w) for pictures (n, 3, H, W), got {shape}"
        )
    return found.shape[1]
