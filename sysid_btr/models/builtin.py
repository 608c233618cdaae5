"""Built-in robots by name."""

from __future__ import annotations

from collections.abc import Callable

from sysid_btr.models.ant import ant
from sysid_btr.models.emps import emps
from sysid_btr.models.nao import nao, nao_table1
from sysid_btr.models.robot import Robot
from sysid_btr.models.xl330 import xl330

BUILTIN: dict[str, Callable[[], Robot]] = {
    "nao": nao,
    "nao:table1": nao_table1,
    "ant": ant,
    "emps": emps,
    "xl330": xl330,
}
