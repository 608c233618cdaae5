"""Make a MuJoCo model move like the robot in a log: which parameters, how sure, what the model is missing.

>>> import sysid_btr as sb
>>> study = sb.make_study(sb.load_robot("leg.xml"), [sb.read_log("leg.parquet")])  # doctest: +SKIP
>>> closing = sb.close(study, ["mass:*", "kp:*=shared"])  # doctest: +SKIP

Names are loaded when they are first used, so that importing the package costs next to nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from sysid_btr.version import __version__ as __version__

if TYPE_CHECKING:
    from sysid_btr.checking import check
    from sysid_btr.comparing import compare
    from sysid_btr.deploying import model, ranges, sample
    from sysid_btr.diagnosis.close import close
    from sysid_btr.executors import open_executor
    from sysid_btr.identify.fit import fit
    from sysid_btr.identify.replay import replay_log
    from sysid_btr.identify.study import make_study
    from sysid_btr.importing import import_log
    from sysid_btr.io.log import Log, LogMeta
    from sysid_btr.io.parquet import read_log, write_log
    from sysid_btr.io.validation import validate_file
    from sysid_btr.models.builtin import load_robot
    from sysid_btr.models.log_checks import validate_log
    from sysid_btr.posterior import posterior
    from sysid_btr.result import read_result
    from sysid_btr.saving import save, tables

_HOME = {
    "Log": "sysid_btr.io.log",
    "LogMeta": "sysid_btr.io.log",
    "check": "sysid_btr.checking",
    "close": "sysid_btr.diagnosis.close",
    "compare": "sysid_btr.comparing",
    "fit": "sysid_btr.identify.fit",
    "import_log": "sysid_btr.importing",
    "load_robot": "sysid_btr.models.builtin",
    "make_study": "sysid_btr.identify.study",
    "model": "sysid_btr.deploying",
    "open_executor": "sysid_btr.executors",
    "posterior": "sysid_btr.posterior",
    "ranges": "sysid_btr.deploying",
    "read_log": "sysid_btr.io.parquet",
    "read_result": "sysid_btr.result",
    "replay_log": "sysid_btr.identify.replay",
    "sample": "sysid_btr.deploying",
    "save": "sysid_btr.saving",
    "tables": "sysid_btr.saving",
    "validate_file": "sysid_btr.io.validation",
    "validate_log": "sysid_btr.models.log_checks",
    "write_log": "sysid_btr.io.parquet",
}

__all__ = [
    "Log",
    "LogMeta",
    "check",
    "close",
    "compare",
    "fit",
    "import_log",
    "load_robot",
    "make_study",
    "model",
    "open_executor",
    "posterior",
    "ranges",
    "read_log",
    "read_result",
    "replay_log",
    "sample",
    "save",
    "tables",
    "validate_file",
    "validate_log",
    "write_log",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'sysid_btr' has no attribute {name!r}; it offers {', '.join(__all__)}")
    home = import_module(_HOME[name])
    value = home if _HOME[name] == f"{__name__}.{name}" else getattr(home, name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOME])
