"""The executor that spreads a batch of candidates over the workers of a dask cluster.

A piece is simulated by a pure function of what the cluster holds, so dask does it again when its worker dies, and on a
new worker sends what that lacks. The pieces of workers that answer no more, or much later than others, are given to
others too; what comes first counts, as all have the same bits.
"""

from __future__ import annotations

import time
import uuid
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import CancelledError
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.errors import LostCluster, ModelError
from sysid_btr.executors.base import Divide, Work
from sysid_btr.executors.wire import Parcel, pack
from sysid_btr.executors.worker import Done, keep, simulate, versions

TICK = 0.5
"""s between looks at what has become of the cluster."""
LATE = 3.0
"""A piece is late that takes this many times as long as the slowest that is done."""
LEAST_LATE = 2.0
"""s below which nothing is late."""
STALLED = 15.0
"""s after which pieces are late of which none is done, where a worker has nothing to do."""
DATA = "sysid-btr-data-"
"""What the cluster's names of our data begin with."""
PIECES = 4
"""Pieces for each thread of the cluster, at most: small ones even out workers of different speed."""
PIECE = 16
"""Candidates below which a thread's share is not cut further: together they share the cost of a Python step."""
EVEN = 1.1
"""Largest part of a problem, over the mean one, up to which they are even enough to be given out whole."""
HELD = 512 * 2**20
"""Bytes of problems that the cluster is left with; more, and it forgets all of them."""


@dataclass(frozen=True)
class Share:
    """What one worker has done.

    Attributes
    ----------
    pieces, candidates : how many.
    seconds, cpu_seconds : spent on them there.
    """

    pieces: int = 0
    candidates: int = 0
    seconds: float = 0.0
    cpu_seconds: float = 0.0

    def with_piece(self, done: Done) -> Share:
        return Share(
            self.pieces + 1,
            self.candidates + len(done.rows),
            self.seconds + done.seconds,
            self.cpu_seconds + done.cpu_seconds,
        )


@dataclass
class _Held:
    """What the cluster was sent, and in which of its pieces of data it lies."""

    packs: list[Any] = field(default_factory=list)
    where: dict[str, int] = field(default_factory=dict)
    bytes: int = 0


class Lost(Exception):
    """The connection to the scheduler broke; what it was given is gone with it."""


class DaskExecutor:
    """Candidates on the workers of a dask cluster.

    Parameters
    ----------
    client : a `distributed.Client`; stays the caller's.
    patience : s without scheduler or workers before it is given up.

    Attributes
    ----------
    shares : worker -> what it has done.
    late : workers that others had to stand in for; they are given nothing more as long as there are others.
    """

    def __init__(self, client: Any, *, patience: float) -> None:
        self.shares: dict[str, Share] = {}
        self.late: set[str] = set()
        self._client = client
        self._patience = patience
        self._address = str(client.scheduler.address)
        self._versions = versions()
        self._parcels: WeakKeyDictionary[Any, tuple[str, tuple[str, ...]]] = WeakKeyDictionary()
        self._held = _Held()

    def run(self, work: Work, problem: Any, candidates: FloatArray, divide: Divide | None = None) -> FloatArray:
        """See `Executor`. One candidate of one log is simulated here: it would only travel.

        Raises
        ------
        LostCluster
            If scheduler or workers stay away.
        """
        divide = divide or (lambda most: [(problem, 1.0)])
        alone = len(candidates) < 2 and len(divide(2)) < 2
        if alone or self._client.status in ("closing", "closed"):
            return work(problem, candidates)
        return _Batch(self, work, divide, candidates).run()

    def threads(self) -> Mapping[str, int]:
        """Workers that are not late, and their threads; waits a while for the first one.

        Raises
        ------
        Lost
            If the scheduler does not answer.
        LostCluster
            If there is no worker.
        """
        until = time.monotonic() + self._patience
        while True:
            found: Mapping[str, int] = self.ask(self._client.scheduler.ncores)
            if found:
                good = {worker: n for worker, n in found.items() if worker not in self.late}
                if not good:
                    self.late.clear()
                return good or found
            if time.monotonic() > until:
                raise LostCluster(
                    f"the scheduler {self._address} has had no worker for {self._patience:g} s; start some: "
                    f"dask worker {self._address} --nworkers auto --nthreads 1"
                )
            time.sleep(TICK)

    def caught_up(self, busy: Mapping[str, Sequence[str]]) -> list[str]:
        """Workers that were late and have nothing to do now; they are late no more."""
        found = [worker for worker in self.ask(self._client.scheduler.ncores) if worker in self.late]
        found = [worker for worker in found if not busy.get(worker)]
        self.late.difference_update(found)
        return found

    def ask(self, question: Callable[..., Any], *given: Any) -> Any:
        """An answer of the scheduler.

        Raises
        ------
        Lost
            If none comes.
        """
        try:
            return self._client.sync(question, *given, callback_timeout=self._patience)
        except (OSError, TimeoutError, AttributeError) as error:  # without connection there is no `scheduler`
            raise Lost from error

    def send(self, problem: Any, workers: Sequence[str] | None) -> tuple[str, list[Any]]:
        """Key of a problem, and the cluster's data in which it lies; what the cluster lacks goes to these workers."""
        known = self._parcels.get(problem)
        if known is None or any(name not in self._held.where for name in known[1]):
            parcel = pack(problem)
            self._add(parcel, workers)
            known = parcel.key, (parcel.key, *parcel.parts)
            self._parcels[problem] = known
        numbers = sorted({self._held.where[name] for name in known[1]})
        return known[0], [self._held.packs[i] for i in numbers]

    def _add(self, parcel: Parcel, workers: Sequence[str] | None) -> None:
        import dask

        parts = {parcel.key: parcel.content, **parcel.parts}
        if self._held.bytes > HELD:
            self.forget()
        held = self._held
        new = {name: data for name, data in parts.items() if name not in held.where}
        if not new:
            return
        with dask.config.set({"distributed.admin.large-graph-warning-threshold": "1 TB"}):
            held.packs.append(self._submit(keep, new, key=DATA + uuid.uuid4().hex, workers=workers))
        held.where.update(dict.fromkeys(new, len(held.packs) - 1))
        held.bytes += sum(map(len, new.values()))

    def forget(self) -> None:
        """Nothing is at the cluster any more."""
        self._held = _Held()

    def submit(self, *given: Any, key: str, workers: Sequence[str] | None) -> Any:
        """A piece to be simulated by one of some workers, or by any."""
        return self._submit(simulate, *given, self._versions, key=key, workers=workers)

    def _submit(self, *given: Any, key: str, workers: Sequence[str] | None) -> Any:
        # a worker that is named may die, and its successor has another name
        named = {} if workers is None else {"workers": list(workers), "allow_other_workers": True}
        return self._client.submit(*given, key=key, pure=False, **named)

    def wait_for_scheduler(self) -> None:
        """Until the connection is back.

        Raises
        ------
        LostCluster
            If it stays away.
        """
        self.forget()
        until = time.monotonic() + self._patience + TICK
        while time.monotonic() < until and self._client.status not in ("closing", "closed"):
            if self._client.status == "running" and self._client.scheduler is not None:
                try:
                    self.ask(self._client.scheduler.identity)
                    return
                except Lost:
                    pass
            time.sleep(TICK)
        raise LostCluster(
            f"the scheduler {self._address} has not answered for {self._patience:g} s; restart it and its workers, or "
            "continue elsewhere (--executor local, or without)"
        )

    def count(self, done: Done) -> None:
        self.shares[done.worker] = self.shares.get(done.worker, Share()).with_piece(done)


class _Batch:
    """One batch on its way."""

    def __init__(self, pool: DaskExecutor, work: Work, divide: Divide, candidates: FloatArray) -> None:
        self.pool, self.work, self.divide, self.candidates = pool, work, divide, candidates
        self.name = f"sysid-btr-{uuid.uuid4().hex}"
        self.pieces: list[tuple[Any, slice]] = []
        """Part of the problem, and rows of the candidates, part by part."""
        self.done: dict[int, FloatArray] = {}
        self.waiting: dict[Any, int] = {}
        self.threads: Mapping[str, int] = {}
        self.blamed: dict[int, set[str]] = {}
        self.slowest: float | None = None
        self.last = time.monotonic()
        self.sent = 0

    def run(self) -> FloatArray:
        """All rows."""
        try:
            while not self.pieces or len(self.done) < len(self.pieces):
                try:
                    if not self.waiting:
                        self.begin()
                    self.wait()
                except Lost:
                    self.waiting.clear()
                    self.pool.wait_for_scheduler()
        finally:
            if self.waiting:
                self.drop(list(self.waiting))
        beside: dict[int, list[FloatArray]] = {}
        for i, (part, _) in enumerate(self.pieces):
            beside.setdefault(id(part), []).append(self.done[i])
        columns = [np.concatenate(rows) for rows in beside.values()]
        return columns[0] if len(columns) == 1 else np.concatenate(columns, axis=1)

    def begin(self) -> None:
        """Give out every piece that is not done."""
        self.threads = self.pool.threads()
        if not self.pieces:
            self.pieces = cut(self.divide, len(self.candidates), sum(self.threads.values()))
        waiting = [i for i in range(len(self.pieces)) if i not in self.done]
        seats = [worker for worker, n in self.threads.items() for _ in range(n)]
        if len(waiting) <= len(seats):
            # the scheduler would give two to the worker that has the data
            for i, worker in zip(waiting, seats, strict=False):
                self.give(i, [worker])
        else:
            for i in waiting:
                self.give(i, list(self.threads) if self.pool.late else None)
        self.last = time.monotonic()

    def give(self, i: int, workers: Sequence[str] | None) -> None:
        """Let one of some workers do a piece, or any."""
        part, which = self.pieces[i]
        key, packs = self.pool.send(part, workers)
        self.sent += 1
        rows = self.candidates[which]
        future = self.pool.submit(self.work, key, packs, rows, key=f"{self.name}-{i}-{self.sent}", workers=workers)
        self.waiting[future] = i

    def wait(self) -> None:
        """Until a piece is done, or for a moment."""
        import distributed

        wait: Callable[..., Any] = distributed.wait
        try:
            with self.pool._client.as_current():
                ended = wait(list(self.waiting), timeout=TICK, return_when="FIRST_COMPLETED").done
        except TimeoutError:
            self.look_after()
            return
        except (CancelledError, OSError) as error:
            raise Lost from error
        for future in ended:
            self.take(future)

    def take(self, future: Any) -> None:
        """What has become of a piece."""
        from distributed import KilledWorker

        i = self.waiting.get(future)
        if i is None:
            return
        try:
            found: Done = future.result(timeout=self.pool._patience)
        except TimeoutError:  # its worker died between simulating and telling: it is being done again
            return
        except KilledWorker as error:
            raise LostCluster(
                "several workers died while they simulated the same candidates; check that they have enough memory "
                "(dask worker --memory-limit), and read their logs"
            ) from error
        except CancelledError as error:
            raise Lost from error
        except ModuleNotFoundError as error:
            raise ModelError(
                f"a worker lacks the package {error.name!r}: install sysid-btr and the packages of its plug-ins on "
                "every machine of the cluster"
            ) from error
        if i not in self.done:
            self.done[i] = found.rows
            self.pool.count(found)
            self.slowest = max(self.slowest or 0.0, found.seconds)
            self.last = time.monotonic()
            self.pool.late |= self.blamed.pop(i, set()) - {found.worker}
        copies = [other for other, piece in self.waiting.items() if piece == i]
        for other in copies:
            del self.waiting[other]
        if len(copies) > 1:
            self.drop([other for other in copies if other is not future])

    def look_after(self) -> None:
        """Give pieces that are late to workers that have nothing to do."""
        self.threads = self.pool.threads()
        late = STALLED if self.slowest is None else max(LEAST_LATE, LATE * self.slowest)
        if time.monotonic() - self.last < late:
            return
        self.last = time.monotonic()
        busy: Mapping[str, Sequence[str]] = self.pool.ask(self.pool._client.scheduler.processing)
        idle = [worker for worker in self.threads if not busy.get(worker)] or self.pool.caught_up(busy)
        if not idle:
            return
        self.pool.forget()  # who is late may be the one that holds the data
        for future, i in list(self.waiting.items()):
            holders = {w for w, keys in busy.items() if any(k == future.key or k.startswith(DATA) for k in keys)}
            self.blamed.setdefault(i, set()).update(holders)
        for i in sorted(set(self.waiting.values()))[: len(idle)]:
            self.give(i, idle)

    def drop(self, futures: list[Any]) -> None:
        """Nobody wants these any more."""
        if self.pool._client.status == "running":
            self.pool._client.cancel(futures, asynchronous=False)


def cut(divide: Divide, count: int, threads: int) -> list[tuple[Any, slice]]:
    """Pieces of a batch for a number of threads: parts of its problem, and rows of its candidates.

    Few candidates are kept together, and the logs that they are to explain are shared out.
    """
    many = count >= threads * PIECE
    parts = divide(1 if many else threads)
    if len(parts) == 1:
        each = max(1, min(PIECES, count // (threads * PIECE))) * threads
    else:
        even = max(share for _, share in parts) * len(parts) <= EVEN and threads % len(parts) == 0
        each = -(-threads // len(parts)) * (1 if even else 2)
    borders = np.linspace(0, count, min(count, each) + 1).round().astype(int)
    return [(part, slice(int(a), int(b))) for part, _ in parts for a, b in pairwise(borders)]
