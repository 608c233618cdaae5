"""Replays and targets as a least-squares problem for the estimators."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from sysid_btr._typing import BoolArray, FloatArray, IntArray
from sysid_btr.models.modifier import Modifier, Parameter
from sysid_btr.objectives.targets import Target
from sysid_btr.replay.engine import Numerics, Replay
from sysid_btr.replay.structure import colour, limbs, parameter_limbs


@dataclass(frozen=True, eq=False)
class Episode:
    """One episode: its replay and what it is compared with."""

    replay: Replay
    targets: tuple[Target, ...]


@dataclass(frozen=True, eq=False)
class ReplayProblem:
    """Whitened residuals of episodes under candidates: a `ResidualProblem` of the estimators.

    The whitened residual of a sample is (measured - predicted) / sigma; the loss is half minus twice the
    Gaussian log-likelihood up to a constant, that is the sum of squares.

    Attributes
    ----------
    episodes : replays under the same parameters.
    start : (p,) where a search begins.
    """

    episodes: tuple[Episode, ...]
    start: FloatArray

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return self.episodes[0].replay.parameters

    @property
    def modifiers(self) -> tuple[Modifier, ...]:
        return self.episodes[0].replay.modifiers

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(p.name for p in self.parameters)

    @cached_property
    def lower(self) -> FloatArray:
        return np.array([p.lower for p in self.parameters])

    @cached_property
    def upper(self) -> FloatArray:
        return np.array([p.upper for p in self.parameters])

    @cached_property
    def scale(self) -> FloatArray:
        """(p,) size of a change that matters."""
        return np.array([p.scale for p in self.parameters])

    @cached_property
    def count(self) -> int:
        """Number of samples that count."""
        return int(sum(target.mask.sum() for e in self.episodes for target in e.targets))

    def residuals(self, candidates: FloatArray) -> FloatArray:
        """Whitened residuals, (m, r), of candidates (m, p); NaN rows where a candidate diverged."""
        candidates = np.atleast_2d(candidates)
        result = np.empty((len(candidates), self.count))
        column = 0
        for episode in self.episodes:
            width = int(sum(t.mask.sum() for t in episode.targets))
            for rows, outputs in episode.replay.chunks(candidates):
                place = column
                for target in episode.targets:
                    white = (target.measured - target.predicted(outputs)) / target.sigma
                    size = int(target.mask.sum())
                    result[rows, place : place + size] = white[:, target.mask]
                    place += size
            column += width
        return result

    def loss(self, candidates: FloatArray) -> FloatArray:
        """Sum of squared whitened residuals, (m,); NaN where a candidate diverged."""
        candidates = np.atleast_2d(candidates)
        total = np.zeros(len(candidates))
        for episode in self.episodes:
            for rows, outputs in episode.replay.chunks(candidates):
                for target in episode.targets:
                    white = (target.measured - target.predicted(outputs)) / target.sigma
                    total[rows] += np.sum(white[:, target.mask] ** 2, axis=1)
        return total

    @cached_property
    def blocks(self) -> IntArray:
        """(r,) label of the stretch of time each residual belongs to, for cluster-robust covariances."""
        labels, offset = [], 0
        for episode in self.episodes:
            time = episode.replay.log.time - episode.replay.log.time[0]
            stretch = (time / BLOCK).astype(np.int64) + offset
            for target in episode.targets:
                grid = np.broadcast_to(stretch[: len(target.mask), None], target.mask.shape)
                labels.append(grid[target.mask])
            offset = int(stretch.max()) + 1
        return np.concatenate(labels)

    @cached_property
    def column_labels(self) -> IntArray:
        """(r,) index of the log column (episode, channel, joint) each residual belongs to."""
        labels, offset = [], 0
        for episode in self.episodes:
            for target in episode.targets:
                grid = np.broadcast_to(offset + np.arange(len(target.joints)), target.mask.shape)
                labels.append(grid[target.mask])
                offset += len(target.joints)
        return np.concatenate(labels)

    @property
    def columns(self) -> tuple[tuple[int, Target, int], ...]:
        """(episode, target, position in the target) of every log column, as `column_labels` counts them."""
        return tuple(
            (i, target, k)
            for i, episode in enumerate(self.episodes)
            for target in episode.targets
            for k in range(len(target.joints))
        )

    @cached_property
    def _limbs(self) -> tuple[list[frozenset[int]], IntArray]:
        """Limbs each parameter acts on, and the limb of each residual."""
        model = self.episodes[0].replay.model
        where = limbs(model)
        of_column = np.array([where[target.joints[k]] for _, target, k in self.columns])
        return parameter_limbs(self.modifiers, where), of_column[self.column_labels]

    @cached_property
    def groups(self) -> tuple[tuple[int, ...], ...]:
        """Parameters that can be varied in one simulation, because they move different limbs."""
        return colour(self._limbs[0])

    def support(self, parameter: int) -> BoolArray | None:
        """(r,) residuals that a parameter can move; None for all."""
        acts_on, limb = self._limbs
        own = acts_on[parameter]
        return np.isin(limb, list(own)) if own else None

    def with_modifiers(self, modifiers: Sequence[Modifier], start: FloatArray) -> ReplayProblem:
        """The same data under another set of modifiers."""
        episodes = tuple(
            replace(e, replay=replace(e.replay, modifiers=tuple(modifiers))) for e in self.episodes
        )
        return ReplayProblem(episodes, start)

    def with_numerics(self, numerics: Numerics) -> ReplayProblem:
        """The same problem under another integrator or step."""
        episodes = tuple(replace(e, replay=replace(e.replay, numerics=numerics)) for e in self.episodes)
        return ReplayProblem(episodes, self.start)


@dataclass(frozen=True, eq=False)
class Conditional:
    """A problem in some of its parameters, the others held.

    Attributes
    ----------
    whole : the problem.
    free : (p,) which parameters are free.
    values : (p,) the held values, and where the free ones start.
    """

    whole: ReplayProblem
    free: BoolArray
    values: FloatArray

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(n for n, f in zip(self.whole.names, self.free, strict=True) if f)

    @property
    def lower(self) -> FloatArray:
        return np.asarray(self.whole.lower[self.free])

    @property
    def upper(self) -> FloatArray:
        return np.asarray(self.whole.upper[self.free])

    @property
    def start(self) -> FloatArray:
        return np.asarray(self.values[self.free])

    def complete(self, candidates: FloatArray) -> FloatArray:
        """Candidates (m, free) with the held values, (m, p)."""
        result = np.tile(self.values, (len(candidates), 1))
        result[:, self.free] = candidates
        return result

    @property
    def groups(self) -> tuple[tuple[int, ...], ...]:
        """See `ReplayProblem.groups`."""
        own = {int(i): k for k, i in enumerate(np.flatnonzero(self.free))}
        found = (tuple(own[i] for i in group if i in own) for group in self.whole.groups)
        return tuple(group for group in found if group)

    def support(self, parameter: int) -> BoolArray | None:
        """See `ReplayProblem.support`."""
        return self.whole.support(int(np.flatnonzero(self.free)[parameter]))

    def residuals(self, candidates: FloatArray) -> FloatArray:
        return self.whole.residuals(self.complete(candidates))

    def loss(self, candidates: FloatArray) -> FloatArray:
        return self.whole.loss(self.complete(candidates))


BLOCK = 0.5
"""Seconds; residuals closer than this are allowed to be correlated in standard errors."""
