"""What the studies of the paper share: rows of ours beside the paper's figures, pictures in its
layout, and cases of CLIP, measured from their true views, recovered at one depth and scored.

``paper.csv`` holds the tables' cases with the paper's figures (NMSE in per cent). A study's work
takes the library of light fields, the number of seeds, and `advance`, which it calls with the
number of steps just done, and returns an `Outcome`.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from tofclip.arrays import AnyArray, FloatArray
from tofclip.errors import InputError
from tofclip.io.light_fields import read_light_field
from tofclip.light_field import FocalStack, LightField
from tofclip.light_field.views import (
    CameraSetup,
    ClipMeasurement,
    corrupt_measurement,
    measure,
)
from tofclip.metrics import nmse
from tofclip.operators.cameras import EvenAngleLineCamera
from tofclip.recovery.light_field import (
    PRESETS,
    ClipRecovery,
    make_shear_range,
    recover_all_in_focus,
)
from tofclip.simulate.light_fields import CameraArray, render_light_field, render_view
from tofclip.simulate.scenes import EDITS, edit_scene, make_scene, remove_occluder
from tofclip.threads import map_parallel

Advance = Callable[[int], None]

CROSS_VALIDATED = "chosen by cross-validation with the first seed, without the truth"

PAPER = Path(__file__).with_name("paper.csv")
LABEL_SEPARATOR = " | "
RECORDED = "data:"  # before the names of recorded light fields
BORDER_PX = 12  # not scored: views leave the picture there
CAMERA_NAMES = {
    "line": "CLIP-1D",
    "line-even": "CLIP-1D, even",
    "single-pixel": "CLIP-0D",
    "diffuser": "CLIP-2D",
}


@dataclass(frozen=True)
class Row:
    """One figure of a table."""

    labels: tuple[str, ...]  # one for each of the table's columns
    ours: tuple[float, ...]  # one for each seed
    paper: float | None = None  # None: the paper has no such figure

    @property
    def mean(self) -> float:
        return float(np.mean(self.ours))

    @property
    def spread(self) -> float:
        """Standard deviation over the seeds (of a sample; 0 for a single one)."""
        return float(np.std(self.ours, ddof=1)) if len(self.ours) > 1 else 0.0


@dataclass(frozen=True)
class Panel:
    """A picture (rows, columns) with its title; brightness from 0, or a map of shears in colours."""

    title: str
    picture: AnyArray
    is_map: bool = False


@dataclass(frozen=True)
class Outcome:
    """Rows and pictures of a study."""

    columns: tuple[str, ...]  # what the rows' labels say
    figure: str  # what the rows' figures are, with the unit
    rows: Sequence[Row]
    panels: Sequence[Sequence[Panel]]  # line by line


Work = Callable[["Library", int, Advance], Outcome]


@dataclass(frozen=True)
class Study:
    """A table or figure of the paper that can be made again."""

    name: str  # what the user types
    aliases: tuple[str, ...]  # other names: the figures that show the table's pictures
    title: str
    note: str  # what differs from the paper
    seconds: float  # about what a seed costs on two cores
    steps: int  # advances for each seed; by default as many as it has cases
    work: Work
    weight: str = CROSS_VALIDATED  # how the prior's weight was chosen: the end of a sentence
    seeded: bool = True  # False: it has no random choices, more seeds change nothing
    recording: str | None = None  # file of the folder of recorded data that it needs
    has_best: bool = False  # rows with a figure of the paper are solved by settings of choice too


REGISTERED: list[Study] = []


def study(name: str, *aliases: str, **others: Any) -> Callable[[Work], Work]:
    """Register the decorated work as a `Study`, whose other fields are given by name."""

    def register(work: Work) -> Work:
        others.setdefault("steps", len(read_cases(name)))
        REGISTERED.append(Study(name, aliases, work=work, **others))
        return work

    return register


class Library:
    """Light fields by name, each rendered or read once. `data`: folder of recorded data, whose
    ``lightfields`` holds NPZ light fields; `array`: cameras of the rendered ones; the paper's 8 x 8
    views of 128 x 128 pixels unless given.
    """

    def __init__(self, data: Path | None = None, array: CameraArray | None = None) -> None:
        self.data, self.array = data, array or CameraArray()
        self._cache: dict[str, LightField] = {}

    def light_field(self, name: str) -> LightField:
        """Return the light field of a scene. `name`: of `tofclip.simulate.light_fields.SCENES`,
        ``NAME:EDIT`` with an edit of the flip test, ``NAME:4x4`` for its middle sixteen views,
        ``NAME:flat`` for its reference view as a poster at s = 0, or ``data:NAME`` for a recorded
        one.
        """
        if name not in self._cache:
            self._cache[name] = self._make_light_field(name)
        return self._cache[name]

    def render_unoccluded(self, name: str) -> AnyArray:
        """Return what the reference view sees of an occlusion scene when its occluder is gone."""
        return render_view(remove_occluder(make_scene(name, self.array)), self.array, (0.0, 0.0))

    def has_scene(self, name: str) -> bool:
        """Whether a light field is rendered, or recorded and at hand."""
        _, _, recorded = name.partition(RECORDED)
        return not recorded or self.has_recording(f"lightfields/{recorded}.npz")

    def has_recording(self, name: str) -> bool:
        return self.data is not None and (self.data / name).is_file()

    def recording(self, name: str) -> Path:
        if self.data is None:
            raise InputError(f"{name} is recorded data; name the folder that holds it by --data")
        return self.data / name

    def _make_light_field(self, name: str) -> LightField:
        scene, _, variant = name.partition(":")
        if name.startswith(RECORDED):
            return read_light_field(self.recording(f"lightfields/{variant}.npz"))
        if variant == "4x4":
            whole = self.light_field(scene)
            middle = np.all((whole.views >= -2) & (whole.views < 2), axis=1)
            return LightField(whole.pictures[middle], whole.views[middle])
        known = make_scene(scene, self.array)
        if variant == "flat":
            views = self.array.views
            poster = render_view(known, self.array, (0.0, 0.0))
            return LightField(np.broadcast_to(poster, (len(views), *poster.shape)), views)
        edited = edit_scene(known, variant) if variant in EDITS else known
        return render_light_field(edited, self.array).light_field


def find_reference_view(light_field: LightField) -> AnyArray:
    """Return the picture of the view nearest to the middle of the aperture."""
    return light_field.pictures[np.argmin((light_field.views**2).sum(axis=1))]


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

    @property
    def key(self) -> str:
        """Return what the row is kept by."""
        return LABEL_SEPARATOR.join(self.labels)


def read_cases(name: str) -> list[Case]:
    """Return the cases of a study, in the order of its table."""
    with PAPER.open(encoding="utf-8", newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["study"] == name]
    texts = ("study", "labels", "scene", "encoder", "data_term")
    cases = []
    for row in rows:
        known: dict[str, Any] = {
            name: text if name in texts else float(text) if text else None
            for name, text in row.items()
        }
        del known["study"]
        cases.append(Case(**known | {"labels": tuple(row["labels"].split(LABEL_SEPARATOR))}))
    return cases


@dataclass(frozen=True)
class SolvedCase:
    """A case with what came out."""

    case: Case
    percent: tuple[float, ...]  # NMSE of each seed
    picture: AnyArray  # (rows, columns), the first seed's
    truth: AnyArray  # (rows, columns), shift-and-add of the true views
    weight: float  # of the first seed's prior

    def row(self) -> Row:
        return Row(self.case.labels, self.percent, self.case.paper)

    def panel(self, title: str) -> Panel:
        """Return the picture, its error under the title."""
        return Panel(f"{title}\n{np.mean(self.percent):.1f} %", self.picture)


def solve_cases(
    cases: Sequence[Case], library: Library, seeds: int, advance: Advance
) -> list[SolvedCase]:
    """Solve every case for every seed, cases on all cores; advances once for each case and seed.
    The prior's weight is chosen by cross-validation with the first seed, and kept for the others.
    """
    # Made once, before the threads start: many cases share a truth, and the library keeps a plain
    # dictionary.
    truths = {
        (case.scene, case.shear): library.light_field(case.scene).refocus(case.shear)
        for case in cases
    }

    def solve_case(case: Case) -> SolvedCase:
        truth = truths[case.scene, case.shear]
        recovery, recovered = ClipRecovery(data_term=case.data_term), []
        for seed in range(seeds):
            recovered.append(recovery.recover(measure_case(case, library, seed), case.shear))
            recovery = replace(recovery, weight=recovered[0].weight)
            advance(1)
        percent = tuple(100 * nmse(each.picture, truth, BORDER_PX) for each in recovered)
        return SolvedCase(case, percent, recovered[0].picture, truth, recovered[0].weight)

    return list(map_parallel(solve_case, cases))


def recover_stack(
    recovery: ClipRecovery, measurement: ClipMeasurement, shears: FloatArray
) -> FocalStack:
    """Recover the pictures refocused at some shears, on all cores."""
    pictures = map_parallel(
        lambda shear: recovery.recover(measurement, shear).picture, shears.tolist()
    )
    return FocalStack(np.stack(list(pictures)), shears)


def measure_case(case: Case, library: Library, seed: int) -> ClipMeasurement:
    """Measure the true views as a case asks for; `seed`: of camera and noise."""
    setup = CameraSetup(case.encoder, case.sampling_ratio, seed)
    clean = measure(library.light_field(case.scene), setup)
    # another stream of random numbers than the camera's, which starts from the same seed
    noise = np.random.default_rng([seed, 2]).standard_normal(clean.values.size, np.float32)
    noisy = clean.values + np.float32(case.white_noise) * clean.values.std() * noise
    return corrupt_measurement(replace(clean, values=noisy), case.photons, case.bad_fraction)


SHEAR_RANGE = (-1.4, 1.4)  # that surfaces are looked for in, for all scenes alike
SEED = 0
LIGHT_FIELD_LABEL = "light field"  # last label of rows where all views are scored


@dataclass(frozen=True)
class BestFigure:
    """What came out for a row."""

    percent: float  # NMSE
    setting: str  # that gave it


def list_best_cases(name: str) -> list[Case]:
    """Return a study's rows of the paper, with the settings of choice."""
    return [choose_settings(case) for case in read_cases(name) if case.paper is not None]


def choose_settings(case: Case) -> Case:
    """Return a case with even angles for lines, and Huber's term for bad measurements."""
    encoder = EvenAngleLineCamera.name if case.encoder == "line" else case.encoder
    return replace(
        case, encoder=encoder, data_term="huber" if case.bad_fraction else case.data_term
    )


def solve_best(
    cases: Sequence[Case],
    library: Library,
    known: Mapping[str, BestFigure],
    keep: Callable[[dict[str, BestFigure]], None],
    advance: Advance,
) -> dict[str, BestFigure]:
    """Solve the rows that are not known yet, measurements on all cores; figures by `Case.key`.
    `known`: of an earlier run; `keep`: called with all figures so far after each measurement, so
    that a run that is stopped can go on.
    """
    figures = {case.key: known[case.key] for case in cases if case.key in known}
    advance(len(figures))
    missing = [case for case in cases if case.key not in figures]
    shared = [
        list(rows)
        for _, rows in groupby(sorted(missing, key=_identify_measurement), _identify_measurement)
    ]
    for case in missing:  # rendered once, before the threads start
        library.light_field(case.scene)
    for solved in map_parallel(partial(_solve_measurement, library), shared):
        figures |= solved
        keep(figures)
        advance(len(solved))
    return figures


def _identify_measurement(case: Case) -> str:
    """Return what rows share that are recovered from the same measurement."""
    return repr(sorted(asdict(replace(case, labels=(), shear=0.0, paper=None)).items()))


def _solve_measurement(library: Library, cases: list[Case]) -> dict[str, BestFigure]:
    truth = library.light_field(cases[0].scene)
    measurement = measure_case(cases[0], library, SEED)
    recovery = ClipRecovery(data_term=cases[0].data_term)
    shears = make_shear_range(*SHEAR_RANGE, measurement.views)
    views = recover_all_in_focus(measurement, shears, recovery=recovery).render_views(truth.views)
    figures = {}
    for case in cases:
        is_light_field = case.labels[-1] == LIGHT_FIELD_LABEL
        pictures = (
            (views.pictures, truth.pictures)
            if is_light_field
            else (views.refocus(case.shear), truth.refocus(case.shear))
        )
        figure = BestFigure(100 * nmse(*pictures, BORDER_PX), "surfaces")
        if not is_light_field and case.paper is not None and figure.percent >= case.paper:
            figure = _try_presets(case, measurement, pictures[1], figure)
        figures[case.key] = figure
    return figures


def _try_presets(
    case: Case, measurement: ClipMeasurement, truth: AnyArray, best: BestFigure
) -> BestFigure:
    """Return the best of both presets and the figure so far."""
    recovery = ClipRecovery(data_term=case.data_term)
    for preset in PRESETS:
        recovered = replace(recovery, preset=preset).recover(measurement, case.shear)
        # the weight chosen for the first serves the second
        recovery = replace(recovery, weight=recovered.weight)
        percent = 100 * nmse(recovered.picture, truth, BORDER_PX)
        if percent < best.percent:
            best = BestFigure(percent, preset)
    return best
