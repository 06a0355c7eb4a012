"""PointingNetwork: pictures and a clause to the logit of its truth, by pointing at the two things that it names."""

from __future__ import annotations

from math import sqrt

import torch
from torch import Tensor, nn
from torchrl.modules import MLP

from lw_torchrl.modules.clause_network import ClauseNetwork
from lw_torchrl.modules.clauses import Clauses

KEYS = 32  # numbers by which a thing is found in a picture
_KEPT = 16  # numbers of what is seen there that tell where it is
_LANDMARKS = 32  # that are sought in a picture whatever is asked
_SHARP = 30.0  # what scores count in the softmax over a picture's places: at 1 a fresh network looks everywhere at once


class SmallImageEncoder(nn.Module):
    """Pictures (n, 3, H, W) float32 in [0, 1] to a map of features (n, 32, H/2, W/2): five convolutions, the inner ones
    at a quarter of the size, for a wider view."""

    def __init__(self) -> None:
        super().__init__()
        self.fine = nn.Sequential(_conv(3, 16, stride=2), _conv(16, 24))
        self.coarse = nn.Sequential(_conv(24, 48, stride=2), _conv(48, 48), _conv(48, 48))
        self.joined = nn.Conv2d(24 + 48, 32, 1)

    def forward(self, pictures: Tensor) -> Tensor:
        fine = self.fine(pictures - 0.5)
        coarse = nn.functional.interpolate(self.coarse(fine), fine.shape[-2:], mode="bilinear", align_corners=False)
        return self.joined(torch.cat((fine, coarse), -3)).relu()


def _conv(before: int, after: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(before, after, 3, stride, 1), nn.GroupNorm(4, after), nn.ReLU())


class PointingNetwork(ClauseNetwork):
    """Finds things in pictures and tells clauses of where they are.

    A thing is a vector of its own, or, of a clause's text, two that the text gives. In each camera's picture it is
    compared with the features of every place; the softmax over the places is where it points. The places' mean
    coordinates and features, and the mean coordinates of some landmarks, which are the same for all things, tell, of
    all cameras, the thing's four numbers: its position in metres, and how far it is open. What clauses are told of is
    the difference of the two things' numbers, as :class:`ClauseNetwork` does.

    Source: the spatial softmax of 'Deep spatial autoencoders for visuomotor learning' (Finn et al., 2016).

    Args:
        encoder: pictures (n, 3, H, W) float32 in [0, 1] to a map of features (n, F, h, w).
        features: F.
        cameras: C, side by side in a row's pictures.
        names: N, how many things there are; 0 for a network that reads texts.
        width, depth, predicates, text_size: as for :class:`ClauseNetwork`.
    """

    numbers = 4
    ends = 2 * KEYS + 2

    def __init__(
        self,
        encoder: nn.Module,
        features: int,
        *,
        cameras: int,
        names: int,
        width: int,
        depth: int,
        predicates: int,
        text_size: int,
    ) -> None:
        super().__init__(width, depth, predicates=predicates, text_size=text_size)
        self.encoder, self.cameras = encoder, cameras
        self.key = nn.Conv2d(features, KEYS, 1)
        self.seen = nn.Conv2d(features, _KEPT, 1)
        self.landmarks = nn.Conv2d(features, _LANDMARKS, 1)
        if names:
            self.names = nn.Embedding(names, KEYS)
        self.place = MLP(
            in_features=cameras * (2 + _KEPT + 2 * _LANDMARKS) + KEYS,
            out_features=self.numbers,
            num_cells=[width, width],
            activation_class=nn.ReLU,
        )

    def forward(self, seen: Tensor, clauses: Clauses, text_vectors: Tensor | None = None) -> Tensor:
        """Answer.

        Args:
            seen: (B, H, W·C, 3) uint8, pictures side by side.
            clauses: (B, Q), those that are asked of each row.
            text_vectors: (U, E) float32, of the texts that ``clauses.text`` numbers, where it reads texts.

        Returns:
            (B, Q) float32, logits of size 30 at most, positive where the clause holds.
        """
        if not self.reads_text:
            return self.tell(self.places(seen, self.names.weight)[0], clauses)
        assert text_vectors is not None
        told = self.texts(text_vectors)
        things, gates, shift, asked = told.split([2 * KEYS, 2, self.numbers, self.width + 1], -1)
        places = self.places(seen, things.unflatten(-1, (2, -1)).flatten(0, 1))[0].unflatten(-2, (-1, 2))
        ends = gates.sigmoid().unsqueeze(-1) * places  # (B, U, 2, 4)
        d = ends[..., 0, :] - ends[..., 1, :] + 0.1 * shift
        picked = d.gather(-2, clauses.text.unsqueeze(-1).expand(*clauses.text.shape, self.numbers))
        return self.judge(picked, asked[clauses.text], None)

    def tell(self, places: Tensor, clauses: Clauses) -> Tensor:
        """The logits (B, Q) of clauses (B, Q) about named things at places (B, N, 4)."""
        zero = torch.zeros_like(places[:, :1])
        known = torch.cat((places, zero), -2)
        first, second = (
            known.gather(-2, which.unsqueeze(-1).expand(*which.shape, self.numbers))
            for which in (clauses.subject, clauses.object)
        )
        return self.judge(first - second, self.predicates.weight[clauses.predicate], clauses.negated)

    def places(self, seen: Tensor, things: Tensor) -> tuple[Tensor, Tensor]:
        """Where things are.

        Args:
            seen: (B, H, W·C, 3) uint8.
            things: (N, 32) float32, their vectors.

        Returns:
            (B, N, 4) float32, positions in metres and how far they are open; and where they are seen,
            (B, C, N, h, w) float32, which sums to 1 over each picture.
        """
        rows = len(seen)
        pictures = seen.unflatten(-2, (self.cameras, -1)).permute(0, 2, 4, 1, 3).flatten(0, 1)
        features = self.encoder(pictures.to(torch.float32) / 255.0)
        height, width = features.shape[-2:]
        scores = torch.einsum("nk,bkp->bnp", things, self.key(features).flatten(-2))
        pointed = (_SHARP / sqrt(KEYS) * scores).softmax(-1)
        grid = torch.stack(
            torch.meshgrid(
                torch.linspace(-1.0, 1.0, height, device=seen.device),
                torch.linspace(-1.0, 1.0, width, device=seen.device),
                indexing="ij",
            )
        ).flatten(-2)
        told = torch.cat((grid.expand(len(features), -1, -1), self.seen(features).flatten(-2)), -2)
        there = torch.einsum("bnp,bfp->bnf", pointed, told)  # (B·C, N, 2 + 16)
        there = there.unflatten(0, (rows, self.cameras)).transpose(1, 2).flatten(-2)
        marks = (_SHARP * self.landmarks(features).flatten(-2)).softmax(-1) @ grid.T  # (B·C, 32, 2)
        marks = marks.reshape(rows, 1, -1).expand(-1, len(things), -1)
        places = self.place(torch.cat((there, marks, things.expand(rows, -1, -1)), -1))
        return places, pointed.unflatten(0, (rows, self.cameras)).unflatten(-1, (height, width))
