"""Which joints can feel each other: subtrees that hang on a fixed torso move independently.

Independent subtrees let one simulation carry the finite difference of one parameter in each of them, which
is exact, not an approximation (Curtis, Powell, Reid 1974, doi:10.1093/imamat/13.1.117).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from sysid_btr.terms.base import Term

if TYPE_CHECKING:
    import mujoco

WHOLE_ROBOT = -1
"""Subtree of something that acts on the whole robot."""


def subtrees(model: mujoco.MjModel) -> dict[str, int]:
    """Subtree of every joint and body by name; names shared by a joint and its body agree."""
    tree = np.arange(max(model.ntree, 1))

    def root(t: int) -> int:
        while tree[t] != t:
            t = int(tree[t])
        return t

    def join(a: int, b: int) -> None:
        tree[root(a)] = root(b)

    joint_equality = 2  # mjEQ_JOINT
    for e in range(model.neq):
        first, second = int(model.eq_obj1id[e]), int(model.eq_obj2id[e])
        if model.eq_type[e] == joint_equality and second >= 0:
            join(*(int(model.dof_treeid[model.jnt_dofadr[j]]) for j in (first, second)))
        elif model.eq_type[e] != joint_equality:
            for t in range(1, len(tree)):
                join(0, t)
    if _may_touch(model):
        for t in range(1, len(tree)):
            join(0, t)
    result = {}
    for b in range(model.nbody):
        t = int(model.body_treeid[b])
        result[model.body(b).name] = root(t) if t >= 0 else WHOLE_ROBOT
    for j in range(model.njnt):
        result[model.joint(j).name] = root(int(model.dof_treeid[model.jnt_dofadr[j]]))
    return result


def _may_touch(model: mujoco.MjModel) -> bool:
    """Whether geoms of two subtrees can collide with each other."""
    moving = np.flatnonzero(model.body_treeid[model.geom_bodyid] >= 0)
    for i, a in enumerate(moving):
        for b in moving[i + 1 :]:
            same = model.body_treeid[model.geom_bodyid[a]] == model.body_treeid[model.geom_bodyid[b]]
            meets = (model.geom_contype[a] & model.geom_conaffinity[b]) | (
                model.geom_contype[b] & model.geom_conaffinity[a]
            )
            if meets and not same:
                return True
    return False


def parameter_subtrees(terms: Sequence[Term], where: dict[str, int]) -> list[frozenset[int]]:
    """Subtrees that each parameter of some terms acts on; empty for the whole robot."""
    result: list[frozenset[int]] = []
    for term in terms:
        for group in term.grouped:
            found = frozenset(where.get(name, WHOLE_ROBOT) for name in group)
            result += [frozenset() if WHOLE_ROBOT in found else found] * len(term.numbers)
    return result


def column_groups(acts_on: Sequence[frozenset[int]]) -> tuple[tuple[int, ...], ...]:
    """Groups of parameters that act on different subtrees, greedily few."""
    groups: list[list[int]] = []
    taken: list[set[int]] = []
    for i, own in enumerate(acts_on):
        for group, used in zip(groups, taken, strict=True):
            if own and used and not (own & used) and -1 not in used:
                group.append(i)
                used |= own
                break
        else:
            groups.append([i])
            taken.append(set(own) if own else {-1})
    return tuple(tuple(g) for g in groups)
