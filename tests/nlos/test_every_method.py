"""What all methods promise alike: hidden points come back where they are; masked points, the order of
points, linearity, progress and history; and what none can image is refused in one line that says
what to do.
"""

import itertools
import warnings
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import (
    AXIS,
    HIDDEN,
    LONG,
    around,
    curved_wall,
    find_refusal,
    planar_wall,
    relative_error,
    see,
)

from nlos import (
    Backprojection,
    Capture,
    FilteredBackprojection,
    FKMigration,
    Grid,
    Hybrid,
    LightCone,
    PlanarRSD,
    Refinement,
    TransientImaging,
)
from nlos.backprojection import Weighting
from nlos.illumination import AliasingWarning
from tofclip.errors import InputError

LONGEST_LINE = 260
SPOT = [0.1, 0.05, 0.0]
GRID = Grid.box((-0.2, 0.2), (-0.2, 0.2), (0.4, 0.6), 0.05)
CONFOCAL = LightCone | FKMigration

PULSED = {
    "backprojection": Backprojection,
    "rsd": PlanarRSD,
    "hybrid": Hybrid,
    "refinement": lambda wavelength: Refinement(Hybrid(wavelength)),
    "gate": lambda wavelength: TransientImaging(Hybrid(wavelength)),
}
PLAIN = {"filtered": FilteredBackprojection(0.05), "light cone": LightCone(), "fk": FKMigration()}
EVERY = {**{name: make(0.4) for name, make in PULSED.items()}, **PLAIN}
every_method = pytest.mark.parametrize("method", EVERY.values(), ids=EVERY.keys())
pulsed_methods = pytest.mark.parametrize("make", PULSED.values(), ids=PULSED.keys())

PULSE = {"wavelength_m": 0.125, "cycles": 3.0}
SETTINGS = {
    "backprojection": (Backprojection(0.125), {**PULSE, "falloff": 1.0, "obliquity": 0.0}),
    "rsd": (PlanarRSD(0.125), {**PULSE, "tolerance": 1e-2}),
    "hybrid": (
        Hybrid(0.125, plane_z=0.1),
        {**PULSE, "tolerance": 1e-2, "propagation": "spectral", "plane_z_m": 0.1},
    ),
    "filtered backprojection": (
        FilteredBackprojection(0.05),
        {"sigma_m": 0.05, "falloff": 0.0, "obliquity": 0.0},
    ),
    "lightcone": (LightCone(), {"falloff": 4.0, "signal_to_noise": 0.8}),
    "fk": (FKMigration(), {"falloff": 4.0}),
}
"""Methods and what their volumes say of how they were made, by the name that they say."""
imagers = pytest.mark.parametrize("name", SETTINGS)


def see_point(name):
    """A hidden point before a planar wall."""
    return see([HIDDEN], planar_wall(), "confocal" if is_confocal(SETTINGS[name][0]) else SPOT)


def is_confocal(method):
    return isinstance(method, CONFOCAL)


def see_nothing(method, wall=None, signal=0.0):
    """An even capture, confocal for those that need it."""
    wall = planar_wall(9, 11) if wall is None else wall
    even = np.full((AXIS.bins, *wall.shape[:-1]), signal)
    return Capture(even, wall, wall if is_confocal(method) else SPOT, AXIS.bin_width, AXIS.start)


def imaging(method):
    """What a user calls to have an image."""
    if isinstance(method, TransientImaging):
        return lambda capture, grid: method.image_gate(capture, grid, 1e-9, 2e-9)
    return lambda capture, grid: method.reconstruct(capture, grid)


def refusal(method, capture, grid):
    """The reason given, which has to be one line, and the same whether asked or not."""
    with pytest.raises(InputError) as caught:
        imaging(method)(capture, grid)
    reason = str(caught.value)
    if hasattr(method, "plan"):
        assert find_refusal(method, capture, grid) == reason
    assert "\n" not in reason
    assert len(reason) < LONGEST_LINE
    return reason


@pytest.mark.parametrize(
    ("name", "curved", "laser"),
    [
        *itertools.product(
            ("backprojection", "filtered backprojection"),
            (False, True),
            ("single", "confocal", "paired"),
        ),
        *itertools.product(["hybrid"], [True], ("single", "confocal")),
        *itertools.product(["rsd"], [False], ("single", "confocal")),
    ],
)
@settings(max_examples=8)
@given(x=st.floats(-0.4, 0.4), y=st.floats(-0.35, 0.35), z=st.floats(0.4, 0.9))
def test_any_hidden_point_comes_back_where_it_is(name, curved, laser, x, y, z):
    """Transforms of confocal scans: see `test_confocal.py`."""
    # Pairs that are mirrored images of each other see few points sharply.
    point = HIDDEN if laser == "paired" else (x, y, z)
    grid, wall = around(point), curved_wall() if curved else planar_wall()
    found = SETTINGS[name][0].reconstruct(see([point], wall, laser, LONG), grid)
    assert found.values.dtype == np.float32
    assert found.values.shape == grid.shape
    assert found.values.min() >= 0
    # Voxels of a third of a wavelength: neighbours are clearly weaker.
    assert found.find_brightest() == pytest.approx(point)


@imagers
def test_masked_points_and_the_order_of_the_others_do_not_matter(name):
    method, capture = SETTINGS[name][0], see_point(name)
    wall, signal = capture.wall.copy(), capture.signal.copy()
    wall[3, 5] = wall[0, 0, 1] = np.nan
    signal[:, 3, 5] = 1e6
    laser = wall if capture.laser.ndim > 1 else capture.laser
    masked = replace(capture, wall=wall, signal=signal, laser=laser)
    order = np.random.default_rng(5).permutation(len(masked.points))
    points = masked.points[order]
    laser = points if capture.laser.ndim > 1 else capture.laser
    listed = replace(masked, wall=points, laser=laser, signal=masked.traces().T[:, order])
    found, expected = (method.reconstruct(one, GRID).values for one in (listed, masked))
    assert relative_error(found, expected) < 1e-5  # sums of float32 in another order


@pytest.mark.parametrize("name", ["backprojection", "rsd", "hybrid"])
def test_fields_are_linear_in_the_signal(name):
    method, capture, random = SETTINGS[name][0], see_point(name), np.random.default_rng(4)
    first, second = (
        replace(capture, signal=random.normal(size=capture.signal.shape)) for _ in range(2)
    )
    both = replace(capture, signal=2 * first.signal - 3 * second.signal)
    # What a method leaves out follows from the first signals that it sees: one plan for all.
    plan = method.plan(first, GRID)
    fields = [plan.field(one).values for one in (first, second, both)]
    assert relative_error(2 * fields[0] - 3 * fields[1], fields[2]) < 1e-5


@imagers
def test_progress_counts_the_cost_and_may_interrupt_and_the_volume_remembers(name):
    (method, settings), capture = SETTINGS[name], replace(see_point(name), provenance={"shot": 7})
    done = []
    volume = method.reconstruct(capture, GRID, done.append)
    assert sum(done) == method.plan(capture, GRID).cost
    assert volume.provenance == {"shot": 7, "imaging": {"method": name, **settings}}

    def interrupt(_):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        method.reconstruct(capture, GRID, interrupt)


@every_method
def test_what_none_can_image_is_refused(method):
    capture, behind = see_nothing(method), Grid(GRID.x, GRID.y, GRID.z - 0.8)
    lone = see_nothing(method, planar_wall(9, 11)[:1, :1])
    assert "one wall point cannot locate anything" in refusal(method, lone, GRID)
    assert "behind the hindmost wall point" in refusal(method, capture, behind)
    reason = refusal(method, capture, large_grid(10))
    assert "10.0 GiB" in reason
    assert "use larger voxels or a smaller box" in reason


def large_grid(size_gib):
    """So much at 12 bytes a voxel, evenly spaced, within the record."""
    across, along = (
        np.linspace(*ends, round((size_gib * 2**30 / 12) ** (1 / 3)))
        for ends in ((-0.2, 0.2), (0.4, 0.6))
    )
    return Grid(across, across, along)


def test_too_many_voxels_for_an_iteration():
    # A volume of 3 GiB is imaged at once, but not with the dozen volumes that a solver holds.
    method = EVERY["refinement"]
    assert not find_refusal(Hybrid(0.4), see_nothing(method), large_grid(3))
    assert "to refine" in refusal(method, see_nothing(method), large_grid(3))


@pulsed_methods
def test_an_empty_band(make):
    method = make(2 * AXIS.spacing)
    reason = refusal(method, see_nothing(method), Grid(GRID.x, GRID.y, [0.4]))
    assert reason.startswith("empty band: time bins of")
    assert "use more than" in reason


@pulsed_methods
def test_a_wall_that_is_too_coarse_is_warned_of_in_one_line(make):
    method, grid = make(0.15), Grid.box((0, 0.05), (0, 0.05), (0.4, 0.45), 0.025)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        imaging(method)(see_nothing(method, signal=1.0), grid)
    (warning,) = caught
    assert warning.category is AliasingWarning
    message = str(warning.message)
    assert "\n" not in message
    assert len(message) < LONGEST_LINE
    assert "use points at most" in message


@pytest.mark.parametrize(
    ("make", "arguments", "message"),
    [
        *((Backprojection, {"wavelength": wave}, "virtual pulse") for wave in (0, -1, np.nan)),
        *((Hybrid, {"wavelength": 0.1, "cycles": n}, "virtual pulse") for n in (0, -1, np.inf)),
        (Hybrid, {"wavelength": 0.1, "propagation": "fast"}, "unknown propagation"),
        *((PlanarRSD, {"wavelength": 0.1, "tolerance": t}, "tolerance") for t in (0, 1, np.nan)),
        *((FilteredBackprojection, {"sigma": sigma}, "sigma") for sigma in (0, -1, np.nan)),
        *(
            (kind, {"falloff": f}, "falloff")
            for kind in (LightCone, FKMigration)
            for f in (-1, np.nan)
        ),
        (LightCone, {"signal_to_noise": 0}, "signal_to_noise"),
        (Weighting, {"falloff": np.nan}, "weights"),
        *((Weighting, {"falloff": 1, "obliquity": o}, "weights") for o in (-1, np.inf)),
    ],
)
def test_settings_are_checked_at_once(make, arguments, message):
    with pytest.raises(InputError, match=message):
        make(**arguments)
