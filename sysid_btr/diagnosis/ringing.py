"""Blows that ring in a missing torque: a damped oscillation that begins at some moment, once or again and again.

A matched filter (Turin 1960, doi:10.1109/TIT.1960.1057571) for every frequency and decay says where one would explain
most of the torque; where it does so at several moments that are equally far apart, the blows come again.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.diagnosis.patterns import SHORTEST_PERIOD, of_motion, pulse_train, single_pulse, stands_out
from sysid_btr.identify.missing_torque import MissingTorque
from sysid_btr.identify.projection import orthonormal
from sysid_btr.terms.disturbance import ExternalDisturbance, ExternalDisturbanceTrain, Push
from sysid_btr.terms.disturbance import RingingDisturbance as Ringing
from sysid_btr.terms.disturbance import RingingDisturbanceTrain as RingingTrain

SLOWEST, FASTEST, FINER = 1.0, 25.0, 1.15
"""Hz that are tried, and the ratio of neighbours."""
DECAYS = (0.1, 0.2, 0.4, 0.8)
"""Seconds that are tried."""
SWINGS = 0.6
"""Periods within the decay below which nothing rings, as of an oscillator whose quality is 2: that is a push."""
LASTS = 5.0
"""Decays after which a ring is over."""
APART = 2.0
"""Decays that blows of a train are apart at least; closer ones are a torque that swings all the time."""
AGAIN = 1.5
"""A train must explain this many times what its largest blow does alone; two equal ones explain twice as much."""


@dataclass(frozen=True)
class Blow:
    """A ring: the numbers of its effect but the amount, and the sum of squares of the torque that it explains."""

    when: tuple[float, ...]
    explained: float


def blows(one: MissingTorque) -> tuple[Blow | None, Blow | None]:
    """The clearest blow that rings, and the clearest train; None where none is, or a push or a wave is clearer."""
    beside = one.beside(of_motion(one))
    guess = _matched(beside)
    if guess is None:
        return None, None
    frequency, decay, answer = guess
    first = int(np.argmax(np.abs(answer)))
    once = _ring(beside, Ringing, (float(one.time[first]), frequency, decay))
    again: Blow | None = None
    comb = _comb(answer, max(round(max(SHORTEST_PERIOD, APART * decay) / one.period), 2))
    if comb is not None and comb[2] >= AGAIN * float(np.max(answer**2)):
        start, period, _ = comb
        again = _ring(beside, RingingTrain, (float(one.time[start]), frequency, decay, period * one.period))
    # plain pushes are sought last: that takes longest, and few torques ring
    return (
        once and _unless_pushed(beside, once, ExternalDisturbance, single_pulse(one)),
        again and _unless_pushed(beside, again, ExternalDisturbanceTrain, pulse_train(one)),
    )


def _matched(one: MissingTorque) -> tuple[float, float, FloatArray] | None:
    """Frequency and decay of the ring that explains most, and the answer (n,) of its filter: signed root of what."""
    n = len(one.torque)
    spectrum = np.fft.rfft(one.torque, 2 * n)
    gain = np.interp(np.fft.rfftfreq(2 * n, one.period), one.frequency, one.gain)
    best: tuple[float, float, FloatArray] | None = None
    for frequency, decay in _tried(one):
        since = one.period * np.arange(min(n, round(LASTS * decay / one.period) + 1))
        shape = np.fft.rfft(np.exp(-since / decay) * np.sin(2 * np.pi * frequency * since), 2 * n) * gain
        size = float(np.sum(np.fft.irfft(shape, 2 * n) ** 2))
        answer = np.fft.irfft(spectrum * shape.conj(), 2 * n)[:n] / np.sqrt(max(size, 1e-300))
        if best is None or np.max(np.abs(answer)) > np.max(np.abs(best[2])):
            best = frequency, decay, np.asarray(answer)
    return best


def _tried(one: MissingTorque) -> Iterator[tuple[float, float]]:
    fastest = min(FASTEST, 0.25 / one.period)
    count = int(np.log(max(fastest / SLOWEST, 1.0)) / np.log(FINER)) + 1
    for frequency in SLOWEST * FINER ** np.arange(count):
        yield from ((float(frequency), decay) for decay in DECAYS if frequency * decay >= SWINGS)


def _comb(answer: FloatArray, least: int) -> tuple[int, int, float] | None:
    """First sample and period, in samples, of the equal blows that explain most, and how much; two blows at least."""
    n = len(answer)
    best: tuple[int, int, float] | None = None
    for period in range(least, n - 1):
        rows = -(-n // period)
        padded = np.zeros(rows * period)
        padded[:n] = answer
        # from each possible first blow on to the end
        total = np.cumsum(padded.reshape(rows, period)[::-1], axis=0)[::-1].ravel()[:n]
        count = (n - 1 - np.arange(n)) // period + 1
        explained = np.where(count >= 2, total**2 / count, 0.0)
        start = int(np.argmax(explained))
        if best is None or explained[start] > best[2]:
            best = start, period, float(explained[start])
    return best


def _ring(one: MissingTorque, effect: type[Push], guess: tuple[float, ...]) -> Blow | None:
    """A blow near a guess, as it explains most; None if it does not ring, a wave does as well, or noise nearly so."""
    from scipy.optimize import least_squares

    step = np.full(len(guess), 1e-3)
    reach = np.array(effect.reaches(*guess))
    low, high = -np.ones(len(guess)), np.ones(len(guess))

    def numbers(x: FloatArray) -> tuple[float, ...]:
        return tuple(np.maximum(np.array(guess) + x * reach, (0.0, *[1e-3] * (len(guess) - 1))))

    def left(x: FloatArray) -> FloatArray:
        shown = _shown(one, effect, numbers(x))
        return one.torque - shown * (shown @ one.torque)

    found = least_squares(left, np.zeros(len(guess)), bounds=(low, high), diff_step=step, max_nfev=30)
    blow = Blow(numbers(found.x), _explained(one, effect, numbers(found.x)))
    _, frequency, decay = blow.when[:3]
    angle = 2 * np.pi * frequency * one.time
    wave = orthonormal(one.seen(np.column_stack([np.sin(angle), np.cos(angle)])))
    rings = frequency * decay >= SWINGS and blow.explained > float(np.sum((wave.T @ one.torque) ** 2))
    clear = rings and stands_out(one, blow.explained, left(found.x), LASTS * decay / one.period)
    return blow if clear else None


def _unless_pushed(one: MissingTorque, blow: Blow, effect: type[Push], push: tuple[float, ...] | None) -> Blow | None:
    """A blow, unless a plain push explains as much."""
    return None if push is not None and _explained(one, effect, push) >= blow.explained else blow


def _shown(one: MissingTorque, effect: type[Push], when: tuple[float, ...]) -> FloatArray:
    """(n,) a push as the estimate shows it, of length 1."""
    borders = np.append(one.time, one.time[-1] + one.period) - 0.5 * one.period
    course = effect.mean_torque(np.array([[1.0, *when]]), borders[None])[0]
    shown = orthonormal(one.seen(course)[:, None])
    return shown[:, 0] if shown.size else np.zeros(len(course))


def _explained(one: MissingTorque, effect: type[Push], when: tuple[float, ...]) -> float:
    """Sum of squares of the torque that a push explains."""
    return float(_shown(one, effect, when) @ one.torque) ** 2
