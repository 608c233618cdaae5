"""The model that was replayed, as one compiled model: what a written file has to compile to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from sysid_btr._typing import BoolArray, FloatArray
from sysid_btr.models.robot import Robot
from sysid_btr.mujoco_conventions import FREE
from sysid_btr.simulation.compiling import compile_model, make_index
from sysid_btr.simulation.numerics import Numerics
from sysid_btr.simulation.silence import silenced
from sysid_btr.terms.base import BatchModel
from sysid_btr.terms.model import Model
from sysid_btr.writeback.features import WRITTEN
from sysid_btr.writeback.native import Beside, Part, part_of

if TYPE_CHECKING:
    import mujoco

    from sysid_btr.io.log import Log


@dataclass(frozen=True, eq=False)
class Target:
    """What to write.

    Attributes
    ----------
    model : compiled, with its free joint even where the log's robot was held.
    parts : every term as the file holds it.
    fields : compiled fields that each part changes.
    """

    model: mujoco.MjModel
    parts: tuple[Part, ...]
    fields: tuple[frozenset[str], ...]


def make_parts(robot: Robot, model: Model, numerics: Numerics) -> tuple[Part, ...]:
    """How a file holds each term that is not neutral; those of the robot itself come first."""
    everything = Model.joined([*((term, ()) for term in robot.always), *model.parts])
    parts, spec = [], robot.make_spec()
    plain, fuses = robot.compile(), bool(spec.compiler.fusestatic)
    for i, (term, own) in enumerate(everything.parts):
        neutral = len(own) > 0 and np.array_equal(own, [p.nominal for p in term.parameters])
        if neutral and not type(term).overrides("edit_spec"):
            continue
        parts.append(part_of(term, term.spread(own[None]), Beside(plain, numerics, everything.terms[i + 1 :], fuses)))
    return tuple(parts)


def make_target(robot: Robot, log: Log, parts: Sequence[Part], numerics: Numerics) -> Target:
    """Compile the robot with everything that a file can hold.

    Parameters
    ----------
    robot : as configured for the log.
    log : says whether the robot was held; some effects take their numerics from the model that was replayed.
    parts, numerics : what is written.
    """
    import mujoco

    writing = tuple(p.stand_in for p in parts if p.stand_in is not None)
    replayed = compile_model(robot, log, writing, numerics)
    batch = BatchModel(replayed, make_index(replayed), numerics.timestep, 1)
    fields: list[frozenset[str]] = []
    for part in parts:
        written = {} if part.stand_in is None else part.stand_in.model_fields(batch, part.values)
        batch.write(written)
        fields.append(frozenset(written))
    model = replayed
    if log.meta.mount == "fixed":
        free = replace(log, meta=replace(log.meta, mount="free"))
        model = compile_model(robot, free, writing, numerics)
    for name, values in batch.fields.items():
        _put(model, name, values[0])
    with silenced():
        mujoco.mj_setConst(model, mujoco.MjData(model))
    held = tuple(_as_written(part, own) for part, own in zip(parts, fields, strict=True))
    return Target(model, held, tuple(fields))


def _as_written(part: Part, fields: frozenset[str]) -> Part:
    """A part that changes what is not written is not in the file."""
    more = sorted(fields - WRITTEN)
    return replace(part, held="no", how=f"a change of {', '.join(more)}, which is not written") if more else part


def _put(model: mujoco.MjModel, name: str, values: FloatArray) -> None:
    """Write one field of a held robot's model into that of the free one, which has a free joint more."""
    if name.startswith("opt."):
        _assign(model.opt, name.removeprefix("opt."), values)
        return
    array = getattr(model, name)
    if len(array) == len(values):
        array[:] = values
        return
    array[_not_free(model, name.partition("_")[0])] = values


def _not_free(model: mujoco.MjModel, kind: str) -> BoolArray:
    """Rows of joints other than free ones, in a field by joint, by degree of freedom or by coordinate."""
    free = model.jnt_type == FREE
    if kind == "jnt":
        return np.asarray(~free)
    size, address, width = (model.nv, model.jnt_dofadr, 6) if kind == "dof" else (model.nq, model.jnt_qposadr, 7)
    keep = np.ones(size, dtype=bool)
    for start in address[free]:
        keep[start : start + width] = False
    return keep


def _assign(options: Any, name: str, values: FloatArray) -> None:
    if np.ndim(getattr(options, name)):
        getattr(options, name)[:] = values
    else:
        setattr(options, name, values.item())
