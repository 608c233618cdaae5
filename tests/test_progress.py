"""Progress: a line at once, one now and then, and what is going on before anything is fitted."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
from toys import make_log, pendulum, run, swing

from sysid_btr.identify.fit import fit
from sysid_btr.identify.study import make_study
from sysid_btr.progress import ProgressLine
from sysid_btr.simulation.numerics import Numerics


def test_the_first_report_is_a_line_at_once_and_the_next_ones_wait() -> None:
    stream = io.StringIO()
    with ProgressLine("close", stream) as progress:
        progress(done=0, total=None, best=float("inf"), note="reading the motion")
        progress(done=3, total=None, best=2.0, note="iteration 1")
    assert stream.getvalue() == "close: 0 replays, 0 s, reading the motion\n"


def test_a_study_and_the_first_fits_say_what_they_do() -> None:
    """They take minutes for a floating base, before the search itself begins."""
    notes: list[str] = []

    def note(**said: Any) -> None:
        notes.append(said["note"])

    commanded = swing()
    position = run(pendulum(), commanded).position[0]
    noisy = position + np.random.default_rng(0).normal(scale=1e-3, size=position.shape)
    log = make_log(commanded.time, {**commanded.channels, "position.arm": noisy[:, 0]})
    study = make_study(pendulum(), [log], numerics=Numerics("RK4", 0.005), threads=1, progress=note)
    assert notes == ["reading the motion", "initial states"]
    fit(study, ["kp:*"], progress=note)
    assert notes.count("choosing starts") > 1
