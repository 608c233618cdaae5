"""Many machines: what they give is what one gives, to the last bit, whatever happens to them."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import distributed
import numpy as np
import pytest
import toys
from hypothesis import given
from hypothesis import strategies as st
from terminal import Cli

from sysid_btr._typing import FloatArray
from sysid_btr.errors import LostCluster, ModelError, UsageError
from sysid_btr.estimators.base import Budget
from sysid_btr.estimators.journal import Journal
from sysid_btr.estimators.lsq import LeastSquares
from sysid_btr.executors import open_executor, place, worker
from sysid_btr.executors.base import HERE, Executor
from sysid_btr.executors.pool import DaskExecutor, cut
from sysid_btr.executors.wire import pack, unpack
from sysid_btr.identify.fit import Fit, fit
from sysid_btr.identify.study import Study, make_study
from sysid_btr.io.log import Log
from sysid_btr.io.split import held_out_all_over
from sysid_btr.objectives.distance import DistanceProblem, MeanSquare, Phi1, Phi2, Wasserstein
from sysid_btr.objectives.marginal import Projection
from sysid_btr.objectives.problem import ReplayProblem, of_both
from sysid_btr.simulation.numerics import Numerics
from sysid_btr.terms.library import select_effects
from sysid_btr.terms.model import Model

FREE = ("mass:*", "kp:*=shared", "kv:*=shared")
QUICK = Numerics("RK4", 0.005)
SAMPLES = Path(__file__).resolve().parents[1] / "sample_logs"


@cache
def leg_log(seconds: float = 2.0) -> Log:
    """A leg heavier than its model, with noise."""
    from sysid_btr.identify.replay import replay_log

    log = toys.swing(toys.LEG_JOINTS, seconds)
    run = replay_log(toys.leg(), log, {"mass:knee": 1.3}, numerics=QUICK)
    rng = np.random.default_rng(0)
    noise = {n: c + rng.normal(scale=1e-3, size=len(c)) for n, c in run.channels.items() if n.startswith("position")}
    return replace(run, channels={**log.channels, **noise})


def study(executor: Executor = HERE, logs: int = 1) -> Study:
    own = [leg_log(2.0 + 0.5 * i) for i in range(logs)]
    return make_study(toys.leg(), own, numerics=QUICK, threads=1, executor=executor)


def problem(executor: Executor = HERE, *effects: str, logs: int = 1) -> ReplayProblem:
    own = study(executor, logs)
    # one variant of each effect
    chosen = {e.name: e for e in select_effects(effects)} if effects else {}
    added = [e.at(("hip", "knee"), own.scales) for e in chosen.values()]
    return own.train_problem((*own.declare(FREE), *added))


def candidates(of: ReplayProblem, count: int, seed: int = 0) -> FloatArray:
    rng = np.random.default_rng(seed)
    return of.start + rng.uniform(0.0, 0.2, (count, len(of.start))) * np.minimum(of.upper - of.start, 5 * of.scale)


# --- what makes it possible -------------------------------------------------------------------------------


@pytest.mark.parametrize("effect", ["", "coulomb_friction", "backlash", "command_delay", "thermal_derating"])
def test_a_candidates_numbers_do_not_depend_on_those_beside_it(effect: str) -> None:
    whole = problem(HERE, *([effect] if effect else []), logs=2)
    rows = candidates(whole, 7)
    residuals, losses = whole.residuals(rows), whole.loss(rows)
    for border in (1, 3, 5):
        parts = [rows[:border], rows[border:]]
        assert np.array_equal(np.concatenate([whole.residuals(p) for p in parts]), residuals)
        assert np.array_equal(np.concatenate([whole.loss(p) for p in parts]), losses)


@pytest.mark.parametrize("distance", [MeanSquare(), Phi1(), Phi2(), Wasserstein()])
def test_a_candidates_distance_does_not_depend_on_those_beside_it(distance: Any) -> None:
    whole = DistanceProblem(problem(), distance)
    rows = candidates(whole.whole, 7)
    parts = [whole.loss(rows[:1]), whole.loss(rows[1:3]), whole.loss(rows[3:])]
    assert np.array_equal(np.concatenate(parts), whole.loss(rows))


def test_whitening_does_not_depend_on_the_candidates_beside() -> None:
    rng = np.random.default_rng(0)
    k, d = 220, 20
    basis = np.linalg.qr(rng.normal(size=(k, d)))[0]
    projection = Projection(np.arange(k), basis, rng.uniform(0, 9, d), rng.normal(size=k), 0.5)
    part = rng.normal(size=(12, k))
    whole = projection.whiten(part)
    for first in range(12):
        assert np.array_equal(projection.whiten(part[first : first + 5]), whole[first : first + 5])


def undivided(most: int) -> list[tuple[Any, float]]:
    return [("whole", 1.0)]


@given(st.integers(1, 3000), st.integers(1, 200))
def test_pieces_cover_a_batch_once_and_keep_every_thread_busy(count: int, threads: int) -> None:
    pieces = [rows for _, rows in cut(undivided, count, threads)]
    assert [i for piece in pieces for i in range(count)[piece]] == list(range(count))
    sizes = [piece.stop - piece.start for piece in pieces]
    assert max(sizes) - min(sizes) <= 1
    assert len(pieces) >= min(count, threads)


@given(st.integers(1, 200), st.integers(1, 16), st.lists(st.integers(1, 50), min_size=1, max_size=40))
def test_logs_are_shared_out_where_candidates_are_few(count: int, threads: int, lengths: list[int]) -> None:
    def divide(most: int) -> list[tuple[Any, float]]:
        parts = [list(part) for part in np.array_split(lengths, min(most, len(lengths)))]
        return [(tuple(part), sum(part) / sum(lengths)) for part in parts]

    pieces = cut(divide, count, threads)
    for part in dict.fromkeys(part for part, _ in pieces):
        rows = [i for own, piece in pieces if own == part for i in range(count)[piece]]
        assert rows[: rows.index(count - 1) + 1] == list(range(count))
    assert len(pieces) >= min(threads, count * min(threads, len(lengths)))


@pytest.mark.parametrize("effect", ["", "coulomb_friction", "stribeck_friction"])
def test_a_problem_in_parts_gives_side_by_side_what_the_whole_gives(effect: str) -> None:
    whole = problem(HERE, *([effect] if effect else []), logs=3)
    rows = candidates(whole, 3)
    for most in (1, 2, 3, 7):
        divided = whole.divided(most)
        assert len(divided) == min(most, 3)
        assert sum(share for _, share in divided) == pytest.approx(1.0)
        assert whole.divided(most) is divided
        beside = np.concatenate([part.residuals(rows) for part, _ in divided], axis=1)
        assert np.array_equal(beside, whole.residuals(rows))
        errors = np.concatenate([part.errors(rows[0]) for part, _ in divided])
        assert np.array_equal(errors, whole.errors(rows[0]))


@pytest.mark.parametrize("logs", [1, 2])
@pytest.mark.parametrize("at_the_end", [True, False])
def test_one_replay_gives_what_is_fitted_and_what_is_held_out(logs: int, at_the_end: bool) -> None:
    own = study(logs=logs)
    if not at_the_end:
        held = [held_out_all_over(e.recording.time, 0.3, 7) for e in own.train]
        train = tuple(e.scoring(~h) for e, h in zip(own.train, held, strict=True))
        own = replace(own, train=train, holdout=tuple(e.scoring(h) for e, h in zip(own.train, held, strict=True)))
    terms = own.declare(FREE)
    fitted, heldout = own.train_problem(terms), own.holdout_problem(terms)
    values = candidates(fitted, 1)
    asked: list[ReplayProblem] = []

    def look(at: ReplayProblem) -> FloatArray:
        asked.append(at)
        return np.asarray(at.residuals(values)[0])

    found = of_both(fitted, heldout, look)
    assert len(asked) == 1
    assert np.array_equal(found[0], fitted.residuals(values)[0])
    assert np.array_equal(found[1], heldout.residuals(values)[0])


def test_another_log_that_is_held_out_is_replayed_by_itself() -> None:
    other = replace(leg_log(), channels={n: c + 1e-3 for n, c in leg_log().channels.items()})
    own = make_study(toys.leg(), [leg_log()], holdout=[other], numerics=QUICK, threads=1)
    terms = own.declare(FREE)
    fitted, heldout = own.train_problem(terms), own.holdout_problem(terms)
    values = candidates(fitted, 1)
    found = of_both(fitted, heldout, lambda at: np.asarray(at.residuals(values)[0]))
    assert np.array_equal(found[0], fitted.residuals(values)[0])
    assert np.array_equal(found[1], heldout.residuals(values)[0])


def test_a_problem_travels_without_what_made_its_model() -> None:
    whole = problem(HERE, "backlash")
    parcel = pack(whole)
    there = unpack(parcel.content, parcel.parts)
    assert b"<mujoco" not in parcel.content
    assert np.array_equal(there.residuals(candidates(whole, 3)), whole.residuals(candidates(whole, 3)))
    with pytest.raises(ModelError, match="another process"):
        there.with_numerics(QUICK.halved()).loss(candidates(whole, 1))


def test_problems_of_the_same_logs_share_what_is_large() -> None:
    own = study()
    masses, gains = (own.train_problem(own.declare([f])) for f in FREE[:2])
    first, again, second = pack(masses), pack(masses), pack(gains)
    assert (first.key, first.parts) == (again.key, again.parts)
    assert first.key != second.key
    assert set(first.parts) == set(second.parts)


# --- a cluster --------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def pool() -> Iterator[DaskExecutor]:
    with open_executor("local:2") as executor:
        assert isinstance(executor, DaskExecutor)
        yield executor


def test_a_cluster_of_our_own_listens_to_this_machine_alone(pool: DaskExecutor) -> None:
    import psutil

    here = psutil.Process()
    sockets = [c for p in (here, *here.children(recursive=True)) for c in p.net_connections(kind="inet")]
    listening = {c.laddr.ip for c in sockets if c.status == psutil.CONN_LISTEN}
    assert listening == {"127.0.0.1"}


@cache
def fit_here() -> Fit:
    return run_fit(study())


def run_fit(own: Study, **options: Any) -> Fit:
    given = {"journal": Journal(), "progress": lambda **_: None, **options}
    return fit(own, own.declare(FREE), estimator=LeastSquares(), rng=np.random.default_rng(0), budget=Budget(), **given)


def assert_same(found: Fit, expected: Fit) -> None:
    assert np.array_equal(found.values, expected.values)
    assert [e.std for e in found.estimates] == [e.std for e in expected.estimates]
    assert found.replays == expected.replays
    assert found.result.loss == expected.result.loss


def test_a_cluster_gives_what_one_machine_gives(pool: DaskExecutor) -> None:
    there, here = problem(pool, "coulomb_friction", logs=2), problem(HERE, "coulomb_friction", logs=2)
    rows = candidates(here, 9)
    assert np.array_equal(there.residuals(rows), here.residuals(rows))
    assert np.array_equal(there.loss(rows), here.loss(rows))
    distance = Wasserstein()
    assert np.array_equal(DistanceProblem(there, distance).loss(rows), DistanceProblem(here, distance).loss(rows))
    # residuals and losses of either log, distances of both at once
    assert sum(share.candidates for share in pool.shares.values()) == 5 * len(rows)
    assert len(pool.shares) == 2


def test_one_candidate_of_two_logs_is_shared_out(pool: DaskExecutor) -> None:
    there, here = problem(pool, logs=2), problem(HERE, logs=2)
    before = sum(share.pieces for share in pool.shares.values())
    row = candidates(here, 1)
    assert np.array_equal(there.residuals(row), here.residuals(row))
    assert np.array_equal(there.errors(row[0]), here.errors(row[0]))
    assert there.loss(row)[0] == here.loss(row)[0]
    assert sum(share.pieces for share in pool.shares.values()) - before >= 6


def test_logs_and_model_are_sent_once(pool: DaskExecutor) -> None:
    whole = problem(pool)
    pool.forget()
    for seed in range(3):
        whole.loss(candidates(whole, 4, seed))
    assert len(pool._held.packs) == 1
    sent = set(pool._held.where)
    changed = whole.with_model(Model.of(study().declare(["mass:knee"])))
    changed.loss(np.linspace(0.9, 1.1, 4)[:, None])
    assert len(set(pool._held.where) - sent) == 1  # the terms, in the problem's own content


def test_a_fit_on_a_cluster_is_that_of_one_machine(pool: DaskExecutor) -> None:
    assert_same(run_fit(study(pool)), fit_here())


def noted(folder: Path, of: ReplayProblem, rows: FloatArray) -> FloatArray:
    """Losses; every candidate that is begun leaves a mark, and the process that began it its number."""
    for row in rows:
        with (folder / f"{row[0]!r}").open("a") as file:
            file.write(f"{os.getpid()}\n")
    return np.asarray(of._losses(rows).sum(axis=1))


def die_once(folder: Path, of: ReplayProblem, rows: FloatArray) -> FloatArray:
    """Losses; the first worker that comes to the last candidate dies when it has begun."""
    result = noted(folder, of, rows)
    if (folder / "victim").read_text() in {repr(row[0]) for row in rows} and not (folder / "dead").exists():
        (folder / "dead").touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return result


def stall_once(folder: Path, of: ReplayProblem, rows: FloatArray) -> FloatArray:
    """Losses; one worker does not come back until it may."""
    first = not (folder / "stalled").exists() and (folder / "victim").read_text() in {repr(row[0]) for row in rows}
    if first:
        (folder / "stalled").touch()
        while folder.exists() and not (folder / "go").exists():
            time.sleep(0.05)
    return np.asarray(of._losses(rows).sum(axis=1))


def test_a_worker_that_dies_costs_its_share_only(
    pool: DaskExecutor, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # on a busy machine a piece may be late, and done twice for that
    monkeypatch.setattr("sysid_btr.executors.pool.LEAST_LATE", np.inf)
    monkeypatch.setattr("sysid_btr.executors.pool.STALLED", np.inf)
    pool._client.wait_for_workers(2)
    pool.late.clear()
    whole = problem(pool)
    rows = candidates(whole, 64)
    (tmp_path / "victim").write_text(repr(rows[-1][0]))
    found = pool.run(partial(die_once, tmp_path), whole, rows)
    assert np.array_equal(found, problem().loss(rows))
    assert (tmp_path / "dead").exists()
    begun_by = [(tmp_path / f"{row[0]!r}").read_text().splitlines() for row in rows]
    dead = begun_by[-1][0]
    assert len(begun_by[-1]) == 2  # what it had begun
    others = [each for each in begun_by if each[0] != dead]
    assert others
    assert all(len(each) == 1 for each in others)


def test_a_fit_goes_on_when_a_worker_dies(pool: DaskExecutor) -> None:
    """And the worker in its place is sent what it lacks."""
    pids = list(pool._client.run(os.getpid).values())

    def kill_one(**_: Any) -> None:
        if pids:
            os.kill(pids.pop(), signal.SIGKILL)
            pids.clear()

    assert_same(run_fit(study(pool), progress=kill_one), fit_here())


@contextmanager
def one_stalls(pool: DaskExecutor, folder: Path) -> Iterator[tuple[ReplayProblem, FloatArray]]:
    """A problem and candidates of which `stall_once` holds one up, until the context ends."""
    pool._client.wait_for_workers(2)
    pool.late.clear()
    whole = problem(pool)
    rows = candidates(whole, 4)
    (folder / "victim").write_text(repr(rows[0][0]))
    try:
        yield whole, rows
    finally:
        (folder / "go").touch()
        pool.late.clear()


def test_others_stand_in_for_a_worker_that_does_not_come_back(pool: DaskExecutor, tmp_path: Path) -> None:
    with one_stalls(pool, tmp_path) as (whole, rows):
        found = pool.run(partial(stall_once, tmp_path), whole, rows)
        assert np.array_equal(found, problem().loss(rows))
        assert (tmp_path / "stalled").exists()
        (late,) = pool.late
        before = pool.shares.get(late)
        assert np.array_equal(whole.loss(rows), found)
        assert pool.shares.get(late) == before


def test_who_was_late_once_stands_in_for_the_last_one(pool: DaskExecutor, tmp_path: Path) -> None:
    with one_stalls(pool, tmp_path) as (whole, rows):
        pool.late.add(next(iter(pool.threads())))
        found = pool.run(partial(stall_once, tmp_path), whole, rows)
        assert np.array_equal(found, problem().loss(rows))


def test_an_error_of_the_work_is_told_as_it_is(pool: DaskExecutor) -> None:
    with pytest.raises(ValueError, match="expected 5"):
        problem(pool).loss(np.ones((4, 3)))


# --- a scheduler somewhere --------------------------------------------------------------------------------


@pytest.fixture
def scheduler(monkeypatch: pytest.MonkeyPatch) -> Iterator[SimpleNamespace]:
    """A scheduler and a worker in processes of their own."""
    import socket

    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{free.getsockname()[1]}"
    monkeypatch.setattr(place, "PATIENCE", 1.0)
    silent = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    dask = [sys.executable, "-m", "dask"]
    host, port = address.removeprefix("tcp://").split(":")
    began = subprocess.Popen(
        [*dask, "scheduler", "--host", host, "--port", port, "--dashboard-address", ":0"], **silent
    )
    processes = [began]

    def add_worker() -> None:
        options = ["--nthreads", "1", "--no-nanny", "--dashboard-address", ":0"]
        processes.append(subprocess.Popen([*dask, "worker", address, *options], **silent))
        with distributed.Client(address, set_as_default=False) as client:
            client.wait_for_workers(1, timeout=60)

    for _ in range(200):
        try:
            socket.create_connection((host, int(port)), 1).close()
            break
        except OSError:
            time.sleep(0.05)
    yield SimpleNamespace(address=address, process=began, add_worker=add_worker)
    for process in reversed(processes):
        process.kill()
        process.wait()


def test_a_lost_scheduler_ends_in_a_message_and_the_run_is_resumed(
    scheduler: SimpleNamespace, cli: Cli, tmp_path: Path
) -> None:
    command = (
        "fit", "--model", SAMPLES / "pendulum.xml", "--log", SAMPLES / "pendulum_clean.parquet",
        *("--fit", "mass:*", "--fit", "kp:*", "--fit", "kv:*", "--threads", 1, "--json"),
    )  # fmt: skip
    journal = tmp_path / "run" / "journal.jsonl"

    def kill_in_mid_run() -> None:
        until = time.monotonic() + 60
        while time.monotonic() < until and not (journal.exists() and journal.stat().st_size > 500):
            time.sleep(0.01)
        scheduler.process.kill()

    no_worker = cli(*command, "--executor", scheduler.address)
    assert no_worker.code == 130
    assert "dask worker" in no_worker.err
    scheduler.add_worker()
    killer = threading.Thread(target=kill_in_mid_run)
    killer.start()
    lost = cli(*command, "--executor", scheduler.address, "--out", journal.parent)
    killer.join()
    assert lost.code == 130, lost.err
    assert "has not answered" in lost.err
    assert "--resume" in lost.err
    resumed, whole = cli(*command, "--out", journal.parent, "--resume"), cli(*command)
    assert resumed.code == whole.code == 0
    assert json.loads(resumed.out)["parameters"] == json.loads(whole.out)["parameters"]


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ("local:0", "1 or more"),
        ("local:x", "1 or more"),
        ("somewhere", "tcp://HOST:PORT"),
        ("tcp://127.0.0.1:1", "dask"),
    ],
)
def test_what_is_no_place_says_what_is(given: str, said: str) -> None:
    with pytest.raises(UsageError, match=said), open_executor(given):
        pass


def test_without_dask_the_message_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(UsageError, match=r"pip install 'sysid-btr\[cluster\]'"), open_executor("local:1"):
        pass
    with open_executor(None) as executor:
        assert executor is HERE


def test_a_worker_with_other_versions_is_refused() -> None:
    with pytest.raises(ModelError, match=r"w1 has .*mujoco.* instead of 0\.1"):
        worker._settle(SimpleNamespace(address="w1"), {**worker.versions(), "mujoco": "0.1"})


def test_a_lost_cluster_is_an_interrupted_run() -> None:
    assert LostCluster.exit_code == 130
