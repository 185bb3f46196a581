"""Whether a picture shows anything: its brightest against that of pictures of the same capture with
its signals shuffled among the wall points.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from nlos.capture import Capture
from nlos.method import Plan
from nlos.volume import Volume
from tofclip.arrays import namespace, to_numpy

# A picture is judged by what this fraction of its voxels exceeds, against that of so many decoys:
# at least two, and of small pictures, whose few speckles tell little, as many as fill these voxels.
BRIGHT_QUANTILE, MIN_DECOYS, MAX_DECOYS, DECOY_VOXELS = 0.999, 2, 8, 1 << 15
# With less evidence than this, a picture may be of noise, a glow, or of wrong units.
MIN_EVIDENCE = 2.0


def measure_evidence(capture: Capture, plan: Plan, picture: Volume) -> float:
    """How much brighter the brightest of a picture is than that of decoys: of the capture itself,
    its signals shuffled among the wall points. About 1 says that there is nothing to see.

    Each depth's brightness is taken relative to the decoys': noise and the wall's glow fade with it.
    `capture`: as it is imaged; `plan`: that the picture was made by, with coarse voxels.
    """
    own, decoys = measure_brightness(capture, plan, picture, MIN_DECOYS)
    return own / max(float(np.mean(decoys)), np.finfo(np.float64).tiny)


def measure_brightness(
    capture: Capture, plan: Plan, picture: Volume, count: int | None = None
) -> tuple[float, list[float]]:
    """Brightest of a picture, and of its decoys, relative to their mean; see `measure_evidence`.
    `count`: of decoys; by default as many as the picture's size asks for.
    """
    if count is None:
        count = int(np.clip(DECOY_VOXELS // picture.values.size, MIN_DECOYS, MAX_DECOYS))
    xp, places = namespace(capture.signal), np.flatnonzero(capture.valid)
    # Whatever order the points come in, the decoys are the same.
    ordered = places[np.lexsort((capture.points + capture.lasers).T)]
    flat, energies = xp.reshape(capture.signal, (capture.axis.bins, -1)), [_find_energy(picture)]
    for seed in range(1, count + 1):
        order = np.arange(capture.valid.size)
        order[ordered] = np.random.default_rng(seed).permutation(ordered)
        signal = xp.take(flat, capture.device.put(order), axis=1)
        shuffled = replace(capture, signal=xp.reshape(signal, capture.signal.shape))
        energies.append(_find_energy(plan.image(shuffled)))
    level = np.mean(energies[1:], axis=(0, 2, 3))[:, np.newaxis, np.newaxis]
    level = np.maximum(level, np.finfo(np.float32).tiny)
    own, *decoys = (float(np.quantile(energy / level, BRIGHT_QUANTILE)) for energy in energies)
    return own, decoys


def _find_energy(volume: Volume) -> NDArray[np.float64]:
    energy: NDArray[np.float64] = np.square(to_numpy(volume.values), dtype=np.float64)
    return energy
