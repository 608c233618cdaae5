"""Numbers for people: SI prefixes, and as many digits as are known."""

from __future__ import annotations

import math
from collections.abc import Sequence

PREFIXES = ((1.0, ""), (1e-3, "m"), (1e-6, "µ"), (1e-9, "n"))
PREFIXED = ("rad", "m", "rad/s", "m/s", "Nm", "N", "s")
"""Units that people read with a prefix."""
CHANNEL_UNITS = {"position": ("rad", "m"), "velocity": ("rad/s", "m/s"), "effort": ("Nm", "N")}
"""Unit of a channel for hinges and for slides."""


def si(value: float | None, unit: str, digits: int = 3) -> str:
    """A number for people: ``0.000612, "rad"`` -> ``0.612 mrad``."""
    if value is None or not math.isfinite(value):
        return "unknown"
    if unit in ("1", ""):
        return f"{value:.{digits}g}"
    if unit not in PREFIXED or value == 0:
        return f"{value:.{digits}g} {unit}"
    factor, prefix = _prefix(abs(value))
    return f"{value / factor:.{digits}g} {prefix}{unit}"


def _prefix(size: float) -> tuple[float, str]:
    return next(((f, p) for f, p in PREFIXES if size >= f * 0.9995), PREFIXES[-1])


def si_all(values: Sequence[float | None], unit: str, digits: int = 3) -> list[str]:
    """Numbers that are compared with each other, all with the prefix of the largest."""
    known = [abs(v) for v in values if v is not None and math.isfinite(v)]
    if unit not in PREFIXED or not any(known):
        return [si(v, unit, digits) for v in values]
    factor, prefix = _prefix(max(known))
    return [
        "unknown" if v is None or not math.isfinite(v) else f"{v / factor:.{digits}g} {prefix}{unit}" for v in values
    ]


def with_digits_of(value: float | None, std: float | None) -> str:
    """A value with as many decimals as two digits of its standard error have."""
    if value is None:
        return "-"
    if std is None or not std > 0:
        return f"{value:.4g}"
    decimals = 1 - math.floor(math.log10(std))
    return f"{value:.{decimals}f}" if 0 <= decimals <= 7 else f"{value:.4g}"


def probability(value: float) -> str:
    """A probability in percent, which is never 0 or 100."""
    if value > 0.995:
        return "over 99 %"
    return "under 1 %" if value < 0.005 else f"{100 * value:.0f} %"


def after_number(unit: str, nominal: float) -> str:
    """What follows a number of this unit in a sentence: of a factor that is 1 in the plain model, of what it is one."""
    if unit == "1":
        return " x nominal" if nominal == 1 else ""
    return f" {unit}"
