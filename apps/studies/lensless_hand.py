"""A recorded hand behind a real diffuser, from the whole sensor and from fewer of its pixels (Supp.
Fig. 4d-f).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from apps.studies.diffusercam import read_diffuser_recording, recover_diffuser_scene
from apps.studies.library import Library
from apps.studies.outcome import Advance, Outcome, Panel, Row, Study

RECORDING = "diffusercam/psf_hand_300x400.npz"
PITCHES_PX = (1, 2, 3)
DISPLAY_THRESHOLD = 0.05  # of the brightest: where the picture is cut off


def run_lensless_hand(library: Library, seeds: int, advance: Advance) -> Outcome:
    """Recover the scene from every pixel, every second and every third on either axis; nothing here
    is random.

    Parameters
    ----------
    library : Library
        Light fields and recordings by name.
    seeds : int
        Repeats with other random numbers.
    advance : callable
        Called with the number of steps just done.

    Returns
    -------
    Outcome
        A row of figures for each case, and the pictures to show.
    """
    recording = read_diffuser_recording(library.recording(RECORDING))
    recoveries = []
    for pitch in PITCHES_PX:
        recoveries.append(recover_diffuser_scene(recording, pitch))
        advance(1)
    window = _find_bright_part(recoveries[0].scene)
    rows = tuple(Row((str(one.pitch_px),), (100 * one.relative_residual,)) for one in recoveries)
    shown = [
        Panel(f"every {pitch}. pixel\n{100 * one.relative_residual:.2f} %", one.scene[window])
        for pitch, one in zip(PITCHES_PX, recoveries, strict=True)
    ]
    return Outcome(("every n-th pixel",), "relative residual, %", rows, (tuple(shown),))


def _find_bright_part(scene: NDArray[np.float32]) -> tuple[slice, slice]:
    """Return the part of a scene that holds what is bright."""
    rows, columns = np.nonzero(scene > DISPLAY_THRESHOLD * scene.max())
    return slice(rows.min(), rows.max() + 1), slice(columns.min(), columns.max() + 1)


STUDY = Study(
    "fig4d",
    (),
    "A hand behind the diffuser of DiffuserCam, recorded",
    "The paper shows its slanted target, of which no recording is at hand; this is another one from the same camera. "
    "Nobody knows the true scene, so the figure is what the picture leaves unexplained of the readings.",
    10,
    len(PITCHES_PX),
    run_lensless_hand,
    seeded=False,
    recording=RECORDING,
)
