"""What a worker of the cluster does: keep the problems it was sent, and simulate pieces of batches."""

from __future__ import annotations

import platform
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import version
from threading import Lock
from time import perf_counter, process_time
from typing import Any

from sysid_btr._typing import FloatArray
from sysid_btr.errors import ModelError
from sysid_btr.executors.base import Work
from sysid_btr.executors.wire import unpack

KEPT = 8
"""Problems a worker keeps unpacked."""
HOME = "sysid_btr"
"""Attribute of dask's worker object under which ours lives, as long as the worker."""


@dataclass(frozen=True)
class Done:
    """A simulated piece.

    Attributes
    ----------
    rows : one for each candidate.
    seconds, cpu_seconds : wall time, and CPU time of the process meanwhile.
    worker : address of who did it.
    """

    rows: FloatArray
    seconds: float
    cpu_seconds: float
    worker: str


@dataclass
class Shelf:
    """Problems a worker has unpacked, the latest last."""

    problems: OrderedDict[str, Any] = field(default_factory=OrderedDict)
    lock: Lock = field(default_factory=Lock)

    def get(self, key: str, packs: Sequence[Mapping[str, bytes]]) -> Any:
        with self.lock:
            if key not in self.problems:
                parts = {name: data for pack in packs for name, data in pack.items()}
                self.problems[key] = unpack(parts[key], parts)
                while len(self.problems) > KEPT:
                    self.problems.popitem(last=False)
            self.problems.move_to_end(key)
            return self.problems[key]


def versions() -> dict[str, str]:
    """What must be the same everywhere for the same bits."""
    from sysid_btr.version import __version__

    found = {"sysid-btr": __version__, "Python": ".".join(platform.python_version_tuple()[:2])}
    return found | {name: version(name) for name in ("mujoco", "numpy", "scipy")}


def keep(pack: dict[str, bytes]) -> dict[str, bytes]:
    """Parts of problems, as the cluster's own data: a worker that needs them gets them once from another one."""
    return pack


def simulate(
    work: Work, key: str, packs: Sequence[Mapping[str, bytes]], rows: FloatArray, wanted: Mapping[str, str]
) -> Done:
    """Simulate one piece.

    Parameters
    ----------
    work : of problem and candidates.
    key : of the problem.
    packs : that hold it.
    rows : (m, p) candidates.
    wanted : versions of who asks.

    Raises
    ------
    ModelError
        If the versions here differ.
    """
    from distributed import get_worker

    worker = get_worker()
    shelf = vars(worker).get(HOME)
    if shelf is None:
        shelf = _settle(worker, wanted)
    wall, cpu = perf_counter(), process_time()
    result = work(shelf.get(key, packs), rows)
    return Done(result, perf_counter() - wall, process_time() - cpu, worker.address)


def _settle(worker: Any, wanted: Mapping[str, str]) -> Shelf:
    """First piece on this worker."""
    from sysid_btr.simulation.silence import silence

    own = versions()
    differ = [f"{name} {own[name]} instead of {v}" for name, v in wanted.items() if own[name] != v]
    if differ:
        raise ModelError(
            f"worker {worker.address} has {', '.join(differ)}: its results would differ. Install the same "
            "versions on all machines"
        )
    silence()
    shelf: Shelf = vars(worker).setdefault(HOME, Shelf())
    return shelf
