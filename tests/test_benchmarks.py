"""Every benchmark still finds what it takes from the package, whether or not it is run."""

from __future__ import annotations

import importlib
import pkgutil

import pytest

import benchmarks

EXTRA = ("pydrake", "ribs", "sklearn")
"""Of the extra `benchmarks`, which the suite does without."""
MODULES = [m.name for m in pkgutil.walk_packages(benchmarks.__path__, "benchmarks.")]


@pytest.mark.parametrize("name", MODULES)
def test_a_benchmark_can_be_imported(name: str) -> None:
    try:
        importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name is None or error.name.partition(".")[0] not in EXTRA:
            raise
        pytest.skip(f"needs {error.name}: pip install 'sysid-btr[benchmarks]'")
