"""The written model: the user's own text but for what changed, and the motion that was reported."""

from __future__ import annotations

import hashlib
import json
import struct
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sysid_btr.cli import run
from sysid_btr.cli.demo import sample_logs
from sysid_btr.diagnosis.closing import Closing
from sysid_btr.display.changes import change_lines, fidelity, model_lines
from sysid_btr.errors import UsageError
from sysid_btr.identify.fit import fit
from sysid_btr.identify.study import Study, make_study
from sysid_btr.io.log import Log
from sysid_btr.io.parquet import read_log
from sysid_btr.models.builtin import load_robot
from sysid_btr.models.robot import Robot
from sysid_btr.run_folder import Folder
from sysid_btr.simulation.numerics import Numerics
from sysid_btr.terms.base import Term
from sysid_btr.terms.disturbance import ConstantForce
from sysid_btr.terms.effect import Effect
from sysid_btr.terms.friction import CoulombFriction, LoadFriction
from sysid_btr.terms.grammar import parse_parameters
from sysid_btr.terms.inertial import GravityTilt, Payload
from sysid_btr.terms.limits import TorqueLimit
from sysid_btr.terms.model import Model
from sysid_btr.terms.sensing import EncoderOffset, EncoderOffsetInLoop
from sysid_btr.terms.servo import CommandDelay, IntegralGain, Kp
from sysid_btr.terms.spring import JointSpring, Tether
from sysid_btr.terms.transmission import Backlash, JointCompliance
from sysid_btr.writeback.params import read_params, starts_from
from sysid_btr.writeback.write import Draft, Identified, describe_model, draft, identified, params_of, save_model
from sysid_btr.writeback.xmltext import Edit, append_child, apply, comment, number, parse, set_attributes
from tests.toys import SCALE, make_log, swing

JOINTS = ("hip", "knee", "ankle")
NUMERICS = Numerics("implicitfast", 0.004)
PLAIN = """<?xml version="1.0" encoding="utf-8"?>
<!-- our robot, do not touch -->
<mujoco model="own">
  <compiler angle="degree" autolimits="true"
            meshdir="shapes"/>

  <default>
    <joint damping=".05" armature="0.006"/>
    <default class="soft">
      <position kp="12" kv='.4'/>   <!-- gains of the ankle -->
      <geom mass="0.15"/>
    </default>
  </default>
  <asset><mesh name="shin" file="shin.stl"/></asset>
  <include file="parts/rest.xml"/>
  <worldbody>
    <geom type="plane" size="2 2 .1" pos="0 0 -3"/>
    <body name="hip">
      <!-- measured on the scale -->
      <inertial pos="0.01 0.004 -.07"  mass=".4"
                fullinertia="1e-3 2e-3 1.5e-3 1e-4 0 2e-4"/>
      <joint name="hip" axis="0 1 0" range="-120 120" limited="false"/>
      <geom type="box" size=".04 .03 .07" contype="0" conaffinity="0"/>
      <body name="knee" pos=".01 0 -.14" euler="0 0 10">
        <joint name="knee" axis="0 1 0" damping=".05 .01" frictionloss="0" springref="20" stiffness=".2"/>
        <geom type="box" size=".03 .03 .06" pos="0 0 -.06" mass=".2" contype="0" conaffinity="0"/>
        <geom type="sphere" size=".02" pos="0 0 -.1" mass=".1" contype="0" conaffinity="0"/>
        <geom type="mesh" mesh="shin" mass="0.05" contype="0" conaffinity="0"/>
        <body name="ankle" pos="0 0 -.12" childclass="soft">
          <joint name="ankle" axis="1 0 0" stiffness=".1"/>
          <geom type="box" size=".08 .04 .01" pos=".03 0 -.03"/>
          <frame pos="0 0 -.01"><geom type="sphere" size=".01" mass=".01"/></frame>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="hip" joint="hip" kp="20" dampratio="0.8"/>
    <general name="knee_servo" joint="knee" gainprm="20" biastype="affine" biasprm="0 -20 -.6"/>
    <position class="soft" name="ankle" joint="ankle"/>
  </actuator>
  <keyframe><key name="bent" qpos=".1 .2 .3"/></keyframe>
</mujoco>
"""
REST = """<mujocoinclude>
  <!-- included -->
  <sensor><jointpos joint="hip"/></sensor>
  <contact><exclude body1="hip" body2="knee"/></contact>
</mujocoinclude>
"""


def write_own(folder: Path, text: str = PLAIN, rest: str = REST) -> Path:
    """A model with an included file and a mesh."""
    (folder / "parts").mkdir(parents=True)
    (folder / "shapes").mkdir()
    (folder / "parts" / "rest.xml").write_text(rest)
    corners = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.08, 0], [0, 0, 0.06]], dtype=np.float32)
    faces = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]
    data = b"\0" * 80 + struct.pack("<I", 4)
    for face in faces:
        data += struct.pack("<12fH", 0, 0, 0, *corners[list(face)].ravel(), 0)
    (folder / "shapes" / "shin.stl").write_bytes(data)
    path = folder / "own.xml"
    path.write_text(text)
    return path


@pytest.fixture
def own(tmp_path: Path) -> Path:
    return write_own(tmp_path / "mine")


@pytest.fixture
def out(tmp_path: Path) -> Folder:
    folder = tmp_path / "elsewhere" / "out"
    folder.mkdir(parents=True)
    return Folder(folder)


def log_of(joints: Sequence[str] = JOINTS, seconds: float = 1.0) -> Log:
    """Commands, and positions that follow them in some way."""
    log = swing(joints, seconds=seconds)
    rng = np.random.default_rng(3)
    channels = dict(log.channels)
    for joint in joints:
        channels[f"position.{joint}"] = 0.8 * channels[f"command.{joint}"] + 1e-3 * rng.normal(size=len(log))
    return make_log(log.time, channels, sample_period=0.01)


def study_of(robot: Robot, numerics: Numerics = NUMERICS, log: Log | None = None) -> Study:
    return make_study(robot, [log or log_of()], numerics=numerics, threads=1)


def model_of(study: Study, terms: Sequence[Term], values: Sequence[float]) -> Identified:
    return Identified(study, Model.of(terms, values), ())


def declared(path: Path, expressions: Sequence[str], values: Sequence[float], **options: Any) -> Identified:
    study = study_of(load_robot(str(path)), **options)
    return model_of(study, parse_parameters(list(expressions), study.robot), values)


def effect(cls: type[Effect], *places: str) -> Effect:
    return cls.at(places, dict.fromkeys((*JOINTS, *places), SCALE))


SKIPPED = ("names", "names_map", "body_iquat", "body_inertia", "body_simple", "dof_simplenum")
"""Bookkeeping, and what is compared as a tensor."""


def fields(model: mujoco.MjModel) -> dict[str, Any]:
    """Every array of a compiled model, inertias as tensors in the bodies' frames."""
    from sysid_btr.writeback.features import tensor

    found = {n: np.asarray(getattr(model, n)) for n in dir(model) if isinstance(getattr(model, n), np.ndarray)}
    found = {n: v for n, v in found.items() if v.dtype.kind in "fiub" and n not in SKIPPED}
    found |= {f"opt.{n}": np.asarray(getattr(model.opt, n)) for n in ("timestep", "gravity", "integrator")}
    found["tensor"] = np.array([tensor(model, i) for i in range(model.nbody)])
    return found


def changed_fields(a: mujoco.MjModel, b: mujoco.MjModel, tolerance: float = 1e-12) -> set[str]:
    """Names of arrays that differ, relative to their largest number."""
    one, two = fields(a), fields(b)
    assert one.keys() == two.keys()
    result = set()
    for name, x in one.items():
        y = two[name]
        if x.shape != y.shape or (
            x.size and np.max(np.abs(x.astype(float) - y.astype(float))) > tolerance * max(np.max(np.abs(x)), 1e-300)
        ):
            result.add(name)
    return result


DERIVED = {
    "body_subtreemass", "body_invweight0", "dof_invweight0", "dof_M0", "dof_length", "tendon_invweight0",
    "actuator_acc0", "cam_pos0", "cam_poscom0", "light_poscom0", "body_sameframe", "geom_sameframe", "D_diag",
    "dof_solref", "dof_solimp", "efm0_L", "bvh_aabb", "bvh_nodeid", "bvh_child", "bvh_depth",
}  # fmt: skip
"""What follows from other fields (bounding volumes lie in the frame of the inertia), or counts only with friction."""
OPTIONS = {"opt.timestep", "opt.integrator"}
UNUSED = {"actuator_dynprm"}
"""MuJoCo's default time constant of drives without a filter, which a replay sets to zero."""


def unlike(spec: mujoco.MjSpec, made: Draft) -> set[str]:
    """Fields in which a file that was written differs from what was replayed; it keeps its keyframes, no replay has."""
    for key in list(spec.keys):
        spec.delete(key)
    return changed_fields(spec.compile(), made.target.model) - DERIVED - UNUSED


# --- text -----------------------------------------------------------------------------------------------


def test_attributes_change_and_nothing_else_does() -> None:
    text = b'<a>\n  <!-- <b x="1"/> -->\n  <b  x = "1"\n      y=\'2 > 1\'/> tail\n</a>\n'
    element = parse(text).children[0]
    edit = set_attributes(text, element, {"x": "3", "z": "4"})
    assert apply(text, [edit]) == text.replace(b'x = "1"', b'x = "3"').replace(b"2 > 1'/>", b'2 > 1\' z="4"/>')
    assert b"y" not in apply(text, [set_attributes(text, element, {"y": None})]).split(b"<b")[2]


def test_elements_are_renamed_and_given_children() -> None:
    text = b"<a><b k='1'><c/></b></a>"
    assert apply(text, [set_attributes(text, parse(text).children[0], {"k": None}, "d")]) == b"<a><d><c/></d></a>"
    inner = parse(text).children[0].children[0]
    assert parse(apply(text, [append_child(text, inner, ["<e/>"])])).children[0].children[0].children[0].tag == "e"


def test_overlapping_edits_are_refused() -> None:
    with pytest.raises(ValueError, match="overlap"):
        apply(b"abcdef", [Edit(0, 3, b""), Edit(2, 4, b"")])


def test_comments_stay_comments() -> None:
    assert "--" not in comment("a -- b --")[4:-3]
    assert parse(f"<a>{comment('a -- b --')}</a>".encode()).tag == "a"


@given(st.floats(allow_nan=False, allow_infinity=False))
def test_numbers_read_back_to_the_same(value: float) -> None:
    assert float(number(value)) == value


# --- the user's own text ----------------------------------------------------------------------------------


def test_only_what_changed_is_changed(own: Path) -> None:
    made = draft(declared(own, ["kp:ankle", "frictionloss:hip"], [1.25, 0.125]))
    before, after = own.read_text(), made.text().decode()
    assert "<!-- our robot, do not touch -->" in after
    wanted = before.replace(
        '<position class="soft" name="ankle" joint="ankle"/>',
        '<position class="soft" name="ankle" joint="ankle" kp="15"/>',
    )
    wanted = wanted.replace(
        'range="-120 120" limited="false"/>',
        'range="-120 120" limited="false" frictionloss="0.125" solreffriction="0.008 1" '
        'solimpfriction="0.99 0.999 0.001 0.5 2"/>',
    )
    wanted = wanted.replace(
        'meshdir="shapes"/>',
        f'meshdir="{own.parent.resolve()}/shapes"/>\n  <option timestep="0.004" integrator="implicitfast"/>',
    )
    wanted = wanted.replace('file="parts/rest.xml"', f'file="{own.parent.resolve()}/parts/rest.xml"')
    header = after[after.index("<!--\n") : after.index("-->\n", after.index("<!--\n")) + 4]
    assert after.replace(header, "") == wanted
    assert "implicitfast 4 ms" in header


CHANGES: dict[str, tuple[list[str], list[float], set[str]]] = {
    "mass of an inertial": (["mass:hip"], [1.3], {"body_mass", "tensor"}),
    "mass of geoms": (["mass:knee"], [0.7], {"body_mass", "tensor"}),
    "mass from a class": (["mass:ankle"], [1.7], {"body_mass", "tensor"}),
    "inertia": (["inertia:hip,ankle"], [1.3, 2.5], {"tensor"}),
    "centre of mass": (["com:hip,knee"], [0.01, 0.002, -0.003, 0.0, 0.004, 0.01], {"body_ipos"}),
    "kp": (["kp:*"], [0.9, 1.2, 1.3], {"actuator_gainprm", "actuator_biasprm"}),
    "kv": (["kv:*=shared"], [1.21], {"actuator_biasprm"}),
    "damping": (["damping:*"], [0.02, 0.07, 0.0], {"dof_damping"}),
    "quadratic damping": (["quadratic_damping:hip,knee"], [0.02, 0.0], {"dof_dampingpoly"}),
    "armature": (["armature:knee"], [0.011], {"dof_armature"}),
    "factors of both": (
        ["damping_factor:hip", "armature_factor:*=shared"],
        [0.4, 1.3],
        {"dof_damping", "dof_armature"},
    ),
    "stiffness": (["stiffness:*"], [0.5, 0.6, 0.7], {"jnt_stiffness"}),
    "force limit": (["force_limit:hip"], [1.5], {"actuator_forcerange", "actuator_forcelimited"}),
    "friction of contacts": (["foot_friction:ankle"], [0.6], {"geom_friction"}),
}


@pytest.mark.parametrize("case", CHANGES)
def test_the_file_compiles_to_the_model_that_was_replayed(own: Path, out: Folder, case: str) -> None:
    expressions, values, wanted = CHANGES[case]
    model = declared(own, expressions, values)
    made = draft(model)
    assert made.source.own
    path = out.write("model.xml", made.text())
    before, after = mujoco.MjModel.from_xml_path(str(own)), mujoco.MjModel.from_xml_path(str(path))
    assert not unlike(mujoco.MjSpec.from_file(str(path)), made)
    assert changed_fields(before, after) - DERIVED - OPTIONS == wanted
    assert save_model(out, made)["reproduces"]


@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    scale=st.lists(st.floats(0.3, 3.0), min_size=9, max_size=9),
    friction=st.floats(0, 2),
    load=st.tuples(st.floats(1e-4, 1), *[st.floats(-0.2, 0.2)] * 3, st.floats(0, 1e-3)),
    tilt=st.tuples(st.floats(-0.2, 0.2), st.floats(-0.2, 0.2)),
)
def test_round_trip(
    own: Path, scale: list[float], friction: float, load: tuple[float, ...], tilt: tuple[float, ...]
) -> None:
    study = study_of(load_robot(str(own)))
    free = parse_parameters(["mass:*", "kp:*", "kv:*"], study.robot)
    effects = (effect(CoulombFriction, "knee"), effect(GravityTilt, "robot"), effect(Payload, "ankle"))
    made = draft(model_of(study, (*free, *effects), [*scale, friction, *tilt, *load]))
    assert not unlike(mujoco.MjSpec.from_string(made.text().decode()), made)


def test_an_include_that_changes_is_put_in_place(tmp_path: Path, out: Folder) -> None:
    rest = REST.replace(
        "</mujocoinclude>",
        "  <actuator>\n    <!-- the sole's -->\n    <adhesion body='ankle' ctrlrange='0 1'/>\n"
        "    <position name='late' joint='hip' kp='1'/></actuator>\n</mujocoinclude>",
    )
    own = write_own(
        tmp_path / "mine", PLAIN.replace('<position name="hip" joint="hip" kp="20" dampratio="0.8"/>', ""), rest
    )
    made = draft(declared(own, ["kp:hip"], [1.5]))
    text = made.text().decode()
    assert "<!-- the sole's -->" in text
    assert 'kp="1.5"' in text
    assert "<include" not in text
    path = out.write("model.xml", made.text())
    assert not unlike(mujoco.MjSpec.from_file(str(path)), made)


def test_what_is_written_can_be_moved_together_with_the_model(tmp_path: Path) -> None:
    own = write_own(tmp_path / "here" / "mine")
    out = tmp_path / "here" / "runs" / "out"
    out.mkdir(parents=True)
    assert save_model(Folder(out), draft(declared(own, ["kp:ankle"], [1.25])))["reproduces"]
    (tmp_path / "here").rename(tmp_path / "there")
    written = tmp_path / "there" / "runs" / "out" / "model.xml"
    assert str(tmp_path) not in written.read_text()
    assert "../../mine/" in written.read_text()
    assert mujoco.MjModel.from_xml_path(str(written)).nmesh == 1


def test_nested_includes_and_textures_are_found_from_elsewhere(tmp_path: Path, out: Folder) -> None:
    rest = REST.replace(
        "<!-- included -->", '<include file="parts/deep.xml"/><asset><texture name="t" type="2d" file="t.png"/></asset>'
    )
    own = write_own(tmp_path / "mine", rest=rest)
    (own.parent / "parts" / "deep.xml").write_text('<m><custom><numeric name="n" data="1 2"/></custom></m>')
    from PIL import Image

    Image.new("RGB", (4, 4), "red").save(own.parent / "t.png")
    path = out.write("model.xml", draft(declared(own, ["kp:hip"], [1.1])).text())
    model = mujoco.MjModel.from_xml_path(str(path))
    assert (model.nnumeric, model.ntex) == (1, 1)


@pytest.mark.filterwarnings("ignore:compiler attribute 'settotalmass':UserWarning")
@pytest.mark.parametrize(
    ("attribute", "effect_of"),
    [('inertiafromgeom="true"', "hip"), ('settotalmass="3"', "knee"), ('boundmass="0.01"', "hip")],
)
def test_compilers_that_derive_masses_are_told_not_to(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, attribute: str, effect_of: str
) -> None:
    monkeypatch.chdir(tmp_path)  # where MuJoCo writes what it warns of
    own = write_own(tmp_path / "mine", PLAIN.replace("<compiler ", f"<compiler {attribute} "))
    made = draft(declared(own, [f"mass:{effect_of}"], [1.2]))
    assert made.source.own
    before = mujoco.MjModel.from_xml_path(str(own))
    after = mujoco.MjModel.from_xml_string(made.text().decode())
    assert changed_fields(before, after) - DERIVED - OPTIONS == {"body_mass", "tensor"}
    assert after.body(effect_of).mass[0] == pytest.approx(1.2 * before.body(effect_of).mass[0], rel=1e-13)


def test_stored_states_keep_their_joints(own: Path) -> None:
    made = draft(model_of(study_of(load_robot(str(own))), (effect(Backlash, "hip"),), [0.02, 0.001]))
    after = mujoco.MjModel.from_xml_string(made.text().decode())
    assert [after.joint(i).name for i in range(4)] == ["hip", "hip__link", "knee", "ankle"]
    np.testing.assert_array_equal(after.key_qpos[0], [0.1, 0, 0.2, 0.3])


def test_a_text_that_cannot_be_edited_is_written_anew(tmp_path: Path) -> None:
    twice = PLAIN.replace(
        "</worldbody>",
        '<replicate count="2" offset="1 0 0"><body name="r"><joint name="r"/><geom size=".1"/></body></replicate>'
        "</worldbody>",
    )
    own = write_own(tmp_path / "mine", twice.replace('<key name="bent" qpos=".1 .2 .3"/>', ""))
    made = draft(declared(own, ["damping:r0"], [0.3]))
    assert not made.source.own
    assert "rewritten" in made.text().decode()
    after = mujoco.MjModel.from_xml_string(made.text().decode())
    assert after.joint("r0").damping[0] == 0.3
    left = unlike(mujoco.MjSpec.from_string(made.text().decode()), made)
    assert left <= {"body_quat", "geom_quat", "geom_pos"}


def test_a_users_model_is_never_overwritten(own: Path) -> None:
    same = own.rename(own.with_name("model.xml"))
    content = same.read_bytes()
    written = save_model(Folder(same.parent), draft(declared(same, ["kp:hip"], [1.1])))
    assert same.read_bytes() == content
    assert written["path"] == "identified.xml"


# --- effects ----------------------------------------------------------------------------------------------

EXACT: dict[str, tuple[type[Effect], tuple[str, ...], list[float], str]] = {
    "dry friction": (CoulombFriction, ("knee",), [0.2], 'frictionloss="0.2"'),
    "backlash": (Backlash, ("knee",), [0.03, 0.002], 'name="knee__link"'),
    "compliance": (JointCompliance, ("hip",), [0.02], 'name="hip__link"'),
    "spring": (JointSpring, ("knee",), [1.5, 0.3], "stiffness="),
    "tether": (Tether, ("knee",), [2.3, 10.0, 0.5, 0.1, -0.3, 0.01, 0.0, -0.02], 'springlength="0 '),
    "tether that hardly grows": (Tether, ("knee",), [2.0, 1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0], 'springlength="-'),
    "torque limit": (TorqueLimit, ("ankle",), [0.3], 'forcerange="-0.3 0.3"'),
    "payload": (Payload, ("knee",), [0.2, 0.05, 0.01, -0.1, 2e-4], 'name="payload_knee"'),
    "tilt": (GravityTilt, ("robot",), [0.05, -0.03], 'gravity="'),
    "constant torque": (ConstantForce, ("knee",), [0.3], "springref="),
    "constant torque without a spring": (ConstantForce, ("hip",), [-0.3], "springref="),
    "encoder in the loop": (EncoderOffsetInLoop, ("knee",), [0.04], 'ref="'),
    "delay": (CommandDelay, ("hip", "knee"), [0.013, 0.02], 'delay="0.013"'),
}


@pytest.mark.parametrize("case", EXACT)
def test_effects_are_elements_of_the_file(own: Path, out: Folder, case: str) -> None:
    cls, places, values, sign = EXACT[case]
    written = save_model(out, draft(model_of(study_of(load_robot(str(own))), (effect(cls, *places),), values)))
    text = (out.path / "model.xml").read_text()
    assert sign in text
    assert f"<!-- sysid_btr: {cls.name}" in text or cls is GravityTilt
    assert written["not_in_file"] == []
    assert written["reproduces"], (written["loss"], written["reported_loss"])
    plain = save_model(out, draft(model_of(study_of(load_robot(str(own))), (), [])))
    assert plain["loss"] != written["loss"]


@pytest.mark.parametrize(("cls", "values"), [(LoadFriction, [0.3]), (IntegralGain, [30.0]), (EncoderOffset, [0.05])])
def test_what_a_file_cannot_hold_is_told_with_its_cost(
    own: Path, out: Folder, cls: type[Effect], values: list[float]
) -> None:
    study = study_of(load_robot(str(own)))
    model = model_of(study, (*parse_parameters(["kp:hip"], study.robot), effect(cls, "knee")), [1.1, *values])
    written = save_model(out, draft(model))
    (entry,) = written["not_in_file"]
    assert (entry["name"], entry["where"], entry["held"]) == (cls.name, ["knee"], "no")
    assert not written["reproduces"]
    assert entry["loss_without"] == pytest.approx(written["loss"], rel=1e-9)
    text = (out.path / "model.xml").read_text()
    assert f"Not in this file: {cls.name}" in text
    assert f"{written['reported_loss']['train']:.10g}" in text


def test_a_delay_under_runge_kutta_is_nearly_in_the_file(own: Path, out: Folder) -> None:
    study = study_of(load_robot(str(own)), Numerics("RK4", 0.005))
    model = model_of(study, (effect(CommandDelay, "knee"),), [0.023])
    written = save_model(out, draft(model))
    (entry,) = written["not_in_file"]
    assert entry["held"] == "approximately"
    loss, reported = written["loss"]["train"], written["reported_loss"]["train"]
    assert abs(loss - reported) < 0.01 * abs(entry["loss_without"]["train"] - reported)


def test_neutral_effects_leave_no_trace(own: Path) -> None:
    effects = (effect(CoulombFriction, "knee"), effect(LoadFriction, "hip"))
    made = draft(model_of(study_of(load_robot(str(own))), effects, [0.0, 0.0]))
    assert {c.attribute for c in made.changes} == {"timestep", "integrator"}
    assert made.missing == ()


# --- other robots ---------------------------------------------------------------------------------------


def test_built_in_robots_are_written_whole(out: Folder) -> None:
    robot = load_robot("nao")
    joints = ("LKneePitch", "RKneePitch", "HeadYaw")
    study = study_of(robot, log=replace(log_of(joints), meta=log_of(joints).meta))
    model = model_of(study, parse_parameters(["mass:LKneePitch", "kp:*=shared"], robot), [1.2, 0.9])
    written = save_model(out, draft(model))
    assert written["reproduces"]
    assert written["from"] == "the robot nao"
    after = mujoco.MjModel.from_xml_path(str(out.path / "model.xml"))
    wanted = {"body_mass", "tensor", "actuator_gainprm", "actuator_biasprm"}
    assert changed_fields(robot.compile(), after) - DERIVED - OPTIONS == wanted | {"eq_objtype"}
    assert int(after.jnt_type[0]) == 0, "the robot keeps its free joint, although the log's was held"
    assert "The log is of a fixed base" in (out.path / "model.xml").read_text()


STANDING = """<mujoco><worldbody><body name="trunk" pos="0 0 0.5"><freejoint/><geom size="0.05" mass="2"/>
<body name="leg"><joint name="hip" axis="0 1 0" damping="0.1" armature="0.01"/>
<geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.2" mass="0.4"/></body></body></worldbody>
<actuator><position joint="hip" kp="20" kv="1"/></actuator>
<keyframe><key name="home" qpos="0 0 0.4 1 0 0 0 0.3"/></keyframe></mujoco>"""


def test_a_keyframe_of_a_robot_that_was_held_stays_in_the_file(tmp_path: Path, out: Folder) -> None:
    (tmp_path / "standing.xml").write_text(STANDING)
    robot = load_robot(str(tmp_path / "standing.xml"))
    model = model_of(study_of(robot, log=log_of(("hip",))), parse_parameters(["kp:hip"], robot), [0.9])
    written = save_model(out, draft(model))
    assert written["reproduces"]
    after = mujoco.MjModel.from_xml_path(str(out.path / "model.xml"))
    np.testing.assert_array_equal(after.key("home").qpos, [0, 0, 0.4, 1, 0, 0, 0, 0.3])


URDF = """<robot name="arm"><mujoco><compiler strippath="false" discardvisual="false"/></mujoco>
<link name="base"/>
<link name="upper"><inertial><origin xyz="0.0123456789012 0 -0.1"/><mass value="0.3123456789012"/>
<inertia ixx="0.00123456789" ixy="0.0001" ixz="0" iyy="0.0012" iyz="0" izz="0.001"/></inertial>
<visual><geometry><mesh filename="shapes/shin.stl"/></geometry></visual></link>
<joint name="hip" type="revolute"><parent link="base"/><child link="upper"/><origin rpy="0.1 0.2 0.3"/>
<axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="9" velocity="9"/><dynamics damping="0.3"/></joint></robot>
"""


def test_a_urdf_becomes_mjcf(tmp_path: Path, out: Folder) -> None:
    path = write_own(tmp_path / "mine").with_name("arm.urdf")
    path.write_text(URDF)
    robot = load_robot(str(path))
    model = model_of(study_of(robot, log=log_of(("hip",))), parse_parameters(["mass:upper"], robot), [1.2])
    written = save_model(out, draft(model))
    assert written["reproduces"]
    text = (out.path / "model.xml").read_text()
    assert "there was no MJCF to change" in text
    after = mujoco.MjModel.from_xml_path(str(out.path / "model.xml"))
    assert changed_fields(robot.compile(), after) - DERIVED - OPTIONS <= {
        "body_mass",
        "tensor",
        "mesh_pathadr",
        "paths",
    }


def test_a_load_on_a_body_of_a_urdf_is_in_its_mjcf(tmp_path: Path, out: Folder) -> None:
    path = write_own(tmp_path / "mine").with_name("arm.urdf")
    path.write_text(URDF)
    robot = load_robot(str(path))
    assert robot.make_spec().compiler.fusestatic  # a body that is welded on is no body of its own
    load = effect(Payload, "upper")
    values = [0.2, 0.01, 0.0, -0.1, 1e-4]
    written = save_model(out, draft(model_of(study_of(robot, log=log_of(("hip",))), (load,), values)))
    assert written["reproduces"]
    after = mujoco.MjModel.from_xml_path(str(out.path / "model.xml"))
    assert after.body("upper").mass == pytest.approx(0.3123456789012 + 0.2)


# --- a fit ------------------------------------------------------------------------------------------------

REPLAY = """
import sys
import mujoco
import numpy as np

given = np.load(sys.argv[2])
model = mujoco.MjModel.from_xml_path(sys.argv[1])
data = mujoco.MjData(model)
names = [str(name) for name in given["joints"]]
motors = [[a for a in range(model.nu) if model.actuator_trnid[a, 0] == model.joint(name).id][0] for name in names]
for name, q, v in zip(names, given["qpos"], given["qvel"]):
    data.joint(name).qpos, data.joint(name).qvel = q, v
for motor, first in zip(motors, given["command"][0]):
    if model.actuator_history[motor, 0]:
        past = np.full((model.actuator_history[motor, 0], 1), first)
        mujoco.mj_initCtrlHistory(model, data, motor, None, past)
links = [model.joint(j).name for j in range(model.njnt) if model.joint(j).name.endswith("__link")]
places = []
for k, time in enumerate(given["time"]):
    while data.time < time - model.opt.timestep / 2:
        mujoco.mj_step(model, data)
    sides = [[name] + [l for l in links if l == name + "__link"] for name in names]
    places.append([sum(data.joint(side).qpos[0] for side in both) for both in sides])
    data.ctrl[motors] = given["command"][k]
assert "sysid_btr" not in sys.modules
np.save(sys.argv[3], np.array(places))
"""


def plain_loss(path: Path, model: Identified, folder: Path) -> tuple[float, float]:
    """Loss on held-out data by MuJoCo alone, in a process that knows nothing of this package; and as reported."""
    episode = model.study.holdout_problem(model.model).episodes[0]
    replay, log = episode.replay, model.study.holdout[0].log
    joints = replay.index.joints
    np.savez(
        folder / "given.npz",
        joints=joints,
        time=log.time - log.time[0],
        command=log.array("command", joints),
        qpos=replay.start[0],
        qvel=replay.start[1],
    )
    script = folder / "plain.py"
    script.write_text(REPLAY)
    command = [sys.executable, str(script), str(path), str(folder / "given.npz"), str(folder / "places.npy")]
    done = subprocess.run(command, capture_output=True, text=True, cwd=folder, check=False)
    assert done.returncode == 0, done.stderr
    places = np.load(folder / "places.npy")
    (target,) = episode.targets
    white = ((target.measured - places[:, target.columns]) / target.sigma)[target.mask]
    reported = model.study.holdout_problem(model.model).loss(model.model.values[None])[0]
    return float(np.sum(white**2)), float(reported)


@pytest.fixture(scope="module")
def fitted() -> Any:
    folder = sample_logs()
    study = make_study(load_robot(str(folder / "leg.xml")), [read_log(folder / "leg_friction.parquet")], threads=1)
    return fit(study, ["mass:HipPitch,KneePitch", "kp:*=shared", "kv:*=shared", "frictionloss:KneePitch"])


def test_plain_mujoco_moves_as_reported(fitted: Any, out: Folder, tmp_path: Path) -> None:
    result: dict[str, Any] = {}
    describe_model(fitted, result, out)
    written = result["written"]
    assert written["reproduces"]
    loss, reported = plain_loss(out.path / "model.xml", identified(fitted), tmp_path)
    assert loss == pytest.approx(reported, rel=1e-9)
    assert written["loss"]["holdout"] == pytest.approx(reported, rel=1e-9)


def test_plain_mujoco_moves_with_all_effects_at_once(own: Path, out: Folder, tmp_path: Path) -> None:
    study = study_of(load_robot(str(own)), Numerics("implicitfast", 0.005))  # divides the log's period
    effects = (
        effect(CoulombFriction, "knee"),
        effect(Backlash, "hip"),
        effect(Payload, "ankle"),
        effect(JointSpring, "ankle"),
        effect(ConstantForce, "knee"),
        effect(CommandDelay, "hip", "ankle"),
        effect(EncoderOffsetInLoop, "knee"),
        effect(TorqueLimit, "hip"),
        effect(GravityTilt, "robot"),
    )
    values = [0.1, 0.02, 0.001, 0.1, 0.02, 0.01, -0.05, 1e-4, 0.3, 0.2, 0.15, 0.018, 0.021, 0.03, 1.5, 0.02, 0.03]
    free = parse_parameters(["mass:knee", "kp:*=shared", "damping:hip"], study.robot)
    model = model_of(study, (*free, *effects), [1.2, 0.9, 0.08, *values])
    written = save_model(out, draft(model))
    assert written["not_in_file"] == []
    assert written["reproduces"], (written["loss"], written["reported_loss"])
    loss, reported = plain_loss(out.path / "model.xml", model, tmp_path)
    assert loss == pytest.approx(reported, rel=1e-9)


def test_every_change_is_told_in_a_line(fitted: Any, out: Folder) -> None:
    result: dict[str, Any] = {}
    describe_model(fitted, result, out)
    lines = change_lines(result["changes"])
    mass = next(line for line in lines if line.startswith("body KneePitch mass 0.42 -> "))
    value = fitted.values[fitted.model.terms.names.index("mass:KneePitch")]
    assert f"(x{value:.3f} +- " in mass
    assert not any("inertia" in line for line in lines)
    assert sum("kp" in line for line in lines) == 1
    assert any(line.startswith("6 actuators kp (x0.92") for line in lines)
    assert any(line.startswith("joint KneePitch frictionloss 0 -> 0.30") and "Nm)" in line for line in lines)
    assert "model.xml: reloaded, it moves as reported" in list(model_lines(result))
    json.dumps(result, allow_nan=False)


def test_a_file_that_holds_less_than_the_fit_says_what_that_costs() -> None:
    written = {"reproduces": False, "loss": {"holdout": 993.0}, "reported_loss": {"holdout": 100.0}}
    assert fidelity(written) == "reloaded, its loss on held-out data is 9.93 times the reported one"
    assert fidelity({**written, "loss": {"holdout": None}}) == "reloaded, its replay diverges"


def test_what_makes_room_for_an_effect_is_told_with_it(own: Path) -> None:
    made = draft(model_of(study_of(load_robot(str(own))), (effect(Backlash, "hip"),), [0.02, 0.001]))
    lines = [c.line for c in made.changes]
    assert "joint hip damping 0.05 -> 0 (backlash (link): play 0.02 rad, softness 0.001 rad/Nm)" in lines
    assert "joint hip__link added: backlash (link) of hip: play 0.02 rad, softness 0.001 rad/Nm" in lines


def test_a_spring_that_is_a_constant_torque_is_called_that(own: Path) -> None:
    made = draft(declared(own, ["constant_force:hip"], [0.5]))
    assert all("(constant_force: torque 0.5 Nm)" in c.line for c in made.changes if c.kind == "joint")
    assert "<!-- sysid_btr: constant_force of hip: torque 0.5 Nm -->" in made.text().decode()


def test_one_joints_gain_beside_a_common_one_is_told_at_that_joint(own: Path) -> None:
    study = study_of(load_robot(str(own)))
    common = parse_parameters(["kp:*=shared"], study.robot)
    made = draft(model_of(study, (*common, effect(Kp, "knee")), [0.9, 0.7]))
    lines = made.text().decode().splitlines()
    (told,) = (i for i, line in enumerate(lines) if "sysid_btr: kp" in line)
    assert "kp of knee: scale 0.7 " in lines[told]
    assert 'joint="knee"' in lines[told + 1]


def test_parameters_read_back_and_replay_the_same(fitted: Any, out: Folder) -> None:
    describe_model(fitted, {}, out)
    params = read_params(out.path, fitted.study.robot)
    np.testing.assert_array_equal(params.model.values, fitted.values)
    assert params.numerics == fitted.study.numerics
    again = fitted.study.train_problem(params.model).loss(params.model.values[None])
    np.testing.assert_array_equal(again, fitted.study.train_problem(fitted.model).loss(fitted.values[None]))
    content = json.loads((out.path / "params.json").read_text())
    first = content["modifiers"][0]["parameters"][0]
    assert {"name", "value", "unit", "std", "ci95", "nominal"} <= set(first)


@pytest.mark.parametrize("numerics", [Numerics("RK4", 0.005, 0.01), Numerics("Euler", 0.004, None, "another")])
def test_numerics_read_back_with_held_servos_and_simulator(own: Path, out: Folder, numerics: Numerics) -> None:
    model = declared(own, ["kp:hip"], [1.1])
    model = replace(model, study=replace(model.study, numerics=numerics))
    out.write("params.json", json.dumps(params_of(model), default=list))
    assert read_params(out.path, load_robot(str(own))).numerics == numerics


def test_effects_read_back_too(own: Path, out: Folder) -> None:
    robot = load_robot(str(own))
    study = study_of(robot)
    effects = (effect(Backlash, "knee"), replace(effect(Payload, "hip")))
    model = model_of(study, effects, [0.02, 0.001, 0.1, 0.01, 0.02, 0.03, 1e-4])
    out.write("params.json", json.dumps(params_of(model), default=list))
    params = read_params(out.path / "params.json", robot)
    assert [type(m) for m in params.model.terms] == [Backlash, Payload]
    assert params.by_name["payload.mass:hip"] == 0.1
    given, unused = starts_from(params, effects[0].parameters)
    assert given == {"backlash.play:knee": 0.02, "backlash.softness:knee": 0.001}
    assert len(unused) == 5


def test_what_is_declared_in_part_or_as_the_models_own_value_reads_back_as_it_was(own: Path, out: Folder) -> None:
    expressions = ["backlash.play:knee", "stiffness:*=shared", "delay:hip", "foot_friction:ankle", "joint_spring:hip"]
    model = declared(own, expressions[:4], [0.02, 0.3, 0.01, 0.6])
    out.write("params.json", json.dumps(params_of(model), default=list))
    read = read_params(out.path, model.study.robot).model
    assert read.terms == model.model.terms
    assert read.values.tolist() == model.model.values.tolist()
    assert {c.line for c in draft(model).changes} >= {"joint hip stiffness 0 -> 0.3"}
    with pytest.raises(UsageError, match="joint_spring:hip is already declared"):
        parse_parameters(expressions, model.study.robot)


def test_parameter_files_that_do_not_fit_are_refused(own: Path, out: Folder) -> None:
    content = params_of(declared(own, ["kp:hip", "mass:knee"], [1.1, 1.2]))
    content["modifiers"] = [{**e, "where": ["elbow"]} for e in content["modifiers"]]
    path = out.write("params.json", json.dumps(content, default=list))
    with pytest.raises(UsageError, match=r"(?s)no servo elbow.*no body elbow"):
        read_params(path, load_robot(str(own)))
    content = params_of(model_of(study_of(load_robot(str(own))), (effect(Backlash, "knee"),), [0.02, 0.001]))
    del content["modifiers"][0]["parameters"][1]
    older = out.write("older.json", json.dumps(content, default=list))
    with pytest.raises(UsageError, match=r"backlash at knee: 1 numbers.*2 \(play, softness each\).*another version"):
        read_params(older, load_robot(str(own)))
    with pytest.raises(UsageError, match="is not JSON"):
        read_params(out.write("params.json", "{"), load_robot(str(own)))
    with pytest.raises(UsageError, match="not a parameter file"):
        read_params(out.write("params.json", '{"schema": "x"}'), load_robot(str(own)))


def test_the_model_written_is_the_model_reported(fitted: Any) -> None:
    # a fit fixes at nominal what it can without loss: what it leaves elsewhere, the motion needs
    blind = replace(fitted.estimates[0], identifiable="no")
    model = identified(replace(fitted, estimates=(blind, *fitted.estimates[1:])))
    np.testing.assert_array_equal(model.model.values, fitted.values)


def test_effects_that_were_not_named_are_not_written(fitted: Any) -> None:
    closing = Closing(
        study=fitted.study,
        verdict="unexplained",
        message="",
        noise_floor={},
        nominal=fitted.nominal,
        before=fitted.before,
        after=fitted.before,
        parameters=fitted.estimates,
        effects=(),
        candidates=(),
        steps=(),
        signature=None,
        before_model=fitted.model,
        model=fitted.model.at(fitted.values + 0.01).with_(effect(LoadFriction, "HipPitch"), [0.2]),
        replays=0,
        seconds=0.0,
    )
    model = identified(closing)
    assert model.model.terms == fitted.model.terms
    np.testing.assert_array_equal(model.model.values, fitted.values)
    assert [e.value for e in model.estimates] == list(fitted.values)


# --- the command line -------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a finished fit."""
    folder = tmp_path_factory.mktemp("finished") / "out"
    samples = sample_logs()
    flags = ["--model", samples / "pendulum.xml", "--log", samples / "pendulum_friction.parquet", "--threads", 1]
    assert run(["fit", *map(str, flags), "--fit", "frictionloss:*", "--out", str(folder)]) == 0
    return folder


def pendulum_flags() -> list[str]:
    samples = sample_logs()
    return [
        "--model",
        str(samples / "pendulum.xml"),
        "--log",
        str(samples / "pendulum_friction.parquet"),
        "--threads",
        "1",
    ]


def test_a_run_leaves_model_and_parameters(finished: Path) -> None:
    result = json.loads((finished / "result.json").read_text())
    assert result["written"]["path"] == "model.xml"
    params = json.loads((finished / "params.json").read_text())
    for path in (result["model"]["path"], params["model"]["path"], result["logs"][0]["path"]):
        assert not Path(path).is_absolute()
        assert (finished / path).is_file()
    assert result["written"]["reproduces"]
    assert result["written"]["sha256"] == hashlib.sha256((finished / "model.xml").read_bytes()).hexdigest()
    assert any(c["attribute"] == "frictionloss" for c in result["changes"])
    assert "joint pendulum frictionloss" in (finished / "report.html").read_text()


def test_replay_at_the_parameters_of_a_run(finished: Path, capsys: pytest.CaptureFixture[str]) -> None:
    reported = json.loads((finished / "result.json").read_text())
    capsys.readouterr()
    assert run(["replay", *pendulum_flags(), "--params", str(finished), "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["numerics"]["chosen"] == reported["numerics"]["chosen"]
    both = [reported["after"][part]["position"]["rmse"] for part in ("train", "holdout")]
    assert min(both) <= result["nominal"]["holdout"]["position"]["rmse"] <= max(both)


def test_a_fit_begins_where_another_ended(finished: Path, capsys: pytest.CaptureFixture[str]) -> None:
    capsys.readouterr()
    flags = ["--params", str(finished / "params.json"), "--fit", "mass:arm", "--fit", "frictionloss:*"]
    assert run(["fit", *pendulum_flags(), *flags, "--max-evaluations", "1", "--json"]) in (0, 5)
    first = json.loads((finished / "params.json").read_text())["modifiers"][0]["parameters"][0]
    found = {p["name"]: p["value"] for p in json.loads(capsys.readouterr().out)["parameters"]}
    assert found["frictionloss:pendulum"] == pytest.approx(first["value"], rel=0.05)


def test_values_that_are_not_free_are_told(finished: Path, capsys: pytest.CaptureFixture[str]) -> None:
    capsys.readouterr()
    run(["fit", *pendulum_flags(), "--params", str(finished), "--fit", "mass:arm"])
    assert "--params: not fitted here, so not used: frictionloss:pendulum" in capsys.readouterr().err


def test_one_value_from_two_flags_is_refused(finished: Path, capsys: pytest.CaptureFixture[str]) -> None:
    flags = ["--params", str(finished), "--set", "frictionloss:pendulum=0.1"]
    assert run(["replay", *pendulum_flags(), *flags]) == 2
    assert "given by --set and by --params: frictionloss:pendulum" in capsys.readouterr().err
