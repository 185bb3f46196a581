"""The contract of linear operators: every operator of the package is listed here and passes all of
it.

On NumPy's arrays all of them, those that are portable on the arrays of other libraries as well.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from array_places import DEVICE_NAMES, find_device

from nlos import Capture, Grid, Hybrid
from nlos.refinement.l1 import WallModel
from tofclip.arrays import ComputeDevice, is_numpy, to_numpy
from tofclip.errors import InputError, ShapeError, TofclipError
from tofclip.operators import (
    BlockDiagonal,
    DenseSensor,
    Diagonal,
    FourierShear,
    HadamardCodes,
    Identity,
    Integration,
    LinearOperator,
    LinearShear,
    LineProjection,
    MaskedSensor,
    MaskedViews,
    MeanWeighting,
    PitchedSensor,
    PointSpreadConvolution,
    RadonProjection,
    Reshape,
    ShearedViews,
    SliceConvolution,
    SparseMatrix,
    Stack,
    ViewSelection,
    WeightedViews,
)

CENTRES = [6.3, 19.0, 31.8]
ANGLES = np.deg2rad([-41.0, 0.7, 35.0])


def line_projection(dtype: type) -> LinearOperator:
    return LineProjection((11, 13), 37, CENTRES, ANGLES, [0.9, 1.0, 1.2], dtype)


def sparse_matrix(dtype: type) -> LinearOperator:
    import scipy.sparse

    matrix = scipy.sparse.random_array(
        (15, 21), density=0.2, rng=np.random.default_rng(3), dtype=dtype
    )
    return SparseMatrix(matrix.tocsr(), (3, 7), (15,))


def view_selection(dtype: type) -> LinearOperator:
    return ViewSelection((5, 3, 4), [3, 0], dtype)


def many_tiles(dtype: type) -> LinearOperator:
    """A picture too large for one cache tile, so that the product has to add up several."""
    return LineProjection((97, 103), 131, [64.2], np.deg2rad([20.0]), [1.0], dtype)


def diagonal(dtype: type) -> LinearOperator:
    return Diagonal(np.random.default_rng(5).standard_normal((5, 7)), dtype)


def composition(dtype: type) -> LinearOperator:
    return Diagonal(np.linspace(0, 2, 37), dtype) @ line_projection(dtype)


def stack(dtype: type) -> LinearOperator:
    other = LineProjection((11, 13), 20, [9.5], [0.2], [1.0], dtype)
    return Stack([line_projection(dtype), other])


def adjoint(dtype: type) -> LinearOperator:
    return line_projection(dtype).H


def normal(dtype: type) -> LinearOperator:
    operator = line_projection(dtype)
    return operator.H @ operator


def linear_shear(dtype: type) -> LinearOperator:
    return LinearShear((11, 14), -0.7, (-4, 3), (0.3, -0.2), dtype)


def fourier_shear(dtype: type) -> LinearOperator:
    """An odd and an even side: the Nyquist frequency exists on the even one only."""
    return FourierShear((11, 14), -0.7, (-4, 3), (0.3, -0.2), dtype)


def radon_projection(dtype: type) -> LinearOperator:
    return RadonProjection((11, 13), 12, np.deg2rad([0, 37, 90, 161]), [0.0, 1.3, -2.6, 0.5], dtype)


def hadamard_codes(dtype: type) -> LinearOperator:
    return HadamardCodes((7, 13), 21, 4, dtype)


def mean_weighting(dtype: type) -> LinearOperator:
    return MeanWeighting([3, 1, 5], 0.3, dtype)


def refocused_single_pixel(dtype: type) -> LinearOperator:
    """The model of supplement Eq. 21: every view's codes after its shear, stacked and weighted."""
    views = [(-1, 0), (0, 2)]
    codes = [
        HadamardCodes((11, 14), 5, k, dtype) @ LinearShear((11, 14), 0.4, v, (0, 0), dtype)
        for k, v in enumerate(views)
    ]
    return MeanWeighting([5, 5], 0.1, dtype) @ Stack(codes)


def light_field_model(dtype: type) -> LinearOperator:
    return BlockDiagonal([HadamardCodes((5, 7), 3 + k, k, dtype) for k in range(3)])


def point_spread_convolution(dtype: type) -> LinearOperator:
    return PointSpreadConvolution((11, 14), np.random.default_rng(6).random((6, 9)), dtype=dtype)


def seen_beyond_the_sensor(dtype: type) -> LinearOperator:
    """Without a lens: the picture is larger than the sensor."""
    return PointSpreadConvolution((21, 16), np.random.default_rng(7).random((9, 16)), (9, 7), dtype)


def dense_sensor(dtype: type) -> LinearOperator:
    return DenseSensor((5, 7), dtype)


def pitched_sensor(dtype: type) -> LinearOperator:
    return PitchedSensor((11, 14), (2, 3.4), (1, 0), dtype)


def masked_sensor(dtype: type) -> LinearOperator:
    return MaskedSensor(np.random.default_rng(8).random((5, 9)) < 0.7, dtype)


def sparse_camera(dtype: type) -> LinearOperator:
    """A sparse sensor behind a diffuser (supplement Note 3)."""
    return pitched_sensor(dtype) @ point_spread_convolution(dtype)


def slice_convolution(dtype: type) -> LinearOperator:
    return SliceConvolution((11, 14), np.random.default_rng(9).random((3, 10, 9)), 19, dtype)


def integration(dtype: type) -> LinearOperator:
    """Views that add up on one sensor (supplement Eq. 19)."""
    spreads = np.random.default_rng(10).random((3, 4, 5))
    return Integration([PointSpreadConvolution((9, 7), spread, dtype=dtype) for spread in spreads])


def weighted_views(dtype: type) -> LinearOperator:
    return WeightedViews((5, 7), np.random.default_rng(11).random((3, 4)), dtype)


def masked_views(dtype: type) -> LinearOperator:
    return MaskedViews(np.random.default_rng(12).random((4, 5, 7)), dtype)


def sheared_views(dtype: type) -> LinearOperator:
    return ShearedViews((11, 14), [(-1, 0), (0, 2), (1, 1)], 0.7, (0.3, 0), dtype)


def reshape(dtype: type) -> LinearOperator:
    return Reshape((3, 4, 5), (12, 5), dtype)


def identity(dtype: type) -> LinearOperator:
    return Identity((3, 5), dtype)


def hidden_to_wall(laser: object, dtype: type) -> LinearOperator:
    """A hidden volume of odd sides, seen from a curved wall with a point missing."""
    x, y = np.meshgrid(np.linspace(-0.4, 0.4, 5), np.linspace(-0.3, 0.3, 3))
    wall = np.stack([x, y, 0.1 * x**2 - 0.05 * y], axis=-1)
    wall[1, 3] = np.nan
    capture = Capture(np.ones((20, 3, 5)), wall, wall if laser is None else laser, 200e-12)
    grid = Grid.box((-0.25, 0.2), (-0.1, 0.2), (0.5, 0.7), (0.15, 0.15, 0.1))
    return WallModel(Hybrid(0.8, 4).plan(capture, grid), capture).operator(dtype)


def hidden_to_lit_wall(dtype: type) -> LinearOperator:
    return hidden_to_wall([0.1, 0.05, 0.0], dtype)


def hidden_to_scanned_wall(dtype: type) -> LinearOperator:
    return hidden_to_wall(None, dtype)


def views_of_their_own(dtype: type) -> LinearOperator:
    return BlockDiagonal(
        [LineProjection((5, 7), 9 + k, [4.0], [0.1 * k], [1.0], dtype) for k in range(3)]
    )


def views_on_one_slit(dtype: type) -> LinearOperator:
    return Integration(
        [LineProjection((5, 7), 9, [4.0], [0.1 * k], [1.0], dtype) for k in range(3)]
    )


def unseen_pixels_and_empty_readings(dtype: type) -> LinearOperator:
    return LineProjection((5, 7), 40, [20.0, 43.0], [0.3, 0.0], [1.0, 2.0], dtype)


PORTABLE: list[Callable[[type], LinearOperator]] = [
    line_projection,
    sparse_matrix,
    many_tiles,
    diagonal,
    composition,
    stack,
    adjoint,
    normal,
    radon_projection,
    views_of_their_own,
    views_on_one_slit,
    unseen_pixels_and_empty_readings,
    reshape,
    identity,
    dense_sensor,
    masked_views,
]
BUILDERS: list[Callable[[type], LinearOperator]] = [
    *PORTABLE,
    view_selection,
    linear_shear,
    fourier_shear,
    hadamard_codes,
    mean_weighting,
    refocused_single_pixel,
    light_field_model,
    point_spread_convolution,
    seen_beyond_the_sensor,
    pitched_sensor,
    masked_sensor,
    sparse_camera,
    slice_convolution,
    integration,
    weighted_views,
    sheared_views,
    hidden_to_lit_wall,
    hidden_to_scanned_wall,
]
BATCHES = [(), (1,), (3,), (32,), (33,)]

every_operator = pytest.mark.parametrize("build", BUILDERS, ids=lambda build: build.__name__)
everywhere = pytest.mark.parametrize(
    ("build", "library"),
    [(build, "numpy") for build in BUILDERS]
    + [(build, library) for build in PORTABLE for library in DEVICE_NAMES],
    ids=lambda value: value if isinstance(value, str) else value.__name__,
)
both_types = pytest.mark.parametrize("dtype", [np.float32, np.float64])
every_batch = pytest.mark.parametrize("batch", BATCHES, ids=str)


def put(library: str, *arrays: np.ndarray) -> tuple[object, ...]:
    """The same values as arrays of a library."""
    return tuple(find_device(library).put(array) for array in arrays)


def fetched(library: str, array: object) -> np.ndarray:
    """Values of a result, which has to be where the operand was."""
    assert ComputeDevice.of(array) == find_device(library)
    return to_numpy(array)


def tolerance(dtype: type) -> float:
    """The project's bound for a matched adjoint: 1e-5 in float32, 1e-12 in float64."""
    return 1e-5 if dtype == np.float32 else 1e-12


def random_pair(operator: LinearOperator, batch: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    # Positive numbers: their products do not cancel, so that the relative bound means something.
    rng = np.random.default_rng(0)
    return rng.random((*operator.shape_in, *batch)), rng.random((*operator.shape_out, *batch))


@everywhere
@both_types
@every_batch
def test_adjoint_matches_forward(build, library, dtype, batch):
    operator = build(dtype)
    x, y = random_pair(operator, batch)
    x_there, y_there = put(library, x, y)
    seen, back = fetched(library, operator(x_there)), fetched(library, operator.adjoint(y_there))
    forward, backward = np.vdot(seen, y), np.vdot(x, back)
    scale = np.linalg.norm(seen) * np.linalg.norm(y)
    assert abs(forward - backward) <= tolerance(dtype) * scale, (
        f"adjoint is off by a factor {backward / forward}"
    )


@everywhere
@both_types
def test_linear(build, library, dtype):
    operator = build(dtype)
    a, _ = random_pair(operator, (3,))
    b = a[::-1] ** 2
    of_both, of_a, of_b = (
        fetched(library, operator(*put(library, x))) for x in (2.5 * a - 1.5 * b, a, b)
    )
    parts = 2.5 * of_a - 1.5 * of_b
    assert np.linalg.norm(of_both - parts) <= 10 * tolerance(dtype) * np.linalg.norm(of_a + of_b)


@everywhere
@both_types
@every_batch
def test_result_has_the_stated_shape_and_type(build, library, dtype, batch):
    operator = build(dtype)
    x, y = put(library, *random_pair(operator, batch))
    seen, back = fetched(library, operator(x)), fetched(library, operator.adjoint(y))
    assert seen.shape == (*operator.shape_out, *batch)
    assert back.shape == (*operator.shape_in, *batch)
    assert seen.dtype == back.dtype == operator.dtype == dtype


@everywhere
@both_types
def test_every_frame_of_a_batch_is_treated_alone(build, library, dtype):
    operator = build(dtype)
    x, y = put(library, *random_pair(operator, (35,)))
    forward, backward = operator(x), operator.adjoint(y)
    for frame in (0, 31, 32, 34):
        pairs = ((forward, operator(x[..., frame])), (backward, operator.adjoint(y[..., frame])))
        for whole, alone in ((to_numpy(whole), to_numpy(alone)) for whole, alone in pairs):
            # Relative to the largest value: where terms cancel, a small one is only as exact as
            # they are.
            bound = tolerance(dtype) * np.abs(alone).max()
            np.testing.assert_allclose(whole[..., frame], alone, rtol=tolerance(dtype), atol=bound)


@everywhere
def test_refuses_every_other_shape(build, library):
    operator = build(np.float32)
    wrong = [
        (),
        (4,),
        operator.shape_in[:-1],
        (*operator.shape_in, 2, 2),
        (operator.shape_in[0] + 1, *operator.shape_in[1:]),
    ]
    for shape in wrong:
        with pytest.raises(ShapeError, match="must have shape"):
            operator(*put(library, np.zeros(shape)))
    with pytest.raises(ShapeError, match="must have shape"):
        operator.adjoint(
            *put(library, np.zeros((operator.shape_out[0] + 1, *operator.shape_out[1:])))
        )
    with pytest.raises(InputError, match="must be real"):
        operator(*put(library, np.zeros(operator.shape_in, complex)))


@everywhere
def test_leaves_its_input_alone(build, library):
    operator = build(np.float32)
    x_before, y_before = (array.astype(np.float32) for array in random_pair(operator, (32,)))
    x, y = put(library, x_before.copy(), y_before.copy())
    operator(x)
    operator.adjoint(y)
    np.testing.assert_array_equal(to_numpy(x), x_before)
    np.testing.assert_array_equal(to_numpy(y), y_before)


@pytest.mark.parametrize("build", PORTABLE, ids=lambda build: build.__name__)
@pytest.mark.parametrize("library", DEVICE_NAMES)
def test_other_libraries_get_what_numpy_gets(build, library):
    operator = build(np.float32)
    x, y = (array.astype(np.float32) for array in random_pair(operator, (5,)))
    x_there, y_there = put(library, x, y)
    for there, here in (
        (operator(x_there), operator(x)),
        (operator.adjoint(y_there), operator.adjoint(y)),
    ):
        # Sums of up to some hundred terms in float32, added in another order.
        np.testing.assert_allclose(to_numpy(there), here, rtol=1e-5, atol=1e-5 * np.abs(here).max())


@pytest.mark.parametrize("library", DEVICE_NAMES)
def test_entries_that_are_given_twice_and_out_of_order_count_together(library):
    import scipy.sparse

    matrix = scipy.sparse.csr_array(
        (np.array([1.0, 2, 4, 8]), [3, 0, 3, 1], [0, 3, 4]), shape=(2, 4)
    )
    assert not matrix.has_canonical_format
    (picture,) = put(library, np.array([1.0, 10, 100, 1000]))
    np.testing.assert_array_equal(to_numpy(SparseMatrix(matrix, (4,), (2,))(picture)), [5002, 80])


@every_operator
def test_what_has_only_compiled_loops_refuses_other_arrays(build):
    operator = build(np.float32)
    assert operator.portable == (build in PORTABLE)
    if not operator.portable:
        x, y = put("array_api_strict", *random_pair(operator, ()))
        for apply, operand in ((operator, x), (operator.adjoint, y)):
            with pytest.raises(
                InputError, match="works on NumPy arrays, not on array_api_strict's"
            ):
                apply(operand)
        assert is_numpy(operator(to_numpy(x)))


def test_composed_with_the_identity_an_operator_is_itself():
    operator = line_projection(np.float32)
    assert Identity((37,)) @ operator is operator


def test_the_adjoint_of_the_adjoint_is_the_operator():
    operator = line_projection(np.float32)
    assert operator.H.H is operator


@pytest.mark.parametrize(
    "build",
    [
        lambda: line_projection(np.float32) @ line_projection(np.float32),
        lambda: Diagonal(np.ones(37), np.float64) @ line_projection(np.float32),
        lambda: Stack([]),
        lambda: Stack([line_projection(np.float32), diagonal(np.float32)]),
        lambda: Stack([line_projection(np.float32), line_projection(np.float64)]),
        lambda: Diagonal([1.0, np.nan]),
        lambda: Diagonal(np.ones(3), np.int64),
        lambda: LineProjection((3, 3), 9, [1.0, 2.0], [0.0], [1.0]),
        lambda: LineProjection((0, 3), 9, [1.0], [0.0], [1.0]),
        lambda: LinearShear((9, 9), 3.0, (0, 3)),
        lambda: FourierShear((9, 9), np.nan, (0, 3)),
        lambda: RadonProjection((9, 9), 9, [0.0, 1.0], [0.0]),
        lambda: RadonProjection((9, 9), 9, [np.nan], [0.0]),
        lambda: HadamardCodes((8, 8), 65, 0),
        lambda: HadamardCodes((8, 8), 0, 0),
        lambda: MeanWeighting([3, 0]),
        lambda: MeanWeighting([3], 1.5),
        lambda: PointSpreadConvolution((9, 9), np.ones((10, 3))),
        lambda: PointSpreadConvolution((9, 9), np.ones(3)),
        lambda: PointSpreadConvolution((9, 9), np.zeros((3, 3))),
        lambda: PointSpreadConvolution((9, 9), [[1.0, np.nan]]),
        lambda: PitchedSensor((9, 9), (0.5, 1)),
        lambda: SliceConvolution((9, 9), np.ones((2, 9, 10))),
        lambda: SliceConvolution((9, 9), np.ones((9, 9))),
        lambda: Reshape((3, 4), (11,)),
        lambda: WeightedViews((9, 9), np.ones(3)),
        lambda: WeightedViews((9, 9), [[np.nan]]),
        lambda: MaskedViews(np.ones((9, 9))),
        lambda: MaskedViews(np.full((2, 3, 3), np.inf)),
        lambda: Integration([]),
        lambda: Integration([dense_sensor(np.float32), mean_weighting(np.float32)]),
        lambda: Integration([dense_sensor(np.float32), dense_sensor(np.float64)]),
        lambda: Identity((37,), np.float64) @ line_projection(np.float32),
        lambda: PitchedSensor((9, 9), (2, 2), (9, 0)),
        lambda: MaskedSensor(np.zeros((4, 4), bool)),
        lambda: MaskedSensor(np.ones(4, bool)),
    ],
)
def test_operators_that_do_not_fit_are_refused(build):
    with pytest.raises(TofclipError):
        build()
