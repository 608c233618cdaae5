"""Editing XML as text: what is not changed stays as its author wrote it, byte for byte."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from xml.parsers import expat
from xml.sax.saxutils import escape

ATTRIBUTE = re.compile(rb"""([\w:.-]+)\s*=\s*("[^"]*"|'[^']*')""")
TAG_NAME = re.compile(rb"<\s*([\w:.-]+)")


@dataclass(eq=False)
class Element:
    """One element and where it stands in the text.

    Attributes
    ----------
    tag, attributes : as parsed.
    start, opened, end : byte offsets of its first character, of what follows its start tag, and of what
        follows it as a whole.
    parent, children : in document order.
    """

    tag: str
    attributes: dict[str, str]
    start: int
    opened: int
    parent: Element | None
    end: int = -1
    children: list[Element] = field(default_factory=list)

    def walk(self) -> Iterator[Element]:
        """The element and all below it, in document order."""
        yield self
        for child in self.children:
            yield from child.walk()

    @property
    def ancestors(self) -> Iterator[Element]:
        """Parent, its parent, up to the root."""
        above = self.parent
        while above is not None:
            yield above
            above = above.parent


def parse(text: bytes) -> Element:
    """The root element of a document.

    Raises
    ------
    ValueError
        If the text is no well-formed XML.
    """
    parser = expat.ParserCreate()
    stack: list[Element] = []
    roots: list[Element] = []

    def start(tag: str, attributes: dict[str, str]) -> None:
        at = parser.CurrentByteIndex
        parent = stack[-1] if stack else None
        element = Element(tag, attributes, at, _end_of_tag(text, at), parent)
        (roots if parent is None else parent.children).append(element)
        stack.append(element)

    def end(_tag: str) -> None:
        element = stack.pop()
        at = parser.CurrentByteIndex
        # a self-closing element ends where its start tag does
        element.end = element.opened if is_self_closing(text, element) else _end_of_tag(text, at)

    parser.StartElementHandler = start
    parser.EndElementHandler = end
    try:
        parser.Parse(text, True)
    except expat.ExpatError as error:
        raise ValueError(f"not well-formed XML: {error}") from error
    return roots[0]


def _end_of_tag(text: bytes, at: int) -> int:
    quote = b""
    for i in range(at, len(text)):
        c = text[i : i + 1]
        if quote:
            if c == quote:
                quote = b""
        elif c in (b'"', b"'"):
            quote = c
        elif c == b">":
            return i + 1
    raise ValueError("not well-formed XML: a tag is not closed")


def is_self_closing(text: bytes, element: Element) -> bool:
    """Whether an element is written as ``<tag/>``."""
    return text[element.opened - 2 : element.opened] == b"/>"


@dataclass(frozen=True)
class Edit:
    """Replace text[start:stop]."""

    start: int
    stop: int
    text: bytes


def apply(text: bytes, edits: Sequence[Edit]) -> bytes:
    """All edits at once; those at one place in the order given."""
    pieces, at = [], 0
    for edit in sorted(edits, key=lambda e: (e.start, e.stop)):
        if edit.start < at:
            raise ValueError("edits overlap")
        pieces += [text[at : edit.start], edit.text]
        at = edit.stop
    return b"".join([*pieces, text[at:]])


def set_attributes(text: bytes, element: Element, values: Mapping[str, str | None], tag: str | None = None) -> Edit:
    """Change attributes of an element; None removes one, a new one goes last. `tag` renames the element."""
    head = text[element.start : element.opened]
    if tag is not None:
        head = TAG_NAME.sub(b"<" + tag.encode(), head, count=1)
    for name, value in values.items():
        found = next((m for m in ATTRIBUTE.finditer(head) if m[1].decode() == name), None)
        if found is None:
            if value is not None:
                close = b"/>" if head.endswith(b"/>") else b">"
                body = head[: -len(close)]
                kept = body.rstrip()
                head = kept + b" " + _pair(name, value) + body[len(kept) :] + close
        elif value is None:
            before = head[: found.start()].rstrip()
            head = before + head[found.end() :]
        else:
            head = head[: found.start(2)] + _quoted(value) + head[found.end(2) :]
    end = element.end if tag is not None else element.opened
    tail = text[element.opened : end]
    if tag is not None and not is_self_closing(text, element):
        cut = tail.rindex(b"</")
        tail = tail[:cut] + b"</" + tag.encode() + b">"
    return Edit(element.start, end, head + tail)


def _pair(name: str, value: str) -> bytes:
    return name.encode() + b"=" + _quoted(value)


def _quoted(value: str) -> bytes:
    return ('"' + escape(value, {'"': "&quot;"}) + '"').encode()


def indent_of(text: bytes, element: Element) -> bytes:
    """White space between the start of an element's line and the element; empty if it does not come first."""
    line = text[text.rfind(b"\n", 0, element.start) + 1 : element.start]
    return line if not line.strip() else b""


def insert_before(text: bytes, element: Element, piece: str) -> Edit:
    """Put something on a line of its own before an element."""
    return Edit(element.start, element.start, piece.encode() + b"\n" + indent_of(text, element))


def insert_after(text: bytes, element: Element, pieces: Sequence[str]) -> Edit:
    """Put things after an element, each on a line of its own."""
    indent = indent_of(text, element)
    return Edit(element.end, element.end, b"".join(b"\n" + indent + p.encode() for p in pieces))


def append_child(text: bytes, element: Element, pieces: Sequence[str], *, first: bool = False) -> Edit:
    """Add children, each on a line of its own, as the first or the last ones."""
    outer = indent_of(text, element)
    inner = indent_of(text, element.children[0]) if element.children else outer + b"  "
    lines = b"".join(b"\n" + inner + p.encode() for p in pieces)
    if is_self_closing(text, element):
        tag = element.tag.encode()
        head = text[element.start : element.opened - 2].rstrip()
        return Edit(element.start, element.opened, head + b">" + lines + b"\n" + outer + b"</" + tag + b">")
    if first:
        return Edit(element.opened, element.opened, lines)
    close = text.rindex(b"</", element.opened, element.end)
    kept = text[element.opened : close].rstrip()
    at = element.opened + len(kept)
    return Edit(at, close, lines + b"\n" + outer)


def comment(words: str) -> str:
    """A comment; two hyphens in a row are not allowed in one."""
    return "<!-- " + words.replace("--", "- -").rstrip("-").strip(" ") + " -->"


def element_text(tag: str, attributes: Mapping[str, str], children: Sequence[str] = ()) -> str:
    """A new element on one line."""
    head = " ".join([tag, *(_pair(k, v).decode() for k, v in attributes.items())])
    return f"<{head}/>" if not children else f"<{head}>{''.join(children)}</{tag}>"


def number(value: float) -> str:
    """The shortest text that reads back to the same float64."""
    text = repr(float(value))
    return text[:-2] if text.endswith(".0") else text


def numbers(values: Iterable[float]) -> str:
    """Several numbers, separated by blanks."""
    return " ".join(number(v) for v in values)
