"""MuJoCo step by step on threads, with laws between the steps, all of it in compiled code."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from copy import copy
from typing import TYPE_CHECKING, Any

import numpy as np

from sysid_btr._typing import IntArray
from sysid_btr.simulation.setup import Setup
from sysid_btr.simulation.silence import mujoco_library
from sysid_btr.simulation.simulator import States
from sysid_btr.simulation.stepping import (
    STATE,
    Calls,
    Copies,
    Engine,
    Kept,
    Thread,
    gives_effort,
    plan_of,
    roll,
    written,
)
from sysid_btr.terms.base import Fields

if TYPE_CHECKING:
    import mujoco


def roll_out(setup: Setup, fields: Fields, borders: IntArray, threads: int) -> States:
    """Roll out on a number of threads; `fields` are those in which candidates differ."""
    plan, own = plan_of(setup)
    m, k, model = setup.size, len(borders), setup.model
    states = States.empty(m, k, setup.index, effort=gives_effort(setup))
    qpos, qvel = (np.full((m, k, size), np.nan) for size in (model.nq, model.nv))
    effort = np.empty((0, 0, 0)) if states.effort is None else states.effort
    kept = Kept(np.asarray(borders, dtype=np.int64), qpos, qvel, effort, np.zeros(m, dtype=np.bool_))
    rows = {name: setup.batch.read(name) for name in written(setup)} | fields
    count = min(threads, m)
    stop = np.zeros(1, dtype=np.int64)
    with ThreadPoolExecutor(count) as pool:
        try:
            owned = list(threads_of(model, rows, setup.state, count))
            jobs = [
                pool.submit(roll, m * t // count, m * (t + 1) // count, plan, own, thread, kept, stop)
                for t, (thread, _) in enumerate(owned)
            ]
            for job in jobs:
                job.result()
        finally:
            stop[0] = 1
    states.put(setup.index, np.arange(k), qpos, qvel)
    states.repeat_last_effort()
    states.failed = kept.failed
    return states


def threads_of(model: mujoco.MjModel, fields: Fields, state: Fields, count: int) -> Iterator[tuple[Thread, Any]]:
    """What each thread simulates with, and the objects that own it."""
    import mujoco

    library = mujoco_library()
    reset, step = (ctypes.cast(getattr(library, f"mj_{n}"), ctypes.c_void_p).value for n in ("resetData", "step"))
    assert reset is not None
    assert step is not None
    for _ in range(count):
        own = copy(model)
        data = mujoco.MjData(own)
        rows = [(own.opt if n.startswith("opt.") else own, n.removeprefix("opt."), v) for n, v in fields.items()]
        rows += [(data, n, v) for n, v in state.items()]
        targets: list[Any] = [getattr(owner, name) for owner, name, _ in rows]
        sources = [np.ascontiguousarray(v, dtype=target.dtype) for (_, _, v), target in zip(rows, targets, strict=True)]
        at, start = (np.array([a.ctypes.data for a in arrays], dtype=np.int64) for arrays in (targets, sources))
        # MuJoCo's batches hold the first rows alone of what is longer and does not change, as of a mesh
        sizes = np.array([a[0].nbytes for a in sources], dtype=np.int64)
        for source, target, (_, name, _) in zip(sources, targets, rows, strict=True):
            if source.shape[2:] != target.shape[1:] or source.shape[1:2] > target.shape[:1]:
                raise ValueError(f"{name} is {target.shape}, and candidates have {source.shape[1:]}")
        copies = Copies(at, start, sizes)
        engine = Engine(*(getattr(data if name in STATE else own, name) for name in Engine._fields))
        calls = Calls(reset, step, own._address, data._address)
        yield Thread(calls, copies, engine, data.warning.number), (own, data, targets, sources)
