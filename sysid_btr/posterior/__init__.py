"""What a log says about parameters as a distribution: priors, sampling with real replays, checks, export.

>>> from sysid_btr.posterior import posterior
>>> drawn = posterior(fit(study, ["mass:*Knee*", "kp:*=shared"]))
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sysid_btr.posterior.draw import Posterior, posterior
    from sysid_btr.posterior.export import to_datatree
    from sysid_btr.posterior.sampling import Settings

_HOME = {"Posterior": "draw", "posterior": "draw", "to_datatree": "export", "Settings": "sampling"}

__all__ = ["Posterior", "Settings", "posterior", "to_datatree"]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}; it offers {', '.join(__all__)}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
