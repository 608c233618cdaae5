"""Keep MuJoCo from printing, from writing a log file when a candidate diverges, and from timing itself.

A diverging candidate is an ordinary result here (it is reported as NaN), and MuJoCo's default would write
one warning a candidate to the console and to a file in the working folder. Its timers (`mjData.timer`) are read by
nobody here; for a small model, reading the clock at every stage takes a fifth of a step.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path


class _LogConfig(ctypes.Structure):
    """`mjLogConfig` of MuJoCo 4."""

    _fields_ = (
        ("logto_console", ctypes.c_bool),
        ("logto_file", ctypes.c_bool),
        ("logfile", ctypes.c_char * 1024),
        ("topics", ctypes.c_int),
    )


@cache
def mujoco_library() -> ctypes.CDLL | None:
    """MuJoCo's C library that is loaded, None if it is none that can be silenced."""
    import mujoco

    found = sorted(Path(mujoco.__file__).parent.glob("*mujoco*.so*")) + sorted(
        Path(mujoco.__file__).parent.glob("*mujoco*.d*l*")
    )
    for path in found:
        if path.name.startswith(("libmujoco.", "mujoco.")):
            library = ctypes.CDLL(str(path))
            if hasattr(library, "mju_getLogConfig"):
                library.mju_getLogConfig.restype = _LogConfig
                library.mju_setLogConfig.argtypes = (_LogConfig,)
                library.mju_setLogConfig.restype = None
                return library
    return None


def silence() -> None:
    """Keep MuJoCo silent for good, in a process that does nothing else: threads would undo each other's `silenced`."""
    library = mujoco_library()
    if library is not None:
        now = library.mju_getLogConfig()
        library.mju_setLogConfig(_LogConfig(False, False, now.logfile, now.topics))
        _clock(library).value = None


@contextmanager
def silenced() -> Iterator[None]:
    """Run MuJoCo without its console and file messages, and without its timers; the settings are restored after."""
    library = mujoco_library()
    if library is None:
        yield
        return
    before, clock = library.mju_getLogConfig(), _clock(library)
    function = clock.value
    silence()
    try:
        yield
    finally:
        library.mju_setLogConfig(before)
        clock.value = function


def _clock(library: ctypes.CDLL) -> ctypes.c_void_p:
    """Where MuJoCo keeps the function that it reads the time with; without one it does not measure."""
    return ctypes.c_void_p.in_dll(library, "mjcb_time")
