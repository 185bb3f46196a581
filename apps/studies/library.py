"""Light fields that studies look at: rendered ones, and recorded ones where their folder is given."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofclip.errors import InputError
from tofclip.io.light_fields import read_light_field
from tofclip.light_field import LightField
from tofclip.simulate.light_fields import CameraArray, make_scene, render_light_field, render_view
from tofclip.simulate.light_fields.scenes import EDITS, edit_scene, remove_occluder


class Library:
    """Light fields by name, each rendered or read once.

    Parameters
    ----------
    data : Path, optional
        Folder of recorded data, whose ``lightfields`` holds NPZ light fields.
    array : CameraArray, optional
        Cameras of the rendered ones; the paper's 8 x 8 views of 128 x 128 pixels unless given.
    """

    def __init__(self, data: Path | None = None, array: CameraArray | None = None) -> None:
        self.data, self.array = data, array or CameraArray()
        self._cache: dict[str, LightField] = {}

    def light_field(self, name: str) -> LightField:
        """Return the light field of a scene.

        Parameters
        ----------
        name : str
            A name of `tofclip.simulate.light_fields.SCENES`, ``NAME:EDIT`` with an edit of the flip
            test, ``NAME:4x4`` for its middle sixteen views, ``NAME:flat`` for its reference view as
            a poster at s = 0, or ``data:NAME`` for a recorded one.
        """
        if name not in self._cache:
            self._cache[name] = self._make_light_field(name)
        return self._cache[name]

    def render_unoccluded(self, name: str) -> NDArray[Any]:
        """Return what the reference view sees of an occlusion scene when its occluder is gone."""
        return render_view(remove_occluder(make_scene(name, self.array)), self.array, (0.0, 0.0))

    def has_recording(self, name: str) -> bool:
        """Tell whether the folder of recorded data holds a file."""
        return self.data is not None and (self.data / name).is_file()

    def recording(self, name: str) -> Path:
        """Return the path of a file of the folder of recorded data.

        Raises
        ------
        InputError
            No folder was given.
        """
        if self.data is None:
            raise InputError(f"{name} is recorded data; name the folder that holds it by --data")
        return self.data / name

    def _make_light_field(self, name: str) -> LightField:
        scene, _, variant = name.partition(":")
        if scene == "data":
            return read_light_field(self.recording(f"lightfields/{variant}.npz"))
        if variant == "4x4":
            whole = self.light_field(scene)
            middle = np.all((whole.views >= -2) & (whole.views < 2), axis=1)
            return LightField(whole.pictures[middle], whole.views[middle])
        known = make_scene(scene, self.array)
        if variant == "flat":
            views = self.array.views
            poster = render_view(known, self.array, (0.0, 0.0))
            return LightField(np.broadcast_to(poster, (len(views), *poster.shape)), views)
        return render_light_field(
            edit_scene(known, variant) if variant in EDITS else known, self.array
        ).light_field
