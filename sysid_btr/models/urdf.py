"""URDF as it is found: made readable for MuJoCo in memory, with a remark for each thing that was changed."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

from sysid_btr.errors import ModelError
from sysid_btr.io._text import some

SHAPES = ("visual", "collision")
ONCE = ("origin", "inertial", "mass", "inertia", "parent", "child", "axis", "limit", "dynamics", "geometry")
"""Elements of which MuJoCo takes one in the same place, and two say different things."""
POINT_MASS, POINT_INERTIA = 1e-6, 1e-9
"""kg and kg m2 of a moving link that has none: a milligram is below what any joint torque shows, and MuJoCo, whose own
smallest is 1e-15, divides by it."""


@dataclass(frozen=True)
class Urdf:
    """A URDF that MuJoCo reads.

    Attributes
    ----------
    text : for `MjSpec.from_string`.
    remarks : a sentence for each thing that was left out or assumed.
    """

    text: str
    remarks: tuple[str, ...]


def read_urdf(path: Path, content: bytes) -> Urdf | None:
    """A URDF without what is not there; None for another XML text, by its outermost element.

    Shapes whose mesh is missing are left out: inertias are stated beside them. A mesh of a ROS package is looked for
    in the folders around the file.

    Raises
    ------
    ModelError
        Elements that stand twice in one place and differ, with all of them; or what is no number where one must be.
    """
    try:
        root = ElementTree.fromstring(content)
    except ElementTree.ParseError:
        return None
    if root.tag != "robot":
        return None
    try:
        remarks = [*_without_repeats(path, root), *_with_found_meshes(path, root), *_with_inertias(root)]
        return Urdf(ElementTree.tostring(root, encoding="unicode"), tuple(remarks))
    except (ValueError, OSError) as error:
        raise ModelError(f"model {path}: a mass, an inertia or a mesh's name cannot be read: {error}") from error
    except RecursionError:
        raise ModelError(f"model {path}: its elements are nested too deeply") from None


def _without_repeats(path: Path, root: ElementTree.Element) -> Iterator[str]:
    same, differ = [], []
    for owner in root:
        for parent in owner.iter():
            for tag in ONCE:
                found = parent.findall(tag)
                where = f"<{tag}> of {owner.tag} {owner.get('name', '')!r}"
                if any(_said(f) != _said(found[0]) for f in found[1:]):
                    said = " and ".join(_said(f) for f in found)
                    differ.append(f"{where} stands {len(found)} times: {said}")
                    continue
                for extra in found[1:]:
                    parent.remove(extra)
                    same.append(where)
    if differ:
        raise ModelError(
            f"model {path}: a URDF states each of these once, and it is not clear which one counts:\n  "
            + "\n  ".join(differ)
            + "\nDelete the wrong one of each."
        )
    if same:
        yield f"is given twice with the same content, and read once: {some(dict.fromkeys(same))}"


def _said(element: ElementTree.Element) -> str:
    return " ".join(ElementTree.tostring(element, encoding="unicode").split())


def _with_found_meshes(path: Path, root: ElementTree.Element) -> Iterator[str]:
    lost = []
    meshes = [mesh for mesh in root.iter("mesh") if mesh.get("filename")]
    places = {id(mesh): _found(path.parent.resolve(), mesh.get("filename", "")) for mesh in meshes}
    for link in root.findall("link"):
        for shape in [s for tag in SHAPES for s in link.findall(tag)]:
            missing = [m.get("filename", "") for m in shape.iter("mesh") if places.get(id(m)) is None]
            if missing:
                link.remove(shape)
                lost += missing
    for mesh in meshes:
        if place := places[id(mesh)]:
            mesh.set("filename", str(place))
    if any(places.values()):
        extension = root.find("mujoco")
        extension = ElementTree.SubElement(root, "mujoco") if extension is None else extension
        compiler = extension.find("compiler")
        compiler = ElementTree.SubElement(extension, "compiler") if compiler is None else compiler
        compiler.set("strippath", "false")
    if lost:
        yield f"meshes that were not found are left out: {some(dict.fromkeys(lost), 3)}; stated masses count"


def _found(folder: Path, name: str) -> Path | None:
    """Where a mesh is: beside the file, in the folder of its package above, or in a folder of that name around."""
    bare = name.removeprefix("file://")
    package, _, inner = bare.removeprefix("package://").partition("/")
    tried = [folder / bare, folder / Path(bare).name]
    if bare.startswith("package://"):
        above = (folder, *folder.parents)
        tried = [base / inner for base in above if base.name == package]
        tried += [base / package / inner for base in above] + [folder / inner, folder / Path(inner).name]
    return next((place for place in tried if place.is_file()), None)


def _with_inertias(root: ElementTree.Element) -> Iterator[str]:
    """Moving links without a mass, or with a mass that has no extent, are points."""
    moving = {
        child.get("link")
        for joint in root.findall("joint")
        if joint.get("type") != "fixed" and (child := joint.find("child")) is not None
    }
    massless, points = [], []
    for link in root.findall("link"):
        name, inertial = link.get("name", ""), link.find("inertial")
        # of a shape that may touch MuJoCo makes an inertia where none is stated
        if name not in moving or (inertial is None and link.find("collision") is not None):
            continue
        if inertial is None:
            inertial = ElementTree.SubElement(link, "inertial")
        mass, inertia = _child(inertial, "mass"), _child(inertial, "inertia")
        if float(mass.get("value", 0)) == 0:
            mass.set("value", str(POINT_MASS))
            massless.append(name)
        diagonal = ("ixx", "iyy", "izz")
        if not any(float(inertia.get(axis, 0)) for axis in diagonal):
            inertia.attrib.update(dict.fromkeys(diagonal, str(POINT_INERTIA)))
            inertia.attrib.update(dict.fromkeys(("ixy", "ixz", "iyz"), "0"))
            points.append(name)
    if massless:
        yield f"links without a mass get {1e6 * POINT_MASS:g} mg: {some(massless)}"
    if points:
        yield f"links without a rotational inertia are points ({POINT_INERTIA:g} kg m2): {some(points)}"


def _child(parent: ElementTree.Element, tag: str) -> ElementTree.Element:
    found = parent.find(tag)
    return ElementTree.SubElement(parent, tag) if found is None else found
