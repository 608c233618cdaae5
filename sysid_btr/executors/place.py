"""Where to simulate, from text to executor."""

from __future__ import annotations

import logging
import signal
import socket
from collections.abc import Iterator
from contextlib import closing, contextmanager
from multiprocessing import resource_tracker
from typing import Any
from urllib.parse import urlsplit

from sysid_btr.errors import UsageError
from sysid_btr.executors.base import HERE, Executor
from sysid_btr.machine import usable_cores
from sysid_btr.optional import optional

CONNECT = 10.0
"""s that a scheduler has to answer at first."""
PATIENCE = 30.0
"""s that scheduler or workers may stay away later."""
LOUD = ("distributed", "tornado")
"""Packages whose logging goes to the terminal."""


@contextmanager
def open_executor(place: str | None) -> Iterator[Executor]:
    """An executor, for as long as the context lasts.

    Parameters
    ----------
    place : ``tcp://HOST:PORT`` of a dask scheduler that runs; ``local`` or ``local:N`` for a cluster of one-thread
        workers on this machine, N or one for each core; None for this process.

    Yields
    ------
    Executor
        For `make_study`. After the context it goes on in this process.

    Raises
    ------
    UsageError
        If that is no place, nobody answers there, or dask is not installed.
    LostCluster
        If the scheduler has no workers.

    Notes
    -----
    Results are those of this process to the last bit, where all machines have the same kind of processor. In a
    script, ``local`` needs the usual ``if __name__ == "__main__":``, because its workers import the script.
    """
    if place is None:
        yield HERE
        return
    count = _local(place)
    if count is None and not place.startswith(("tcp://", "tls://")):
        raise UsageError(
            f"--executor {place}: expected tcp://HOST:PORT of a dask scheduler, or local or local:N for N workers here"
        )
    distributed = optional("distributed", "cluster", f"--executor {place}")
    from sysid_btr.executors.pool import DaskExecutor

    with _quiet_log(), _client(distributed, place, count) as client:
        executor = DaskExecutor(client, patience=PATIENCE)
        executor.threads()
        yield executor


def caution(place: str | None) -> str:
    """What to know of a place before anything is sent there; empty where there is nothing."""
    if place is None or not place.startswith("tcp://"):
        return ""
    return (
        f"--executor {place}: problems travel as pickles, without encryption, and whoever reaches that port can run "
        "code on its workers: keep it within a network that you trust, or use tls:// with certificates"
    )


def _local(place: str) -> int | None:
    """Workers of a cluster of our own; None if it is not one."""
    base, colon, number = place.partition(":")
    if base != "local":
        return None
    if not colon:
        return usable_cores()
    if not number.isdecimal() or int(number) < 1:
        raise UsageError(f"--executor {place}: the number of workers must be 1 or more, as in local:4")
    return int(number)


@contextmanager
def _client(distributed: Any, place: str, count: int | None) -> Iterator[Any]:
    if count is not None:
        with _deaf():
            cluster = distributed.LocalCluster(
                n_workers=count,
                threads_per_worker=1,
                processes=True,
                dashboard_address="127.0.0.1:0",  # else it listens on all addresses, without a password
                silence_logs=logging.CRITICAL,
            )
        with closing(cluster), distributed.Client(cluster, set_as_default=False) as client:
            yield client
        return
    try:
        address = urlsplit(place)
        # asked first, because dask does not take a refusal for an answer
        socket.create_connection((address.hostname or "", address.port or 0), CONNECT).close()
        client = distributed.Client(place, timeout=PATIENCE, set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        raise UsageError(
            f"--executor {place}: no dask scheduler answers there. Start one (dask scheduler), then workers on every "
            f"machine (dask worker {place} --nworkers auto --nthreads 1), and check that the port is open"
        ) from error
    with client:
        yield client


@contextmanager
def _quiet_log() -> Iterator[None]:
    """What dask has to say about lost connections is said by us."""
    ours = [log for name, log in logging.root.manager.loggerDict.items() if name.partition(".")[0] in LOUD]
    before = [(log, log.level) for log in ours if isinstance(log, logging.Logger)]
    for log, _ in before:
        log.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        for log, level in before:
            log.setLevel(level)


@contextmanager
def _deaf() -> Iterator[None]:
    """Processes begun here, and those that they begin, do not hear Ctrl-C: it is for this one, which ends them."""
    resource_tracker.ensure_running()  # it would undo the mask when the first process begins
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
