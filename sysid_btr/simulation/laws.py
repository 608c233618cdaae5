"""Laws of terms as machine code: compiled once, kept beside their source, and called between steps without Python."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import cache
from typing import Any, NamedTuple

import numba
import numpy as np
from numba import types
from numba.core.errors import NumbaError
from numba.extending import register_jitable

from sysid_btr._typing import BoolArray, FloatArray, IntArray
from sysid_btr.errors import UsageError
from sysid_btr.simulation.setup import Law
from sysid_btr.terms import law as terms_law

_ROW = types.float64[::1]
_STEP = types.NamedTuple([types.float64, types.float64, *[_ROW] * terms_law.ROWS], terms_law.Step)
SIGNATURE = types.void(_STEP, types.float64[:, ::1], types.float64[:, ::1], types.int64[::1])


class Laws(NamedTuple):
    """The laws (n,) of a setup, in the order in which they act.

    Attributes
    ----------
    address : of the machine code of each.
    rows, width, kept : its numbers are (rows, width), its memory (rows, kept).
    number, memory, place : (n + 1,) where its own begin in what is laid end to end.
    places : positions among the joints, law after law.
    """

    address: IntArray
    rows: IntArray
    width: IntArray
    kept: IntArray
    number: IntArray
    memory: IntArray
    place: IntArray
    places: IntArray


def table_of(laws: Sequence[Law], candidates: int) -> tuple[Laws, FloatArray, BoolArray]:
    """Laws (n,) and, for each candidate, their numbers (candidates, k) end to end, and which of them do anything.

    What a law at its neutral values does is nothing, so it is not called.
    """
    numbers = [law.term.law_numbers(law.values) for law in laws]
    rows, width = ([n.shape[axis] for n in numbers] for axis in (1, 2))
    kept, places = [law.term.law_memory for law in laws], [law.places for law in laws]
    table = Laws(
        _whole([address_of(law.term.law) for law in laws]),
        _whole(rows),
        _whole(width),
        _whole(kept),
        _ends(np.multiply(rows, width)),
        _ends(np.multiply(rows, kept)),
        _ends([len(p) for p in places]),
        _whole(np.concatenate([np.zeros(0), *places])),
    )
    flat = np.concatenate([np.zeros((candidates, 0)), *(n.reshape(candidates, -1) for n in numbers)], axis=1)
    awake = np.ones((candidates, len(laws)), dtype=np.bool_)
    for n, law in enumerate(laws):
        neutral = law.term.neutral
        if len(neutral):
            awake[:, n] = (law.values != law.term.spread(neutral[None])).any(axis=(1, 2))
    return table, flat, awake


def side_by_side(laws: Laws, joints: int, count: int) -> Laws:
    """Laws of places, without memory, of a robot that is there so many times, its joints one after another."""
    places = [
        (laws.places[a:b] + joints * np.arange(count)[:, None]).ravel()
        for a, b in zip(laws.place[:-1], laws.place[1:], strict=True)
    ]
    return laws._replace(
        rows=laws.rows * count, number=laws.number * count, place=laws.place * count, places=np.concatenate(places)
    )


def numbers_of_many(laws: Laws, numbers: FloatArray, count: int) -> FloatArray:
    """One candidate's numbers (k,) of laws as `side_by_side` has them: (k count,)."""
    ends = zip(laws.number[:-1], laws.number[1:], strict=True)
    return np.concatenate([np.tile(numbers[a:b], count) for a, b in ends])


def _whole(values: Any) -> IntArray:
    return np.asarray(values, dtype=np.int64)


def _ends(counts: Any) -> IntArray:
    return np.concatenate([np.zeros(1, dtype=np.int64), np.cumsum(_whole(counts))])


def compiled(function: Callable[..., Any]) -> Any:
    """A function as machine code, which is kept beside its source where there is a place for it."""
    found = numba.njit(nogil=True, error_model="numpy")(function)
    with suppress(RuntimeError):  # neither a file nor a cache that can be written: compiled again in each process
        found.enable_caching()
    return found


@cache
def address_of(law: Callable[..., None]) -> int:
    """Where the machine code of a law is.

    Raises
    ------
    UsageError
        The law is not in the Python that numba compiles.
    """
    _register_used(law)
    own = compiled(law)
    try:
        own.compile(SIGNATURE)
    except NumbaError as error:
        raise UsageError(
            f"{law.__module__}.{law.__qualname__} cannot be compiled: {str(error).strip()}\n"
            "A law acts on the numbers of one candidate, in the Python that numba compiles: numbers, arrays, math"
        ) from error
    found = own.overloads[SIGNATURE.args]
    return int(found.library.get_pointer_to_function(found.fndesc.llvm_cfunc_wrapper_name))


@cache
def _register_used(function: Any) -> None:
    """Let compiled code call the plain functions that a function calls."""
    for name in function.__code__.co_names:
        used = function.__globals__.get(name)
        if getattr(used, "used_in_laws", False):
            _register_used(used)
            register_jitable(used)
