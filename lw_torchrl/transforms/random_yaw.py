"""RandomYaw: an augmentation that rotates the scenes of demonstrations about the vertical axis."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase, unravel_key
from torch import Tensor, nn

from lw_torchrl._util.checks import Probability, Scale, typed
from lw_torchrl._util.devices import plain
from lw_torchrl._util.keys import Keys, as_keys, check_apart, key_beside, read
from lw_torchrl.language.layout import METAWORLD, Layout
from lw_torchrl.language.plans import AnyPlans
from lw_torchrl.language.roles import StepRole
from lw_torchrl.language.skills import has_direction
from lw_torchrl.transforms.augmentation import PlanAugmentation, role_table

_KEYS = ("observation", "action", "expert_action", "unclipped_action")
_places: dict[tuple[tuple[int, ...], torch.device], Tensor] = {}


def _places_on(starts: tuple[int, ...], device: torch.device) -> Tensor:
    """Return the indices (2P,) int64 of the P x coordinates, then of the P y coordinates, cached for each device."""
    if (places := _places.get((starts, device))) is None:
        with torch.inference_mode(False):  # autograd rejects tensors that were created in inference mode
            places = torch.tensor([*starts, *(start + 1 for start in starts)]).to(device)
        if plain(places):
            _places[starts, device] = places
    return places


def _turned(values: Tensor, starts: tuple[int, ...], cos: Tensor, sin: Tensor) -> Tensor:
    """Rotate the pairs (x, y) that begin at the indices ``starts`` in ``values`` (..., D)."""
    places = _places_on(starts, values.device)
    x, y = values.index_select(-1, places).split(len(starts), -1)
    cos, sin = cos.unsqueeze(-1), sin.unsqueeze(-1)
    turned = torch.cat((cos * x - sin * y, sin * x + cos * y), -1)
    return values.index_copy(-1, places, turned.to(values.dtype))


def turn_observation(observation: Tensor, angle: Tensor, layout: Layout = METAWORLD) -> Tensor:
    """Rotate the positions in observations (..., D) about the vertical axis through the origin by (...) radians."""
    starts = tuple(part.start for part in layout.all_positions)
    return _turned(observation, starts, angle.cos(), angle.sin())


def turn_vectors(vectors: Tensor, angle: Tensor) -> Tensor:
    """Rotate vectors (..., 3) about the vertical axis by angles (...) in radians."""
    return _turned(vectors, (0,), angle.cos(), angle.sin())


def random_rotations(number: int, device: torch.device | None = None) -> Tensor:
    """Draw uniformly random rotations (number, 3, 3) float32 from PyTorch's global generator.

    Source: K. Shoemake, "Uniform random rotations", from unit quaternions.
    """
    w, x, y, z = nn.functional.normalize(torch.randn(number, 4, device=device, dtype=torch.float32), dim=-1).unbind(-1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


class RandomYaw(PlanAugmentation):
    """An augmentation that rotates the positions and actions of each row by a random angle about the vertical axis.

    Use it in a replay buffer, after a :class:`QAFTransform`: conditions such as "left of" need the original scene.

    Changes ``observation`` (B, 39), ``action`` (B, 4), and, if present, ``expert_action``, ``unclipped_action``
    (B, 4) and ``("next", "observation")``, all float32. Writes the angle in radians, ``observation_yaw`` (B,) float32,
    and ``("next", "observation_yaw")``, with which features also rotate constant positions. An action's horizontal
    displacement is shortened if it would leave [-1, 1]. Orientations are not rotated, so use features without
    orientations: "differences" or "relative". Angles are drawn from PyTorch's global generator; the angles of repeated
    rotations add up. Of TorchRL's losses, only BCLoss passes the angle to the features.

    Args:
        scale: standard deviation of the angle, in radians; with 10, the angle is nearly uniform.
        plans: the actor's plans. With plans, the transform also reads ``qaf`` (B, S) and ``task_id`` (B,) int64, and
            draws a uniform angle for rows in which no active step has a direction (for example, "move the puck to the
            target location").
        tilt: probability of also applying a uniform 3-D rotation to a row whose active steps carry or move an object to
            a place. Writes ``observation_tilt`` (B, 3, 3) float32, by which :class:`~lw_torchrl.modules.RoleFeatures`
            rotates the relative position. Requires canonical plans, see :func:`~lw_torchrl.canonical_plans`.
        layout: the layout of observations and actions; None for that of the plans, or Meta-World's without plans.
        in_keys: replacements for ``observation``, ``action``, ``expert_action``, ``unclipped_action``, in this order.
        out_keys: the keys for the rotated tensors; None for ``in_keys``.

    Raises:
        ValueError: at call time, the observation or action is missing, or, with plans, ``qaf`` or ``task_id``.
        TypeError: the transform is used in an environment.

    Example:
        >>> import lw_torchrl as lw, torch
        >>> from tensordict import TensorDict
        >>> rows = TensorDict({"observation": torch.rand(2, 39), "action": torch.tensor([[0.5, 0.0, 0.1, 1.0]] * 2)}, 2)
        >>> lw.RandomYaw(0.3)(rows)["action"][:, :2].norm(dim=-1)
        tensor([0.5000, 0.5000])

    Source: data augmentation by a symmetry of the task, as in ``torchvision.transforms.RandomRotation`` for images.
    """

    @typed
    def __init__(
        self,
        scale: Scale,
        *,
        plans: AnyPlans | None = None,
        tilt: Probability = 0.0,
        layout: Layout | None = None,
        in_keys: Keys | None = None,
        out_keys: Keys | None = None,
    ) -> None:
        super().__init__(
            in_keys=as_keys("in_keys", in_keys, _KEYS),
            out_keys=as_keys("out_keys", in_keys if out_keys is None else out_keys, _KEYS),
        )
        for source, target in zip(self.in_keys, self.out_keys, strict=True):
            if target != source:
                check_apart(self.in_keys, [target])
        self.scale, self.tilt, self.has_plans = scale, tilt, plans is not None
        if plans is not None:
            plans = self._read_plans(plans)
            if layout not in (None, plans.layout):
                raise ValueError(f"layout must be that of the plans, {plans.layout.name!r}, got {layout.name!r}")
            layout = plans.layout
            free = torch.tensor([not has_direction(skill) for skill in plans.skills])
            self.register_buffer("free", free[self._tables.skill_index], persistent=False)  # (T, S) bool
            if tilt:
                self.register_buffer("to_places", role_table(plans, self._tables, _moves_to_a_place), persistent=False)
        elif tilt:
            raise ValueError(f"tilt needs plans, which describe how objects move, got tilt={tilt} and plans=None")
        self.layout = METAWORLD if layout is None else layout
        self._begin = self.layout.displaced("RandomYaw").start

    def _angle(self, tensordict: TensorDictBase, observation: Tensor) -> Tensor:
        angle = self.scale * torch.randn(observation.shape[:-1], device=observation.device, dtype=torch.float32)
        if not self.has_plans:
            return angle
        any_angle = torch.pi * (2 * torch.rand_like(angle) - 1)
        return torch.where(self._all_true(tensordict, "free"), any_angle, angle)

    def _all_true(self, tensordict: TensorDictBase, name: str) -> Tensor:
        """Return (B,) bool: whether the condition of any plan step is true, and the table ``name`` (T, S) bool is true
        for every such step."""
        qaf, rows, steps = self.answers(tensordict, ["qaf", "task_id"])
        true = (qaf > 0.5) & steps
        return (self.table(name, rows.device)[rows] | ~true).all(-1) & true.any(-1)

    def _tilt(self, tensordict: TensorDictBase) -> Tensor:
        """Draw the 3-D rotation of each row, (B, 3, 3) float32."""
        free = self._all_true(tensordict, "to_places")
        chosen = free & (torch.rand(free.shape, device=free.device, dtype=torch.float32) < self.tilt)
        rotations = random_rotations(free.numel(), free.device).reshape(*free.shape, 3, 3)
        return torch.where(chosen[..., None, None], rotations, torch.eye(3, device=free.device, dtype=torch.float32))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        tensordict = tensordict.copy()  # replay[:] may return the storage itself
        (source, target), *actions = zip(self.in_keys, self.out_keys, strict=True)
        observation, _ = read(tensordict, self.in_keys[:2])
        angle = self._angle(tensordict, observation)
        tilt = self._tilt(tensordict) if self.tilt else None
        old_yaw, old_tilt = (tensordict.get(key_beside(source, ending), None) for ending in ("_yaw", "_tilt"))
        yaw = angle if old_yaw is None else old_yaw + angle
        if old_tilt is not None:  # express an earlier tilt in the rotated axes
            old_tilt = turn_vectors(turn_vectors(old_tilt.mT, angle.unsqueeze(-1)).mT, angle.unsqueeze(-1))
            tensordict.set(key_beside(target, "_tilt"), old_tilt if tilt is None else tilt @ old_tilt)
        elif tilt is not None:
            tensordict.set(key_beside(target, "_tilt"), tilt)
        cos, sin, begin = angle.cos(), angle.sin(), self._begin
        tensordict.set(target, turn_observation(observation, angle, self.layout))
        tensordict.set(key_beside(target, "_yaw"), yaw)
        if (following := tensordict.get(unravel_key(("next", source)), None)) is not None:
            after = unravel_key(("next", target))
            tensordict.set(after, turn_observation(following, angle, self.layout)).set(key_beside(after, "_yaw"), yaw)
        for key, turned_key in actions:
            if (action := tensordict.get(key, None)) is None:
                continue
            turned = _turned(action, (begin,), cos, sin)
            # Shorten displacements that leave [-1, 1], unless they were outside before (as in unclipped actions).
            plane = slice(begin, begin + 2)
            before, now = (each[..., plane].abs().amax(-1, keepdim=True) for each in (action, turned))
            turned[..., plane] /= torch.where(before <= 1.0, now.clamp(min=1.0), 1.0)
            if tilt is not None:
                way = turned[..., begin : begin + 3]
                tilted = (tilt @ way.unsqueeze(-1)).squeeze(-1)
                longest = torch.where(way.abs().amax(-1, keepdim=True) <= 1.0, tilted.abs().amax(-1, keepdim=True), 1.0)
                turned[..., begin : begin + 3] = tilted / longest.clamp(min=1.0)
            tensordict.set(turned_key, turned)
        return tensordict


def _moves_to_a_place(role: StepRole) -> bool:
    return role.verb == "carry" or (role.verb == "move" and role.direction is None)
