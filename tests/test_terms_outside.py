"""A term from another package: one class, and it is fitted, found and written as the built-in ones are."""

from __future__ import annotations

from dataclasses import dataclass, replace
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import ClassVar

import mujoco
import numpy as np
import pytest
import toys

from sysid_btr._typing import FloatArray
from sysid_btr.diagnosis.close import close
from sysid_btr.errors import UsageError
from sysid_btr.identify.fit import fit
from sysid_btr.identify.replay import replay_log
from sysid_btr.identify.study import Study, make_study
from sysid_btr.run_folder import Folder
from sysid_btr.simulation.numerics import Numerics
from sysid_btr.terms.base import BatchModel, Fields, Kind
from sysid_btr.terms.effect import Effect
from sysid_btr.terms.library import ENTRY_POINTS
from sysid_btr.terms.scales import JointScale
from sysid_btr.testing import check_term
from sysid_btr.writeback.write import draft, identified, save_model


@dataclass(frozen=True)
class HardeningSpring(Effect):
    """A spring that hardens as it is stretched, as a rubber sleeve does: torque -k q^3.

    Native: the second of `jnt_stiffnesspoly`.
    """

    name: ClassVar[str] = "hardening_spring"
    title: ClassVar[str] = "spring that hardens"
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("k", "Nm/rad3", 0.0, 0.0, 10.0, 0.1),)
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (("joint_spring", "motion of several sizes"),)

    @classmethod
    def sized(cls, scale: JointScale) -> tuple[Kind, ...]:
        k = max(scale.torque_rms, 1e-9) / max(scale.span, 1e-9) ** 3
        return (replace(cls.kinds[0], upper=100 * k, scale=k),)

    def model_fields(self, batch: BatchModel, values: FloatArray) -> Fields:
        stiffness = batch.read("jnt_stiffnesspoly")
        stiffness[:, [batch.model.joint(name).id for name in self.places], 1] += values[:, :, 0]
        return {"jnt_stiffnesspoly": stiffness}


TRUE = 1.5
"""Nm/rad3."""


@pytest.fixture(autouse=True)
def installed(monkeypatch: pytest.MonkeyPatch) -> None:
    """As if another package had said ``[project.entry-points."sysid_btr.terms"] hardening_spring = ...``."""
    entry = EntryPoint("hardening_spring", f"{__name__}:HardeningSpring", ENTRY_POINTS)
    monkeypatch.setattr(EntryPoint, "load", lambda self: HardeningSpring)
    monkeypatch.setattr("importlib.metadata.entry_points", lambda *, group: [entry] if group == ENTRY_POINTS else [])


@pytest.fixture(scope="module")
def study() -> Study:
    """A pendulum with such a spring."""

    def stretch(spec: mujoco.MjSpec) -> None:
        spec.joint("arm").stiffness = [0.0, 0.0, TRUE]

    motion = toys.swing(seconds=4.0, size=1.0)
    run = replay_log(toys.with_spec(toys.pendulum(), stretch), motion, numerics=Numerics("RK4", 0.00125))
    measured = run.channels["position.arm"] + np.random.default_rng(3).normal(0.0, 4e-4, len(run))
    log = replace(motion, channels={**motion.channels, "position.arm": measured})
    return make_study(toys.pendulum(), [log], numerics=Numerics("RK4", 0.005))


def test_it_keeps_the_contract() -> None:
    check_term(HardeningSpring)


def test_it_is_fitted_and_written(study: Study, tmp_path: Path) -> None:
    found = fit(study, ["hardening_spring:*"])
    [k] = found.estimates
    assert k.name == "hardening_spring:arm"
    assert k.ci95[0] <= TRUE <= k.ci95[1]
    written = save_model(Folder(tmp_path), draft(identified(found)))
    assert written["reproduces"]
    assert written["not_in_file"] == []
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "model.xml"))
    assert model.jnt_stiffnesspoly[0, 1] == pytest.approx(k.value)


def test_it_is_found_among_all_effects(study: Study) -> None:
    closing = close(study, ["kp:arm"])
    assert [(e.effect, e.where) for e in closing.effects] == [("hardening_spring", ("arm",))]
    assert closing.verdict == "explained"
    [k] = closing.effects[0].parameters
    assert k.ci95[0] <= TRUE <= k.ci95[1]


def test_one_that_is_no_term_is_refused(study: Study, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(EntryPoint, "load", lambda self: "spring")
    with pytest.raises(UsageError, match="'hardening_spring' is installed but is not a class derived from Term"):
        study.declare(["kp:arm"])
