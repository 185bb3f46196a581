"""How good pictures of CLIP are on recorded and rendered light fields, without telling the recovery anything.

Run with ``python tests/benchmarks/pictures.py --data DIR [--seeds N] [--only WORDS] [--json]``; DIR/lightfields holds
the NPZ files. NMSE in per cent of shift-and-add of the true views, 12 pixels at the border left out: mean and spread
over seeds of the angles or codes. Seconds are medians: of the search for the prior's weight, and of the solve itself.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tofclip.clip_measurement import Setup, measure, spoilt
from tofclip.clip_recovery import ClipRecovery
from tofclip.io.light_fields import read_light_field
from tofclip.metrics import nmse

BORDER_PX = 12


@dataclass(frozen=True)
class Sheet:
    """What is asked of one light field: the shear, and cases of (encoder, preset, bad fraction, {ratio: limit})."""

    shear: float
    cases: tuple[tuple[str, str, float, dict[float, float]], ...]


SHEETS = {
    "render_letters": Sheet(
        -0.3,
        (
            ("line", "fast", 0.0, {2.0: 3.0, 1.0: 4.5, 0.5: 8.5, 0.25: 17.0}),
            ("line", "quality", 0.0, {2.0: 2.0, 1.0: 3.0, 0.5: 4.5, 0.25: 10.0}),
            ("single-pixel", "fast", 0.0, {1.0: 2.6, 0.5: 4.3, 0.25: 7.6}),
            ("single-pixel", "quality", 0.0, {1.0: 1.8, 0.5: 3.0, 0.25: 5.5}),
            *((("line", preset, bad, {1.0: 5.5})) for preset in ("fast", "quality") for bad in (0.01, 0.05, 0.1)),
        ),
    ),
    "render_planes": Sheet(0.0, (("line", "fast", 0.0, {2.0: 2.6, 1.0: 4.1, 0.5: 6.9, 0.25: 10.8}),)),
    "hci_antinous": Sheet(0.0, (("line", "fast", 0.0, {2.0: 0.5, 1.0: 0.7, 0.5: 1.2, 0.25: 2.1}),)),
}
"""Limits in per cent; those of the last two are what the trials of total variation with the best weight reached."""


def scored(path: Path, shear: float, setup: Setup, preset: str, bad: float) -> tuple[float, float, float]:
    """Return NMSE in per cent, seconds of the search for the weight, and seconds of the solve."""
    light_field = read_light_field(path)
    recovery = ClipRecovery(preset=preset, data_term="huber" if bad else "squares")
    found = recovery.recover(spoilt(measure(light_field, setup), None, bad), shear)
    percent = 100 * nmse(found.picture, light_field.refocus(shear), BORDER_PX)
    return percent, found.seconds_weight, found.seconds


def rows(folder: Path, seeds: int, only: str) -> list[dict[str, Any]]:
    """Score every case whose description contains `only`, telling each as it is done."""
    found = []
    for name, sheet in SHEETS.items():
        for encoder, preset, bad, limits in sheet.cases:
            for ratio, limit in limits.items():
                label = f"{name} {encoder} {preset} SR {ratio:g}" + (f" bad {bad:.0%}" if bad else "")
                if only not in label:
                    continue
                path = folder / "lightfields" / f"{name}.npz"
                each = [scored(path, sheet.shear, Setup(encoder, ratio, seed), preset, bad) for seed in range(seeds)]
                percent, weighing, solving = np.array(each).T
                row = {
                    "case": label,
                    "nmse_percent": round(float(percent.mean()), 2),
                    "spread": round(float(percent.std(ddof=1)), 2) if seeds > 1 else 0.0,
                    "limit": limit,
                    "seconds_weight": round(float(np.median(weighing)), 2),
                    "seconds": round(float(np.median(solving)), 2),
                }
                print("{case:46}{nmse_percent:8} +- {spread:<6} limit {limit:<6}".format(**row), end="", flush=True)
                print(f"weight {row['seconds_weight']} s, solve {row['seconds']} s", flush=True)
                found.append(row)
    return found


def main() -> None:
    """Print the sheet and, with ``--json``, one JSON object at its end."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--only", default="")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    found = rows(arguments.data, arguments.seeds, arguments.only)
    if arguments.json:
        print(json.dumps({"seeds": arguments.seeds, "rows": found}))


if __name__ == "__main__":
    main()
