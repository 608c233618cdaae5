"""A posterior as ArviZ knows it: an xarray DataTree, written as netCDF."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sysid_btr.optional import optional, require
from sysid_btr.version import __version__

if TYPE_CHECKING:
    from numpy.random import Generator

    from sysid_btr.posterior.outcome import Posterior
    from sysid_btr.posterior.predictive import Band

SCHEMA = "sysid_btr.posterior/1"
NOISE_SEED = 0
"""Of the noise in `posterior_predictive`, so that a posterior is always written to the same numbers."""


def check_installed() -> None:
    """Refuse before the work what could not be written after it.

    Raises
    ------
    UsageError
        A package of the extra ``posterior`` is missing.
    """
    for package in ("emcee", "arviz_base", "arviz_stats", "h5netcdf", "corner"):
        require(package, "posterior", "a posterior")


def to_datatree(posterior: Posterior) -> Any:
    """The draws with their densities, for ArviZ.

    Returns
    -------
    xarray.DataTree
        Group ``posterior``: one variable a parameter, dimensions ``chain`` and ``draw``. A chain is a walker, as in
        `arviz_base.from_emcee`; coordinate ``ensemble`` says of which ensemble. Walkers of one ensemble are not
        independent: the R-hat and autocorrelation times that count are attributes of each variable. Group
        ``sample_stats``: ``lp``, the log density, and ``log_likelihood``, both up to a constant. ``observed_data``:
        every held-out sensor, ``channel.joint``, with its own times (s). ``posterior_predictive``: the same as
        predicted by a few draws, with noise as large as the error that the fitted model leaves of fitted data.

    Raises
    ------
    UsageError
        arviz-base is missing.
    """
    base = optional("arviz_base", "posterior", "the posterior as a DataTree")
    drawn = posterior.sample
    ensembles, steps, walkers, _ = drawn.draws.shape
    names = [variable_name(name) for name in drawn.names]

    def as_chains(array: Any) -> Any:
        return np.moveaxis(array, 2, 1).reshape(ensembles * walkers, steps)

    observed, rng = _observed(posterior), np.random.default_rng(NOISE_SEED)
    tree = base.from_dict(
        {
            "observed_data": {name: band.measured[band.held_out] for name, band in observed.items()},
            "posterior_predictive": {name: _replicates(band, rng) for name, band in observed.items()},
            "posterior": {name: as_chains(drawn.draws[..., j]) for j, name in enumerate(names)},
            "sample_stats": {"lp": as_chains(drawn.log_density), "log_likelihood": as_chains(drawn.log_likelihood)},
        },
        dims={name: [f"time_{name}"] for name in observed},
        coords={f"time_{name}": band.time[band.held_out] for name, band in observed.items()},
        check_conventions=False,  # many short chains are what an ensemble is
        attrs={
            "/": {
                "schema": SCHEMA,
                "sysid_btr": __version__,
                "converged": int(drawn.converged),
                "termination": drawn.termination,
                "model": posterior.study.robot.name,
            }
        },
    )
    member = np.repeat(np.arange(ensembles), walkers)
    for group in ("posterior", "sample_stats"):
        tree[group] = tree[group].to_dataset().assign_coords(ensemble=("chain", member))
    found = drawn.convergence
    parameters = posterior.fit.model.terms.parameters
    for j, (name, parameter, prior) in enumerate(zip(names, parameters, posterior.priors, strict=True)):
        tree["posterior"][name].attrs.update(
            {
                "long_name": parameter.name,
                "units": parameter.unit,
                "nominal": parameter.nominal,
                "valid_range": [parameter.lower, parameter.upper],
                "prior": str(prior),
                "rhat_over_ensembles": float(found.rhat[j]),
                "autocorrelation_time": float(found.tau[j]),
                "ess": float(found.ess[j]),
            }
        )
    return tree


def _observed(posterior: Posterior) -> dict[str, Band]:
    """Held-out sensors by the name of their variable."""
    return {variable_name(f"{band.channel}.{band.joint}"): band for band in posterior.bands}


def _replicates(band: Band, rng: Generator) -> Any:
    """What a sensor may show, (1, draws, held-out samples)."""
    replays = band.draws[:, band.held_out]
    return (replays + rng.normal(scale=band.error, size=replays.shape)).astype(np.float32)[None]


def netcdf(posterior: Posterior) -> bytes:
    """The DataTree as a netCDF4 file; `xarray.open_datatree` and `arviz_base.from_netcdf` read it.

    Raises
    ------
    UsageError
        A package of the extra is missing.
    """
    optional("h5netcdf", "posterior", "posterior.nc")
    tree = to_datatree(posterior)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "posterior.nc"
        tree.to_netcdf(path, engine="h5netcdf")
        return path.read_bytes()


def variable_name(name: str) -> str:
    """A parameter's name as netCDF takes it: a slash would be a group."""
    return name.replace("/", "|")
