"""Settings of imaging around corners and of simulated scenes, declared once for the command line and for
Python: name, unit, meaning and default of each.

What is not given is found by `nlos.imaging`. Importing this loads nothing heavy.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any, TypeVar

from tofclip.errors import InputError
from tofclip.plugins import Parts, list_settings, split_assignments

if TYPE_CHECKING:
    from nlos.capture import Capture
    from nlos.method import Method, Plan
    from nlos.volume import Grid

Limits = tuple[float, float]
Wanted = TypeVar("Wanted", bound="Settings")

SCANS = ("single", "confocal")
WALLS = ("planar", "cylinder", "wavy", "relief", "plates")  # those of `nlos.simulate`
MATERIALS = ("matte", "retroreflecting")
METHODS = Parts(
    "nlos.methods",
    "method",
    {
        "rsd": "nlos.phasor.plan:PlanarRSD",
        "hybrid": "nlos.phasor.plan:Hybrid",
        "backprojection": "nlos.backprojection:Backprojection",
        "filtered-backprojection": "nlos.backprojection:FilteredBackprojection",
        "lct": "nlos.confocal:LightCone",
        "fk": "nlos.confocal:FKMigration",
    },
)
register_method = METHODS.register
# They give the same picture; the later one takes more walls and lasers, and more time.
METHODS_BY_SPEED = ("rsd", "hybrid", "backprojection")
# An image by waves takes as long as to back-project this many pairs of spots; measured. One is
# made for every laser spot, or two for every wall point that sees many.
MIN_PAIRS_PER_IMAGE = 250


def declare_setting(
    unit: str, meaning: str, default: Any = None, shown: str | None = None, **more: Any
) -> Any:
    """Declare a setting: its unit, what it means, and in words what it is where it is not given."""
    shown = str(default) if shown is None else shown
    metadata = {"unit": unit, "help": meaning, "shown": shown, **more}
    return dataclasses.field(default=default, metadata=metadata)


@dataclass(frozen=True)
class Settings:
    """How a capture is imaged; None is found by `settings_for`.

    What is done to the capture first: `flip`, `gate`, `gate_ramp`, `fade`, `bins_together`; the
    virtual pulse: `wavelength`, `cycles`; the voxels: `voxel`, and their box, `x`, `y`, `near`,
    `far`, `everywhere`; the `method`, a name of `METHODS`, and its own settings, of which None
    is left to it: `tolerance`, `sigma`, `falloff`, `signal_to_noise`, and in `set` what only it knows, as
    ``"name=value"``. The metadata of each field
    hold its ``unit``, its meaning (``help``), in words the default (``shown``), and the unit that it
    is ``written`` with on the command line where that is another. `gate_found`
    tells whether the gate was found from the capture, and `reasons`, by the names of settings, why
    those that were found are what they are.
    """

    wavelength: float | None = declare_setting(
        "m",
        "Carrier of the virtual pulse.",
        shown="the shortest that wall points and time bins carry, and that stands out of the noise",
        written="mm",
    )
    cycles: float = declare_setting(
        "wavelengths", "Length of the virtual pulse in wavelengths.", 3.0
    )
    voxel: float | None = declare_setting(
        "m",
        "Distance of neighbouring voxels.",
        shown="an eighth of the wavelength; lct, fk: a third of the path of a bin",
        written="mm",
    )
    near: float | None = declare_setting(
        "m",
        "First depth.",
        shown="one voxel beyond the middle of the wall's relief, and of the gate",
    )
    far: float | None = declare_setting(
        "m", "Last depth.", shown="as far as the record reaches, at most two wall widths"
    )
    x: tuple[float, float] | None = declare_setting("m", "First and last x.", shown="the wall's")
    y: tuple[float, float] | None = declare_setting(
        "m", "First and last y; y points down.", shown="the wall's"
    )
    everywhere: bool = declare_setting(
        "",
        "Fill all of that box with voxels, not only the part that coarse ones find bright.",
        False,
        shown="no",
    )
    flip: str | None = declare_setting(
        "", "Mirror the picture along x or y.", shown="no", choices=("x", "y")
    )
    gate: float | None = declare_setting(
        "m",
        "Blank what arrives up to so much path after the wall's own light.",
        shown="until it has faded, where the record holds it",
    )
    gate_ramp: float | None = declare_setting(
        "m", "Signals rise over so much path after the gate.", shown="a quarter of a gate found"
    )
    fade: float | None = declare_setting(
        "m",
        "Signals fade out over so much path before the record ends.",
        shown="a tenth of the record, where light still comes then",
    )
    bins_together: int | None = declare_setting(
        "bins", "Time bins added up to one before imaging.", shown="while a wavelength keeps 16"
    )
    tolerance: float | None = declare_setting(
        "1", "Error allowed for the sake of speed: rsd, hybrid.", shown="0.01"
    )
    sigma: float | None = declare_setting(
        "m",
        "Width of the Laplacian: filtered-backprojection.",
        shown="a quarter of the wavelength",
        written="mm",
    )
    falloff: float | None = declare_setting(
        "1",
        "How light fades with distance: lct, fk; 4 for matte things, 2 for retroreflecting ones.",
        shown="4",
    )
    signal_to_noise: float | None = declare_setting("1", "Of the Wiener filter: lct.", shown="0.8")
    method: str | None = declare_setting(
        "",
        f"One of {', '.join(METHODS.own)}.",
        shown="the quickest that suits the capture",
        choices=METHODS,
    )
    set: list[str] | None = declare_setting(  # noqa: RUF009 - declares a field
        "",
        "A further setting of the method, which tofclip plugins NAME lists; may be given again.",
        shown="its own",
    )
    gate_found: bool = False
    reasons: Mapping[str, str] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.set and self.method is None:
            raise InputError("settings of one method are given (`set`): name it (`method`)")

    @property
    def box(self) -> tuple[Limits, Limits, Limits]:
        """First and last voxel along x, y and z, m."""
        x, y, near, far = self.x, self.y, self.near, self.far
        if x is None or y is None or near is None or far is None:
            raise InputError("these settings have no box yet; complete them by settings_for")
        return x, y, (near, far)

    def prepare(
        self, capture: Capture, join: Callable[[Capture], Capture] | None = None
    ) -> Capture:
        """Mirror a ``capture``'s coordinates, blank the wall's own light and put time bins together, as settings
        say.

        Of laser spots and wall points the fewer come as laser spots: a wave is imaged for each,
        and seen from a lone detector all of its surroundings would be bright. ``join`` brings pairs to
        their midpoints: `nlos.preparation.MidpointJoin.join` for many captures of one geometry.
        """
        from nlos import preparation
        from nlos.illumination import choose_roles

        capture = choose_roles((join or preparation.join_near_lasers)(capture))
        if self.gate is not None:
            capture = preparation.remove_first_bounce(capture, self.gate, self.gate_ramp or 0.0)
        if self.fade:
            capture = preparation.fade_record_end(capture, self.fade)
        return self.prepare_counts(capture)

    def prepare_counts(self, capture: Capture) -> Capture:
        """Do what `prepare` does to a ``capture``, but what is counted stays counted: no blanking."""
        from nlos.preparation import flip_capture, rebin_capture

        flipped = flip_capture(capture, self.flip) if self.flip else capture
        bins = 1 if self.bins_together is None else self.bins_together
        return flipped if bins == 1 else rebin_capture(flipped, bins)

    def grid(self, voxel: float | None = None) -> Grid:
        """Fill the box with voxels, of the settings' size unless ``voxel`` (m) says otherwise."""
        from nlos.volume import Grid

        return Grid.box(*self.box, self.voxel_size if voxel is None else voxel)

    @property
    def voxel_size(self) -> float:
        """Distance of voxels, m; NaN, which every grid refuses, where it is not known yet."""
        return math.nan if self.voxel is None else self.voxel

    def make_method(self, name: str | None = None) -> Method:
        """Build a method by its ``name``, the settings' own by default; what is None is left to it."""
        chosen = name or self.method or METHODS_BY_SPEED[0]
        given = {key: getattr(self, key) for key in list_taken(chosen)}
        own = split_assignments(self.set or ()) if chosen == self.method else {}
        made: Method = METHODS.make(
            chosen, {key: one for key, one in given.items() if one is not None} | own
        )
        return made

    def plan_quickest(self, capture: Capture, grid: Grid) -> tuple[str, Plan]:
        """Return the first method that takes a ``capture``, as `prepare` returns it, and a ``grid``, and does not
        take longer than the last one, and its plan. `InputError`: none of them can image it, for the
        reason of the last.
        """
        *quicker, last = METHODS_BY_SPEED
        for name in quicker:
            try:
                plan = self.make_method(name).plan(capture, grid)
            except InputError:
                continue
            if plan.images == 1 or plan.images * MIN_PAIRS_PER_IMAGE <= len(capture.points):
                return name, plan
        return last, self.make_method(last).plan(capture, grid)

    def with_found(self: Wanted, name: str, value: Any, reason: str = "") -> Wanted:
        """Return the settings with the ``value`` that was found for ``name``, if it was not given, and
        the ``reason``.
        """
        if (given := getattr(self, name)) is not None and given is not False:
            return self
        reasons = {**self.reasons, name: reason} if reason else self.reasons
        return replace(self, **{name: value}, reasons=reasons)

    def to_dict(self) -> dict[str, Any]:
        """Name every setting that has a value."""
        return {name: value for name, value in asdict(self).items() if value is not None}


@dataclass(frozen=True)
class SceneSettings:
    """What is hidden before which wall, how it is scanned, and the instrument with its noise. The
    metadata of each field are those of `nlos.Settings`.
    """

    letters: str | None = declare_setting(
        "", "Flat letters, as read from the wall.", shown="T, if nothing else is given"
    )
    points: str | None = declare_setting("", "Points that scatter evenly, in m.", shown="none")
    mesh: str | None = declare_setting(
        "", "Triangle mesh (.ply, .obj, .stl) in m, in the wall's frame.", shown="none"
    )
    depth: float = declare_setting("m", "Depth of the letters.", 1.0)
    height: float = declare_setting("m", "Height of a capital letter.", 0.7)
    material: str = declare_setting(
        "", f"Of letters or mesh: {' or '.join(MATERIALS)}.", "matte", choices=MATERIALS
    )
    facet: float = declare_setting(
        "m", "Size of the facets that letters or mesh are cut into.", 0.025, written="mm"
    )
    wall: str = declare_setting(
        "",
        "planar, cylinder, wavy, relief (hills) or plates (two, hanging apart).",
        "cylinder",
        choices=WALLS,
    )
    wall_points: int = declare_setting("1", "Rows of wall points, and columns.", 48)
    wall_width: float = declare_setting("m", "Width and height of the wall.", 2.0)
    scan: str = declare_setting("", "single (one laser spot) or confocal.", "single", choices=SCANS)
    laser: tuple[float, float] = declare_setting(
        "m", "Where the laser spot is, in m; the nearest wall point is taken.", (0.0, 0.0)
    )
    bin_width: float = declare_setting("s", "Duration of a time bin.", 32e-12, written="ps")
    jitter: float = declare_setting(
        "s", "Standard deviation of the instrument's response.", 30e-12, written="ps"
    )
    peak_counts: float | None = declare_setting(
        "1", "Expected photons in the brightest bin.", shown="no noise"
    )
    background: float = declare_setting(
        "1", "Expected background counts per bin, with --peak-counts.", 0.0
    )
    seed: int = declare_setting("1", "Of the photons' chance.", 0)


def list_taken(method: str) -> list[str]:
    """Return the fields of `Settings` that a method takes, by its name."""
    known = {one.name for one in dataclasses.fields(Settings)}
    return [name for name in list_settings(METHODS[method]) if name in known]
