"""RandomYaw: demonstrations as they would look, had the scene been turned about the vertical."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase, Transform

from lw_torchrl._checks import check_scale, missing_keys
from lw_torchrl.language.observation import FIRST, HAND, POSITIONS, SECOND, a_step_before

_STARTS = tuple(part.start for part in (*POSITIONS, *map(a_step_before, (HAND, FIRST, SECOND))))
_NOT_FOR_ENVIRONMENTS = "RandomYaw is for replay buffers: an environment has done its action before it is turned"


def _turned(values: Tensor, starts: tuple[int, ...], cos: Tensor, sin: Tensor) -> Tensor:
    turned = values.clone()
    for start in starts:
        x, y = values[..., start], values[..., start + 1]
        turned[..., start] = cos * x - sin * y
        turned[..., start + 1] = sin * x + cos * y
    return turned


def _reach(action: Tensor) -> Tensor:
    """The larger of the two numbers in the plane, (..., 1)."""
    return action[..., :2].abs().amax(-1, keepdim=True)


class RandomYaw(Transform):
    """Turns each sampled row, its positions and its action alike, by a random angle about the vertical.

    What is to the left of the hand in every demonstration of a task is a little in front of it or behind it in some
    rows, so a policy learns to move along the way to the goal rather than in the direction that the demonstrations
    happened to have. For replay buffers; where a :class:`QAFTransform` is used, put it first, since conditions speak of
    the scene as it was.

    Changes ``observation`` (B, 39) float32 and ``action`` (B, 4) float32, and ``("next", "observation")``,
    ``expert_action`` and ``unclipped_action`` where they are. An action's way in the plane is shortened where turning
    would lead it out of [-1, 1], its direction kept; one that was outside before keeps its length. Orientations stay as
    they were, and so do fixed places: use it with features that hold neither, "differences" or "relative", and without
    ``focus``. Angles are drawn from PyTorch's global generator; the trainers seed it.

    Args:
        scale: standard deviation of the angle, in radians.

    Raises:
        ValueError: a negative or infinite scale; a sample without observation or action.
        TypeError: it is given to an environment.

    Example:
        >>> import lw_torchrl as lw, torch
        >>> from tensordict import TensorDict
        >>> rows = TensorDict({"observation": torch.rand(2, 39), "action": torch.tensor([[0.5, 0.0, 0.1, 1.0]] * 2)}, 2)
        >>> lw.RandomYaw(0.3)(rows)["action"][:, :2].norm(dim=-1)
        tensor([0.5000, 0.5000])

    Source: data augmentation by a symmetry of the task, as for images in ``torchvision.transforms.RandomRotation``.
    """

    def __init__(self, scale: float) -> None:
        super().__init__(in_keys=["observation", "action"], out_keys=["observation", "action"])
        self.scale = check_scale("scale", scale)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Turn each row of a sample."""
        tensordict = tensordict.copy()  # of a buffer's whole range it may be the storage itself
        observation = tensordict.get("observation", None)
        if observation is None or "action" not in tensordict.keys():
            raise missing_keys(tensordict.keys(), "observation", "action")
        angle = self.scale * torch.randn(observation.shape[:-1], device=observation.device)
        cos, sin = angle.cos(), angle.sin()
        tensordict.set("observation", _turned(observation, _STARTS, cos, sin))
        if (following := tensordict.get(("next", "observation"), None)) is not None:
            tensordict.set(("next", "observation"), _turned(following, _STARTS, cos, sin))
        for name in {"action", "expert_action", "unclipped_action"} & set(tensordict.keys()):
            action = tensordict.get(name)
            turned = _turned(action, (0,), cos, sin)
            turned[..., :2] /= torch.where(_reach(action) <= 1.0, _reach(turned).clamp(min=1.0), 1.0)
            tensordict.set(name, turned)
        return tensordict

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        raise TypeError(_NOT_FOR_ENVIRONMENTS)

    def set_container(self, container: Transform | EnvBase) -> None:
        """Join a buffer's transforms; an environment's actions cannot be turned after the fact."""
        if isinstance(container, EnvBase):
            raise TypeError(_NOT_FOR_ENVIRONMENTS)
        super().set_container(container)
