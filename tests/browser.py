"""Pages in a real browser, where the machine has one."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

BROWSER = next((b for b in ("chromium", "chromium-browser", "google-chrome") if shutil.which(b)), None)
PAGE = Path(__file__).with_suffix(".html")
"""Shows another page in a frame, and writes down what it finds there."""


def browse(page: Path, home: Path, width: int, *, dark: bool = False) -> Any:
    """What a browser finds on a page in a frame of some width; skips where there is none."""
    if BROWSER is None:
        pytest.skip("no chromium or chrome on this machine")
    watch = home / "watch.html"
    watch.write_text(PAGE.read_text().replace("@PAGE", page.as_uri()).replace("@WIDTH", str(width)))
    flags = ["--headless", "--no-sandbox", "--disable-gpu", "--window-size=1300,1000", "--allow-file-access-from-files"]
    flags += ["--host-resolver-rules=MAP * ~NOTFOUND", f"--user-data-dir={home / 'profile'}", "--enable-logging=stderr"]
    flags += ["--force-dark-mode", "--blink-settings=preferredColorScheme=0"] if dark else []
    done = subprocess.run(
        [BROWSER, *flags, "--virtual-time-budget=60000", "--dump-dom", watch.as_uri()],
        capture_output=True, text=True, check=True, timeout=180,
    )  # fmt: skip
    assert "CONSOLE" not in done.stderr, done.stderr
    match = re.search(r'<pre id="found">(.*?)</pre>', done.stdout, re.DOTALL)
    assert match is not None
    assert match.group(1), "the page was ready in time"
    found = json.loads(match.group(1).replace("&lt;", "<").replace("&gt;", ">").replace("&amp;", "&"))
    assert "error" not in found, found["error"]
    return found
