"""Several logs under the same candidates in one batch: candidates times logs are its simulations.

The cost of a step in Python, which laws need, is then shared among the logs; and a few candidates of many short logs
fill all threads.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from sysid_btr._typing import FloatArray, UInt8Array
from sysid_btr.simulation.base_states import BaseStates, place_base
from sysid_btr.simulation.replay import Replay
from sysid_btr.simulation.setup import write_terms
from sysid_btr.simulation.silence import silenced
from sysid_btr.simulation.start import behind_sensors
from sysid_btr.terms.base import BatchModel, Outputs

if TYPE_CHECKING:
    import mujoco

ALIKE = 0.6
"""Length of a log, as a fraction of the longest, from which it is worth simulating to the longest one's end."""


def group_replays(replays: Sequence[Replay]) -> list[tuple[int, ...]]:
    """Positions of the replays that can be simulated together, longest first in each party."""
    order = sorted(range(len(replays)), key=lambda i: -replays[i].steps)
    found: list[list[int]] = []
    for i in order:
        for party in found:
            first = replays[party[0]]
            if replays[i].steps >= ALIKE * first.steps and _joinable(first, replays[i]):
                party.append(i)
                break
        else:
            found.append([i])
    return sorted(tuple(party) for party in found)


def batched_chunks(replays: Sequence[Replay], candidates: FloatArray) -> Iterator[tuple[slice, tuple[Outputs, ...]]]:
    """Predicted sensors of all replays of a party, a chunk of candidates at a time.

    Parameters
    ----------
    replays : that `group_replays` says can be simulated together.
    candidates : (m, parameters).

    Yields
    ------
    (slice, tuple of Outputs)
        Rows of the chunk, and the sensors of every replay in turn; a diverged candidate is all NaN.
    """
    if len(replays) == 1:
        for rows, alone in replays[0].chunks(candidates):
            yield rows, (alone,)
        return
    candidates = np.atleast_2d(np.asarray(candidates, dtype=np.float64))
    size = max(min(replay.chunk_size for replay in replays) // len(replays), 1)
    for first in range(0, len(candidates), size):
        rows = slice(first, min(first + size, len(candidates)))
        with silenced():
            outputs = _run(replays, candidates[rows])
        yield rows, outputs


def _run(replays: Sequence[Replay], candidates: FloatArray) -> tuple[Outputs, ...]:
    lead, m = replays[0], len(candidates)
    logs, grids = len(replays), [replay.grid for replay in replays]
    differing = sorted({n for r in replays[1:] for n in _different(lead.model, r.model) or ()})
    numbers = {n: np.repeat(np.stack([getattr(r.model, n) for r in replays]), m, axis=0) for n in differing}
    batch = BatchModel(lead.model, lead.index, lead.numerics.timestep, m * logs, numbers)
    values_of = lead._values(candidates)
    pairs = [(term, np.tile(values, (logs, 1, 1))) for term, values in values_of]
    write_terms(batch, pairs)
    steps = max(grid.steps for grid in grids)
    starts = (np.repeat(np.stack([r.start[i] for r in replays]), m, axis=0) for i in (0, 1))
    shown = np.repeat(np.stack([r.shown for r in replays]), m, axis=0)
    qpos, qvel = behind_sensors(batch, pairs, shown, *starts)
    last = np.minimum(np.arange(steps), np.array([[g.steps - 1] for g in grids]))
    command, extra = (
        np.repeat(np.stack([rows[k] for rows, k in zip(of_logs, last, strict=True)]), m, axis=0)
        for of_logs in ([g.command for g in grids], [g.extra for g in grids])
    )
    own_logs = [(r.log, g) for r, g in zip(replays, grids, strict=True)]
    setup = lead._prepare(batch, pairs, qpos, qvel, command, own_logs, extra)
    bases = [r.base_start for r in replays if r.base_start is not None]
    if bases:
        place_base(setup, BaseStates.joined(bases).chosen(np.repeat(np.arange(logs), m)))
    # borders that any of the logs wants to see
    borders = np.unique(np.concatenate([grid.state for grid in grids]))
    states = lead.simulate(setup, borders)
    result = []
    for i, (replay, grid) in enumerate(zip(replays, grids, strict=True)):
        share = slice(i * m, (i + 1) * m)
        own = states.of(share, np.searchsorted(borders, grid.state))
        own.repeat_last_effort()
        result.append(replay.read(setup, share, values_of, own, grid))
    return tuple(result)


def _joinable(a: Replay, b: Replay) -> bool:
    """Whether two replays differ only in their logs and in numbers of their models."""
    if type(a) is not Replay or type(b) is not Replay:
        return False
    same = (
        a.terms == b.terms
        and a.robot.always == b.robot.always
        and a.switched == b.switched
        and a.numerics == b.numerics
        and a.effort == b.effort
        and a.threads == b.threads
        and a.log.meta.mount == b.log.meta.mount
        and (a.base_start is None) == (b.base_start is None)
        and _input_names(a) == _input_names(b)
        and np.array_equal(a.index.scale, b.index.scale)
        and a.grid.extra.shape[1] == b.grid.extra.shape[1]
    )
    return same and _different(a.model, b.model) is not None


def _input_names(replay: Replay) -> frozenset[str]:
    return frozenset(n for n in replay.log.channels if n.split(".")[0] in ("voltage", "enabled"))


def _different(a: mujoco.MjModel, b: mujoco.MjModel) -> frozenset[str] | None:
    """Fields in which two models differ; None if they differ in what one batch cannot hold."""
    from mujoco.batch import MODEL_FIELDS

    if np.array_equal(_content(a), _content(b)):
        return frozenset()
    if not np.array_equal(_values(a.opt), _values(b.opt)) or a.names != b.names:
        return None
    found = set()
    for name in (n for n in dir(a) if not n.startswith("_")):
        x, y = getattr(a, name), getattr(b, name)
        if isinstance(x, int) and name.startswith("n") and x != y:
            return None
        if isinstance(x, np.ndarray) and not np.array_equal(x, y, equal_nan=x.dtype.kind == "f"):
            if name not in MODEL_FIELDS:
                return None
            found.add(name)
    return frozenset(found)


def _content(model: mujoco.MjModel) -> UInt8Array:
    """A model as MuJoCo writes it: compared a hundred times as fast as its fields."""
    import mujoco

    content = np.empty(mujoco.mj_sizeModel(model), dtype=np.uint8)
    mujoco.mj_saveModel(model, None, content)
    return content


def _values(options: mujoco.MjOption) -> FloatArray:
    """All numbers of MuJoCo's options."""
    names = (n for n in dir(options) if not n.startswith("_"))
    return np.concatenate([np.atleast_1d(np.asarray(getattr(options, n), dtype=np.float64)) for n in names])
