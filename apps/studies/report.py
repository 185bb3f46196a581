"""The studies by name, made here or on a cluster and kept in a folder; their tables as Markdown and CSV,
their pictures laid out like the paper's, and the page that shows them all.
"""

from __future__ import annotations

import csv
import io
import json
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import cache, partial
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from apps.figures.style import (
    DEPTH_COLOURMAP,
    SMALL_FONT_PT,
    add_colour_bar,
    draw_image,
    make_figure,
    scale_brightness,
    store_picture,
)
from apps.progress import run_with_progress, show_progress
from apps.studies import (  # noqa: F401 - each registers its studies
    cameras,
    hidden_scene_adjoint,
    light_fields,
    occlusion,
    pictures,
    surfaces,
)
from apps.studies.cases import (
    LABEL_SEPARATOR,
    REGISTERED,
    SEED,
    SHEAR_RANGE,
    Advance,
    BestFigure,
    Library,
    Outcome,
    Study,
    list_best_cases,
    solve_best,
)
from tofclip import __version__
from tofclip.errors import InputError
from tofclip.files import atomic_path
from tofclip.notebook import save_figure
from tofclip.sequences.jobs import Job, Summary

ORDER = (
    *(f"table{number}" for number in range(1, 8)),
    *("table7-flash", "fig14", "table8", "table9", "table10", "fig4", "fig4d", "fig5", "fig20"),
    *("note1", "note2", "dealing", "surfaces", "surface-scenes"),
)
STUDIES = tuple(sorted(REGISTERED, key=lambda one: ORDER.index(one.name)))

PAGE_NAME = "reproduction.md"
STUDY_FOLDER = "reproduction"  # beside the page: what each study made

OWN_SETTING = "the table's"
UNTRIED_SETTING = "the table's (others not tried)"

PANEL_INCHES = 1.5
MIN_SHEAR, MAX_SHEAR = -1.4, 0.8  # shears


BEST_NOTE = (
    "Best of ours (tables 2 to 10) is what a user gets who takes the settings of choice: lines at even angles, "
    "Huber's term for bad measurements, and each pixel at a depth of its own that is found from the same measurements "
    "(`surfaces`, the same range of depths for all scenes; `tofclip clip recover --preset surfaces`). Where that is "
    "not below the paper's figure, the presets `fast` and `quality` are tried as well, and the lowest figure counts, "
    "that of the table's own settings included. One measurement for each row (the first seed); weights are chosen by "
    "cross-validation, without the truth."
)

# a finished study as `make_result` keeps it
Result = Mapping[str, Any]


def find_studies(name: str) -> tuple[Study, ...]:
    """Return the study of a name, of a figure that shows its pictures, or every one for ``all``."""
    matching = tuple(study for study in STUDIES if name in ("all", study.name, *study.aliases))
    if not matching:
        known = ", ".join(word for study in STUDIES for word in (study.name, *study.aliases))
        raise InputError(f"unknown study '{name}'; take all or one of {known}")
    return matching


def load_result(path: Path, settings: Mapping[str, Any]) -> Result | None:
    """Return the result in `path` if it is whole and was made with the same settings."""
    try:
        found = json.loads(path.read_text("utf-8"))
        return found if found["settings"] == settings else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def add_best(result: Result, figures: Mapping[str, BestFigure], seconds: float | None) -> Result:
    """Return a study's result with what the settings of choice reach in its rows. `figures`: by the
    rows' labels; rows that are missing are marked as not tried; `seconds`: of processor time, that
    they took; None: not known.
    """

    def identify(row: Mapping[str, Any]) -> list[str]:
        """Rows that differ in their data term only are settings of one case of the table."""
        named = zip(result["columns"], row["labels"], strict=True)
        return [label for column, label in named if column != "data term"]

    rows = []
    for row in result["rows"]:
        best = None
        if row["paper"] is not None:
            own = min(one["mean"] for one in result["rows"] if identify(one) == identify(row))
            figure = figures.get(LABEL_SEPARATOR.join(row["labels"]))
            best = {"percent": own, "setting": UNTRIED_SETTING if figure is None else OWN_SETTING}
            if figure is not None and figure.percent < own:
                best = asdict(figure)
        rows.append(row | {"best": best})
    return {**result, "rows": rows, "best_seconds": seconds}


def count_below(results: Sequence[Result]) -> tuple[int, int]:
    """Return how many rows the best of ours is below the paper's figure in, and of how many."""
    rows = [row for one in results for row in one["rows"] if row.get("best") is not None]
    return sum(row["best"]["percent"] < row["paper"] for row in rows), len(rows)


def write_result(result: Result, folder: Path) -> list[Path]:
    """Write NAME.md, NAME.csv and, last, NAME.json, which marks the study as finished."""
    name = result["name"]
    texts = {
        f"{name}.md": f"{render_section(result)}\n",
        f"{name}.csv": _render_csv(result),
        f"{name}.json": json.dumps(result, indent=1, default=float),  # of float32
    }
    for file, text in texts.items():
        _write_text(folder / file, text)
    return [folder / file for file in texts]


def write_page(results: Sequence[Result], folder: Path) -> Path:
    """Write the page with the table and the picture of every study."""
    head = (
        "# Tables and figures of the paper, made again\n\n"
        "Made by `tofclip reproduce`; do not edit. Ours is the mean over the seeds and its standard deviation; the "
        "paper gives single figures. Measurements come from the true views, never from the model; errors are NMSE "
        "relative to the variance of shift-and-add of the true views, 12 pixels at the border left out; how the "
        "prior's weight was chosen is said at each table. Most scenes of the paper are not public: its figures stand "
        "beside ours for other scenes of the same kind, which may be easier or harder.\n"
    )
    below, compared = count_below(results)
    if compared:
        share = f"{below} of {compared} rows ({100 * below / compared:.0f} %)"
        head += f"\n{BEST_NOTE} It is below the paper's figure in {share}."
        best = (row.get("best") or {} for result in results for row in result["rows"])
        untried = sum(one.get("setting") == UNTRIED_SETTING for one in best)
        if untried:
            head += f" In {untried} rows only the table's own settings were tried."
    sections = (render_section(result, f"{STUDY_FOLDER}/") for result in results)
    _write_text(folder / PAGE_NAME, "\n\n".join([head.rstrip(), *sections]) + "\n")
    return folder / PAGE_NAME


def render_section(result: Result, beside: str = "") -> str:
    """Return a study's section in Markdown; `beside`: its picture's folder."""
    names = ", ".join([result["name"], *result["also"]])
    has_best = "best_seconds" in result
    header = [*result["columns"], f"ours ({result['figure']})", "spread", "paper"]
    header += ["best of ours", "by", "against the paper"] if has_best else []
    cells = (_format_cells(row, has_best) for row in result["rows"])
    lines = [header, ["---"] * len(header), *cells]
    table = "\n".join(f"| {' | '.join(cells)} |" for cells in lines)
    made = f"`{result['command']}`, {result['seconds']:.0f} s"
    picture = f"![{result['title']}]({beside}{result['name']}.png)"
    text = f"{result['note']} The prior's weight: {result['weight']}. Made by {made}."
    if has_best:
        below, compared = count_below([result])
        text += f" Best of ours: below the paper's figure in {below} of {compared} rows"
        if result["best_seconds"] is not None:
            text += f", {result['best_seconds']:.0f} s of processor time"
        text += "."
    return f"## {result['title']} ({names})\n\n{text}\n\n{table}\n\n{picture}"


def _format_cells(row: Mapping[str, Any], has_best: bool) -> list[str]:
    paper = "" if row["paper"] is None else f"{row['paper']:.2f}"
    spread = f"{row['spread']:.2f}" if len(row["ours"]) > 1 else ""
    cells = [*row["labels"], f"{row['mean']:.2f}", spread, paper]
    if not has_best:
        return cells
    if row["best"] is None:
        return [*cells, "", "", ""]
    mark = "below" if row["best"]["percent"] < row["paper"] else "above"
    return [*cells, f"{row['best']['percent']:.2f}", row["best"]["setting"], mark]


def _render_csv(result: Result) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")  # writes None as an empty cell
    seeds = max(len(row["ours"]) for row in result["rows"])
    best = ("best", "by") if "best_seconds" in result else ()
    numbers = (f"seed {number}" for number in range(seeds))
    writer.writerow([*result["columns"], "mean", "spread", "paper", *best, *numbers])
    for row in result["rows"]:
        figures = [row["mean"], row["spread"], row["paper"]]
        if best:
            figures += (row["best"] or {"percent": "", "setting": ""}).values()
        writer.writerow([*row["labels"], *figures, *row["ours"]])
    return text.getvalue()


def _write_text(path: Path, text: str) -> None:
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def make_reproduction_figure(title: str, outcome: Outcome) -> Figure:
    """Draw the panels of an outcome, one line below the other."""
    lines = outcome.panels
    columns = max(map(len, lines))
    figure = make_figure(PANEL_INCHES * columns, (PANEL_INCHES + 0.35) * len(lines) + 0.4)
    figure.suptitle(title, fontsize=SMALL_FONT_PT + 2, wrap=True)
    axes = figure.subplots(len(lines), columns, squeeze=False)
    for row, line in zip(axes, lines, strict=True):
        for place in row:
            place.set_axis_off()
        for place, panel in zip(row, line, strict=False):
            if panel.is_map:
                look: Any = {"cmap": DEPTH_COLOURMAP, "vmin": MIN_SHEAR, "vmax": MAX_SHEAR}
                drawn = draw_image(place, panel.picture, **look)
                add_colour_bar(place, drawn, "s (px per view)")
            else:
                draw_image(place, panel.picture, cmap="gray", **scale_brightness(panel.picture))
            place.set_title(panel.title, fontsize=SMALL_FONT_PT - 2)
    return figure


def is_possible(study: Study, library: Library) -> bool:
    """Return whether the recording that a study needs is there; say what is left out."""
    if study.recording is None or library.has_recording(study.recording):
        return True
    print(
        f"{study.name}: left out, it needs {study.recording} of the recorded data (--data)",
        file=sys.stderr,
    )
    return False


def _describe_settings(study: Study, library: Library, seeds: int) -> dict[str, Any]:
    """What a result depends on, as it comes back from JSON."""
    recorded = None if library.data is None else library.data.name
    return {
        "name": study.name,
        "weight": study.weight,
        "seeds": seeds,
        "data": recorded,
        "version": __version__,
    }


def run_on_cluster(
    studies: Sequence[Study], library: Library, seeds: int, folder: Path, cluster: str
) -> Summary:
    """Have the studies that are not there yet made by workers."""
    data = None if library.data is None else library.data.resolve()
    jobs = []
    for study in studies:
        path = folder.resolve() / f"{study.name}.json"
        if load_result(path, _describe_settings(study, library, seeds)) is None:
            path.unlink(missing_ok=True)  # of other settings, or damaged
            # By name, because a job has to survive pickling.
            work = partial(make_study, study.name, data, seeds, path.parent)
            beside = tuple(path.with_suffix(suffix) for suffix in (".md", ".csv", ".png"))
            jobs.append(Job(study.name, path, work, beside))
    return run_with_progress("reproducing", jobs, cluster)


def make_study(name: str, data: Path | None, seeds: int, folder: Path) -> None:
    """Make a study again and write it; light fields are rendered or read once in a process."""
    (study,) = find_studies(name)
    _run_study(study, _load_library(data), seeds, folder, lambda _: None)


_load_library = cache(Library)  # of each worker


def load_or_make_result(study: Study, library: Library, seeds: int, folder: Path) -> Result:
    """Return a study's result, made now unless the folder has it."""
    kept = load_result(folder / f"{study.name}.json", _describe_settings(study, library, seeds))
    if kept is not None:
        print(f"{study.name}: kept from an earlier run", file=sys.stderr)
        return kept
    repeats = seeds if study.seeded else 1
    print(f"{study.name}: {study.title}, about {study.seconds * repeats:.0f} s", file=sys.stderr)
    with show_progress(study.name, study.steps * repeats) as advance:
        result = _run_study(study, library, seeds, folder, advance)
    print(f"{study.name}: {result['seconds']:.0f} s", file=sys.stderr)
    return result


def complete_best(result: Result, study: Study, library: Library, folder: Path) -> Result:
    """Return the result with the best of ours in rows of the paper; what is missing is made now."""
    if not study.has_best:
        return result
    cases = list_best_cases(study.name)
    path = folder / f"{study.name}-best.json"
    settings = {
        "name": study.name,
        "version": __version__,
        "seed": SEED,
        "shears": list(SHEAR_RANGE),
    }
    kept = dict(load_result(path, settings) or {"figures": {}, "seconds": 0.0})
    began = time.process_time() - kept["seconds"]

    def keep(figures: dict[str, BestFigure]) -> None:
        kept.update(
            settings=settings,
            figures={key: asdict(figure) for key, figure in figures.items()},
            seconds=time.process_time() - began,
        )
        with atomic_path(path) as temporary:
            temporary.write_text(json.dumps(kept, indent=1), encoding="utf-8")

    known = {key: BestFigure(**figure) for key, figure in kept["figures"].items()}
    with show_progress(f"{study.name}, best of ours", len(cases)) as advance:
        figures = solve_best(cases, library, known, keep, advance)
    full = add_best(result, figures, kept["seconds"])
    write_result(full, folder)
    return full


def _run_study(
    study: Study, library: Library, seeds: int, folder: Path, advance: Advance
) -> Result:
    """Run a study, and write its figure, its tables and, last, what marks it as finished."""
    started = time.perf_counter()
    outcome = study.work(library, seeds if study.seeded else 1, advance)
    seconds = time.perf_counter() - started
    recorded = "" if library.data is None else f" --data {library.data.name}"
    command = f"tofclip reproduce {study.name} --out {folder.parent.name or '.'}{recorded} --seeds {seeds}"
    picture = folder / f"{study.name}.png"
    save_figure(make_reproduction_figure(study.title, outcome), picture)
    store_picture(picture, picture)
    rows = [asdict(row) | {"mean": row.mean, "spread": row.spread} for row in outcome.rows]
    result = {
        "name": study.name,
        "also": study.aliases,
        "title": study.title,
        "note": study.note,
        "weight": study.weight,
        "settings": _describe_settings(study, library, seeds),
        "command": command,
        "columns": outcome.columns,
        "figure": outcome.figure,
        "rows": rows,
        "seconds": seconds,
    }
    write_result(result, folder)
    return result


def load_all_results(library: Library, seeds: int, folder: Path) -> list[Result]:
    """Every result that the folder holds with these settings, in the order of the paper's tables."""
    found = (
        load_result(folder / f"{study.name}.json", _describe_settings(study, library, seeds))
        for study in STUDIES
    )
    return [result for result in found if result is not None]


def summarise_result(result: Result) -> dict[str, Any]:
    """Mean of ours and of the paper's over the rows where it has figures, and the time."""
    known = [row for row in result["rows"] if row["paper"] is not None]
    figures = {"rows": len(result["rows"]), "seconds": result["seconds"]}
    if not known:
        return figures
    ours, paper = (sum(row[key] for row in known) / len(known) for key in ("mean", "paper"))
    return figures | {"mean_ours": ours, "mean_paper": paper}
