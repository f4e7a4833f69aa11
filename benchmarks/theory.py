"""Eqs. 50 and 51 on the ideal layer: ARC beside SMC with the same gains, with parametric mismatch only.

    python benchmarks/theory.py [--rigs 5] [--json]

Printed: RMS errors on T2 of both laws, the ratio of their errors beside the paper's (0.92 of T1 dynamic, 0.53 of T1 steady,
0.70 of T2); V3 (the Lyapunov function with the parameters' part) in the first and the last second of T2; and the largest |S1|
beside Eq. 50's ultimate bound sqrt(epsilon / lambda). See `offline/theory.py`.
"""

from __future__ import annotations

import argparse
import json

from rich.console import Console
from rich.table import Table

from softloop.offline.theory import PAPER_RATIOS, compare


def main() -> None:
    """Compare on some rigs, show, and with --json print the figures."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rigs", type=int, default=5)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    found = {seed: compare(seed) for seed in range(options.rigs)}
    if options.json:
        print(json.dumps(found))
        return
    table = Table(title="ideal layer, parametric mismatch only; ratios are ARC over SMC", title_justify="left")
    heads = (
        "rig",
        "SMC T2 rms",
        "ARC T2 rms",
        *(f"{n} (paper {v:g})" for n, v in PAPER_RATIOS.items()),
        "V3 start",
        "V3 end",
        "|S1|",
        "bound",
    )
    for head in heads:
        table.add_column(head, justify="right")
    for seed, rig in found.items():
        arc, ratios = rig["arc"], [f"{rig['ratio'][n]:.2f}" for n in PAPER_RATIOS]
        cells = [f"{rig['smc']['t2_rms_deg']:.3f}", f"{arc['t2_rms_deg']:.3f}", *ratios]
        cells += [f"{arc['v3_start']:.0f}", f"{arc['v3_end']:.0f}", f"{arc['s1_max_deg_s']:.1f}", f"{rig['s1_bound_deg_s']:.0f}"]
        table.add_row(str(seed), *cells)
    Console(width=150).print(table)


if __name__ == "__main__":
    main()
