"""Pictures refocused from one CLIP shot: the flip test (Table 2), bad measurements and few photons
(Tables 5 and 6), and which view gets which angle.
"""

from __future__ import annotations

from itertools import groupby

from apps.studies.best import choose_settings
from apps.studies.cases import CAMERA_NAMES, Case, Library, SolvedCase, solve_cases
from apps.studies.outcome import CROSS_VALIDATED, Advance, Outcome, Panel, Row, Study
from tofclip.simulate.scenes import EDITS

SAMPLING_RATIO = 0.5
TABLE2_PERCENT = {  # NMSE in per cent: original, shift, flip, rotate
    ("line", "still-life", -0.8): (7.28, 8.75, 8.13, 7.26),
    ("line", "still-life", -0.1): (9.53, 7.10, 7.14, 7.59),
    ("line", "still-life", 0.5): (7.22, 7.96, 7.17, 6.38),
    ("line", "blocks", -0.6): (4.71, 4.34, 4.88, 4.54),
    ("line", "blocks", 0.0): (5.52, 3.70, 3.67, 4.28),
    ("line", "blocks", 0.8): (6.48, 4.21, 4.40, 4.89),
    ("single-pixel", "still-life", -0.8): (8.75, 9.66, 9.70, 9.36),
    ("single-pixel", "still-life", -0.1): (8.71, 7.97, 9.22, 8.18),
    ("single-pixel", "still-life", 0.5): (8.97, 9.34, 8.52, 8.39),
    ("single-pixel", "blocks", -0.6): (5.40, 5.37, 5.20, 4.64),
    ("single-pixel", "blocks", 0.0): (5.47, 5.57, 5.54, 5.54),
    ("single-pixel", "blocks", 0.8): (5.22, 4.86, 4.59, 5.08),
}
FLIP_CASES = [
    Case(
        (CAMERA_NAMES[encoder], scene, f"{shear:g}", edit),
        f"{scene}:{edit}",
        encoder,
        SAMPLING_RATIO,
        shear,
        percent,
    )
    for (encoder, scene, shear), figures in TABLE2_PERCENT.items()
    for edit, percent in zip(EDITS, figures, strict=True)
]


def run_flip_test(library: Library, seeds: int, advance: Advance) -> Outcome:
    """Recover every edit of both scenes at three depths with both cameras.

    `library`: light fields and recordings by name; `seeds`: repeats with other random numbers;
    `advance`: called with the number of steps just done. Returns A row of figures for each case,
    and the pictures to show.
    """
    solved = solve_cases(FLIP_CASES, library, seeds, advance)
    panels = []
    for first in range(0, len(solved), len(EDITS)):
        for start in ("truth", "recovered"):
            line = solved[first : first + len(EDITS)]
            camera, scene, shear, _ = line[0].case.labels
            if start == "truth" and camera == CAMERA_NAMES["line"]:
                panels.append(
                    tuple(
                        Panel(f"{scene}, {one.case.labels[3]}, s = {shear}", one.truth)
                        for one in line
                    )
                )
            if start == "recovered":
                panels.append(tuple(one.panel(f"{camera}, s = {shear}") for one in line))
    rows = tuple(one.row() for one in solved)
    return Outcome(("camera", "scene", "s", "edit"), "NMSE, %", rows, tuple(panels))


FLIP_STUDY = Study(
    "table2",
    ("fig6", "fig7"),
    "Generalised flip test at SR = 0.5",
    "The paper's scenes are not public: its scene 1 and 2 stand beside our own 'still-life' and 'blocks'.",
    CROSS_VALIDATED,
    40,
    len(FLIP_CASES),
    run_flip_test,
    best=tuple(map(choose_settings, FLIP_CASES)),
)


SHEARS = {"blocks": -0.6, "letters": -0.4, "printed-words": -0.3, "printed-letters": -0.3}
TABLE5_PERCENT = {  # fraction of bad measurements to the pictures' NMSE, per cent
    ("single-pixel", "printed-words"): {0.001: 1.54, 0.002: 2.08, 0.01: 11.24},
    ("single-pixel", "printed-letters"): {0.001: 4.50, 0.002: 4.7, 0.01: 6.5},
    ("line", "letters"): {0.01: 5.07, 0.05: 12.1, 0.1: 15.2},
    ("line", "blocks"): {0.01: 1.68, 0.05: 6.05, 0.1: 9.38},
}
TABLE6_PERCENT = {  # photons of the largest measurement to NMSE, per cent
    ("line", "blocks"): {400: 7.30, 1000: 6.54, 4000: 5.92, 10000: 6.01},
    ("line", "letters"): {400: 2.85, 1000: 2.66, 4000: 2.55, 10000: 2.53},
    ("single-pixel", "blocks"): {400: 57.88, 1000: 40.62, 4000: 20.58, 10000: 14.95},
    ("single-pixel", "letters"): {400: 43.45, 1000: 25.45, 4000: 16.16, 10000: 7.05},
}


INVALID_CASES = [
    Case(
        (CAMERA_NAMES[encoder], scene, f"{100 * share:g} %", term),
        scene,
        encoder,
        1.0,
        SHEARS[scene],
        percent if term == "squares" else None,
        bad_fraction=share,
        data_term=term,
    )
    for (encoder, scene), figures in TABLE5_PERCENT.items()
    for term in ("squares", "huber")
    for share, percent in figures.items()
]
PHOTON_CASES = [
    Case(
        (CAMERA_NAMES[encoder], scene, str(photons)),
        scene,
        encoder,
        1.0,
        SHEARS[scene],
        percent,
        photons=photons,
    )
    for (encoder, scene), figures in TABLE6_PERCENT.items()
    for photons, percent in figures.items()
]


def run_invalid_measurements(library: Library, seeds: int, advance: Advance) -> Outcome:
    """Set a fraction of the measurements to 0 or to the largest; recover with squares, and with
    Huber's term.

    `library`: light fields and recordings by name; `seeds`: repeats with other random numbers;
    `advance`: called with the number of steps just done. Returns A row of figures for each case,
    and the pictures to show.
    """
    return _make_outcome(
        ("camera", "scene", "bad measurements", "data term"),
        solve_cases(INVALID_CASES, library, seeds, advance),
    )


def run_few_photons(library: Library, seeds: int, advance: Advance) -> Outcome:
    """Count photons; the largest measurement has the number given.

    `library`: light fields and recordings by name; `seeds`: repeats with other random numbers;
    `advance`: called with the number of steps just done. Returns A row of figures for each case,
    and the pictures to show.
    """
    return _make_outcome(
        ("camera", "scene", "photons"), solve_cases(PHOTON_CASES, library, seeds, advance)
    )


def _make_outcome(columns: tuple[str, ...], solved: list[SolvedCase]) -> Outcome:
    panels = []
    for _, some in groupby(
        solved, key=lambda one: (one.case.encoder, one.case.scene, one.case.data_term)
    ):
        line = list(some)
        camera, scene, *_ = line[0].case.labels
        shown = (one.panel(", ".join(one.case.labels[2:])) for one in line)
        panels.append((Panel(f"{camera}, {scene}\ntrue", line[0].truth), *shown))
    rows: tuple[Row, ...] = tuple(one.row() for one in solved)
    return Outcome(columns, "NMSE, %", rows, tuple(panels))


CORRUPTION_STUDIES = (
    Study(
        "table5",
        ("fig12",),
        "Bad measurements at SR = 1",
        "The paper does not say its data term; its figures stand beside squares, Huber's is ours. Scenes are our own.",
        CROSS_VALIDATED,
        50,
        len(INVALID_CASES),
        run_invalid_measurements,
        best=tuple(choose_settings(case) for case in INVALID_CASES if case.paper is not None),
    ),
    Study(
        "table6",
        ("fig13",),
        "Few photons at SR = 1",
        "Scenes are our own.",
        CROSS_VALIDATED,
        15,
        len(PHOTON_CASES),
        run_few_photons,
        best=tuple(map(choose_settings, PHOTON_CASES)),
    ),
)


ASSIGNMENT_RATIOS = (2.0, 1.0, 0.5, 0.25)
ASSIGNMENT_SCENES = {"letters": -0.4, "blocks": -0.6}
RECORDED_SCENES = {"render_letters": -0.3, "render_planes": 0.0, "hci_antinous": 0.0}
ASSIGNMENT_ENCODERS = ("line", "line-even")


def run_angle_assignment(library: Library, seeds: int, advance: Advance) -> Outcome:
    """Recover with both ways of dealing; others' light fields too where they are at hand, as
    figures only.

    `library`: light fields and recordings by name; `seeds`: repeats with other random numbers;
    `advance`: called with the number of steps just done. Returns A row of figures for each case,
    and the pictures to show.
    """
    scenes = ASSIGNMENT_SCENES | {
        f"data:{name}": shear
        for name, shear in RECORDED_SCENES.items()
        if library.has_recording(f"lightfields/{name}.npz")
    }
    cases = [
        Case(
            (scene.removeprefix("data:"), CAMERA_NAMES[encoder], f"{ratio:g}"),
            scene,
            encoder,
            ratio,
            shear,
        )
        for scene, shear in scenes.items()
        for encoder in ASSIGNMENT_ENCODERS
        for ratio in ASSIGNMENT_RATIOS
    ]
    solved = solve_cases(cases, library, seeds, advance)
    panels = []
    rendered = len(ASSIGNMENT_SCENES) * len(ASSIGNMENT_ENCODERS) * len(ASSIGNMENT_RATIOS)
    for first in range(0, rendered, len(ASSIGNMENT_RATIOS)):
        line = solved[first : first + len(ASSIGNMENT_RATIOS)]
        scene, camera, _ = line[0].case.labels
        shown = (one.panel(f"SR = {one.case.labels[2]}") for one in line)
        panels.append((Panel(f"{scene}, {camera}\ntrue", line[0].truth), *shown))
    rows = tuple(one.row() for one in solved)
    return Outcome(("scene", "camera", "SR"), "NMSE, %", rows, tuple(panels))


ASSIGNMENT_STUDY = Study(
    "dealing",
    (),
    "Angles assigned to views at random, and evenly over the aperture",
    "Beyond the paper, which deals at random.",
    CROSS_VALIDATED,
    25,
    2 * len(ASSIGNMENT_SCENES) * len(ASSIGNMENT_RATIOS),
    run_angle_assignment,
)
