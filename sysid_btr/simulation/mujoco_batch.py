"""The built-in simulator: MuJoCo on the cores of this machine, a candidate's numbers in each simulation of a batch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from sysid_btr._typing import IntArray
from sysid_btr.machine import usable_cores
from sysid_btr.simulation.setup import Setup
from sysid_btr.simulation.simulator import States
from sysid_btr.terms.base import BatchModel, Fields

if TYPE_CHECKING:
    from mujoco.batch import Batch

SEGMENT = 1024
"""Steps per rollout call; bounds the records that are held at once."""
POSITION, VELOCITY, ACCELERATION = 1, 2, 3
"""Stages of MuJoCo's forward dynamics (mjtStage)."""


@dataclass(frozen=True)
class MujocoBatch:
    """Simulations of a `mujoco.batch.Batch`, on as many threads as are asked for."""

    def rollout(self, setup: Setup, borders: IntArray, *, threads: int = 0) -> States:
        threads = threads or usable_cores()
        if setup.laws or setup.held_steps:
            # imports what compiles laws, which takes a second
            from sysid_btr.simulation.mujoco_steps import roll_out

            return roll_out(setup, _derived(setup.batch, threads), borders, threads)
        batch = _load(setup.batch, setup.state, threads)
        states = _roll(batch, setup, borders)
        states.failed = batch.warning[:, :, 1].sum(axis=1) > 0
        return states


def evaluate(
    batch: BatchModel, state: Fields, names: Sequence[str], *, stage: int = ACCELERATION, threads: int = 0
) -> Fields:
    """What MuJoCo derives from given states: fields of MjData by name, (m, ...) each, computed up to a stage."""
    simulations = _load(batch, state, threads or usable_cores())
    found = {name: simulations.bind(name) for name in names}
    simulations.forward(stage=stage)
    return {name: values.copy() for name, values in found.items()}


def _load(batch: BatchModel, state: Fields, threads: int) -> Batch:
    """A batch with the candidates' numbers in it."""
    from mujoco.batch import Batch

    simulations = Batch(batch.model, batch.size, threads)
    for name, values in _derived(batch, threads).items():
        simulations.expand(name)[...] = values
    for name, values in state.items():
        simulations.bind(name)[...] = values
    return simulations


def _derived(batch: BatchModel, threads: int) -> Fields:
    """Changed fields of all candidates, and what the engine derives from them, once for those that are the same."""
    from mujoco import MjModel
    from mujoco.batch import Batch

    if not batch.derives:
        return batch.fields
    changed = [name for name in batch.fields if name in MjModel._setconst_inputs]
    numbers = np.concatenate([batch.fields[name].reshape(batch.size, -1) for name in changed], axis=1)
    first: dict[bytes, int] = {}
    same = [first.setdefault(row.tobytes(), i) for i, row in enumerate(numbers)]
    rows, own = np.unique(same, return_inverse=True)
    few = Batch(batch.model, len(rows), threads)
    for name in changed:
        few.expand(name)[...] = batch.fields[name][rows]
    few.set_const()
    derived = {name: few.expanded(name) for name in MjModel._setconst_outputs if name not in changed}
    return batch.fields | {name: values[own] for name, values in derived.items() if values is not None}


def _roll(batch: Batch, setup: Setup, borders: IntArray) -> States:
    """All steps in one call of the engine, or in a few: memory stays bounded whatever the length of the log."""
    import mujoco

    index, nv = setup.index, setup.model.nv
    states = States.empty(setup.size, len(borders), index)
    states.put(index, np.array([0]), batch.bind("qpos")[:, None], batch.bind("qvel")[:, None])
    spec = int(mujoco.mjtState.mjSTATE_CTRL.value)
    if setup.applied is not None:
        spec |= int(mujoco.mjtState.mjSTATE_QFRC_APPLIED.value)
    for first in range(0, setup.steps, SEGMENT):
        last = min(first + SEGMENT, setup.steps)
        control = setup.ctrl(slice(first, last))
        if setup.applied is not None:
            applied = np.zeros((*control.shape[:2], nv))
            applied[:, :, index.dof] = setup.applied[:, first:last]
            control = np.concatenate([control, applied], axis=2)
        records = batch.rollout(last - first, control, spec, record=("qpos", "qvel"))
        wanted = np.flatnonzero((borders > first) & (borders <= last))
        local = borders[wanted] - first - 1
        states.put(index, wanted, records["qpos"][:, local], records["qvel"][:, local])
    return states
