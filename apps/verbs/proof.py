"""`tofclip bench`: how fast and how large this program's parts are on this machine; `tofclip reproduce`:
the paper's synthetic tables and figures, made again.
"""

from __future__ import annotations

from pathlib import Path

import typer

from apps.options import CLUSTER, arg, opt
from apps.progress import report_summary, show_progress
from apps.report import PRINTS_JSON, make_folder, report, require_writable
from tofclip.errors import InputError
from tofclip.files import atomic_path, require_apart


def bench(
    name: str = arg(
        "NAME",
        "recovery, clip, depth, streaming, rsd, propagation, confocal, backprojection, decode, or one of a group, as "
        "recovery-l1. Studies, by name only: camera, device, corner, viewer.",
        "all",
    ),
    page: Path | None = opt("MD", "A page of the figures to write.", shown="none"),
    peers: Path | None = opt(
        "PYTHON",
        "A Python that has other programs to compare with: pip install y-tal pyfftw astra-toolbox lensless.",
        shown="none",
    ),
) -> None:
    """Measure time and memory, each beside the least that the work needs.

    All cases together take some ten minutes on two cores and are cut short after twenty, with
    --peers half an hour more. Other programs slow it down: close them. TOFCLIP_THREADS bounds the number of threads.

    Example: tofclip bench recovery

    Example: tofclip bench --page benchmarks.md --json
    """
    from apps.benchmarks.harness import count_processes, find_cases, render_page, run_cases

    cases = find_cases(name)
    if page is not None:
        # Before the measurements, which take minutes.
        require_writable(page, ".md", inputs=(peers,))
    with show_progress("measuring", count_processes(cases)) as advance:
        figures = run_cases(cases, None if peers is None else str(peers), advance)
    if page is not None:
        command = "tofclip bench" if name == "all" else f"tofclip bench {name}"
        with atomic_path(page) as temporary:
            temporary.write_text(render_page(figures, command), encoding="utf-8")
    if PRINTS_JSON.get():
        report(figures)
        return
    lines = {}
    for entry in figures["entries"]:
        # Sizes and threads rise, so that the last run is the largest.
        run = entry["runs"][-1]
        lines[entry["name"]] = run.get("problem") or (
            f"{run['seconds']['median']:.4g} s at {run['size']} {entry['size']}, {run['times_floor']:.2f} times "
            f"{entry['floor']}, {run['peak_mib']:.0f} MiB"
        )
    report(lines, [] if page is None else [page])


def _complete_study(incomplete: str) -> list[str]:
    from apps.studies.report import STUDIES

    names = ["all", *(name for study in STUDIES for name in (study.name, *study.aliases))]
    return [name for name in names if name.startswith(incomplete)]


def reproduce(
    name: str = typer.Argument(
        metavar="NAME",
        help="table2, fig12, ...; all for every one.",
        autocompletion=_complete_study,
    ),
    out: Path = opt("DIR", "Folder for tables and pictures; made if missing.", ...),
    data: Path | None = opt("DIR", "Recorded data: DIR/lightfields/*.npz are studied as well."),
    seeds: int = opt("N", "Repeats with other angles, codes and noise.", 3, min=1),
    cluster: str | None = CLUSTER,
) -> None:
    """Make tables and figures of the paper again, its figures beside ours.

    Writes DIR/reproduction.md, which shows everything, and NAME.md, NAME.csv, NAME.png and
    NAME.json of each study in DIR/reproduction. A study that is there already, made with the same
    settings, is not made again. Rows of tables 2 to 10 are also solved with the settings of choice
    ("best of ours"); NAME-best.json keeps them, and a run that is stopped goes on there. On a
    cluster each study is a task; its seeds stay together, since the weight chosen with the first
    one holds for all.

    Example: tofclip reproduce table2 --out reproduction --seeds 3
    """
    from apps.studies import report as paper
    from apps.studies.cases import Library

    studies = paper.find_studies(name)
    if data is not None and not data.is_dir():
        raise InputError(f"{data}: no such folder of recorded data")
    folder = out / paper.STUDY_FOLDER
    require_apart([out, folder], [data])
    make_folder(folder)
    library = Library(data)
    # A single study that was named is tried even without its recording, so that the reason is an
    # error.
    possible = [
        study for study in studies if paper.is_possible(study, library) or len(studies) == 1
    ]
    summary = (
        None if cluster is None else paper.run_on_cluster(possible, library, seeds, folder, cluster)
    )
    failed = set() if summary is None else {failure.name for failure in summary.failures}
    results = [
        paper.complete_best(
            paper.load_or_make_result(study, library, seeds, folder), study, library, folder
        )
        for study in possible
        if study.name not in failed
    ]
    page = paper.write_page(paper.load_all_results(library, seeds, folder), out)
    figures = {result["name"]: paper.summarise_result(result) for result in results}
    if summary is None:
        report({"seeds": seeds, **figures}, [page])
        return
    report_summary(summary, len(possible), page, {"seeds": seeds, **figures})
