"""The user's own tasks and controllers: where they are found, and errors that name them where they fail."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from traceback import extract_tb
from typing import Any

from sysid_btr.errors import SysidError, UsageError
from sysid_btr.io.log import with_hint
from sysid_btr.models.robot import Robot


def load_own(called: str, text: str, robot: Robot, available: str) -> Any:
    """What ``module:name`` stands for: an object, or what a class without arguments, or a function of the robot, makes.

    Parameters
    ----------
    called : in errors, the flag and what was given.
    available : what there is beside one's own, in words.

    Raises
    ------
    UsageError
        If there is no such module or name, or its code fails.
    """
    module, _, name = text.partition(":")
    module = module.removesuffix(".py")
    if not name:
        raise UsageError(f"{called}: available are {available}")
    try:
        with blamed(f"{called}: {module}"), _looked_for_here():
            there = import_module(module)
    except ModuleNotFoundError as error:
        if not f"{module}.".startswith(f"{error.name}."):
            raise UsageError(f"{called}: {module} needs {error.name}, which is not installed") from error
        raise UsageError(
            f"{called}: there is no module {module} in {Path.cwd()} or among what is installed; available are "
            f"{available}"
        ) from None
    if not hasattr(there, name):
        known = [n for n in vars(there) if not n.startswith("_")]
        raise UsageError(f"{called}: module {module} has no {with_hint(name, known)}")
    own = getattr(there, name)
    with blamed(called):
        if isinstance(own, type):
            return own()
        return own(robot) if callable(own) else own


@contextmanager
def blamed(called: str) -> Iterator[None]:
    """Let what fails in code that may be the user's be an error that says so, and where.

    Raises
    ------
    UsageError
        In place of any error that is not the library's own, or of a module that is missing.
    """
    try:
        yield
    except (SysidError, ModuleNotFoundError):
        raise
    except Exception as error:
        frame = extract_tb(error.__traceback__)[-1]
        # a syntax error says itself where it is, and what cannot be called at all has no place
        placed = not isinstance(error, SyntaxError) and frame.filename != __file__
        where = f" ({Path(frame.filename).name}, line {frame.lineno})" if placed else ""
        raise UsageError(f"{called} failed: {type(error).__name__}: {error}{where}") from error


@contextmanager
def _looked_for_here() -> Iterator[None]:
    """Modules of the present folder can be imported."""
    sys.path.insert(0, str(Path.cwd()))
    try:
        yield
    finally:
        sys.path.pop(0)
