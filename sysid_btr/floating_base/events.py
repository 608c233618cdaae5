"""Stretches of a recording that no walking model should be fitted to: falls, pick-ups, slips.

Times and speeds below are the Nao's; `BodySize` makes them those of the robot.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from sysid_btr._typing import BoolArray, FloatArray
from sysid_btr.floating_base.size import BodySize

FALLEN = 0.8
"""rad, tilt of the base from which no biped comes back: that is when it has fallen."""
BEFORE = 0.3
"""s before a fall that are left out as well: whatever began it is not the model's to explain."""
AROUND = 0.1
"""s left out on either side of a pick-up or a slip."""
AIRBORNE = 0.15
"""s without load under any foot that are more than a step."""
UNLOADED = 0.1
"""Fraction of the weight below which the feet carry nothing."""
SLIP_SPEED, SLIP_TIME, CERTAIN = 0.12, 0.05, 5.0
"""m/s and s of a loaded foot's motion that is a slip, and the standard errors it must exceed."""


@dataclass(frozen=True)
class Event:
    """Something that interrupts a walk.

    Attributes
    ----------
    kind : what happened.
    start, stop : s on the log's clock; a fall lasts to the end of the episode.
    """

    kind: Literal["fall", "pick-up", "slip"]
    start: float
    stop: float

    def __str__(self) -> str:
        if self.kind == "fall":
            return f"fall at {self.start:.2f} s"
        return f"{self.kind} from {self.start:.2f} to {self.stop:.2f} s"


def find_fall(time: FloatArray, tilt: FloatArray) -> Event | None:
    """The first moment at which the tilt (rad) of the base is more than a walk allows."""
    beyond = np.flatnonzero(tilt > FALLEN)
    if len(beyond) == 0:
        return None
    k = int(beyond[0])
    moment = float(time[k])
    if k and tilt[k] > tilt[k - 1]:
        moment = float(np.interp(FALLEN, [tilt[k - 1], tilt[k]], [time[k - 1], time[k]]))
    return Event("fall", moment, float(time[-1]))


def find_pickups(time: FloatArray, load: FloatArray, size: BodySize) -> tuple[Event, ...]:
    """Stretches in which no foot carries anything; `load` is the total in any unit, (n,)."""
    weight = float(np.median(load[load > 0])) if np.any(load > 0) else 0.0
    if weight <= 0:
        return ()
    return _stretches("pick-up", time, load < UNLOADED * weight, size.time(AIRBORNE))


def find_slips(
    time: FloatArray, speed: FloatArray, std: FloatArray, loaded: BoolArray, size: BodySize
) -> tuple[Event, ...]:
    """Stretches in which a loaded foot moves over the ground; all (n, feet), m/s."""
    moving = loaded & (speed > size.speed(SLIP_SPEED)) & (speed > CERTAIN * std)
    return tuple(e for column in moving.T for e in _stretches("slip", time, column, size.time(SLIP_TIME)))


def usable(time: FloatArray, events: tuple[Event, ...], size: BodySize) -> BoolArray:
    """(n,) samples outside of all events."""
    keep = np.ones(len(time), dtype=bool)
    for event in events:
        before = size.time(BEFORE if event.kind == "fall" else AROUND)
        after = np.inf if event.kind == "fall" else size.time(AROUND)
        keep &= (time < event.start - before) | (time > event.stop + after)
    return keep


def _stretches(
    kind: Literal["pick-up", "slip"], time: FloatArray, inside: BoolArray, least: float
) -> tuple[Event, ...]:
    edges = np.diff(np.concatenate([[False], inside, [False]]).astype(np.int8))
    pairs = zip(np.flatnonzero(edges == 1), np.flatnonzero(edges == -1), strict=True)
    return tuple(Event(kind, float(time[a]), float(time[b - 1])) for a, b in pairs if time[b - 1] - time[a] >= least)
