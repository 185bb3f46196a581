"""A capture, imaged as settings ask: what is open is found by `nlos.settings`, every image has a
bar.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Generic

from apps.nlos.methods import Imaging, from_library, to_library
from apps.progress import show_progress

if TYPE_CHECKING:
    from nlos import Capture, Grid, Plan, Settings, Volume
    from tofclip.arrays import ComputeDevice


@dataclass(frozen=True, eq=False)
class PreparedImaging(Generic[Imaging]):
    """A capture ready to be imaged, with every setting known.

    Parameters
    ----------
    capture : Capture
        Gated, its bins put together.
    grid : Grid
    settings : Settings
        As the library has them.
    shown : ImagingSettings
        As the command line has them; given back, they lead here again.
    """

    capture: Capture
    grid: Grid
    settings: Settings
    shown: Imaging


def prepare_imaging(
    recorded: Capture,
    wanted: Imaging,
    methods: Sequence[str] | None = None,
    device: ComputeDevice | None = None,
) -> PreparedImaging[Imaging]:
    """Find every setting that is not given, and the voxels: all that the box holds, or the part
    that coarse voxels show to be bright.

    Parameters
    ----------
    recorded : Capture
    wanted : ImagingSettings
    methods : sequence of str, optional
        That will image; by default the one in the settings, or the quickest.
    device : ComputeDevice, optional
        Where to compute; where the capture is by default.
    """
    from nlos.sampling import AliasingWarning
    from nlos.settings import complete_settings, find_bright_box, scout_grid

    given = to_library(wanted).to_dict()
    if methods:
        given["method"] = methods[0]
    given = {name: value for name, value in given.items() if name not in ("reasons", "gate_found")}
    found = complete_settings(recorded, **given)
    capture = found.prepare(recorded)
    if device is not None:
        capture = capture.on(device)
    if found.reasons.get("wavelength"):
        # It was chosen with the wall's sampling in mind.
        warnings.simplefilter("ignore", AliasingWarning)
    coarse = scout_grid(found)
    if coarse is not None or found.method is None:
        quickest, plan = found.plan_quickest(capture, coarse or found.grid())
        found = found if found.method else found.with_method(quickest)
    if coarse is not None:
        found = find_bright_box(found, image_capture("looking over", plan, capture))
    found = replace(found, everywhere=True)
    shown = from_library(wanted, found, methods or [found.method or ""])
    return PreparedImaging(capture, found.grid(), found, shown)


def image_capture(title: str, plan: Plan, capture: Capture) -> Volume:
    """Image the hidden scene under a progress bar that counts look-ups or voxels, whichever the
    plan does.
    """
    with show_progress(title, plan.cost) as advance:
        return plan.image(capture, advance)


@contextmanager
def warnings_to_stderr() -> Iterator[None]:
    """Print what the methods warn of on standard error, each warning once and on one line."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        yield
    for text in dict.fromkeys(str(one.message) for one in caught):
        print(f"tofclip: warning: {' '.join(text.split())}", file=sys.stderr)
