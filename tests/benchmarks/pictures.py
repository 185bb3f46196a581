"""How good pictures of CLIP are on recorded and rendered light fields, without telling the recovery
anything.

Run with ``python tests/benchmarks/pictures.py --data DIR [--seeds N] [--only WORDS] [--oracle]
[--json]``, where DIR/lightfields holds the NPZ files. NMSE in per cent of shift-and-add of the true
views, 12 pixels at the border left out: mean and spread over seeds of the angles or codes. Seconds
are medians: of the search for the prior's weight, and of the solve itself. ``--oracle`` also
recovers with weights over two decades around the one found, and tells the least NMSE of all.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from tofclip.io.light_fields import read_light_field
from tofclip.light_field.measurement import CameraSetup, corrupt_measurement, measure
from tofclip.metrics import nmse
from tofclip.recovery.light_field import ClipRecovery

BORDER_PX = 12
FACTORS = 10 ** np.linspace(-1, 1, 9)
LINE = (
    "{case:46}{nmse_percent:8} +- {spread:<6} limit {limit:<6} best weight {oracle_percent:<8}"
    "search {seconds_weight} s, solve {seconds} s"
)


@dataclass(frozen=True)
class Sheet:
    """What is asked of one light field: the shear, and cases of (encoder, preset, bad fraction,
    {ratio: limit}).
    """

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
            *(
                (("line", preset, bad, {1.0: 5.5}))
                for preset in ("fast", "quality")
                for bad in (0.01, 0.05, 0.1)
            ),
        ),
    ),
    "render_planes": Sheet(
        0.0, (("line", "fast", 0.0, {2.0: 2.6, 1.0: 4.1, 0.5: 6.9, 0.25: 10.8}),)
    ),
    "hci_antinous": Sheet(0.0, (("line", "fast", 0.0, {2.0: 0.5, 1.0: 0.7, 0.5: 1.2, 0.25: 2.1}),)),
}
"""Limits in per cent; those of the last two are what the trials of total variation with the best
weight reached.
"""


@dataclass(frozen=True)
class Score:
    """NMSE in per cent with the weight found, the least with any weight tried, and seconds."""

    percent: float
    oracle: float
    seconds_weight: float
    seconds: float


def scored(
    path: Path,
    shear: float,
    setup: CameraSetup,
    settings: ClipRecovery,
    bad: float,
    factors: Sequence[float],
) -> Score:
    """Recover once as a user would, and again with the weight found times each of the factors."""
    light_field = read_light_field(path)
    truth, measured = (
        light_field.refocus(shear),
        corrupt_measurement(measure(light_field, setup), None, bad),
    )
    found = settings.recover(measured, shear)
    percent = 100 * nmse(found.picture, truth, BORDER_PX)
    others = (
        replace(settings, weight=found.weight * factor).recover(measured, shear).picture
        for factor in factors
    )
    oracle = min([percent, *(100 * nmse(picture, truth, BORDER_PX) for picture in others)])
    return Score(percent, oracle, found.seconds_weight, found.seconds)


def rows(folder: Path, seeds: int, only: str, factors: Sequence[float]) -> list[dict[str, Any]]:
    """Score every case whose description contains `reject_unknown`, telling each as it is done."""
    found = []
    for name, sheet in SHEETS.items():
        for encoder, preset, bad, limits in sheet.cases:
            settings = ClipRecovery(preset=preset, data_term="huber" if bad else "squares")
            for ratio, limit in limits.items():
                label = f"{name} {encoder} {preset} SR {ratio:g}" + (
                    f" bad {bad:.0%}" if bad else ""
                )
                if only not in label:
                    continue
                path = folder / "lightfields" / f"{name}.npz"
                setups = [CameraSetup(encoder, ratio, seed) for seed in range(seeds)]
                scores = [
                    scored(path, sheet.shear, setup, settings, bad, factors) for setup in setups
                ]
                found.append(row := {"case": label, "limit": limit, **_summary(scores)})
                print(LINE.format(**row), flush=True)
    return found


def _summary(scores: list[Score]) -> dict[str, float]:
    percent, oracle = [one.percent for one in scores], [one.oracle for one in scores]
    return {
        "nmse_percent": round(float(np.mean(percent)), 2),
        "spread": round(float(np.std(percent, ddof=1)), 2) if len(scores) > 1 else 0.0,
        "oracle_percent": round(float(np.mean(oracle)), 2),
        "seconds_weight": round(float(np.median([one.seconds_weight for one in scores])), 2),
        "seconds": round(float(np.median([one.seconds for one in scores])), 2),
    }


def main() -> None:
    """Print the sheet and, with ``--json``, one JSON object at its end."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--only", default="")
    parser.add_argument("--oracle", action="store_true")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    found = rows(
        arguments.data,
        arguments.seeds,
        arguments.reject_unknown,
        FACTORS if arguments.oracle else (),
    )
    if arguments.json:
        print(json.dumps({"seeds": arguments.seeds, "rows": found}))


if __name__ == "__main__":
    main()
