"""How fast the light-field cameras' models are, as ratios to the bare products and transforms they
stand for.

Run with ``python tests/benchmarks/operators.py [--sampling-ratio R] [--repeats N] [--json]``. Light
fields of 8 x 8 views of 128 x 128 pixels, one picture at a time on one core; medians of one run on
one machine. `set-up` makes camera and model; the first of a process also loads compiled loops,
which a warm-up does before. The floor of a sparse model is one product with its CSR matrix by
scipy, that of a model with transforms a forward and an inverse FFT of its padded size by scipy,
that of the single pixel one Hadamard matrix product on either side for each view by BLAS.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from functools import partial

import numpy as np
import scipy.fft
import scipy.linalg

from tofclip.operators import LinearOperator
from tofclip.operators.light_field_camera import CAMERAS, LineCamera
from tofclip.threads import limit_blas_threads

SHAPE = (128, 128)
VIEWS = [(float(v), float(u)) for v in range(-4, 4) for u in range(-4, 4)]
SHEAR = -0.3
RATIOS = (2.0, 1.0, 0.5, 0.25)
AREA_SENSORS = ("coded-aperture", "cubic-phase", "diffuser")


def median_ms(action: Callable[[], object], repeats: int) -> float:
    """Milliseconds of `action`, after two warm-ups."""
    seconds = []
    for number in range(repeats + 2):
        start = time.perf_counter()
        action()
        if number >= 2:
            seconds.append(time.perf_counter() - start)
    return float(np.median(seconds)) * 1e3


def model(name: str, ratio: float) -> LinearOperator:
    """A fresh camera's weighted model at `SHEAR`."""
    camera = CAMERAS[name](SHAPE, VIEWS, ratio, 0)
    return camera.weighting() @ camera.model(SHEAR)


def bare_sparse_product(ratio: float) -> Callable[[], object]:
    """One product of the line camera's CSR matrix with one picture."""
    matrix = LineCamera(SHAPE, VIEWS, ratio, 0).model(SHEAR).matrix
    picture = np.ones(SHAPE[0] * SHAPE[1], np.float32)
    return lambda: matrix @ picture


def bare_transforms(size: int) -> Callable[[], object]:
    """A forward and an inverse FFT of a square."""
    picture = np.ones((size, size), np.float32)
    return lambda: scipy.fft.irfft2(scipy.fft.rfft2(picture), s=picture.shape)


def bare_codes() -> Callable[[], object]:
    """A Hadamard product on either side of one picture for each view."""
    hadamard, picture = (
        scipy.linalg.hadamard(SHAPE[0]).astype(np.float32),
        np.ones(SHAPE, np.float32),
    )
    return lambda: [hadamard @ picture @ hadamard for _ in VIEWS]


def table(ratio: float, repeats: int) -> list[dict[str, object]]:
    """One row for each camera: milliseconds of its model, and of it relative to its floor."""
    product = bare_sparse_product(ratio)
    floors = {"line": product, "line-even": product, "single-pixel": bare_codes()}
    rows = []
    for name in CAMERAS:
        operator = model(name, min(ratio, 1.0) if name in AREA_SENSORS else ratio)
        picture = np.random.default_rng(0).random(operator.shape_in).astype(np.float32)
        measurements = operator(picture)
        floor = median_ms(floors.get(name, bare_transforms(192)), repeats)
        forward = median_ms(lambda: operator(picture), repeats)  # noqa: B023 - called at once
        adjoint = median_ms(lambda: operator.adjoint(measurements), repeats)  # noqa: B023
        rows.append(
            {
                "camera": name,
                "readings": operator.shape_out[0],
                "floor_ms": round(floor, 3),
                "forward_ms": round(forward, 3),
                "adjoint_ms": round(adjoint, 3),
                "forward_times_floor": round(forward / floor, 2),
                "adjoint_times_floor": round(adjoint / floor, 2),
            }
        )
    return rows


def set_up(repeats: int) -> list[dict[str, object]]:
    """Milliseconds that camera and model take to make, for each sampling ratio that the camera has."""
    return [
        {
            "camera": name,
            "ratio": ratio,
            "set_up_ms": round(median_ms(partial(model, name, ratio), repeats), 1),
        }
        for name in CAMERAS
        for ratio in RATIOS
        if ratio <= 1 or name not in AREA_SENSORS
    ]


def main() -> None:
    """Print both tables or, with ``--json``, one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sampling-ratio", type=float, default=0.5)
    parser.add_argument("--repeats", type=int, default=30)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    with limit_blas_threads():
        speed = table(arguments.sampling_ratio, arguments.repeats)
        making = set_up(max(3, arguments.repeats // 10))
    if arguments.json:
        print(
            json.dumps(
                {"sampling_ratio": arguments.sampling_ratio, "speed": speed, "set_up": making}
            )
        )
        return
    print(f"sampling ratio {arguments.sampling_ratio}, one core")
    print(
        f"{'':16}{'readings':>9}{'floor ms':>10}{'forward':>9}{'adjoint':>9}{'x floor':>9}{'x floor':>9}"
    )
    for row in speed:
        print(
            f"{row['camera']:16}{row['readings']:9}{row['floor_ms']:10}{row['forward_ms']:9}{row['adjoint_ms']:9}"
            f"{row['forward_times_floor']:9}{row['adjoint_times_floor']:9}"
        )
    print(f"\n{'set-up, ms':16}" + "".join(f"{f'SR {ratio:g}':>10}" for ratio in RATIOS))
    for name in CAMERAS:
        found = {row["ratio"]: row["set_up_ms"] for row in making if row["camera"] == name}
        print(f"{name:16}" + "".join(f"{found.get(ratio, ''):>10}" for ratio in RATIOS))


if __name__ == "__main__":
    main()
