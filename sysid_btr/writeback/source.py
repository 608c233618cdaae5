"""The text to write into: the user's own MJCF, or one made from a robot that has none."""

from __future__ import annotations

import ctypes
import re
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from sysid_btr.run_folder import relative
from sysid_btr.writeback.xmltext import (
    Edit,
    Element,
    append_child,
    apply,
    comment,
    element_text,
    is_self_closing,
    number,
    parse,
    set_attributes,
)

if TYPE_CHECKING:
    import mujoco

    from sysid_btr.models.robot import Robot

LONG_NUMBER = re.compile(r"-?\d+\.\d{10,}(?:e[-+]?\d+)?")
DIGITS = 17
"""Significant digits from which every float64 reads back."""
FOLDERS = ("meshdir", "texturedir", "assetdir")
TEXTURE_FILES = ("file", "fileright", "fileleft", "fileup", "filedown", "filefront", "fileback")


@dataclass(frozen=True)
class Included:
    """Another file whose content stands in a text, between two comments.

    Attributes
    ----------
    path : of the file.
    begin, end : the comments.
    content : what stands between them as long as nothing in it is changed.
    nested : whether it includes further files.
    """

    path: Path
    begin: bytes
    end: bytes
    content: bytes
    nested: bool


@dataclass(frozen=True)
class Source:
    """An MJCF that compiles to the plain robot, wherever it stands.

    Attributes
    ----------
    text : with what it includes in place, and with absolute paths to its assets.
    origin : where it is from, in words.
    includes : what can be folded back into includes.
    own : whether it is the user's own text.
    """

    text: bytes
    origin: str
    includes: tuple[Included, ...] = ()
    own: bool = True


def own_source(path: Path) -> Source:
    """The text of an MJCF file.

    Raises
    ------
    ValueError
        If it is not MJCF, such as a URDF.
    """
    text = path.read_bytes().removeprefix(b"\xef\xbb\xbf")
    if parse(text).tag != "mujoco":
        raise ValueError(f"{path} is not MJCF")
    found: list[Included] = []
    text = _expand(text, path.parent, path.parent, found)
    return Source(absolute_assets(text, path.parent.resolve()), path.name, tuple(found))


def made_source(robot: Robot, why: str = "") -> Source:
    """A complete MJCF of a robot without an MJCF file: built in, made in Python, or read from a URDF."""
    spec = robot.make_spec()
    spec.compile()
    text = LONG_NUMBER.sub(lambda m: number(float(m[0])), precise_xml(spec)).encode()
    folder = Path(spec.modelfiledir or ".").resolve()
    origin = f"the robot {robot.name}" if robot.path is None else robot.path.name
    return Source(absolute_assets(text, folder), origin + why, own=False)


def _expand(text: bytes, main: Path, folder: Path, found: list[Included]) -> bytes:
    """Put the content of included files in place, as MuJoCo does; outer files come before inner ones."""
    edits = []
    for element in parse(text).walk():
        if element.tag != "include" or "file" not in element.attributes:
            continue
        name = element.attributes["file"]
        path = next((p for p in (main / name, folder / name) if p.is_file()), main / name)
        inner = path.read_bytes().removeprefix(b"\xef\xbb\xbf")
        here = len(found)
        begin = comment(f"included from {name} [{here + 1}]").encode()
        end = comment(f"end of {name} [{here + 1}]").encode()
        found.append(Included(path.resolve(), begin, end, b"", False))
        inner = _expand(path.read_bytes().removeprefix(b"\xef\xbb\xbf"), main, path.parent, found)
        root = parse(inner)
        content = b"" if is_self_closing(inner, root) else inner[root.opened : inner.rindex(b"</")]
        found[here] = Included(path.resolve(), begin, end, content, len(found) > here + 1)
        edits.append(Edit(element.start, element.end, begin + content + end))
    return apply(text, edits)


def fold_includes(text: bytes, includes: Sequence[Included]) -> bytes:
    """Turn unchanged content of other files back into includes, by absolute path."""
    for part in includes:
        start = text.find(part.begin)
        if start < 0 or part.nested:
            continue
        stop = text.index(part.end, start)
        if text[start + len(part.begin) : stop] == part.content:
            include = element_text("include", {"file": str(part.path)}).encode()
            text = text[:start] + include + text[stop + len(part.end) :]
    return text


def absolute_assets(text: bytes, folder: Path) -> bytes:
    """Make the folders of meshes and textures absolute, so that the text can stand anywhere.

    Parameters
    ----------
    text : MJCF without includes.
    folder : of the file it is from.
    """
    root = parse(text)
    edits: dict[int, tuple[Element, dict[str, str | None]]] = {}

    def put(element: Element, name: str, value: str) -> None:
        edits.setdefault(element.start, (element, {}))[1][name] = value

    compilers = [e for e in root.children if e.tag == "compiler"]
    missing: dict[str, str] = {}
    for name, tags in (("meshdir", ("mesh", "hfield", "skin", "flexcomp")), ("texturedir", ("texture",))):
        if not any(_relative_file(e) for e in root.walk() if e.tag in tags):
            continue
        stated = next((c for c in reversed(compilers) if {name, "assetdir"} & set(c.attributes)), None)
        if stated is None:
            missing[name] = str(folder)
            continue
        own = stated.attributes.get(name, stated.attributes.get("assetdir", ""))
        put(stated, name if name in stated.attributes else "assetdir", str(folder / own))
    for element in root.walk():
        if element.tag == "model" and _relative_file(element):
            put(element, "file", str(folder / element.attributes["file"]))
    inserted: list[Edit] = []
    if missing and compilers:
        for name, value in missing.items():
            put(compilers[0], name, value)
    elif missing:
        inserted.append(append_child(text, root, [element_text("compiler", missing)], first=True))
    return apply(text, [*inserted, *(set_attributes(text, e, values) for e, values in edits.values())])


def relative_assets(text: bytes, folder: Path) -> bytes:
    """Make folders of meshes and textures and included files relative to the folder in which the text will stand.

    Parameters
    ----------
    text : MJCF, with absolute paths as `absolute_assets` and `fold_includes` leave them.
    folder : where it will stand.
    """
    edits = []
    for element in parse(text).walk():
        names = {"compiler": FOLDERS, "include": ("file",), "model": ("file",)}.get(element.tag, ())
        given = {n: element.attributes[n] for n in names if Path(element.attributes.get(n, "")).is_absolute()}
        if given:
            edits.append(set_attributes(text, element, {n: relative(path, folder) for n, path in given.items()}))
    return apply(text, edits)


def _relative_file(element: Element) -> bool:
    names = TEXTURE_FILES if element.tag == "texture" else ("file",)
    return any(n in element.attributes and not Path(element.attributes[n]).is_absolute() for n in names)


_PRECISION = threading.Lock()


def precise_xml(spec: mujoco.MjSpec) -> str:
    """XML of a compiled spec with all digits of its numbers, where this MuJoCo can; with six otherwise."""
    with _precision(DIGITS):
        return str(spec.to_xml())


@contextmanager
def _precision(digits: int) -> Iterator[None]:
    library = _library()
    if library is None:
        yield
        return
    with _PRECISION:
        before = library._mjPRIVATE__get_xml_precision()
        library._mjPRIVATE__set_xml_precision(digits)
        try:
            yield
        finally:
            library._mjPRIVATE__set_xml_precision(before)


@cache
def _library() -> ctypes.CDLL | None:
    """MuJoCo's library, if it lets the number of digits be set."""
    import mujoco

    for path in sorted(Path(mujoco.__file__).parent.glob("*mujoco.*")):
        if path.name.startswith(("libmujoco.", "mujoco.")) and path.suffix not in (".py", ".pyi"):
            try:
                library = ctypes.CDLL(str(path))
            except OSError:
                continue
            if hasattr(library, "_mjPRIVATE__set_xml_precision"):
                library._mjPRIVATE__get_xml_precision.restype = ctypes.c_int
                library._mjPRIVATE__set_xml_precision.argtypes = (ctypes.c_int,)
                library._mjPRIVATE__set_xml_precision.restype = None
                return library
    return None
