"""`tofclip design`: a CLIP instrument before it is built."""

from __future__ import annotations

import statistics
from pathlib import Path
from typing import TYPE_CHECKING, Any

from apps.options import JSON, PICTURE_FORMATS, SEED, arg, opt
from apps.progress import show_activity
from apps.report import make_folder, report, require_writable
from tofclip.errors import InputError
from tofclip.files import PICTURE_SUFFIXES

if TYPE_CHECKING:
    from tofclip.designs import Design, DesignReport

SCENE_NAMES = ("letters", "plates", "poles")


def design(
    camera: Path = arg("TOML", "The instrument; keys as in tofclip.designs.Design.", read=True),
    out: Path = opt(
        "PNG", f"The picture, {PICTURE_FORMATS}; with --simulate a folder.", Path("design.png")
    ),
    compare: Path | None = opt("TOML", "Another instrument to draw below.", shown="none"),
    optimise: str | None = opt(
        "WHAT",
        "angles: find better ones up to max_angle_deg for the range near_m to far_m, compare, and write them "
        "beside --out, .toml.",
        shown="nothing",
        choices=("angles",),
    ),
    simulate: str | None = opt(
        "SCENE",
        f"Write shots with their camera and truth instead: {', '.join(SCENE_NAMES)}.",
        shown="none",
        choices=SCENE_NAMES,
    ),
    shots: int = opt("N", "Simulated shots of each scene; 0: predictions alone.", 20, min=0),
    seed: int = SEED,
    as_json: bool = JSON,
) -> None:
    """Say what a CLIP instrument will see before it is built, by theory and by simulated shots.

    Picture errors (NMSE) and range deviations are those of the linear inverse, bias and noise apart;
    methods with a prior do better. They are computed from the camera's operator and, beside them, found
    in shots of three scenes that the ray caster draws. range_offset_m is what other pixels' rays do to
    a range in all shots alike.

    With --simulate, recover takes the shots of a slit or a 1d sensor, and clip recover those of a 2d or
    0d sensor, whose instants are summed.

    Example: tofclip design camera.toml --out camera.png

    Example: tofclip design camera.toml --optimise angles --out better.png

    Example: tofclip design camera.toml --simulate plates --shots 3 --out shots/
    """
    from tofclip.designs import Design, optimise_angles
    from tofclip.designs import design as examine

    if optimise not in (None, "angles"):
        raise InputError(f"'{optimise}' cannot be optimised; take angles")
    if simulate is None:
        require_writable(out, *PICTURE_SUFFIXES, inputs=(camera, compare))
    known = {camera.stem: Design.load(camera)}
    if simulate is not None:
        if compare or optimise:
            raise InputError("--simulate writes shots of one instrument; leave the others out")
        if out.suffix in PICTURE_SUFFIXES:
            raise InputError("--simulate writes a folder of shots; name it by --out")
        written = _write_shots(known[camera.stem], simulate, shots, seed, out)
        report({"scene": simulate, "shots": shots, "seed": seed}, as_json, written)
        return
    written = [out]
    if compare is not None:
        known[compare.stem if compare.stem not in known else str(compare)] = Design.load(compare)
    with show_activity("examining"):
        if optimise:
            better, file = optimise_angles(known[camera.stem]), out.with_suffix(".toml")
            require_writable(file, inputs=(camera, compare))
            better.save(file)
            known["optimised"] = better
            written.append(file)
        reports = {name: examine(one, shots, seed) for name, one in known.items()}
    from apps.figures.instrument import make_design_figure
    from tofclip.notebook import save_figure

    save_figure(make_design_figure(reports), out)
    told = {name: _list_figures(one) for name, one in reports.items()}
    if len(told) == 1:
        told = told[camera.stem]
    else:  # side by side, their scenes below
        scenes = {f"{name}_scenes": one.pop("scenes") for name, one in told.items()}
        told |= scenes
    report(told, as_json, written)


def _list_figures(found: DesignReport) -> dict[str, Any]:
    """Figures by name; those of the scenes by theirs."""
    figures = {"angles_deg": list(found.design.angles_deg), **found.figures}
    names = {
        "picture_error": "picture_error",
        "picture_bias": "picture_bias",
        "range_deviation_m": "median_deviation",
        "range_offset_m": "median_offset",
    }
    scenes = {
        scene: {
            f"{name}_{kind}": getattr(known.get(scene), field, None)
            for name, field in names.items()
            for kind, known in (("predicted", found.predicted), ("simulated", found.simulated))
        }
        for scene in found.predicted
    }
    seconds = [one.seconds for one in found.simulated.values()]
    pace = statistics.median(seconds) if seconds else None
    return {**figures, "seconds_per_shot": pace, "scenes": scenes}


def _write_shots(known: Design, name: str, shots: int, seed: int, out: Path) -> list[Path]:
    """Write shots, camera and true frames into a folder."""
    from tofclip.designs import make_scene, take_shots
    from tofclip.simulate import render_true_frames

    if shots < 1:
        raise InputError("--simulate takes --shots 1 or more")
    scene = make_scene(name, known)
    make_folder(out / "shots")
    exposure, taken = take_shots(known, scene, shots, seed)
    written = []
    for number, shot in enumerate(taken):
        written.append(out / "shots" / f"shot_{number:03}.h5")
        shot.save(written[-1])
    truth, camera = out / "truth.h5", out / "camera.h5"
    render_true_frames(scene, known.instrument, exposure).save(truth)
    known.camera.save(camera)
    return [*written, truth, camera]
