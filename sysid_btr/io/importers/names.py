"""Names of joints: which one of the model a foreign name may mean."""

from __future__ import annotations

import difflib
import re
import shlex
from collections.abc import Iterable, Sequence

from sysid_btr.io._text import mirrored

_NOISE = ("joint", "motor", "jnt")
_CUTOFF = 0.75


def folded(name: str) -> str:
    """A name without case, separators and words such as "joint"."""
    plain = re.sub(r"[^0-9a-z]", "", name.casefold())
    for word in _NOISE:
        bare = plain.removesuffix(word).removeprefix(word)
        plain = bare or plain
    return plain


def suggestions(foreign: Iterable[str], model: Sequence[str]) -> dict[str, str]:
    """Joints of the model that names of a log may mean; one of each at most, exact names left out.

    Names alike but for case and separators come first; then the most alike, never left for right; then those of
    whose words one name has all and the other more, if no second one does.
    """
    free = [name for name in model if name not in set(foreign)]
    names = [name for name in foreign if name not in model]
    found: dict[str, str] = {}
    for name in names:
        same = [other for other in free if folded(other) == folded(name)]
        if len(same) == 1:
            found[name] = same[0]
            free.remove(same[0])
    for name in names:
        if name in found:
            continue
        by_fold = {folded(other): other for other in free if not _other_side(name, other)}
        close = difflib.get_close_matches(folded(name), by_fold, n=1, cutoff=_CUTOFF)
        if close:
            found[name] = by_fold[close[0]]
            free.remove(found[name])
    for name in names:
        if name in found:
            continue
        likely = [other for other in free if _shares_words(name, other)]
        if len(likely) == 1 and not any(_shares_words(n, likely[0]) for n in names if n not in found and n != name):
            found[name] = likely[0]
            free.remove(likely[0])
    return found


def _words(name: str) -> frozenset[str]:
    """Words of a name, as separators and capitals part them."""
    parts = re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|[0-9]+", name)
    return frozenset(part.casefold() for part in parts) - frozenset(_NOISE)


def _shares_words(name: str, other: str) -> bool:
    a, b = _words(name), _words(other)
    return bool(a and b) and (a <= b or b <= a) and not _other_side(name, other)


def quoted(text: str) -> str:
    """A word for a shell."""
    return shlex.quote(text)


def _other_side(a: str, b: str) -> bool:
    """Whether one name is of the left side and the other of the right."""
    return mirrored(a, b) or (_side(a) is not None and _side(b) is not None and _side(a) != _side(b))


def _side(name: str) -> str | None:
    lower = name.casefold()
    if re.match(r"l(eft)?[_.\- ]", lower) or re.match(r"L[A-Z]", name) or "left" in lower:
        return "left"
    if re.match(r"r(ight)?[_.\- ]", lower) or re.match(r"R[A-Z]", name) or "right" in lower:
        return "right"
    if lower.endswith(("_l", ".l", "-l")):
        return "left"
    if lower.endswith(("_r", ".r", "-r")):
        return "right"
    return None
