"""A capture imaged as its settings ask: what they leave open is found, coarse voxels tell where the
scene is bright, and that part is imaged.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from typing import Any, Generic

from nlos.band import VirtualPulse
from nlos.capture import Capture
from nlos.completion import complete_settings, find_bright_box, find_scout
from nlos.evidence import measure_evidence
from nlos.method import Plan
from nlos.resolution import compute_diffraction_limit
from nlos.settings import METHODS_BY_SPEED, Settings, Wanted, list_taken
from nlos.volume import Grid, Volume
from tofclip.arrays import ComputeDevice

Draw = Callable[[str, Plan, Capture], Volume]
"""Images a capture by a plan, under a title that a progress bar may show."""


def draw_silently(title: str, plan: Plan, capture: Capture) -> Volume:
    """Image a capture and show nothing meanwhile."""
    return plan.image(capture)


@dataclass(frozen=True, eq=False)
class PreparedImaging(Generic[Wanted]):
    """A capture ready to be imaged, with every setting known."""

    capture: Capture  # gated, its bins put together
    grid: Grid
    settings: Wanted
    recorded: Capture  # as it came
    scouted: tuple[Plan, Volume] | None  # coarse voxels that were looked over

    def describe(self, volume: Volume) -> Volume:
        """Return the volume that was imaged, its provenance under ``imaging`` completed by the
        settings with their reasons, `evidence`, and for a virtual pulse `resolution_m`, widths of a
        point's image where the volume is brightest.
        """
        described = {**volume.provenance.get("imaging", {}), "settings": self.settings.to_dict()}
        described["evidence"] = self.measure_evidence()
        if "wavelength" in list_taken(self.settings.method or METHODS_BY_SPEED[0]):
            pulse = VirtualPulse(self.settings.wavelength or 0.0, self.settings.cycles)
            widths = compute_diffraction_limit(self.capture, volume.find_brightest(), pulse)
            described["resolution_m"] = asdict(widths)
        return replace(volume, provenance={**volume.provenance, "imaging": described})

    def measure_evidence(self) -> float:
        """How much brighter the coarse picture's brightest is than that of shuffled copies."""
        scouted = self.scouted
        if scouted is None:
            coarse = find_scout(self.capture, replace(self.settings, everywhere=False))
            settings, grid = coarse or (self.settings, self.grid)
            plan = settings.plan_quickest(self.capture, grid)[1]
            scouted = plan, plan.image(self.capture)
        return measure_evidence(self.capture, *scouted)


def prepare_imaging(
    recorded: Capture,
    wanted: Wanted,
    device: ComputeDevice | None = None,
    draw: Draw = draw_silently,
) -> PreparedImaging[Wanted]:
    """Find every setting that is not given, and the voxels: all that the box holds, or the part
    that coarse voxels show to be bright. By default it computes where the capture is.
    """
    found = complete_settings(recorded, wanted)
    capture = found.prepare(recorded)
    if device is not None:
        capture = capture.on(device)
    scout, scouted = find_scout(capture, found), None
    if scout is not None or found.method is None:
        coarse, grid = scout or (found, found.grid())
        quickest, plan = coarse.plan_quickest(capture, grid)
        found = found if found.method else found.with_method(quickest)
    if scout is not None:
        scouted = plan, draw("looking over", plan, capture)
        found = find_bright_box(found, scouted[1])
    found = replace(found, everywhere=True)
    return PreparedImaging(capture, found.grid(), found, recorded, scouted)


def reconstruct(capture: Capture, **given: Any) -> Volume:
    """Image the hidden scene as ``tofclip nlos reconstruct`` does by default.

    Parameters
    ----------
    capture : Capture
        As it was recorded.
    **given
        Fields of `Settings` that are known, lengths in m; the others are found.

    Returns
    -------
    Volume
        The part of the space before the wall that is bright. ``provenance["imaging"]`` names the ``settings``
        with the reasons for what was found; ``evidence``, how much brighter the picture's brightest
        is than that of shuffled copies of the capture, about 1 where there is nothing; and
        ``resolution_m``, how wide a point's image is where the volume is brightest.

    Raises
    ------
    InputError
        No picture can come of the capture, or not with what is given.

    Examples
    --------
    >>> import numpy as np, nlos
    >>> from nlos.simulate import PointScene
    >>> x, y = np.meshgrid(np.linspace(-0.5, 0.5, 16), np.linspace(-0.5, 0.5, 16))
    >>> wall, scene = np.stack([x, y, 0 * x], axis=-1), PointScene([[0.1, -0.2, 0.8]])
    >>> axis = nlos.capture.TimeAxis(256, 40e-12)
    >>> volume = nlos.reconstruct(scene.simulate_capture(wall, np.zeros(3), axis, 200e-12))
    >>> bool(abs(volume.find_brightest()[2] - 0.8) < 0.1)
    True
    """
    prepared = prepare_imaging(capture, Settings(**given))
    method = prepared.settings.make_method()
    return prepared.describe(method.reconstruct(prepared.capture, prepared.grid))
