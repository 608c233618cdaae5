"""Whole numbers as the registers of servos hold them, read without their sign."""

from __future__ import annotations

import re

import numpy as np

from sysid_btr._typing import FloatArray

_KNOWN = re.compile(r"(?P<kind>int|sign)(?P<bits>[1-9]\d?)")
EXAMPLES = "int16 (two's complement in 16 bits), sign15 (bit 15 is the sign, those below the magnitude)"


def is_encoding(name: str) -> bool:
    """Whether an encoding is called so."""
    found = _KNOWN.fullmatch(name)
    return found is not None and 2 <= int(found["bits"]) <= 32


def decode(values: FloatArray, name: str) -> FloatArray:
    """Numbers with their sign, of numbers read as if they had none; those that have it already stay.

    Parameters
    ----------
    values : ndarray; NaN where missing.
    name : ``int16``: two's complement in 16 bits; ``sign15``: bit 15 is the sign, those below it the magnitude.
    """
    found = _KNOWN.fullmatch(name)
    if found is None:
        raise ValueError(f"{name!r} is not an encoding")
    bits = int(found["bits"])
    if found["kind"] == "int":
        return np.where(values >= 2.0 ** (bits - 1), values - 2.0**bits, values)
    return np.where(values >= 2.0**bits, 2.0**bits - values, values)
