"""How the blind benchmark judges families, and how its logs and tables come back from disk."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest

from benchmarks.blind.draw import SAMPLE_LOGS
from benchmarks.blind.families import judge_families
from benchmarks.blind.table import Row, append, read_rows, write_rows
from reference_simulator import forms, load_robot
from reference_simulator.effects import CommandDelay, Effect

LEG = load_robot(SAMPLE_LOGS / "leg.xml")


def name(effect: str, *where: str, confused: Sequence[str] = (), **more: Any) -> dict[str, Any]:
    return {"effect": effect, "where": list(where), "confused_with": list(confused), "parameters": [], **more}


def outcome(verdict: str, planted: Sequence[Effect], *named: dict[str, Any], effort: bool = False) -> str:
    result = {"verdict": verdict, "effects": list(named)}
    return judge_families(result, [e.resolved(LEG) for e in planted], LEG, effort).outcome


KNEE = forms.AsymmetricFriction(where=("KneePitch",))
BAND = forms.ElasticBand(where=("KneePitch",))
SINE = forms.SineTorque(where=("HipRoll",))
TABLE = [
    ("yes", "explained", [KNEE], [name("coulomb_friction", "KneePitch")]),
    ("yes", "partly_explained", [KNEE], [name("stribeck_friction", "KneePitch")]),
    ("yes", "explained", [KNEE], [name("coulomb_friction", "KneePitch"), name("constant_force", "KneePitch")]),
    ("wrong", "explained", [KNEE], [name("coulomb_friction", "KneePitch"), name("constant_force", "HipRoll")]),
    (
        "yes",
        "explained",
        [KNEE, SINE],
        [name("coulomb_friction", "KneePitch"), name("constant_force", "KneePitch", "HipRoll")],
    ),
    (
        "wrong",
        "explained",
        [KNEE, SINE],
        [name("coulomb_friction", "KneePitch"), name("constant_force", "HipPitch", "HipRoll")],
    ),
    ("missed", "explained", [KNEE, SINE], [name("coulomb_friction", "KneePitch"), name("constant_force", "KneePitch")]),
    ("wrong", "explained", [KNEE], [name("coulomb_friction", "HipPitch")]),
    ("provisional", "partly_explained", [KNEE], [name("coulomb_friction", "HipPitch")]),
    ("wrong", "explained", [KNEE], [name("backlash", "KneePitch", confused=["coulomb_friction"])]),
    ("ambiguous", "ambiguous", [KNEE], [name("backlash", "KneePitch", confused=["coulomb_friction"])]),
    ("ambiguous", "ambiguous", [KNEE], [name("coulomb_friction", "KneePitch", confused=["backlash"])]),
    ("yes", "ambiguous", [KNEE], [name("coulomb_friction", "KneePitch", confused=["load_friction"])]),
    ("unexplained", "unexplained", [KNEE], []),
    ("missed", "nothing_missing", [KNEE], []),
    ("missed", "explained", [KNEE, CommandDelay()], [name("coulomb_friction", "KneePitch")]),
    ("yes", "explained", [CommandDelay()], [name("actuator_filter", *LEG.joints)]),
    ("yes", "explained", [CommandDelay()], [name("command_delay", *LEG.joints[:5])]),
    ("wrong", "explained", [CommandDelay()], [name("command_delay", *LEG.joints[:3])]),
    ("yes", "explained", [forms.StiffnessRamp()], [name("voltage_sag", "robot")]),
    ("yes", "explained", [BAND], [name("joint_spring", "HipPitch", "KneePitch")]),
    ("wrong", "explained", [BAND], [name("joint_spring", "AnklePitch")]),
    ("unexplained", "unexplained", [KNEE], [name("free_torque", "KneePitch", family="unknown torque")]),
]


@pytest.mark.parametrize(("expected", "verdict", "planted", "named"), TABLE)
def test_families_and_places_decide(
    expected: str, verdict: str, planted: list[Effect], named: list[dict[str, Any]]
) -> None:
    assert outcome(verdict, planted, *named) == expected


def test_only_effort_tells_a_filtered_encoder_from_a_late_command() -> None:
    filtered, late = forms.EncoderFilter(where=("KneePitch",)), name("command_delay", "KneePitch")
    assert outcome("explained", [filtered], late) == "yes"
    assert outcome("explained", [filtered], late, effort=True) == "wrong"


def test_certainties_are_kept_with_whether_the_name_is_right() -> None:
    named = [name("coulomb_friction", "KneePitch", certainty=0.9), name("backlash", "HipRoll", certainty=0.2)]
    result = {"verdict": "partly_explained", "effects": named}
    found = judge_families(result, [KNEE], LEG, effort=False)
    assert [(g.certainty, right) for g, right in found.named] == [(0.9, True), (0.2, False)]


def test_of_one_family_the_least_sure_name_and_what_it_rests_on_are_kept() -> None:
    sure = name("coulomb_friction", "KneePitch", certainty=0.9, evidence={"family": 0.99, "left": 0.01})
    less = name("viscous_damping", "KneePitch", certainty=0.6, evidence={"family": 0.7, "left": 0.1})
    found = judge_families({"verdict": "explained", "effects": [sure, less]}, [KNEE], LEG, effort=False)
    assert [(g.certainty, g.evidence) for g, _ in found.named] == [(0.6, less["evidence"])]


def _row(**values: Any) -> Row:
    numbers = {"series": 0, "number": 1, "seed": 1, "effort": 0, "seconds": 1.0, "replays": 2}
    own = {f.name: numbers.get(f.name, f.name) for f in fields(Row)} | values
    return Row(**own)


NEWER = [f.name for f in fields(Row) if f.default == ""]


@pytest.mark.parametrize("lacking", range(1, len(NEWER) + 1))
def test_a_table_without_the_newer_columns_is_read_and_continued(lacking: int, tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    write_rows(path, [_row()])
    old = [",".join(line.split(",")[:-lacking]) for line in path.read_text().splitlines()]
    path.write_text("\n".join(old) + "\n")
    assert read_rows(path)[0] == _row(**dict.fromkeys(NEWER[-lacking:], ""))
    append(path, _row(id="two"))
    assert [r.id for r in read_rows(path)] == ["id", "two"]
    assert read_rows(path)[1].evidence == "evidence"


@pytest.mark.parametrize("columns", [slice(0, -len(NEWER) - 1), slice(1, None)])
def test_a_table_of_other_columns_is_refused(columns: slice, tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    path.write_text(",".join([f.name for f in fields(Row)][columns]) + "\n")
    with pytest.raises(ValueError, match="other columns"):
        read_rows(path)


def test_a_recorded_log_comes_back_with_its_truth(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pinocchio", reason="recording needs Pinocchio (pip install pin)", exc_type=ImportError)
    import numpy as np

    from benchmarks.blind import recorded
    from reference_simulator import record
    from sysid_btr.io.parquet import read_log

    monkeypatch.setattr(recorded, "LOGS", tmp_path)
    found = recorded.record("shape", 5, 0)
    case = recorded.draw("shape", 5, 0)
    assert (found.bench, found.effects, found.motion) == (case.bench, case.spec.effects, case.spec.motion)
    assert recorded.record("shape", 5, 0) == found == recorded.read("shape", 5, 0)
    exact, kept = record(case.spec)[0], read_log(found.path)
    for channel, values in exact.channels.items():
        np.testing.assert_allclose(kept.channels[channel], values, rtol=1e-6, atol=1e-7)
