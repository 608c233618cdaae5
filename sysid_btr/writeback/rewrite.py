"""Change an MJCF, attribute by attribute, until it compiles to a wanted model."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import pi
from typing import TYPE_CHECKING

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.writeback.features import COUNTS, Attributes, Kind, count, differ, of_kind, same, significant, tensor
from sysid_btr.writeback.xmltext import (
    Edit,
    Element,
    append_child,
    apply,
    comment,
    element_text,
    insert_after,
    insert_before,
    number,
    numbers,
    parse,
    set_attributes,
)

if TYPE_CHECKING:
    import mujoco

ROUNDS = 6
"""One change may bring another: a mass moves the damping that a servo derives from it."""
REPEATED = ("replicate", "composite", "flexcomp", "default")
"""Elements whose content is no single object of the model."""
ROUNDING = 1e-9
TAG = "sysid_btr:"
"""Beginning of the names that elements without one are given for as long as they are looked for."""
ORIENTATION = ("quat", "euler", "axisangle", "xyaxes", "zaxis")


KINDS: tuple[Kind, ...] = ("option", *COUNTS)


class CannotWriteError(ValueError):
    """A wanted change that no attribute of this text makes."""


@dataclass(frozen=True, eq=False)
class Compiled:
    """A text, the model it compiles to, and the element of each of its objects.

    Attributes
    ----------
    text, root : the MJCF.
    model : compiled.
    angle : unit of its angles, rad.
    explicit : whether a body's inertia may be stated although it has geoms.
    total : mass to which the compiler scales the model, kg; not positive for none.
    elements : kind -> element of each object, None for one that stands in no element of its own.
    """

    text: bytes
    root: Element
    model: mujoco.MjModel
    angle: float
    explicit: bool
    total: float
    elements: Mapping[Kind, Sequence[Element | None]]

    def at(self, kind: Kind, i: int) -> Element:
        """The element of an object.

        Raises
        ------
        CannotWriteError
            If it has none of its own.
        """
        element = self.elements[kind][i]
        if element is None:
            name = getattr(self.model, kind)(i).name
            raise CannotWriteError(f"{kind} {name or i} is not a single element of the text")
        return element


def compile_text(text: bytes) -> Compiled:
    """Compile a text and find the element of each object.

    Raises
    ------
    CannotWriteError
        If MuJoCo cannot compile it.
    """
    import mujoco

    from sysid_btr.simulation.silence import silenced

    root = parse(text)
    named: dict[Kind, dict[str, Element]] = {k: {} for k in COUNTS}
    edits = []
    for element in root.walk():
        kind = _kind(element)
        if kind is None:
            continue
        name = element.attributes.get("name")
        if name is None:
            name = f"{TAG}{element.start}"
            edits.append(set_attributes(text, element, {"name": name}))
        named[kind][name] = element
    try:
        # what the compiler warns of was said when the robot was loaded
        with silenced(), warnings.catch_warnings(action="ignore"):
            spec = mujoco.MjSpec.from_string(apply(text, edits).decode())
            model = spec.compile()
    except ValueError as error:
        raise CannotWriteError(f"MuJoCo cannot compile the text: {error}") from error
    elements = {
        kind: [found.get(getattr(model, kind)(i).name) for i in range(count(model, kind))]
        for kind, found in named.items()
    }
    elements["body"][0] = next((e for e in root.children if e.tag == "worldbody"), None)
    return Compiled(
        text=text,
        root=root,
        model=model,
        angle=pi / 180 if spec.compiler.degree else 1.0,
        explicit=spec.compiler.inertiafromgeom != mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE,
        total=float(spec.compiler.settotalmass),
        elements=elements,
    )


def _kind(element: Element) -> Kind | None:
    """What an element makes, if it makes one object."""
    above = [a.tag for a in element.ancestors]
    if not above or any(tag in REPEATED for tag in above):
        return None
    if above[0] in ("actuator", "tendon") and element.tag != "plugin":
        return "actuator" if above[0] == "actuator" else "tendon"
    if "worldbody" not in above:
        return None
    kinds: dict[str, Kind] = {"body": "body", "joint": "joint", "freejoint": "joint", "geom": "geom", "site": "site"}
    return kinds.get(element.tag)


def rewrite(text: bytes, target: mujoco.MjModel, notes: Mapping[tuple[Kind, str], str]) -> Compiled:
    """Change a text until it compiles to a wanted model.

    Parameters
    ----------
    text : MJCF with absolute paths.
    target : what it shall compile to: the same objects, and what structure was added.
    notes : (kind, name) -> comment to put before an object that is changed or added.

    Raises
    ------
    CannotWriteError
        If no change of attributes does that.
    """
    now = compile_text(add_structure(compile_text(text), target, notes))
    for kind in COUNTS:
        _check_order(now, target, kind)
    for _ in range(ROUNDS):
        edits = list(_edits(now, target))
        if not edits:
            return compile_text(add_notes(now, notes))
        now = compile_text(apply(now.text, edits))
    left = sorted({f"{kind} {label}" for kind, label in unequal(now.model, target)})
    raise CannotWriteError(f"no attribute of the text changes {', '.join(left) or 'what has to change'}")


def unequal(model: mujoco.MjModel, target: mujoco.MjModel) -> list[tuple[Kind, str]]:
    """Kind and property of whatever differs, once for each object."""
    return [
        (kind, feature.label)
        for kind in KINDS
        for i in range(count(target, kind))
        for feature in of_kind(kind)
        if differ(feature, model, target, i)
    ]


def _check_order(now: Compiled, target: mujoco.MjModel, kind: Kind) -> None:
    names = [getattr(now.model, kind)(i).name for i in range(count(now.model, kind))]
    wanted = [getattr(target, kind)(i).name for i in range(count(target, kind))]
    ours = ["" if name.startswith(TAG) else name for name in names]
    if ours != wanted:
        raise CannotWriteError(f"the text cannot be given the {kind} order of the model that was replayed")


def _edits(now: Compiled, target: mujoco.MjModel) -> list[Edit]:
    edits: dict[int, Edit] = {}

    def change(element: Element, values: Attributes, tag: str | None = None) -> None:
        edits[element.start] = set_attributes(now.text, element, values, tag)

    options: Attributes = {}
    for feature in of_kind("option"):
        if feature.write is not None and differ(feature, now.model, target, 0):
            options |= feature.write(now.model, target, 0, now.angle)
    result = _option_edits(now, options)
    bodies = [i for i in range(1, target.nbody) if any(differ(f, now.model, target, i) for f in of_kind("body"))]
    if bodies and not now.explicit:
        result += _compiler(now, {"inertiafromgeom": "auto"})
    elif bodies and now.total > 0:
        result += _compiler(now, {"settotalmass": "-1"})
    else:
        result += [edit for i in bodies for edit in _body_edits(now, target, i)]
    for kind in ("joint", "geom", "site", "tendon"):
        for i in range(count(target, kind)):
            values: Attributes = {}
            for feature in of_kind(kind):
                if feature.write is not None and differ(feature, now.model, target, i):
                    values |= feature.write(now.model, target, i, now.angle)
            if {"damping", "stiffness"} & set(values) and kind == "joint" and b"springdamper" in now.text:
                values |= {"springdamper": "0 0"}  # from which the compiler would derive both again
            if values:
                change(now.at(kind, i), values)
    for i in range(target.nu):
        values, tag = _actuator(now, target, i)
        if values:
            change(now.at("actuator", i), values, tag)
    return [*result, *edits.values()]


def _option_edits(now: Compiled, values: Attributes) -> list[Edit]:
    """Where the text states an option last, there it is changed; else in its last <option>, else in a new one."""
    if not values:
        return []
    options = [e for e in now.root.children if e.tag == "option"]
    if not options:
        new = element_text("option", {k: v for k, v in values.items() if v is not None})
        after = [e for e in now.root.children if e.tag == "compiler"]
        return [
            insert_after(now.text, after[-1], [new]) if after else append_child(now.text, now.root, [new], first=True)
        ]
    by_element: dict[int, tuple[Element, Attributes]] = {}
    for name, value in values.items():
        element = next((o for o in reversed(options) if name in o.attributes), options[-1])
        by_element.setdefault(element.start, (element, {}))[1][name] = value
    return [set_attributes(now.text, element, changed) for element, changed in by_element.values()]


# --- inertia --------------------------------------------------------------------------------------------


def _body_edits(now: Compiled, target: mujoco.MjModel, i: int) -> list[Edit]:
    body = now.at("body", i)
    inertial = next((c for c in body.children if c.tag == "inertial"), None)
    if inertial is None:
        geoms = _scaled_geoms(now, target, i, body)
        if geoms:
            return geoms
        stated = {"pos": numbers(target.body_ipos[i])}
        if not same(target.body_iquat[i], np.array([1.0, 0.0, 0.0, 0.0])):
            stated["quat"] = numbers(target.body_iquat[i])
        stated |= {"mass": number(target.body_mass[i]), "diaginertia": numbers(target.body_inertia[i])}
        return [append_child(now.text, body, [element_text("inertial", stated)], first=True)]
    values: Attributes = {}
    if not same(now.model.body_mass[i], target.body_mass[i]):
        values["mass"] = number(target.body_mass[i])
    if not same(now.model.body_ipos[i], target.body_ipos[i]):
        values["pos"] = numbers(target.body_ipos[i])
    values |= _inertia(inertial, tensor(now.model, i), target, i)
    return [set_attributes(now.text, inertial, values)]


def _scaled_geoms(now: Compiled, target: mujoco.MjModel, i: int, body: Element) -> list[Edit]:
    """Masses of all geoms of a body by one factor, where they are stated and that is all that changes."""
    factor = float(target.body_mass[i] / now.model.body_mass[i]) if now.model.body_mass[i] > 0 else 1.0
    geoms = [e for e in body.walk() if e in now.elements["geom"] and _owner(e) is body]
    if (
        abs(factor - 1) < ROUNDING  # what rounding left of an earlier change
        or not all(float(g.attributes.get("mass", "0")) > 0 for g in geoms)
        or not same(now.model.body_ipos[i], target.body_ipos[i])
        or not same(factor * tensor(now.model, i), tensor(target, i))
    ):
        return []
    return [set_attributes(now.text, g, {"mass": number(factor * float(g.attributes["mass"]))}) for g in geoms]


def _inertia(inertial: Element, now: FloatArray, target: mujoco.MjModel, i: int) -> Attributes:
    wanted = tensor(target, i)
    if same(now, wanted):
        return {}
    own = next((n for n in ("diaginertia", "fullinertia") if n in inertial.attributes), None)
    factor = float(np.trace(wanted) / np.trace(now)) if np.trace(now) > 0 else 0.0
    if own is not None and same(factor * now, wanted):
        return {own: numbers([factor * float(x) for x in inertial.attributes[own].split()])}
    values: Attributes = {name: None for name in (*ORIENTATION, "fullinertia") if name in inertial.attributes}
    return values | {"quat": numbers(target.body_iquat[i]), "diaginertia": numbers(target.body_inertia[i])}


def _compiler(now: Compiled, values: Attributes) -> list[Edit]:
    compilers = [e for e in now.root.children if e.tag == "compiler"]
    stating = [e for e in compilers if set(values) & set(e.attributes)] or compilers[-1:]
    return [set_attributes(now.text, e, values) for e in stating]


# --- actuators ------------------------------------------------------------------------------------------

SPECIAL = ("kp", "kv", "ki", "dampratio", "timeconst", "inheritrange", "imax", "slewmax", "posrange")
"""What other elements than <general> derive numbers from."""


def _actuator(now: Compiled, target: mujoco.MjModel, i: int) -> tuple[Attributes, str | None]:
    """Changed attributes of an actuator, and the tag it needs if its own cannot state the gains."""
    values: Attributes = {}
    tag: str | None = None
    for feature in of_kind("actuator"):
        if not differ(feature, now.model, target, i):
            continue
        if feature.write is not None:
            values |= feature.write(now.model, target, i, now.angle)
            continue
        element = now.at("actuator", i)
        gains = SERVOS.get(element.tag, _no_servo)(target.actuator_gainprm[i], target.actuator_biasprm[i])
        if gains is not None:
            present = SERVOS[element.tag](now.model.actuator_gainprm[i], now.model.actuator_biasprm[i]) or {}
            values |= {name: number(v) for name, v in gains.items() if v != present.get(name)}
            if "kv" in values and "dampratio" in element.attributes:
                values["dampratio"] = None
        else:
            values |= _general(now, target, i, element)
            tag = None if element.tag == "general" else "general"
    return values, tag


def _no_servo(_gain: FloatArray, _bias: FloatArray) -> None:
    return None


def _position_gains(gain: FloatArray, bias: FloatArray) -> dict[str, float] | None:
    rest = (*gain[1:], bias[0], *bias[3:])
    if any(rest) or bias[1] != -gain[0] or bias[2] > 0:
        return None
    return {"kp": float(gain[0]), "kv": float(-bias[2]) + 0.0}


def _velocity_gains(gain: FloatArray, bias: FloatArray) -> dict[str, float] | None:
    rest = (*gain[1:], *bias[:2], *bias[3:])
    return None if any(rest) or bias[2] != -gain[0] else {"kv": float(gain[0])}


SERVOS: Mapping[str, Callable[[FloatArray, FloatArray], dict[str, float] | None]] = {
    "position": _position_gains,
    "intvelocity": _position_gains,
    "velocity": _velocity_gains,
}
"""Elements whose gains have names."""
DYNAMICS = ("none", "integrator", "filter", "filterexact")


def _general(now: Compiled, target: mujoco.MjModel, i: int, element: Element) -> Attributes:
    """Gains of an actuator as <general> has them; everything that its own tag implied is stated too."""
    gain, bias = target.actuator_gainprm[i], target.actuator_biasprm[i]
    least = now.model.actuator_gainprm[i], now.model.actuator_biasprm[i]
    values: Attributes = {
        "gainprm": numbers(gain[: max(significant(gain), significant(least[0]))]),
        "biasprm": numbers(bias[: max(significant(bias), significant(least[1]), 3)]),
    }
    if element.tag == "general":
        return values
    kind = int(now.model.actuator_dyntype[i])
    if target.actuator_gaintype[i] != 0 or target.actuator_biastype[i] not in (0, 1) or kind >= len(DYNAMICS):
        raise CannotWriteError(f"<{element.tag}> actuator {target.actuator(i).name!r} cannot be given other gains")
    values |= {"gaintype": "fixed", "biastype": ("none", "affine")[int(target.actuator_biastype[i])]}
    values |= {"dyntype": DYNAMICS[kind]}
    if kind:
        values["dynprm"] = numbers(now.model.actuator_dynprm[i][: significant(now.model.actuator_dynprm[i])])
    if target.actuator_ctrllimited[i]:
        values |= {"ctrllimited": "true", "ctrlrange": numbers(target.actuator_ctrlrange[i])}
    if target.actuator_actlimited[i]:
        values |= {"actlimited": "true", "actrange": numbers(target.actuator_actrange[i])}
    return values | {name: None for name in SPECIAL if name in element.attributes}


# --- structure ------------------------------------------------------------------------------------------


def add_structure(now: Compiled, target: mujoco.MjModel, notes: Mapping[tuple[Kind, str], str]) -> bytes:
    """The text with the bodies, joints, sites and tendons that the wanted model has more."""
    edits: list[Edit] = []
    bodies = {now.model.body(i).name: i for i in range(now.model.nbody)}
    children: dict[int, list[str]] = {}
    for i in range(1, target.nbody):
        if target.body(i).name not in bodies:
            parent = bodies[target.body(int(target.body_parentid[i])).name]
            children.setdefault(parent, []).extend([*_note(notes, "body", target.body(i).name), _body(target, i)])
    sites = {now.model.site(i).name for i in range(now.model.nsite)}
    for i in range(target.nsite):
        if target.site(i).name not in sites | {""}:
            body = bodies[target.body(int(target.site_bodyid[i])).name]
            site = {"name": target.site(i).name, "pos": numbers(target.site_pos[i])}
            children.setdefault(body, []).append(element_text("site", site))
    for parent, pieces in children.items():
        edits.append(append_child(now.text, now.at("body", parent), pieces))
    joints = {now.model.joint(i).name for i in range(now.model.njnt)}
    added = [i for i in range(target.njnt) if target.joint(i).name and target.joint(i).name not in joints]
    by_body: dict[int, list[str]] = {}
    for i in added:
        body = bodies[target.body(int(target.jnt_bodyid[i])).name]
        by_body.setdefault(body, []).extend([*_note(notes, "joint", target.joint(i).name), _joint(now, target, i)])
    for body, pieces in by_body.items():
        own = now.at("body", body)
        last = [c for c in own.children if any(e in now.elements["joint"] and _owner(e) is own for e in c.walk())]
        edits.append(insert_after(now.text, last[-1], pieces))
    tendons = {now.model.tendon(i).name for i in range(now.model.ntendon)}
    new = [i for i in range(target.ntendon) if target.tendon(i).name not in tendons | {""}]
    if new:
        lines = [element_text("tendon", {}, [_tendon(target, i) for i in new])]
        edits.append(append_child(now.text, now.root, lines))
    if added:
        edits += _key_edits(now, target, added)
    return apply(now.text, edits)


def _note(notes: Mapping[tuple[Kind, str], str], kind: Kind, name: str) -> list[str]:
    return [comment(notes[kind, name])] if (kind, name) in notes else []


def _owner(element: Element) -> Element | None:
    return next((a for a in element.ancestors if a.tag == "body"), None)


def _body(target: mujoco.MjModel, i: int) -> str:
    inertial = {
        "pos": numbers(target.body_ipos[i]),
        "mass": number(target.body_mass[i]),
        "diaginertia": numbers(target.body_inertia[i]),
    }
    place = {"name": target.body(i).name, "pos": numbers(target.body_pos[i])}
    return element_text("body", place, [element_text("inertial", inertial)])


JOINT_TYPES = ("free", "ball", "slide", "hinge")


def _joint(now: Compiled, target: mujoco.MjModel, i: int) -> str:
    stated: Attributes = {
        "name": target.joint(i).name,
        "type": JOINT_TYPES[int(target.jnt_type[i])],
        "pos": numbers(target.jnt_pos[i]),
        "axis": numbers(target.jnt_axis[i]),
        "limited": "false",
    }
    for feature in of_kind("joint"):
        if feature.write is not None:
            stated |= feature.write(target, target, i, now.angle)
    if not target.dof_frictionloss[target.jnt_dofadr[i]] > 0:
        stated = {k: v for k, v in stated.items() if not k.endswith("friction")}
    return element_text("joint", {k: v for k, v in stated.items() if v is not None})


def _tendon(target: mujoco.MjModel, i: int) -> str:
    """A tendon over joints, such as one that damps both sides of a gear, or from site to site."""
    import mujoco

    first, size = int(target.tendon_adr[i]), int(target.tendon_num[i])
    over = range(first, first + size)
    own = {"name": target.tendon(i).name}
    for feature in of_kind("tendon"):
        if feature.write is not None:
            own |= {k: v for k, v in feature.write(target, target, i, 1.0).items() if v is not None}
    if target.wrap_type[first] == mujoco.mjtWrap.mjWRAP_SITE:
        ends = [element_text("site", {"site": target.site(int(target.wrap_objid[w])).name}) for w in over]
        return element_text("spatial", own, ends)
    wraps = [
        element_text(
            "joint", {"joint": target.joint(int(target.wrap_objid[w])).name, "coef": number(target.wrap_prm[w])}
        )
        for w in over
    ]
    return element_text("fixed", own, wraps)


def _key_edits(now: Compiled, target: mujoco.MjModel, added: Sequence[int]) -> list[Edit]:
    """Zeros in the stored states for joints that were not there."""
    merged: dict[int, tuple[Element, Attributes]] = {}
    for name, size, addresses in (
        ("qpos", now.model.nq, target.jnt_qposadr[list(added)]),
        ("qvel", now.model.nv, target.jnt_dofadr[list(added)]),
    ):
        for key in now.root.walk():
            values = key.attributes.get(name, "").split() if key.tag == "key" else []
            if len(values) == size > 0:
                for address in sorted(int(a) for a in addresses):
                    values.insert(address, "0")
                merged.setdefault(key.start, (key, {}))[1][name] = " ".join(values)
    return [set_attributes(now.text, key, values) for key, values in merged.values()]


def add_notes(now: Compiled, notes: Mapping[tuple[Kind, str], str]) -> bytes:
    """The text with comments before objects; those that were added have theirs."""
    edits = []
    for (kind, name), words in notes.items():
        if kind == "option":
            found = [e for e in now.root.children if e.tag == "option"][-1:]
        else:
            found = [e for e in now.elements[kind] if e is not None and e.attributes.get("name") == name]
        if found and comment(words).encode() not in now.text:
            edits.append(insert_before(now.text, found[0], comment(words)))
    return apply(now.text, edits)
