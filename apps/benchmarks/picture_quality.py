"""Study: how good pictures of CLIP are on recorded and rendered light fields, which `TOFCLIP_DATA`
names, recovered as a user would, without the truth.

NMSE in per cent of shift-and-add of the true views, `BORDER_PX` left out: mean and spread over
seeds of the angles or codes. The limits are what total variation with the best weight reached.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from apps.benchmarks.harness import Case, PreparedCase
from tofclip.errors import InputError
from tofclip.io.light_fields import read_light_field
from tofclip.light_field.measurement import CameraSetup, corrupt_measurement, measure
from tofclip.metrics import nmse
from tofclip.recovery.light_field import ClipRecovery

BORDER_PX = 12
SEEDS = 5


@dataclass(frozen=True)
class QualityCase:
    """What is recovered, and how good it has to be."""

    light_field: str  # name of the NPZ file, without its ending
    shear: float
    encoder: str
    preset: str
    # NMSE in per cent that must not be exceeded, by the sampling ratio in per cent
    limits: dict[int, float]
    corrupted: float = 0.0  # fraction of the measurements that are wildly wrong

    @property
    def name(self) -> str:
        """The case's name on the command line."""
        short = self.light_field.removeprefix("render_").removeprefix("hci_")
        parts = ["quality", short, self.encoder, self.preset]
        return "-".join([*parts, *([f"{self.corrupted:.0%}"] if self.corrupted else [])])


LETTERS = "render_letters", -0.3
QUALITY_CASES = (
    QualityCase(*LETTERS, "line", "fast", {25: 17.0, 50: 8.5, 100: 4.5, 200: 3.0}),
    QualityCase(*LETTERS, "line", "quality", {25: 10.0, 50: 4.5, 100: 3.0, 200: 2.0}),
    QualityCase(*LETTERS, "single-pixel", "fast", {25: 7.6, 50: 4.3, 100: 2.6}),
    QualityCase(*LETTERS, "single-pixel", "quality", {25: 5.5, 50: 3.0, 100: 1.8}),
    *(
        QualityCase(*LETTERS, "line", preset, {100: 5.5}, corrupted)
        for preset in ("fast", "quality")
        for corrupted in (0.01, 0.05, 0.1)
    ),
    QualityCase("render_planes", 0.0, "line", "fast", {25: 10.8, 50: 6.9, 100: 4.1, 200: 2.6}),
    QualityCase("hci_antinous", 0.0, "line", "fast", {25: 2.1, 50: 1.2, 100: 0.7, 200: 0.5}),
)


def prepare_quality(wanted: QualityCase, ratio_percent: int) -> PreparedCase:
    """A recovery with the weight that the search found, against the products it needs.

    `ratio_percent`: sampling ratio.
    """
    path = Path(os.environ.get("TOFCLIP_DATA", ""), "lightfields", f"{wanted.light_field}.npz")
    if not path.is_file():
        raise InputError(f"{path} is missing: TOFCLIP_DATA names the folder of recorded data")
    light_field = read_light_field(path)
    truth = light_field.refocus(wanted.shear)
    settings = ClipRecovery(
        preset=wanted.preset, data_term="huber" if wanted.corrupted else "squares"
    )

    def recover(seed: int) -> tuple[float, float]:
        setup = CameraSetup(wanted.encoder, ratio_percent / 100, seed)
        measured = corrupt_measurement(measure(light_field, setup), None, wanted.corrupted)
        found = settings.recover(measured, wanted.shear)
        return 100 * nmse(found.picture, truth, BORDER_PX), found.seconds_weight

    def judge() -> dict[str, float]:
        errors, searches = zip(*map(recover, range(SEEDS)), strict=True)
        return {
            "nmse_percent": float(np.mean(errors)),
            "spread_percent": float(np.std(errors, ddof=1)),
            "limit_percent": wanted.limits[ratio_percent],
            "weight_search_s": float(np.median(searches)),
        }

    measured = corrupt_measurement(
        measure(light_field, CameraSetup(wanted.encoder, ratio_percent / 100, 0)),
        None,
        wanted.corrupted,
    )
    camera = measured.camera()
    model = camera.weighting() @ camera.model(wanted.shear)
    first = settings.recover(measured, wanted.shear)
    solver = ClipRecovery(preset=wanted.preset, data_term=settings.data_term, weight=first.weight)
    picture = np.ones(model.shape_in, np.float32)

    def products() -> None:
        for _ in range(first.iterations):
            model.adjoint(model(picture))

    return PreparedCase(lambda: solver.recover(measured, wanted.shear), products, 1, figures=judge)


CASES = tuple(
    Case(
        wanted.name,
        f"{wanted.light_field}, {wanted.encoder}, {wanted.preset}"
        + (f", {wanted.corrupted:.0%} wrong" if wanted.corrupted else ""),
        "per cent as many measurements as pixels",
        tuple(wanted.limits),
        "pictures",
        "the products of its iterations alone",
        partial(prepare_quality, wanted),
    )
    for wanted in QUALITY_CASES
)
