"""Symmetries of a world: what is learned in one position holds in every other in which the world looks the same."""

from collections.abc import Sequence

import numpy as np
import torch as th
from torch import nn

from sb3_uspl.observations import BELIEF, COMMON, PRIVILEGED, TRUTH, UNCERTAINTY

Symmetry = tuple[np.ndarray, np.ndarray]
"""Matrices, ``(n_common, n_common)`` and ``(n_privileged, n_privileged)``, that turn both observations into those of the same
episode in a world that is turned or mirrored. What the robot senses and does must not change: ``target`` and actions are its
own, relative to its body."""

_NEXT_COORDINATE = 0.01
"""Weight of a coordinate of ``common`` relative to the one before it in the choice of the position that stands for all."""


class SymmetryGroup(nn.Module):
    """
    A world's symmetries, the identity first.

    :param symmetries: of the environment, without the identity
    :param n_common: size of ``common``
    :param n_privileged: size of ``privileged``
    :raises ValueError: if a matrix has another size, or two symmetries one after the other are none of them
    """

    common: th.Tensor
    privileged: th.Tensor
    _rank: th.Tensor

    def __init__(self, symmetries: Sequence[Symmetry], n_common: int, n_privileged: int):
        super().__init__()
        shapes = ((n_common, n_common), (n_privileged, n_privileged))
        given = [tuple(np.shape(matrix) for matrix in pair) for pair in symmetries]
        if any(pair != shapes for pair in given):
            raise ValueError(
                f"`symmetries` must be pairs of matrices for `common` and `privileged`, of the shapes {shapes[0]} and "
                f"{shapes[1]}; got {given}."
            )
        pairs = [(np.eye(n_common), np.eye(n_privileged)), *symmetries]
        _check_closed(pairs)
        for name, matrices in zip(("common", "privileged"), zip(*pairs, strict=True), strict=True):
            self.register_buffer(name, th.as_tensor(np.stack(matrices), dtype=th.float32), persistent=False)
        common = self.common.double()
        changed = (common - common[0]).abs().sum((0, 2)).nonzero()[:, 0]
        rank = th.einsum("i,gij->gj", _NEXT_COORDINATE ** th.arange(len(changed), dtype=th.float64), common[:, changed])
        # Relative to the identity's: coordinates that no symmetry changes would drown the others.
        self.register_buffer("_rank", rank - rank[0], persistent=False)

    def canonical(self, common: th.Tensor) -> th.Tensor:
        """
        The same symmetry for all positions that look the same, but for this: which makes the first coordinate greatest that
        symmetries change, or the next one if that leaves a choice; seven of them count, of which each weighs a hundredth.

        :param common: ``(n, n_common)``
        :return: numbers of symmetries, ``(n,)``
        """
        return (common.to(self._rank.dtype) @ self._rank.T).argmax(dim=1)

    def random(self, lengths: th.Tensor, rng: np.random.Generator) -> th.Tensor:
        """
        One for each episode, all as likely.

        :param lengths: of the episodes, ``(n_episodes,)``
        :param rng: random generator
        :return: numbers of symmetries, ``(lengths.sum(),)``
        """
        drawn = th.as_tensor(rng.integers(len(self.common), size=len(lengths)))
        return drawn.to(lengths.device).repeat_interleave(lengths)

    def turn(self, obs: dict[str, th.Tensor], which: th.Tensor) -> dict[str, th.Tensor]:
        """
        Observations as they would have been; an uncertainty as that of independent dimensions.

        :param obs: batch by key, ``(n, ...)``
        :param which: numbers of symmetries, ``(n,)``
        :return: the same keys
        """
        turned = dict(obs)
        turned[COMMON] = _apply(self.common[which], obs[COMMON])
        privileged = self.privileged[which]
        for key in (PRIVILEGED, TRUTH, BELIEF):
            if key in obs:
                turned[key] = _apply(privileged, obs[key])
        if UNCERTAINTY in obs:
            turned[UNCERTAINTY] = _apply(privileged.square(), obs[UNCERTAINTY].square()).sqrt()
        return turned


def _apply(matrices: th.Tensor, vectors: th.Tensor) -> th.Tensor:
    return (matrices @ vectors[:, :, None])[:, :, 0]


def _check_closed(pairs: Sequence[Symmetry]) -> None:
    flat = np.array([np.concatenate([np.ravel(matrix) for matrix in pair]) for pair in pairs])
    for i, first in enumerate(pairs):
        for k, second in enumerate(pairs):
            both = np.concatenate([np.ravel(b @ a) for a, b in zip(first, second, strict=True)])
            if not np.isclose(flat, both, atol=1e-6).all(axis=1).any():
                raise ValueError(
                    f"`symmetries` must be all of a group: number {k} after number {i} (0 is the identity) is a symmetry, "
                    f"too, but not among the {len(pairs) - 1} given."
                )
