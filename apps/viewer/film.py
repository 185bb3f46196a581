"""A film of all frames, made without a screen."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from apps.mp4 import filming
from apps.viewer.picture import Still
from apps.viewer.render import Renderer
from apps.viewer.session import Session
from tofclip.errors import InputError

PICTURES_PER_SECOND = 15.0
MOST_PICTURES = 1500
"""A minute; live sources never end."""


def frames_of(session: Session) -> list[int]:
    """Return the frames of a film at natural speed: at most 15 a second, and none twice."""
    source = session.source
    count = len(source)
    pictures = min(MOST_PICTURES, count, max(1, round(count / source.rate * PICTURES_PER_SECOND)))
    return [int(frame) for frame in np.linspace(source.oldest, count - 1, pictures).round()]


def save_film(session: Session, renderer: Renderer, out: Path, advance: Callable[[int], None]) -> int:
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
    whole = session.shown(0.0)  # a transient begins at its end: with all of its points
    still, most, frames = Still(session.source.title, whole, renderer), 0, frames_of(session)
    rate = min(PICTURES_PER_SECOND, session.source.rate)
    if not frames:
        raise InputError(f"{session.source.title}: there is nothing to film")
    with filming(out, rate) as film:
        for frame in frames:
            session.jump(frame)
            shown = session.shown(0.0)
            film.add(still.pixels(shown))
            most = max(most, len(shown.cloud))
            advance(1)
    return most
