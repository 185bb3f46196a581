"""How something is looked at, in a file that can be handed on: sources, frame, settings, colours,
filters and viewpoint.
"""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from apps.viewer.look import Colouring
from apps.viewer.session import Filters, Section, Session
from apps.viewer.viewpoint import Viewpoint
from tofclip.errors import FileFormatError

KIND = "tofclip view"


def write_state(session: Session, viewpoint: Viewpoint) -> str:
    """Return the state of a session, seen from a viewpoint, as JSON."""
    eye, target = viewpoint.eye.tolist(), viewpoint.target.tolist()
    state = {
        "kind": KIND,
        **session.opened,
        "frame": session.clock.frame + 1,
        "settings": [setting.value for setting in session.source.settings],
        "colouring": asdict(session.colouring),
        "filters": asdict(session.filters),
        "point_size_m": session.point_size,
        "viewpoint": [eye, target, viewpoint.field_of_view],
    }
    return json.dumps(state, indent=1)


def read_state(path: Path) -> dict[str, Any]:
    """Read a state; sources that are not where they were are looked for beside the file."""
    try:
        state = json.loads(path.read_text())
        is_one = state["kind"] == KIND and isinstance(state["sources"], list)
    except (ValueError, KeyError, TypeError):
        is_one = False
    if not is_one:
        raise FileFormatError(path, "is not a state that 'save state' of tofclip view wrote")
    beside = [path.parent / Path(name).name for name in state["sources"]]
    state["sources"] = [
        str(near) if "://" not in name and not Path(name).exists() else name
        for name, near in zip(state["sources"], beside, strict=True)
    ]
    return dict(state)


def restore_state(session: Session, state: dict[str, Any], path: Path) -> None:
    """Bring a session of the same sources into a state."""
    try:
        for setting, value in zip(session.source.settings, state["settings"], strict=True):
            setting.value = value
        colouring, filters = state["colouring"], state["filters"]
        limits, section = colouring["limits"], filters["section"]
        session.colouring = Colouring(**{**colouring, "limits": limits and tuple(limits)})
        kept = {name: tuple(one) for name, one in filters["limits"].items()}
        session.filters = Filters(kept, section and Section(**section))
        session.point_size = state["point_size_m"]
        eye, target, field_of_view = state["viewpoint"]
        session.viewpoint = Viewpoint(np.array(eye), np.array(target), field_of_view)
        session.clock.jump(state["frame"] - 1)
    except (KeyError, TypeError, ValueError) as fault:
        raise FileFormatError(path, f"does not fit its sources: {fault}") from fault
