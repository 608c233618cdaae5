"""Robots: where a model comes from, and what is known about it beyond its MJCF."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sysid_btr.errors import ModelError
from sysid_btr.models.urdf import read_urdf
from sysid_btr.mujoco_conventions import SINGLE, slides
from sysid_btr.terms.base import Scope, Term
from sysid_btr.terms.drives import Drive, joint_drives
from sysid_btr.units import CHANNEL_UNITS

if TYPE_CHECKING:
    import mujoco

    from sysid_btr.io.log import Log

KEYFRAME = "keyframe:"
"""Begins the name of a pose of the model."""
Position = str | tuple[str, float]
"""A joint and where it stands, rad or m; or a pose of the model, for all of them."""


@dataclass(frozen=True, repr=False)
class Robot:
    """A model that can be compiled, and its table of what identification needs to know.

    Attributes
    ----------
    name : how the user calls it.
    make_spec : builds a fresh, editable MjSpec.
    path : the file it came from, if any.
    digest : SHA-256 of the compiled-from XML.
    bounds : parameter, glob or ``FIELD`` -> (lower, upper), over the defaults of the grammar.
    priors : parameter, glob or ``FIELD`` -> prior as text, such as ``normal(1, 0.1)``, for posteriors.
    tied : groups of joints driven by one motor; their gains are one parameter.
    always : terms without parameters of their own that belong to the robot (drive electronics).
    fields : ``FIELD`` -> term of the parameters that this robot has beyond those of the grammar.
    at : joints with the positions at which they stand, and ``keyframe:NAME`` for all, in the order in which they were
        told; for what a log does not measure.
    remarks : what of its file was left out, assumed or added; empty where the model is the file's own.
    drives_stated : whether a joint without an actuator has none; a URDF does not say.
    """

    name: str
    make_spec: Callable[[], mujoco.MjSpec]
    path: Path | None = None
    digest: str = ""
    bounds: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    tied: tuple[tuple[str, ...], ...] = ()
    always: tuple[Term, ...] = ()
    configure: Callable[[Robot, Log], Robot] | None = None
    priors: Mapping[str, str] = field(default_factory=dict)
    fields: Mapping[str, type[Term]] = field(default_factory=dict)
    at: tuple[Position, ...] = ()
    remarks: tuple[str, ...] = ()
    drives_stated: bool = True

    def __repr__(self) -> str:
        return f"<Robot {self.name}{'' if self.path is None else f' ({self.path})'}>"

    def _repr_html_(self) -> str:
        from sysid_btr.display.html import facts_html

        facts = {
            "joints": ", ".join(joint_names(self)),
            "with a drive": ", ".join(driven_joints(self)),
            "bodies": ", ".join(body_names(self)),
            "mass": f"{float(self.model.body_mass.sum()):.4g} kg",
        }
        return facts_html(f"robot {self.name}", facts)

    def to_dict(self) -> dict[str, Any]:
        """Name, file and digest, as results have them, and what was changed of the file."""
        remarks = {"remarks": list(self.remarks)} if self.remarks else {}
        path = None if self.path is None else str(self.path)
        return {"name": self.name, "path": path, "sha256": self.digest, **remarks}

    def for_log(self, log: Log) -> Robot:
        """The robot as this log's metadata describes it (servo registers, supply, load)."""
        return self if self.configure is None else replace(self.configure(self, log), at=self.at)

    def names(self, scope: Scope) -> tuple[str, ...]:
        """Names that a term of this scope can have as its places, in model order."""
        listing: Mapping[Scope, Callable[[Robot], tuple[str, ...]]] = {
            "body": body_names,
            "joint": joint_names,
            "drive": driven_joints,
            "feedback": feedback_joints,
            "servo": servo_joints,
        }
        return listing[scope](self) if scope in listing else (scope,)

    @cached_property
    def model(self) -> mujoco.MjModel:
        """The plain model, shared by all who read it; `compile` gives one that may be changed."""
        return self.compile()

    @cached_property
    def fingerprint(self) -> str:
        """Digest of the compiled model, and so of all files that it was made of."""
        import mujoco

        content = np.empty(mujoco.mj_sizeModel(self.model), dtype=np.uint8)
        mujoco.mj_saveModel(self.model, None, content)
        return _digest(content.tobytes())

    def compile(self) -> mujoco.MjModel:
        """The plain model, compiled anew."""
        try:
            return self.make_spec().compile()
        except ValueError as error:
            raise ModelError(f"model {self.name}: MuJoCo cannot compile it: {error}") from error


def robot_from_file(path: Path) -> Robot:
    """Any MJCF or URDF as a robot."""
    import mujoco

    try:
        content = path.read_bytes()
    except OSError as error:
        raise ModelError(f"model {path} cannot be read: {error.strerror}; check the file's permissions") from error
    if not content.lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"<"):
        raise ModelError(
            f"model {path}: this is not an XML file, so it is neither MJCF nor URDF. Give the robot's model with "
            "--model, and a log with --log"
        )
    urdf = read_urdf(path, content)

    def make_spec() -> mujoco.MjSpec:
        if urdf is None:
            return mujoco.MjSpec.from_file(str(path))
        spec = mujoco.MjSpec.from_string(urdf.text)
        spec.modelfiledir = str(path.parent)
        return spec

    if urdf is None and path.suffix != path.suffix.lower():
        raise ModelError(
            f"model {path}: MuJoCo does not read {path.suffix}: rename the file to end in {path.suffix.lower()}"
        )
    try:
        make_spec().compile().names.decode()
    except UnicodeDecodeError as error:
        raise ModelError(f"model {path}: a name in it is not UTF-8 text ({error}). Save the file as UTF-8") from error
    except (ValueError, OSError) as error:
        raise ModelError(
            f"model {path}: MuJoCo cannot read it: {error}. Give an MJCF or URDF file that MuJoCo's own viewer opens "
            "(python -m mujoco.viewer --mjcf=FILE), meshes and included files beside it"
        ) from error
    remarks = () if urdf is None else urdf.remarks
    stated = urdf is None
    return Robot(path.stem, make_spec, path, _digest(content), remarks=remarks, drives_stated=stated)


def robot_from_spec(name: str, make_spec: Callable[[], mujoco.MjSpec], **known: object) -> Robot:
    """A robot defined in Python."""
    xml = make_spec().to_xml()
    return Robot(name=name, make_spec=make_spec, digest=_digest(xml.encode()), **known)  # type: ignore[arg-type]


def joint_names(robot: Robot) -> tuple[str, ...]:
    """Hinge and slide joints of the model, in model order."""
    model = robot.model
    return tuple(model.joint(i).name for i in range(model.njnt) if model.jnt_type[i] in SINGLE)


def alike_joints(robot: Robot) -> tuple[tuple[str, ...], ...]:
    """Joints that three or more limbs have in common: as far down a tree, with as heavy links and rotors."""
    model, groups = robot.model, dict[tuple[float, ...], list[str]]()
    depth = np.zeros(model.nbody, dtype=np.int64)
    for body in range(1, model.nbody):
        depth[body] = depth[model.body_parentid[body]] + model.body_jntnum[body]
    for name in joint_names(robot):
        joint = model.joint(name).id
        body, dof = model.jnt_bodyid[joint], model.jnt_dofadr[joint]
        numbers = (model.body_mass[body], model.body_subtreemass[body], model.dof_armature[dof])
        key = (depth[body], model.jnt_type[joint], *(float(f"{x:.3g}") for x in numbers))
        groups.setdefault(key, []).append(name)
    return tuple(tuple(group) for group in groups.values() if len(group) > 2)


def joint_ranges(robot: Robot) -> dict[str, tuple[float, float]]:
    """Joint limits where the model states them, rad or m."""
    model = robot.model
    ranges = {}
    for i in range(model.njnt):
        low, high = model.jnt_range[i]
        if model.jnt_type[i] in SINGLE and high > low:
            ranges[model.joint(i).name] = (float(low), float(high))
    return ranges


def channel_units(robot: Robot) -> dict[str, str]:
    """Unit of each channel on this robot; both where it has hinges and slides."""
    model = robot.model
    found = {slides(model, j) for j in joint_names(robot)}
    kinds = [k for k, there in ((0, False in found), (1, True in found)) if there]
    return {channel: ", ".join(units[k] for k in kinds) for channel, units in CHANNEL_UNITS.items()}


def body_names(robot: Robot) -> tuple[str, ...]:
    """Bodies of the model with mass, in model order."""
    model = robot.model
    return tuple(model.body(i).name for i in range(1, model.nbody) if model.body_mass[i] > 0)


def driven_joints(robot: Robot) -> tuple[str, ...]:
    """Joints with a drive of their own, in model order."""
    return tuple(drive.joint for drive in joint_drives(robot.model))


def feedback_joints(robot: Robot) -> tuple[str, ...]:
    """Joints whose drive feeds back position or velocity, in model order."""
    return tuple(drive.joint for drive in joint_drives(robot.model) if drive.kind != "torque")


def servo_joints(robot: Robot) -> tuple[str, ...]:
    """Joints that a position servo drives, in model order."""
    return tuple(drive.joint for drive in servo_drives(robot.model))


def servo_drives(model: mujoco.MjModel) -> tuple[Drive, ...]:
    """Position servos, in model order."""
    return tuple(drive for drive in joint_drives(model) if drive.kind == "position")


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
