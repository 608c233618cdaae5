"""`python -m benchmarks.startup`: how long `import sysid_btr` and `sysid-btr --help` take, beside a bare interpreter.

The best of some starts in turn, each in a process of its own, on files that are in the cache.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path

RESULTS = Path(__file__).parent / "results" / "startup.json"
STARTS = {
    "bare": "pass",
    "import": "import sysid_btr",
    "help": "import sys; from sysid_btr.cli import main; sys.argv = ['sysid-btr', '--help']; main()",
}
GOALS = {"import": 0.3, "help": 0.5}
"""s, the bare interpreter's start apart for the import."""
ROUNDS = 10


def seconds(code: str) -> float:
    """Wall time of one start."""
    began = time.perf_counter()
    subprocess.run([sys.executable, "-c", code], check=True, stdout=subprocess.DEVNULL)
    return time.perf_counter() - began


def main() -> None:
    best = dict.fromkeys(STARTS, float("inf"))
    for _ in range(ROUNDS):
        best = {name: min(best[name], seconds(code)) for name, code in STARTS.items()}
    bare = best["bare"]
    rows = {
        name: {"wall_s": round(s, 3), "over_bare": round(s / bare, 2), "goal_s": GOALS.get(name)}
        for name, s in best.items()
    }
    rows["import"]["wall_s"] = round(best["import"] - bare, 3)
    RESULTS.write_text(json.dumps(rows, indent=1) + "\n")
    print(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
