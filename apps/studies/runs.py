"""Studies made here or on a cluster, kept in a folder, and made again only where they are missing."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict
from functools import cache, partial
from pathlib import Path
from typing import Any

from apps.figures.style import store_picture
from apps.progress import run_with_progress, show_progress
from apps.studies.cases import (
    SEED,
    SHEAR_RANGE,
    Advance,
    BestFigure,
    Library,
    Study,
    list_best_cases,
    solve_best,
)
from apps.studies.report import (
    STUDIES,
    Result,
    add_best,
    find_studies,
    load_result,
    make_reproduction_figure,
    make_result,
    write_result,
)
from tofclip import __version__
from tofclip.files import atomic_path
from tofclip.notebook import save_figure
from tofclip.sequences.jobs import Job, Summary


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


@cache
def _load_library(data: Path | None) -> Library:
    return Library(data)


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
    """Run a study, and write its figure, its tables and, last, the file that marks it as
    finished.
    """
    started = time.perf_counter()
    outcome = study.work(library, seeds if study.seeded else 1, advance)
    seconds = time.perf_counter() - started
    recorded = "" if library.data is None else f" --data {library.data.name}"
    command = f"tofclip reproduce {study.name} --out {folder.parent.name or '.'}{recorded} --seeds {seeds}"
    picture = folder / f"{study.name}.png"
    save_figure(make_reproduction_figure(study.title, outcome), picture)
    store_picture(picture, picture)
    result = make_result(
        study, outcome, _describe_settings(study, library, seeds), command, seconds
    )
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
