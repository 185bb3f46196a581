"""What stands around the points on the page: a box with the lengths of its sides, a scale bar, the
axes, and the clip box with its handles.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from apps.viewer.colouring import format_length
from apps.viewer.viewpoint import Box

if TYPE_CHECKING:
    import viser

BOX_COLOUR, BOX_LINE_PX = (139, 147, 163), 1.0
SCALE_BAR_COLOUR, SCALE_BAR_PX = (235, 238, 245), 4.0
CLIP_COLOUR = (255, 176, 32)
AXES_FRACTION = 0.12
"""Length of the axes, and of the clip box's handles, of half the box's diagonal."""

POINTING_INWARDS = (0.0, 0.5**0.5, -(0.5**0.5), 0.0)
"""Quaternion, w x y z: half a turn after which the arrows at the high corner point into the box."""

LABEL_SCALE = 0.9
AXIS_COLOURS = ((229, 72, 77), (70, 167, 88), (62, 142, 208))


def draw_furniture(scene: viser.SceneApi, box: Box) -> list[Any]:
    """Draw box, scale bar and axes around a cloud.

    `box`: of the cloud. Returns to be shown and hidden together.
    """
    drawn: list[Any] = [_add_lines(scene, "/box", box.corners[np.array(box.edges)], BOX_COLOUR)]
    for name, length_m, place in zip("xyz", box.high - box.low, box.length_marks, strict=True):
        words = f"{name} {format_length(float(length_m))}"
        anchor = "top-right" if name == "z" else "top-left"  # z is written at the right
        drawn.append(_add_label(scene, f"/box_{name}", words, place, anchor))
    bar = box.scale_bar
    if (length_m := float(bar[1, 0] - bar[0, 0])) > 0:
        drawn.append(_add_lines(scene, "/scale", bar[np.newaxis], SCALE_BAR_COLOUR, SCALE_BAR_PX))
        words = format_length(length_m)
        drawn.append(_add_label(scene, "/scale_length", words, bar.mean(axis=0), "top-center"))
    return drawn + _draw_axes(scene, box)


def _draw_axes(scene: viser.SceneApi, box: Box) -> list[Any]:
    """Name x, y and z at the far lower left corner, which is nearly always in the picture; small."""
    origin = np.array([box.low[0], box.high[1], box.high[2]])
    ends = origin + _measure_reach(box) * AXES_FRACTION * np.eye(3)
    drawn = []
    for axis, (name, colour) in enumerate(zip("xyz", AXIS_COLOURS, strict=True)):
        ray = np.stack([origin, ends[axis]])[np.newaxis]
        drawn.append(_add_lines(scene, f"/axes_{name}", ray, colour, 2.0))
        drawn.append(_add_label(scene, f"/axes_{name}_name", name, ends[axis], "center-center"))
    return drawn


class ClipBox:
    """A box in the scene whose two opposite corners can be dragged; points outside are not shown.

    `changed`: called with the box after a corner was dragged.
    """

    def __init__(self, scene: viser.SceneApi, changed: Callable[[Box], None]) -> None:
        self._scene, self._changed = scene, changed
        self._handles: list[Any] = []

    @property
    def is_shown(self) -> bool:
        """Whether there are handles to drag."""
        return bool(self._handles)

    def show(self, box: Box) -> None:
        """Draw the box with its handles."""
        self._draw_edges(box)
        corners = {"low": box.low, "high": box.high}
        turns = {"low": (1.0, 0.0, 0.0, 0.0), "high": POINTING_INWARDS}
        if self._handles:
            for handle, corner in zip(self._handles, corners.values(), strict=True):
                handle.position = corner
            return
        for name, corner in corners.items():
            handle = self._scene.add_transform_controls(
                f"/clip/{name}",
                scale=2 * AXES_FRACTION * _measure_reach(box),
                disable_rotations=True,
                disable_sliders=True,
                depth_test=False,
                position=corner,
                wxyz=turns[name],
            )
            handle.on_update(lambda _: self._report())
            self._handles.append(handle)

    def hide(self) -> None:
        """Take the box and its handles away."""
        for handle in self._handles:
            handle.remove()
        self._handles = []
        if self._scene.get_handle_by_name("/clip/box") is not None:
            self._scene.remove_by_name("/clip/box")

    def _report(self) -> None:
        corners = np.stack([np.asarray(handle.position, float) for handle in self._handles])
        # a corner may be dragged past the other
        box = Box(corners.min(axis=0), corners.max(axis=0))
        self._draw_edges(box)
        self._changed(box)

    def _draw_edges(self, box: Box) -> None:
        _add_lines(self._scene, "/clip/box", box.corners[np.array(box.edges)], CLIP_COLOUR)


def _measure_reach(box: Box) -> float:
    return max(float(np.linalg.norm(box.high - box.low)) / 2, 0.01)


def _add_lines(
    scene: viser.SceneApi,
    name: str,
    ends: NDArray[Any],
    colour: tuple[int, int, int],
    width_px: float = BOX_LINE_PX,
) -> Any:
    points = ends.astype(np.float32)
    return scene.add_line_segments(
        name, points, colour, thickness=width_px, thickness_units="screen"
    )


def _add_label(
    scene: viser.SceneApi, name: str, text: str, position: NDArray[Any], anchor: Any = "top-left"
) -> Any:
    return scene.add_label(
        name, text, position=position, anchor=anchor, font_screen_scale=LABEL_SCALE
    )
