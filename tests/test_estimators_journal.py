"""The journal: exact floats, torn and damaged files, other fits' journals, large attachments."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from sysid_btr.errors import UsageError
from sysid_btr.estimators import Budget, Evaluator, Journal, Record, Stop, Termination, get_estimator, silent
from sysid_btr.testing import Killed, Witness, exponential_decay, rosenbrock, run


def _record(value: float) -> Record:
    return Record("loss", np.array([[value, -value]]), {"loss": np.array([value])}, seconds=value)


def _write(path: Path, n: int = 3, fingerprint: str = "mine") -> Journal:
    journal = Journal(path, fingerprint=fingerprint)
    for i in range(n):
        journal.append(_record(0.1 * (i + 1)))
    return journal


_floats = st.floats(allow_nan=False, width=64)


@given(candidates=arrays(np.float64, (2, 3), elements=_floats), loss=arrays(np.float64, 2, elements=_floats))
def test_a_record_survives_its_text_bit_by_bit(candidates: np.ndarray, loss: np.ndarray) -> None:
    again = Record.from_line(Record("loss", candidates, {"loss": loss}, 0.1).to_line())
    assert again.candidates.tobytes() == candidates.tobytes()
    assert again.arrays["loss"].tobytes() == loss.tobytes()


def test_written_journal_replays(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "fit.journal"
    _write(path)
    journal = Journal(path, fingerprint="mine")
    assert len(journal) == 3
    assert journal.evaluations == 3
    assert journal.seconds == pytest.approx(0.3)
    for i in range(3):
        record = journal.replay("loss", _record(0.1 * (i + 1)).candidates, whole=False)
        assert record is not None
        assert record.arrays["loss"][0] == 0.1 * (i + 1)
    assert journal.replay("loss", np.zeros((1, 2)), whole=False) is None
    journal.append(_record(9.0))
    assert len(Journal(path, fingerprint="mine")) == 4


def test_every_cut_of_the_file_is_survived(tmp_path: Path) -> None:
    """Power may fail at any byte: what was whole is kept, and the journal goes on."""
    path = tmp_path / "fit.journal"
    _write(path)
    data = path.read_bytes()
    ends = [i + 1 for i, byte in enumerate(data) if byte == ord("\n")]
    for cut in range(len(data) + 1):
        path.write_bytes(data[:cut])
        journal = Journal(path, fingerprint="mine")
        assert len(journal) == sum(end <= cut for end in ends[1:])
        for i in range(len(journal), 3):
            journal.rewind()
            while journal.position < len(journal):
                journal.replay("loss", _record(0.1 * (journal.position + 1)).candidates, whole=False)
            journal.append(_record(0.1 * (i + 1)))
        assert path.read_bytes() == data


def test_unwritten_blocks_at_the_end_are_dropped(tmp_path: Path) -> None:
    path = tmp_path / "fit.journal"
    _write(path)
    for rubbish in (b"\0" * 512, b'{"kind": "loss", "candi\n', b"\0" * 40 + b"\n"):
        data = path.read_bytes()
        path.write_bytes(data + rubbish)
        assert len(Journal(path, fingerprint="mine")) == 3
        assert path.read_bytes() == data


def test_damage_in_the_middle_is_reported_and_nothing_lost(tmp_path: Path) -> None:
    path = tmp_path / "fit.journal"
    _write(path)
    damaged = path.read_bytes().replace(b'"kind"', b'"kinb"', 1)
    path.write_bytes(damaged)
    with pytest.raises(UsageError, match="line 2: damaged"):
        Journal(path, fingerprint="mine")
    assert path.read_bytes() == damaged


def test_numbers_that_were_changed_in_a_record_are_noticed(tmp_path: Path) -> None:
    path = tmp_path / "fit.journal"
    journal = Journal(path)
    for value in (1.5, 2.5):
        journal.append(_record(value))
    path.write_bytes(path.read_bytes().replace(b"1.5", b"0.0", 1))
    with pytest.raises(UsageError, match="line 2: damaged"):
        Journal(path)


def test_an_attachment_that_was_changed_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "fit.journal"
    Journal(path).append(_record(1.0), np.ones((3, 2)))
    np.save(tmp_path / "fit.journal.0.npy", np.zeros((3, 2)))
    with pytest.raises(UsageError, match="not what was written"):
        Journal(path).attachment(0)


def test_another_fits_journal_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "fit.journal"
    _write(path, fingerprint="theirs")
    data = path.read_bytes()
    with pytest.raises(UsageError, match=r"belongs to another fit.*'theirs'.*'mine'.*--overwrite"):
        Journal(path, fingerprint="mine")
    assert path.read_bytes() == data


@pytest.mark.parametrize("content", [b"time,q\n0.0,1.0\n", b"time", b'{"a": 1}\n', b"[]\n", b"\xff\xfe\n"])
def test_a_file_that_is_no_journal_is_refused_and_kept(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "log.csv"
    path.write_bytes(content)
    with pytest.raises(UsageError, match="not a journal"):
        Journal(path)
    assert path.read_bytes() == content


def test_a_journal_of_a_later_schema_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "fit.journal"
    path.write_text(json.dumps({"journal": "sysid_btr.journal/9", "fingerprint": ""}) + "\n")
    with pytest.raises(UsageError, match="schema"):
        Journal(path)


def test_other_settings_are_noticed(tmp_path: Path) -> None:
    path = tmp_path / "fit.journal"
    run(get_estimator("ga"), rosenbrock(), journal=Journal(path))
    before = path.read_bytes()
    with pytest.raises(UsageError, match="other candidates"):
        run(get_estimator("ga"), rosenbrock(), journal=Journal(path), seed=1)
    with pytest.raises(UsageError, match="other candidates"):
        run(get_estimator("lsq"), rosenbrock(), journal=Journal(path))
    assert path.read_bytes() == before


def test_append_before_the_end_is_a_mistake() -> None:
    journal = Journal()
    journal.append(_record(1.0))
    journal.rewind()
    with pytest.raises(ValueError, match="last record"):
        journal.append(_record(2.0))


def test_only_the_latest_attachment_is_kept(tmp_path: Path) -> None:
    path = tmp_path / "fit.journal"
    journal = Journal(path)
    for i in range(3):
        journal.append(_record(float(i + 1)), np.full((2, 2), float(i)))
    assert [p.name for p in sorted(tmp_path.iterdir())] == ["fit.journal", "fit.journal.2.npy"]
    again = Journal(path)
    np.testing.assert_array_equal(again.attachment(2), np.full((2, 2), 2.0))
    with pytest.raises(UsageError, match="record 1 cannot be read"):
        again.attachment(0)


def test_each_search_keeps_its_latest_attachment(tmp_path: Path) -> None:
    path = tmp_path / "journal.jsonl"
    first = Journal(path)
    for size in (1.0, 2.0):
        first.append(_record(size), np.full((2, 2), size))
    second = first.section()
    for size in (3.0, 4.0):
        second.append(_record(size), np.full((2, 2), size))
    again = Journal(path)
    for number, size in ((1, 2.0), (3, 4.0)):
        np.testing.assert_array_equal(again.attachment(number), np.full((2, 2), size))
    assert len(list(tmp_path.glob("*.npy"))) == 2


def test_attachments_of_other_journals_are_left_alone(tmp_path: Path) -> None:
    other = tmp_path / "fit.journal.extra"
    Journal(other).append(_record(1.0), np.ones((1, 1)))
    journal = Journal(tmp_path / "fit.journal")
    journal.append(_record(1.0), np.ones((1, 1)))
    journal.append(_record(2.0), np.ones((1, 1)))
    np.testing.assert_array_equal(Journal(other).attachment(0), np.ones((1, 1)))


def test_least_squares_journal_is_small_and_never_holds_residuals(tmp_path: Path) -> None:
    """Normal matrices, not residuals: the text is kilobytes; one array holds the last Jacobian."""
    path = tmp_path / "fit.journal"
    problem = exponential_decay(np.random.default_rng(0), noise=0.01)
    result = run(get_estimator("lsq"), problem, journal=Journal(path))
    assert path.stat().st_size < 40_000
    assert result.jacobian is not None
    attachments = list(tmp_path.glob("*.npy"))
    assert len(attachments) == 1
    assert attachments[0].stat().st_size == pytest.approx(8 * result.jacobian.shape[0] * 4, abs=200)


def test_least_squares_resumes_from_every_record(tmp_path: Path) -> None:
    """Killed between any two batches, it skips none, simulates what the journal cannot hold at most once more, and ends
    with the same bits, Jacobian included."""
    problem = exponential_decay(np.random.default_rng(0), noise=0.01)
    estimator = get_estimator("lsq", n_starts=2)
    reference = Witness(problem)
    whole = run(estimator, reference)
    assert whole.jacobian is not None
    for limit in range(0, whole.evaluations, 3):
        path = tmp_path / f"{limit}.journal"
        witness = Witness(problem, limit=limit, fault=Killed())
        with pytest.raises(Killed):
            run(estimator, witness, journal=Journal(path))
        again = Witness(problem)
        resumed = run(estimator, again, journal=Journal(path))
        assert again.goes_on(witness, len(witness.answered), reference, again=1)
        assert resumed.jacobian is not None
        assert resumed.jacobian.tobytes() == whole.jacobian.tobytes()


@pytest.mark.parametrize("change", [None, [0.0], [[1.0]]])
def test_a_record_that_lacks_what_the_search_keeps_is_refused(tmp_path: Path, change: list[object] | None) -> None:
    """With a checksum that is right: somebody wrote it."""
    path, problem = tmp_path / "fit.journal", exponential_decay(np.random.default_rng(0), noise=0.01)
    run(get_estimator("lsq"), problem, journal=Journal(path))
    whole = Journal(path)
    number = next(i for i, record in enumerate(whole.records) if record.kind == "residuals")
    record = whole.records[number]
    arrays = {name: values for name, values in record.arrays.items() if name != "gram"}
    changed = replace(record, arrays=arrays if change is None else {**arrays, "gram": np.array(change)})
    lines = path.read_bytes().splitlines(keepends=True)
    lines[number + 1] = changed.to_line()
    path.write_bytes(b"".join(lines))
    with pytest.raises(UsageError, match=f"record {number + 1} of the journal.*--overwrite"):
        run(get_estimator("lsq"), problem, journal=Journal(path))


def test_resumed_twice_is_as_once(tmp_path: Path) -> None:
    path = tmp_path / "fit.journal"
    problem = exponential_decay(np.random.default_rng(0), noise=0.01)
    estimator = get_estimator("cmaes")
    whole = run(estimator, problem)
    asked = 0
    for limit in (40, 90):
        witness = Witness(problem, limit=limit, fault=KeyboardInterrupt())
        result = run(estimator, witness, journal=Journal(path))
        assert result.termination is Termination.INTERRUPTED
        asked += len(witness.answered)
    last = Witness(problem)
    result = run(estimator, last, journal=Journal(path))
    assert asked + len(last.answered) == whole.evaluations
    assert result.x.tobytes() == whole.x.tobytes()
    assert result.history == whole.history


def test_a_smaller_budget_reads_only_what_it_pays_for() -> None:
    problem = exponential_decay(np.random.default_rng(0), noise=0.01)
    journal = Journal()
    run(get_estimator("ga"), problem, evaluations=100, journal=journal)
    again = Witness(problem)
    short = run(get_estimator("ga"), again, evaluations=45, journal=journal)
    fresh = run(get_estimator("ga"), problem, evaluations=45)
    assert not again.answered
    assert short.evaluations == 45
    assert (short.loss, short.history) == (fresh.loss, fresh.history)


def test_seconds_of_earlier_runs_count() -> None:
    problem = exponential_decay(np.random.default_rng(0), noise=0.01)
    journal = Journal()
    evaluator = Evaluator(problem, budget=Budget(), journal=journal, progress=silent)
    evaluator.loss(problem.start[None])
    journal.append(Record("loss", problem.upper[None].copy(), {"loss": np.array([1.0])}, seconds=100.0))
    late = Evaluator(problem, budget=Budget(seconds=50.0), journal=journal, progress=silent)
    late.loss(problem.start[None])
    late.loss(problem.upper[None])  # replayed: free
    with pytest.raises(Stop) as caught:
        late.loss(problem.lower[None])
    assert caught.value.termination is Termination.BUDGET_SPENT
    assert late.evaluations == 2


def test_evaluator_clips_before_it_simulates_and_remembers() -> None:
    witness = Witness(rosenbrock())
    evaluator = Evaluator(witness, budget=Budget(), journal=Journal(), progress=silent)
    evaluator.loss(np.array([[9.0, 30.0], [-9.0, 0.0]]))
    np.testing.assert_array_equal(witness.answered, [[5.0, 5.0], [-5.0, 0.0]])
    assert np.all(evaluator.best_x <= 5.0)


@pytest.mark.parametrize("bad", [np.zeros(2), np.zeros((1, 3)), np.array([[np.nan, 0.0]])])
def test_evaluator_refuses_candidates_that_are_not_numbers(bad: np.ndarray) -> None:
    evaluator = Evaluator(rosenbrock(), budget=Budget(), journal=Journal(), progress=silent)
    with pytest.raises(ValueError, match="candidates must be finite"):
        evaluator.loss(bad)


def test_a_problem_that_writes_into_its_candidates_does_no_harm() -> None:
    class Scribbler(Witness):
        def loss(self, candidates: np.ndarray) -> np.ndarray:
            losses = super().loss(candidates)
            candidates[:] = 99.0
            return losses

    evaluator = Evaluator(Scribbler(rosenbrock()), budget=Budget(), journal=Journal(), progress=silent)
    evaluator.loss(rosenbrock().start[None])
    np.testing.assert_array_equal(evaluator.best_x, rosenbrock().start)
