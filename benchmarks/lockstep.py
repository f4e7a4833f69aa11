"""How fast is lockstep pace over all processes? Two runs of different length, so that starting up and judging cancel out.

python benchmarks/lockstep.py [--seconds 40]
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

SHORT_S = 2.0


def run_s(folder: Path, armed_s: float) -> float:
    """Wall time of a whole run with the gate armed for `armed_s`. Raises CalledProcessError when it does not end well."""
    command = [sys.executable, "-m", "softloop.deploy.cli", "run", "sim", "--pace", "lockstep", "--no-report", "--quiet"]
    command += ["--duration", str(armed_s), "--run-dir", str(folder / f"{armed_s:g}")]
    began_s = time.monotonic()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    return time.monotonic() - began_s


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seconds", type=float, default=40.0, help="rig time of the longer run's stretch")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="sl-lockstep-") as folder:
        run_s(Path(folder), 0.5)  # kernels compiled, files in memory
        short_s, long_s = run_s(Path(folder), SHORT_S), run_s(Path(folder), SHORT_S + options.seconds)
    took_s = long_s - short_s
    speed = options.seconds / took_s
    print(f"lockstep over all processes: {options.seconds:g} s of rig time in {took_s:.1f} s, {speed:.2f} x real time")
    print(f"starting, ending and judging a run: {short_s - SHORT_S * took_s / options.seconds:.1f} s")


if __name__ == "__main__":
    main()
