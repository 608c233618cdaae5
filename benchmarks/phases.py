"""Where the CPU time of a run goes: physics, with laws of every step and without, linear algebra, set-up, and so on.

A thread looks every few milliseconds at the Python stack of the one that works, and gives the CPU time that the process
has used since to the part of the first rule that fits. Nothing is slowed down, and nothing has to know of it.
"""

from __future__ import annotations

import sys
import threading
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from time import process_time
from types import FrameType
from typing import Any

from sysid_btr.simulation.numerics import INTEGRATORS

EVERY = 0.005
"""s between two looks."""
STEP = "choosing the step"
SETUP = "set-up"
ONE, MANY = "physics of one candidate", "physics"
LAWS, COMPILED = "physics under laws", "compiling laws"
ALGEBRA, REPORT, REST = "linear algebra", "report", "else"
PARTS = (MANY, ONE, LAWS, COMPILED, ALGEBRA, STEP, SETUP, REPORT, REST)

COMPILER = "/numba/core/"
WHOLE = {
    "choose_numerics": STEP,
    "realise_servo": STEP,
    "with_short_steps": STEP,
    "write_all": REPORT,
    "describe_model": REPORT,
    "print_result": REPORT,
}
"""Functions whose time is of one part, whatever they call."""
FOLDERS = (
    ("numpy/linalg/", ALGEBRA),
    ("scipy/linalg/", ALGEBRA),
    ("sysid_btr/floating_base/chain.py", ALGEBRA),
    ("sysid_btr/floating_base/innovations.py", ALGEBRA),
    ("sysid_btr/objectives/", ALGEBRA),
    ("sysid_btr/estimators/lsq.py", ALGEBRA),
    ("sysid_btr/identify/study.py", SETUP),
    ("sysid_btr/io/", SETUP),
    ("sysid_btr/models/", SETUP),
    ("sysid_btr/simulation/compiling.py", SETUP),
    ("<frozen importlib", SETUP),
)
"""Beginnings of paths, the first that fits the innermost frame, then the one that called it, and so on."""


@dataclass
class Phases:
    """CPU seconds by part, of this process, and the steps that the simulator took.

    Attributes
    ----------
    seconds : by part.
    steps : of one simulation each, by the name of the integrator; one evaluation of the dynamics without a step counts
        as a step of Euler's method.
    calls : into the simulator, by part.
    """

    seconds: dict[str, float] = field(default_factory=lambda: defaultdict(float))
    steps: Counter[str] = field(default_factory=Counter)
    calls: Counter[str] = field(default_factory=Counter)

    @property
    def physics(self) -> float:
        """CPU seconds inside MuJoCo."""
        return self.seconds[ONE] + self.seconds[MANY] + self.seconds[LAWS]

    def to_dict(self) -> dict[str, float]:
        """Shares of all CPU time."""
        whole = sum(self.seconds.values()) or 1.0
        return {part: round(self.seconds[part] / whole, 3) for part in PARTS}


@contextmanager
def watched() -> Iterator[Phases]:
    """Watch what this thread does."""
    found, done, watching = Phases(), threading.Event(), threading.get_ident()

    def look() -> None:
        before = process_time()
        while not done.wait(EVERY):
            now = process_time()
            stacks = {name: _stack(frame) for name, frame in sys._current_frames().items()}
            # laws are compiled by the thread that is the first to run them
            compiles = any(COMPILER in frame.f_code.co_filename for stack in stacks.values() for frame in stack)
            found.seconds[COMPILED if compiles else _part_of(stacks.get(watching, []))] += now - before
            before = now

    thread = threading.Thread(target=look, daemon=True)
    with _counting(found):
        thread.start()
        try:
            yield found
        finally:
            done.set()
            thread.join()


@contextmanager
def _counting(found: Phases) -> Iterator[None]:
    """Count the steps of every simulation, by wrapping the ways into MuJoCo."""
    from mujoco import mjtIntegrator
    from mujoco.batch import Batch

    from sysid_btr.simulation.mujoco_batch import MujocoBatch

    integrators = {getattr(mjtIntegrator, f"mjINT_{name.upper()}").value: name for name in INTEGRATORS}
    rollout, forward = MujocoBatch.rollout, Batch.forward

    def physics(simulator: MujocoBatch, setup: Any, *args: Any, **options: Any) -> Any:
        part = LAWS if setup.laws or setup.held_steps else ONE if setup.size == 1 else MANY
        found.calls[part] += 1
        found.steps[integrators[setup.model.opt.integrator]] += setup.steps * setup.size
        return rollout(simulator, setup, *args, **options)

    def evaluation(batch: Any, *args: Any, **options: Any) -> Any:
        part = ONE if batch.nsim == 1 else MANY
        found.calls[part] += 1
        found.steps["Euler"] += int(batch.nsim)
        return forward(batch, *args, **options)

    ways = ((MujocoBatch, "rollout", physics, rollout), (Batch, "forward", evaluation, forward))
    for owner, name, watching, _ in ways:
        setattr(owner, name, watching)
    try:
        yield
    finally:
        for owner, name, _, own in ways:
            setattr(owner, name, own)


def _stack(frame: FrameType | None) -> list[FrameType]:
    """Frames from the innermost one on."""
    found = []
    while frame is not None:
        found.append(frame)
        frame = frame.f_back
    return found


def _part_of(stack: Sequence[FrameType]) -> str:
    """The part that a stack, from its innermost frame on, belongs to."""
    for outer in reversed(stack):
        if (whole := WHOLE.get(outer.f_code.co_name)) is not None:
            return whole
    for inner in stack:
        code = inner.f_code
        if code.co_name in ("physics", "evaluation") and code.co_filename == __file__:
            return str(inner.f_locals["part"])
        place = Path(code.co_filename).as_posix()
        for beginning, part in FOLDERS:
            if beginning in place:
                return part
    return REST
