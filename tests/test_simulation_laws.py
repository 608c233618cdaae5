"""Laws as machine code: what they may be, what is said of one that cannot be compiled, and how they are stopped."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sysid_btr._typing import FloatArray, IntArray
from sysid_btr.errors import UsageError
from sysid_btr.simulation.laws import address_of
from sysid_btr.simulation.mujoco_batch import MujocoBatch
from sysid_btr.simulation.mujoco_steps import threads_of
from sysid_btr.simulation.stepping import Kept, plan_of, roll, written
from sysid_btr.terms.base import Kind, Term
from sysid_btr.terms.free_form import FREE_FORMS, SPLINES, smooth_modes, spline
from sysid_btr.terms.law import Step
from sysid_btr.testing.simulator import _every, _under_laws


def scaled(x: float) -> float:
    """Not marked as `used_in_laws`."""
    return 2 * x


@dataclass(frozen=True)
class Unmarked(Term):
    name: ClassVar[str] = "unmarked"
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("size", "Nm", 0.0, 0.0, 1.0, 0.1),)

    @staticmethod
    def law(step: Step, numbers: FloatArray, memory: FloatArray, places: IntArray) -> None:
        step.joint_torque[places[0]] += scaled(numbers[0, 0])


def test_a_law_that_cannot_be_compiled_is_named() -> None:
    with pytest.raises(UsageError, match=r"test_simulation_laws\.Unmarked\.law cannot be compiled") as caught:
        address_of(Unmarked.law)
    assert "scaled" in str(caught.value)
    assert "numbers of one candidate" in str(caught.value)


def test_a_law_without_a_file_is_compiled_all_the_same() -> None:
    made: dict[str, object] = {}
    exec("def law(step, numbers, memory, places):\n    step.gain[places[0]] = numbers[0, 0]", made)
    assert address_of(made["law"]) != 0  # type: ignore[arg-type]


@settings(deadline=None)  # the first call imports SciPy
@given(
    st.lists(st.floats(-5, 5), min_size=SPLINES, max_size=SPLINES), st.floats(-0.5, 1.5, allow_nan=False), st.booleans()
)
def test_a_curve_is_the_sum_of_its_modes(amounts: list[float], x: float, exact: bool) -> None:
    x = round(5 * x) / 5 if exact else x  # at the knots, too
    modes = smooth_modes()
    wanted = float(modes(min(max(x, 0.0), 1.0)) @ amounts)
    assert spline(modes.c @ amounts, x) == pytest.approx(wanted, abs=1e-9)


@given(st.lists(st.floats(-5, 5), min_size=SPLINES, max_size=SPLINES))
def test_a_curve_of_what_is_not_a_number_is_finite(amounts: list[float]) -> None:
    """A state that diverged must not be an address beyond the numbers."""
    coefficients = np.array(amounts)
    assert spline(coefficients, float("nan")) == spline(coefficients, 0.0)


def test_every_curve_of_the_state_has_a_law_of_its_own() -> None:
    laws = [curve.law for curve in FREE_FORMS if curve.overrides("law")]
    assert len(set(laws)) == len(laws) == 8


TETRAHEDRON = """<mujoco><option gravity="0 0 -9.81"/>
  <asset><mesh name="t" vertex="0 0 0  .1 0 0  0 .1 0  0 0 .1"/></asset>
  <worldbody><body name="b"><joint name="a" axis="0 1 0"/><geom type="mesh" mesh="t" mass="1"/></body></worldbody>
  <actuator><position joint="a" kp="5" kv=".3"/></actuator></mujoco>"""


def test_of_the_boxes_of_a_mesh_no_more_is_copied_than_a_batch_holds() -> None:
    """MuJoCo's batches hold the first of them alone, and what is beyond is not the candidates'."""
    model = mujoco.MjModel.from_xml_string(TETRAHEDRON)
    moving = model.bvh_aabb[:2] + np.arange(3)[:, None, None]
    assert moving[0].nbytes < model.bvh_aabb.nbytes
    ((thread, _owners),) = threads_of(model, {"bvh_aabb": moving}, {"qpos": np.zeros((3, 1))}, 1)
    assert list(thread.copies.size) == [moving[0].nbytes, 8]


def test_fields_that_a_model_does_not_have_in_this_shape_are_refused() -> None:
    model = mujoco.MjModel.from_xml_string(TETRAHEDRON)
    for wrong in (np.zeros((3, 1, 2)), np.zeros((3, 5))):
        with pytest.raises(ValueError, match="body_mass is"):
            list(threads_of(model, {"body_mass": wrong}, {}, 1))


@pytest.mark.parametrize("told", [0, 1])
def test_threads_that_are_told_to_stop_begin_no_other_candidate(told: int) -> None:
    setup = _under_laws(3)
    plan, own = plan_of(setup)
    states = [np.full((3, len(_every()), 2), np.nan) for _ in range(2)]
    kept = Kept(_every(), *states, np.empty((0, 0, 0)), np.zeros(3, dtype=bool))
    fields = {name: setup.batch.read(name) for name in written(setup)}
    ((thread, _owners),) = threads_of(setup.model, fields, setup.state, 1)
    roll(0, 3, plan, own, thread, kept, np.array([told]))
    assert np.isnan(kept.qpos).all() if told else np.isfinite(kept.qpos).all()


def test_an_interrupted_rollout_tells_its_threads_to_stop(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[int] = []

    def rolls(*given: Any) -> None:
        # until the caller says so, which waits for nothing else
        while not given[-1][0]:
            pass
        told.append(int(given[-1][0]))

    def interrupted(job: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("sysid_btr.simulation.mujoco_steps.roll", rolls)
    monkeypatch.setattr("concurrent.futures.Future.result", interrupted)
    with pytest.raises(KeyboardInterrupt):
        MujocoBatch().rollout(_under_laws(4), _every(), threads=2)
    assert told == [1, 1]
