"""What is installed works by itself: the wheel has its data files, and what cites the package is well-formed."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

from sysid_btr.version import __version__

ROOT = Path(__file__).resolve().parents[1]
USE = """
import json, sys
import sysid_btr
from sysid_btr.cli import run
from sysid_btr.cli.demo import sample_logs
samples = sample_logs()
code = run(["fit", "--model", str(samples / "pendulum.xml"), "--log", str(samples / "pendulum_clean.parquet"),
            "--fit", "mass:arm", "--threads", "1", "--out", sys.argv[1]])
print("\\n" + json.dumps([sysid_btr.__file__, str(samples), code]))
"""


@pytest.mark.slow
def test_a_wheel_fits_and_reports_away_from_its_sources(tmp_path: Path) -> None:
    pytest.importorskip("hatchling", reason="a wheel is built with hatchling, of the extra `dev`")
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(tmp_path)]
    subprocess.run(build, cwd=ROOT, check=True, capture_output=True)
    site, out = tmp_path / "site", tmp_path / "out"
    with zipfile.ZipFile(next(tmp_path.glob("*.whl"))) as wheel:
        wheel.extractall(site)
    environment = {**os.environ, "PYTHONPATH": str(site)}
    done = subprocess.run(
        [sys.executable, "-c", USE, str(out)], cwd=tmp_path, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    package, samples, code = json.loads(done.stdout.splitlines()[-1])
    assert code == 0
    assert Path(package).is_relative_to(site)
    assert Path(samples).is_relative_to(site)
    assert {"result.json", "model.xml", "report.html", "explore.html"} <= {file.name for file in out.iterdir()}
    assert (site / "sysid_btr" / "guide" / "verdicts.md").is_file()


def test_the_citation_names_this_version() -> None:
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert re.search(r"^version: (.*)$", citation, re.MULTILINE).group(1) == __version__  # type: ignore[union-attr]


def test_every_extra_that_is_named_exists() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    pages = [ROOT / "README.md", ROOT / "Dockerfile", *(ROOT / "docs" / "guide").glob("*.md")]
    named = {
        extra
        for file in (*pages, *(ROOT / "sysid_btr").rglob("*.py"))
        for found in re.findall(r"(?:sysid-btr|/src)\[([a-z,]+)\]", file.read_text(encoding="utf-8"))
        for extra in found.split(",")
    }
    assert {"posterior", "ros", "cluster"} <= named <= set(extras)
