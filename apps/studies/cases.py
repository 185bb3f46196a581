"""Cases of CLIP: light fields to look at, measured from their true views, recovered at one depth and
scored.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apps.studies.outcome import Advance, Panel, Row
from tofclip.errors import InputError
from tofclip.io.light_fields import read_light_field
from tofclip.light_field import LightField
from tofclip.light_field.measurement import (
    CameraSetup,
    ClipMeasurement,
    corrupt_measurement,
    measure,
)
from tofclip.metrics import nmse
from tofclip.recovery.light_field import ClipRecovery
from tofclip.simulate.light_fields import CameraArray, render_light_field, render_view
from tofclip.simulate.scenes import EDITS, edit_scene, make_scene, remove_occluder
from tofclip.threads import map_parallel


class Library:
    """Light fields by name, each rendered or read once.

    `data`: folder of recorded data, whose ``lightfields`` holds NPZ light fields; `array`: cameras
    of the rendered ones; the paper's 8 x 8 views of 128 x 128 pixels unless given.
    """

    def __init__(self, data: Path | None = None, array: CameraArray | None = None) -> None:
        self.data, self.array = data, array or CameraArray()
        self._cache: dict[str, LightField] = {}

    def light_field(self, name: str) -> LightField:
        """Return the light field of a scene.

        `name`: A name of `tofclip.simulate.light_fields.SCENES`, ``NAME:EDIT`` with an edit of the
        flip test, ``NAME:4x4`` for its middle sixteen views, ``NAME:flat`` for its reference view
        as a poster at s = 0, or ``data:NAME`` for a recorded one.
        """
        if name not in self._cache:
            self._cache[name] = self._make_light_field(name)
        return self._cache[name]

    def render_unoccluded(self, name: str) -> NDArray[Any]:
        """Return what the reference view sees of an occlusion scene when its occluder is gone."""
        return render_view(remove_occluder(make_scene(name, self.array)), self.array, (0.0, 0.0))

    def has_recording(self, name: str) -> bool:
        """Return whether the folder of recorded data holds a file."""
        return self.data is not None and (self.data / name).is_file()

    def recording(self, name: str) -> Path:
        """Return the path of a file of the folder of recorded data."""
        if self.data is None:
            raise InputError(f"{name} is recorded data; name the folder that holds it by --data")
        return self.data / name

    def _make_light_field(self, name: str) -> LightField:
        scene, _, variant = name.partition(":")
        if scene == "data":
            return read_light_field(self.recording(f"lightfields/{variant}.npz"))
        if variant == "4x4":
            whole = self.light_field(scene)
            # The 4 x 4 views in the middle of the array.
            middle = np.all((whole.views >= -2) & (whole.views < 2), axis=1)
            return LightField(whole.pictures[middle], whole.views[middle])
        known = make_scene(scene, self.array)
        if variant == "flat":
            views = self.array.views
            poster = render_view(known, self.array, (0.0, 0.0))
            return LightField(np.broadcast_to(poster, (len(views), *poster.shape)), views)
        return render_light_field(
            edit_scene(known, variant) if variant in EDITS else known, self.array
        ).light_field


BORDER_PX = 12
"""Pixels that are not scored: views leave the picture there."""

CAMERA_NAMES = {
    "line": "CLIP-1D",
    "line-even": "CLIP-1D, even",
    "single-pixel": "CLIP-0D",
    "diffuser": "CLIP-2D",
}


@dataclass(frozen=True)
class Case:
    """One figure of a table."""

    labels: tuple[str, ...]  # of its row
    scene: str  # as the library knows it
    encoder: str
    sampling_ratio: float
    shear: float
    paper: float | None = None  # NMSE in the paper, per cent
    bad_fraction: float = 0.0
    photons: float | None = None
    white_noise: float = 0.0  # standard deviation relative to that of the measurements
    data_term: str = "squares"  # of the recovery


@dataclass(frozen=True)
class SolvedCase:
    """A case with what came out."""

    case: Case
    percent: tuple[float, ...]  # NMSE of each seed
    picture: NDArray[Any]  # (rows, columns), the first seed's, and shift-and-add of the true views
    truth: NDArray[Any]  # (rows, columns), the first seed's, and shift-and-add of the true views
    weight: float  # of the first seed's prior

    def row(self) -> Row:
        """Return the row of the table."""
        return Row(self.case.labels, self.percent, self.case.paper)

    def panel(self, title: str) -> Panel:
        """Return the picture, its error under the title."""
        return Panel(f"{title}\n{np.mean(self.percent):.1f} %", self.picture)


def solve_cases(
    cases: Sequence[Case], library: Library, seeds: int, advance: Advance
) -> list[SolvedCase]:
    """Solve every case for every seed, cases on all cores; advances once for each case and seed.

    The prior's weight is chosen by cross-validation with the first seed, and kept for the others.

    `library`: light fields by name; `seeds`: repeats with other cameras and noise; `advance`:
    called with 1 after each case and seed. Returns in the order of the cases.
    """
    # Made once, before the threads start: many cases share a truth, and the library keeps a plain
    # dictionary.
    truths = {
        (case.scene, case.shear): library.light_field(case.scene).refocus(case.shear)
        for case in cases
    }

    def solve_case(case: Case) -> SolvedCase:
        truth = truths[case.scene, case.shear]
        recovery, found = ClipRecovery(data_term=case.data_term), []
        for seed in range(seeds):
            found.append(recovery.recover(measure_case(case, library, seed), case.shear))
            # The weight chosen with the first seed serves the others.
            recovery = replace(recovery, weight=found[0].weight)
            advance(1)
        percent = tuple(100 * nmse(recovered.picture, truth, BORDER_PX) for recovered in found)
        return SolvedCase(case, percent, found[0].picture, truth, found[0].weight)

    return list(map_parallel(solve_case, cases))


def measure_case(case: Case, library: Library, seed: int) -> ClipMeasurement:
    """Measure the true views as a case asks for.

    `seed`: of camera and noise.
    """
    setup = CameraSetup(case.encoder, case.sampling_ratio, seed)
    clean = measure(library.light_field(case.scene), setup)
    # another stream of random numbers than the camera's, which starts from the same seed
    noise = np.random.default_rng([seed, 2]).standard_normal(clean.values.size, np.float32)
    noisy = clean.values + np.float32(case.white_noise) * clean.values.std() * noise
    return corrupt_measurement(replace(clean, values=noisy), case.photons, case.bad_fraction)
