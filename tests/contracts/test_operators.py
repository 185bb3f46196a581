"""The contract of linear operators: every operator of the package is listed here and passes all of
it.

On NumPy's arrays all of them, those that are portable on the arrays of other libraries as well.
"""

import numpy as np
import pytest
import scipy.sparse
from array_places import DEVICE_NAMES, FETCHED, find_device

from nlos import Capture, Grid, Hybrid
from nlos.refinement.l1 import WallModel
from tofclip.arrays import ComputeDevice, is_numpy, to_numpy
from tofclip.errors import InputError, ShapeError, TofclipError
from tofclip.operators import (
    BlockDiagonal,
    DenseSensor,
    Diagonal,
    HadamardCodes,
    Identity,
    Integration,
    LinearShear,
    LineProjection,
    MeanWeighting,
    PitchedSensor,
    PointSpreadConvolution,
    RadonProjection,
    Reshape,
    Selection,
    SliceConvolution,
    SparseMatrix,
    Stack,
    WeightedViews,
)

CENTRES, ANGLES = [6.3, 19.0, 31.8], np.deg2rad([-41.0, 0.7, 35.0])
VIEWS = [(-1, 0), (0, 2), (1, 1)]


def draw(seed, *shape):
    return np.random.default_rng(seed).random(shape)


def line_projection(dtype=np.float32):
    return LineProjection((11, 13), 37, CENTRES, ANGLES, [0.9, 1.0, 1.2], dtype)


def sparse_matrix(dtype):
    random = np.random.default_rng(3)
    matrix = scipy.sparse.random_array((15, 21), density=0.2, rng=random, dtype=dtype)
    return SparseMatrix(matrix.tocsr(), (3, 7), (15,))


def own_slits(dtype, extra):
    return [LineProjection((5, 7), 9 + extra * k, [4.0], [0.1 * k], [1.0], dtype) for k in range(3)]


def refocused_single_pixel(dtype):
    """The model of supplement Eq. 21: every view's codes after its shear, stacked and weighted."""
    codes = [
        HadamardCodes((11, 14), 5, k, dtype) @ LinearShear((11, 14), 0.4, view, (0, 0), dtype)
        for k, view in enumerate(VIEWS[:2])
    ]
    return MeanWeighting([5, 5], 0.1, dtype) @ Stack(codes)


def spread_views(dtype):
    """Views that add up on one sensor (supplement Eq. 19)."""
    return Integration(
        [PointSpreadConvolution((9, 7), spread, dtype=dtype) for spread in draw(10, 3, 4, 5)]
    )


def hidden_to_wall(laser, dtype):
    """A hidden volume of odd sides, seen from a curved wall with a point missing."""
    x, y = np.meshgrid(np.linspace(-0.4, 0.4, 5), np.linspace(-0.3, 0.3, 3))
    wall = np.stack([x, y, 0.1 * x**2 - 0.05 * y], axis=-1)
    wall[1, 3] = np.nan
    capture = Capture(np.ones((20, 3, 5)), wall, wall if laser is None else laser, 200e-12)
    grid = Grid.box((-0.25, 0.2), (-0.1, 0.2), (0.5, 0.7), (0.15, 0.15, 0.1))
    return WallModel(Hybrid(0.8, 4).plan(capture, grid), capture).operator()


PORTABLE = {
    "line projection": line_projection,
    "sparse matrix": sparse_matrix,
    # too large for one cache tile, so that the product has to add up several
    "many tiles": lambda t: LineProjection((97, 103), 131, [64.2], np.deg2rad([20]), [1.0], t),
    "unseen pixels": lambda t: LineProjection((5, 7), 40, [20.0, 43.0], [0.3, 0.0], [1.0, 2.0], t),
    "diagonal": lambda t: Diagonal(draw(5, 5, 7) - 0.5, t),
    "composition": lambda t: Diagonal(np.linspace(0, 2, 37), t) @ line_projection(t),
    "stack": lambda t: Stack(
        [line_projection(t), LineProjection((11, 13), 20, [9.5], [0.2], [1.0], t)]
    ),
    "adjoint": lambda t: line_projection(t).H,
    "normal": lambda t: line_projection(t).H @ line_projection(t),
    "radon": lambda t: RadonProjection(
        (11, 13), 12, np.deg2rad([0, 37, 90, 161]), [0.0, 1.3, -2.6, 0.5], t
    ),
    "views of their own": lambda t: BlockDiagonal(own_slits(t, 1)),
    "views on one slit": lambda t: Integration(own_slits(t, 0)),
    "reshape": lambda t: Reshape((3, 4, 5), (12, 5), t),
    "identity": lambda t: Identity((3, 5), t),
    "dense sensor": lambda t: DenseSensor((5, 7), t),
}
BUILDERS = PORTABLE | {
    "views chosen": lambda t: Selection((5, 3, 4), (2, 3, 4), [3, 0], t),
    "linear shear": lambda t: LinearShear((11, 14), -0.7, (-4, 3), (0.3, -0.2), t),
    "Hadamard codes": lambda t: HadamardCodes((7, 13), 21, 4, t),
    "mean weighting": lambda t: MeanWeighting([3, 1, 5], 0.3, t),
    "single pixel": refocused_single_pixel,
    "light field": lambda t: BlockDiagonal([HadamardCodes((5, 7), 3 + k, k, t) for k in range(3)]),
    "point spread": lambda t: PointSpreadConvolution((11, 14), draw(6, 6, 9), dtype=t),
    # without a lens the picture is larger than the sensor
    "beyond the sensor": lambda t: PointSpreadConvolution((21, 16), draw(7, 9, 16), (9, 7), t),
    "pitched sensor": lambda t: PitchedSensor((11, 14), (2, 3.4), (1, 0), t),
    "pixels chosen": lambda t: Selection((5, 9), (3,), [7, 44, 0], t),
    # a sparse sensor behind a diffuser (supplement Note 3)
    "sparse camera": lambda t: BUILDERS["pitched sensor"](t) @ BUILDERS["point spread"](t),
    "slice convolution": lambda t: SliceConvolution((11, 14), draw(9, 3, 10, 9), 19, t),
    "integration": spread_views,
    "weighted views": lambda t: WeightedViews((5, 7), draw(11, 3, 4), t),
    "hidden to lit wall": lambda t: hidden_to_wall([0.1, 0.05, 0.0], t),
    "hidden to scanned wall": lambda t: hidden_to_wall(None, t),
}
BATCHES = [(), (1,), (3,), (32,), (33,)]

everywhere = pytest.mark.parametrize(
    ("build", "library"),
    [
        pytest.param(build, library, id=f"{name}-{library}")
        for name, build in BUILDERS.items()
        for library in ("numpy", *(DEVICE_NAMES if name in PORTABLE else ()))
    ],
)
in_every_type = pytest.mark.parametrize(
    ("build", "library", "dtype"),
    [
        pytest.param(*one.values, dtype, id=f"{one.id}-{dtype.__name__}")
        for one in everywhere.args[1]
        for dtype in (np.float32, np.float64)
        # these work in single precision only
        if dtype == np.float32 or "hidden to" not in one.id
    ],
)


def put(library, *arrays):
    """The same values as arrays of a library."""
    return tuple(find_device(library).put(array) for array in arrays)


def fetched(library, array):
    """Values of a result, which has to be where the operand was."""
    assert ComputeDevice.of(array) == find_device(library)
    return to_numpy(array)


def tolerance(dtype):
    """The project's bound for a matched adjoint: 1e-5 in float32, 1e-12 in float64."""
    return 1e-5 if dtype == np.float32 else 1e-12


def random_pair(operator, batch):
    # Positive numbers: their products do not cancel, so that the relative bound means something.
    rng = np.random.default_rng(0)
    return rng.random((*operator.shape_in, *batch)), rng.random((*operator.shape_out, *batch))


@in_every_type
def test_adjoint_matches_forward_and_both_have_the_stated_shape_and_type(build, library, dtype):
    operator = build(dtype)
    for batch in BATCHES:
        require_adjoint(operator, library, dtype, batch)


def require_adjoint(operator, library, dtype, batch):
    x, y = random_pair(operator, batch)
    x_there, y_there = put(library, x.astype(dtype), y.astype(dtype))
    seen, back = fetched(library, operator(x_there)), fetched(library, operator.adjoint(y_there))
    assert seen.shape == (*operator.shape_out, *batch)
    assert back.shape == (*operator.shape_in, *batch)
    assert seen.dtype == back.dtype == operator.dtype == dtype
    # what it is given is left alone
    np.testing.assert_array_equal(to_numpy(x_there), x.astype(dtype))
    np.testing.assert_array_equal(to_numpy(y_there), y.astype(dtype))
    forward, backward = np.vdot(seen, y), np.vdot(x, back)
    scale = np.linalg.norm(seen) * np.linalg.norm(y)
    assert abs(forward - backward) <= tolerance(dtype) * scale, (
        f"adjoint is off by a factor {backward / forward}"
    )


@in_every_type
def test_linear(build, library, dtype):
    operator = build(dtype)
    a, _ = random_pair(operator, (3,))
    b = a[::-1] ** 2
    of_both, of_a, of_b = (
        fetched(library, operator(*put(library, x))) for x in (2.5 * a - 1.5 * b, a, b)
    )
    parts = 2.5 * of_a - 1.5 * of_b
    assert np.linalg.norm(of_both - parts) <= 10 * tolerance(dtype) * np.linalg.norm(of_a + of_b)


@in_every_type
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


@pytest.mark.parametrize("name", PORTABLE)
@pytest.mark.parametrize("library", DEVICE_NAMES)
def test_other_libraries_get_what_numpy_gets(name, library):
    operator = PORTABLE[name](np.float32)
    x, y = (array.astype(np.float32) for array in random_pair(operator, (5,)))
    x_there, y_there = put(library, x, y)
    FETCHED.clear()
    seen, back = operator(x_there), operator.adjoint(y_there)
    assert FETCHED == []
    for there, here in ((seen, operator(x)), (back, operator.adjoint(y))):
        # Sums of up to some hundred terms in float32, added in another order.
        np.testing.assert_allclose(to_numpy(there), here, rtol=1e-5, atol=1e-5 * np.abs(here).max())


@pytest.mark.parametrize("library", DEVICE_NAMES)
def test_entries_that_are_given_twice_and_out_of_order_count_together(library):
    matrix = scipy.sparse.csr_array(
        (np.array([1.0, 2, 4, 8]), [3, 0, 3, 1], [0, 3, 4]), shape=(2, 4)
    )
    assert not matrix.has_canonical_format
    (picture,) = put(library, np.array([1.0, 10, 100, 1000]))
    np.testing.assert_array_equal(to_numpy(SparseMatrix(matrix, (4,), (2,))(picture)), [5002, 80])


@pytest.mark.parametrize("name", BUILDERS)
def test_what_has_only_compiled_loops_refuses_other_arrays(name):
    operator = BUILDERS[name](np.float32)
    assert operator.portable == (name in PORTABLE)
    if not operator.portable:
        x, y = put("array_api_strict", *random_pair(operator, ()))
        for apply, operand in ((operator, x), (operator.adjoint, y)):
            with pytest.raises(
                InputError, match="works on NumPy arrays, not on array_api_strict's"
            ):
                apply(operand)
        assert is_numpy(operator(to_numpy(x)))


def test_composed_with_the_identity_an_operator_is_itself():
    operator = line_projection()
    assert Identity((37,)) @ operator is operator


def test_the_adjoint_of_the_adjoint_is_the_operator():
    operator = line_projection()
    assert operator.H.H is operator


@pytest.mark.parametrize(
    "build",
    [
        lambda: line_projection() @ line_projection(),
        lambda: Diagonal(np.ones(37), np.float64) @ line_projection(),
        lambda: Stack([]),
        lambda: Stack([line_projection(), Diagonal(np.ones((5, 7)))]),
        lambda: Stack([line_projection(), line_projection(np.float64)]),
        lambda: Diagonal([1.0, np.nan]),
        lambda: Diagonal(np.ones(3), np.int64),
        lambda: LineProjection((3, 3), 9, [1.0, 2.0], [0.0], [1.0]),
        lambda: LineProjection((0, 3), 9, [1.0], [0.0], [1.0]),
        lambda: LinearShear((9, 9), 3.0, (0, 3)),
        lambda: LinearShear((9, 9), np.nan, (0, 3)),
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
        lambda: Integration([]),
        lambda: Integration([DenseSensor((5, 7)), MeanWeighting([3, 1, 5])]),
        lambda: Integration([DenseSensor((5, 7)), DenseSensor((5, 7), np.float64)]),
        lambda: Identity((37,), np.float64) @ line_projection(),
        lambda: PitchedSensor((9, 9), (2, 2), (9, 0)),
        lambda: Selection((4, 4), (2,), [3, 3]),
        lambda: Selection((4, 4), (2,), [3, 16]),
        lambda: Selection((4, 4), (1,), [-1]),
    ],
)
def test_operators_that_do_not_fit_are_refused(build):
    with pytest.raises(TofclipError):
        build()
