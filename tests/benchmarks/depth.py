"""How close ranges from counted photons come to the Cramer-Rao bound, over the whole span of use.

Run with ``python tests/benchmarks/depth.py [--trials N] [--plot PNG] [--json]``. Every cell is
simulated histograms of 256 bins of 20 ps with a pulse of 60 ps; cells in which a return goes unseen
now and then lie below the threshold at which the bound holds, and are marked so.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

from scipy.stats import binom

from tofclip.lidar import Pulse
from tofclip.lidar.photons import PhotonDetector, measure_accuracy
from tofclip.units import MILLIMETRE

PHOTONS = (20, 50, 100, 200, 500, 1000, 2000, 5000, 10_000)
BACKGROUNDS = (0.01, 0.03, 0.1, 0.3, 1.0)
RATE = 0.01
ALWAYS_SEEN = 0.999


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=2000)
    parser.add_argument("--plot", type=Path)
    parser.add_argument("--json", action="store_true")
    asked = parser.parse_args()
    detector = PhotonDetector(Pulse.gaussian(60e-12), 20e-12, 256, RATE)
    cells = [cell(detector, n, b, asked.trials, seed) for seed, (b, n) in enumerate(grid())]
    if asked.plot:
        plot(cells, asked.plot)
    if asked.json:
        print(json.dumps(cells))
        return
    low, high = binom.interval(0.95, asked.trials, RATE)
    print(
        f"false alarms: {RATE:.3f} stated, {low / asked.trials:.4f}..{high / asked.trials:.4f} expected in 95 of 100"
    )
    print("background  photons   rms (mm)  bound (mm)  ratio  detected  false alarms")
    for one in cells:
        note = "" if one["above_threshold"] else "  below threshold"
        print(
            f"{one['background']:10g} {one['photons']:8d} {one['rms_m'] / MILLIMETRE:10.4f} "
            f"{one['bound_m'] / MILLIMETRE:11.4f} {one['ratio']:6.3f} {one['detection_rate']:9.4f} "
            f"{one['false_alarm_rate']:13.4f}{note}"
        )


def grid() -> list[tuple[float, int]]:
    """Every background with every number of photons."""
    return [(b, n) for b in BACKGROUNDS for n in PHOTONS]


def cell(
    detector: PhotonDetector, photons: int, background: float, trials: int, seed: int
) -> dict[str, Any]:
    """Run one cell of the table."""
    figures = asdict(measure_accuracy(detector, photons, background, trials, seed))
    above = figures["detection_rate"] >= ALWAYS_SEEN
    return {"photons": photons, "background": background, "above_threshold": above, **figures}


def plot(cells: list[dict[str, Any]], path: Path) -> None:
    """Draw errors over photons, one colour for each background, beside the bounds."""
    from apps.figures.style import label_axes, make_figure, save_figure

    figure = make_figure(9, 4)
    left, right = figure.subplots(1, 2)
    for number, background in enumerate(BACKGROUNDS):
        row = [one for one in cells if one["background"] == background]
        colour = f"C{number}"
        left.loglog(
            PHOTONS, [one["bound_m"] / MILLIMETRE for one in row], color=colour, linewidth=1
        )
        left.loglog(
            PHOTONS, [one["rms_m"] / MILLIMETRE for one in row], "o", color=colour, markersize=4
        )
        right.semilogx(
            PHOTONS,
            [one["ratio"] for one in row],
            "o-",
            color=colour,
            markersize=4,
            label=f"{background:g}",
        )
    right.axhline(1.1, color="black", linestyle=":", linewidth=0.8)
    right.set_ylim(0.9, 1.3)
    right.legend(title="background photons a bin", fontsize=8, title_fontsize=8)
    label_axes(left, "RMS range error (dots) and Cramer-Rao bound (lines)", "signal photons", "mm")
    label_axes(
        right, "error / bound; cells above the frame lie below threshold", "signal photons", "ratio"
    )
    save_figure(figure, path)


if __name__ == "__main__":
    main()
