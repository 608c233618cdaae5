"""What a run may take of the machine: cores, and memory, of which more is refused before it is asked for."""

from __future__ import annotations

import os
from pathlib import Path

from sysid_btr.errors import SysidError, UsageError

VARIABLE = "SYSID_BTR_MEMORY"
"""Environment variable that sets the limit, in GB."""
SHARE = 0.5
"""Of the memory that there is, where nothing is set: arrays are copied, and other programs run beside."""
CONTAINER = Path("/sys/fs/cgroup/memory.max")
"""Where Linux says what a container may take."""
GB = 1e9


def usable_cores() -> int:
    """Cores that this process may run on, where the system tells them from those that there are."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def memory_limit() -> float:
    """Bytes that one thing may take.

    Raises
    ------
    UsageError
        If the environment sets something else than a number above zero.
    """
    given = os.environ.get(VARIABLE)
    if not given:
        return SHARE * _there_is()
    try:
        limit = float(given)
    except ValueError:
        limit = 0.0
    if not limit > 0:
        raise UsageError(f"{VARIABLE}={given}: give the memory that may be taken in GB, such as 4")
    return limit * GB


def require_memory(size: float, what: str, remedy: str, error: type[SysidError] = UsageError) -> None:
    """Refuse what takes more than the limit.

    Parameters
    ----------
    size : bytes.
    what : that takes them.
    remedy : what to do instead.
    error : raised.
    """
    limit = memory_limit()
    if size > limit:
        raise error(
            f"{what} would take {size / GB:.3g} GB of memory, and {limit / GB:.3g} GB may be taken: {remedy}, or set "
            f"{VARIABLE} (GB)"
        )


def _there_is() -> float:
    """Bytes of memory of this machine, or of the container that this process runs in."""
    try:
        physical = float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    except (AttributeError, OSError, ValueError):  # not on this system
        return 8 * GB
    try:
        return min(physical, float(CONTAINER.read_text()))
    except (OSError, ValueError):  # no container, or one without a limit
        return physical
