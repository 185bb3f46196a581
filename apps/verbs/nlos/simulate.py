"""`tofclip nlos simulate`: the capture that an instrument would make of a known hidden scene."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from apps.conventions import (
    RECORD_SUFFIXES,
    JsonOption,
    build_provenance,
    name_beside,
    report,
    require_writable,
)
from apps.nlos.scene import SceneSettings, simulate_scene
from apps.settings import (
    SettingsOption,
    add_setting_flags,
    load_settings,
    save_settings,
    settings_to_dict,
)

SETTINGS_HEADING = "tofclip nlos simulate --settings THIS --out CAPTURE"


@add_setting_flags(SceneSettings)
def simulate(
    out: Annotated[Path, typer.Option(metavar="H5", help="The capture to write.")],
    settings: SettingsOption = None,
    as_json: JsonOption = False,
    **flags: Any,
) -> None:
    """Simulate the capture of a known hidden scene before a relay wall.

    Letters and meshes hide what is behind them; light that meets several surfaces is left out. The
    capture carries the truth, for nlos compare. The settings are written beside it (.toml).

    Example: tofclip nlos simulate --letters T --wall cylinder --wall-points 32 --out capture.h5
    """
    chosen = load_settings(SceneSettings, settings, flags)
    inputs = [Path(path) for path in (settings, chosen.mesh) if path]
    beside = name_beside(out, ".toml")
    require_writable(out, *RECORD_SUFFIXES, inputs=inputs)
    require_writable(beside, inputs=inputs)
    started = time.perf_counter()
    capture, truth = simulate_scene(chosen)
    past = build_provenance(
        {"verb": "nlos simulate", **settings_to_dict(chosen)}, *inputs, earlier=capture.provenance
    )
    truth.attach_to_record(replace(capture, provenance=past)).save(out)
    save_settings(chosen, beside, SETTINGS_HEADING)
    figures = {
        "wall_points": len(capture.points),
        "bins": capture.axis.bins,
        "path_m": [float(capture.axis.paths[0]), float(capture.axis.paths[-1])],
        "hidden_facets": len(truth.positions),
        "largest": float(capture.signal.max()),
        "total": float(capture.signal.sum(dtype="float64")),
        "seconds": time.perf_counter() - started,
    }
    report(figures, as_json, [out, beside])
