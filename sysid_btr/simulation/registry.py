"""Simulators by name, built in or installed by other packages."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache

from sysid_btr.errors import UsageError
from sysid_btr.plugins import installed, load_installed
from sysid_btr.simulation.mujoco_batch import MujocoBatch
from sysid_btr.simulation.numerics import MUJOCO, Numerics
from sysid_btr.simulation.simulator import Simulator

ENTRY_POINTS = "sysid_btr.simulators"
"""Entry-point group; each entry makes a `Simulator` when it is called without arguments."""

BUILT_IN: Mapping[str, Callable[[], Simulator]] = {MUJOCO: MujocoBatch}


def available() -> tuple[str, ...]:
    """Names of the simulators installed."""
    return (*BUILT_IN, *sorted(set(installed(ENTRY_POINTS)) - set(BUILT_IN)))


def on_simulator(numerics: Numerics, name: str | None) -> Numerics:
    """The same on a simulator that is known to be installed; None leaves the one they have.

    Raises
    ------
    UsageError
        See `get_simulator`.
    """
    chosen = numerics if name is None else replace(numerics, simulator=name)
    get_simulator(chosen.simulator)
    return chosen


@cache
def get_simulator(name: str) -> Simulator:
    """The simulator called `name`, built in or installed under the entry-point group `ENTRY_POINTS`.

    Raises
    ------
    UsageError
        There is none of that name, or it cannot be loaded.
    """
    make = BUILT_IN.get(name) or load_installed(ENTRY_POINTS, name, "simulator")
    if make is None:
        raise UsageError(f"there is no simulator {name!r}; installed are {', '.join(available())}")
    simulator: Simulator = make()
    return simulator
