"""A film of all frames, made without a screen."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from apps.mp4 import open_film
from apps.viewer.render import Renderer
from apps.viewer.scene_figure import SceneFigure
from apps.viewer.session import Session
from tofclip.errors import InputError

MAX_FRAME_RATE_HZ = 15.0
MAX_FILM_FRAMES = 1500
"""A minute; live sources never end."""


def choose_frames(session: Session) -> list[int]:
    """Return the frames of a film at natural speed: at most 15 a second, and none twice."""
    source = session.source
    count = len(source)
    pictures = min(MAX_FILM_FRAMES, count, max(1, round(count / source.rate * MAX_FRAME_RATE_HZ)))
    return [int(frame) for frame in np.linspace(source.oldest, count - 1, pictures).round()]


def save_film(
    session: Session, renderer: Renderer, out: Path, advance: Callable[[int], None]
) -> int:
    """Write a film, whole or not at all.

    Parameters
    ----------
    session : Session
    renderer : Renderer
    out : Path
        Ends in ``.mp4``.
    advance : callable
        Called with 1 after every picture.

    Returns
    -------
    int
        The largest number of points in a picture.

    Raises
    ------
    InputError, MissingDependencyError, StorageError
    """
    whole = session.frame_at(0.0)  # a transient begins at its end: with all of its points
    still, most, frames = (
        SceneFigure(session.title, whole, renderer),
        0,
        choose_frames(session),
    )
    rate = min(MAX_FRAME_RATE_HZ, session.source.rate)
    if not frames:
        raise InputError(f"{session.source.title}: there is nothing to film")
    with open_film(out, rate) as film:
        for frame in frames:
            # The clock stands still, so that the frame that is due is the one jumped to.
            session.jump(frame)
            shown = session.frame_at(0.0)
            film.add(still.pixels(shown))
            most = max(most, len(shown.cloud))
            advance(1)
    return most
