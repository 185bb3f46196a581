"""Tables of studies as Markdown and CSV, what is kept of a finished one, and the page that shows
them all.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tofclip.files import atomic_path

if TYPE_CHECKING:
    from apps.studies.best import BestFigure
    from apps.studies.outcome import Outcome, Study

PAGE_NAME = "reproduction.md"
STUDY_FOLDER = "reproduction"
"""Beside the page: what each study made."""

OWN_SETTING = "the table's"
UNTRIED_SETTING = "the table's (others not tried)"

BEST_NOTE = (
    "Best of ours (tables 2 to 10) is what a user gets who takes the settings of choice: lines at even angles, "
    "Huber's term for bad measurements, and each pixel at a depth of its own that is found from the same measurements "
    "(`surfaces`, the same range of depths for all scenes; `tofclip clip recover --preset surfaces`). Where that is "
    "not below the paper's figure, the presets `fast` and `quality` are tried as well, and the lowest figure counts, "
    "that of the table's own settings included. One measurement for each row (the first seed); weights are chosen by "
    "cross-validation, without the truth."
)

Result = Mapping[str, Any]
"""A finished study as it is kept: name, title, note, weight, command, settings, columns, figure,
rows, seconds.
"""


def make_result(
    study: Study, outcome: Outcome, settings: Mapping[str, Any], command: str, seconds: float
) -> Result:
    """Return what is kept of a finished study; plain values only.

    `command`: that makes the study again; `seconds`: that it took.
    """
    rows = [asdict(row) | {"mean": row.mean, "spread": row.spread} for row in outcome.rows]
    return {
        "name": study.name,
        "also": study.aliases,
        "title": study.title,
        "note": study.note,
        "weight": study.weight,
        "settings": dict(settings),
        "command": command,
        "columns": outcome.columns,
        "figure": outcome.figure,
        "rows": rows,
        "seconds": seconds,
    }


def load_result(path: Path, settings: Mapping[str, Any]) -> Result | None:
    """Return the result in `path` if it is whole and was made with the same settings."""
    try:
        found = json.loads(path.read_text("utf-8"))
        return found if found["settings"] == settings else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def add_best(result: Result, figures: Mapping[str, BestFigure], seconds: float | None) -> Result:
    """Return a study's result with what the settings of choice reach in its rows.

    `figures`: by the rows' labels, as `apps.studies.best.solve_best` returns them; rows that are
    missing are marked as not tried; `seconds`: of processor time, that they took; None: not known.
    """
    rows = []
    for row in result["rows"]:
        # the same case with another data term is one of the table's own settings
        own = min(
            one["mean"]
            for one in result["rows"]
            if _identify_case(result, one) == _identify_case(result, row)
        )
        found = figures.get(" | ".join(row["labels"]))
        best = None if row["paper"] is None else _choose_better(own, found)
        rows.append(row | {"best": best})
    return {**result, "rows": rows, "best_seconds": seconds}


def _identify_case(result: Result, row: Mapping[str, Any]) -> tuple[str, ...]:
    """Return what rows share that differ in their data term only."""
    named = zip(result["columns"], row["labels"], strict=True)
    return tuple(label for column, label in named if column != "data term")


def _choose_better(own: float, found: BestFigure | None) -> dict[str, Any]:
    """Return the lower figure and its setting."""
    if found is None:
        return {"percent": own, "setting": UNTRIED_SETTING}
    if own <= found.percent:
        return {"percent": own, "setting": OWN_SETTING}
    return {"percent": found.percent, "setting": found.setting}


def count_below(results: Sequence[Result]) -> tuple[int, int]:
    """Return how many rows the best of ours is below the paper's figure in, and of how many."""
    compared = [row for result in results for row in result["rows"] if _is_compared(row)]
    return sum(row["best"]["percent"] < row["paper"] for row in compared), len(compared)


def _is_compared(row: Mapping[str, Any]) -> bool:
    return row.get("best") is not None and row["paper"] is not None


def write_result(result: Result, folder: Path) -> list[Path]:
    """Write NAME.md, NAME.csv and, last, NAME.json, which marks the study as finished."""
    name = result["name"]
    texts = {
        f"{name}.md": f"{render_section(result)}\n",
        f"{name}.csv": _render_csv(result),
        f"{name}.json": json.dumps(result, indent=1, default=list),
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
        head += f"\n{BEST_NOTE} It is below the paper's figure in {share}.\n"
        untried = sum(
            _is_compared(row) and row["best"]["setting"] == UNTRIED_SETTING
            for result in results
            for row in result["rows"]
        )
        if untried:
            head = f"{head.rstrip()} In {untried} rows only the table's own settings were tried.\n"
    sections = (render_section(result, f"{STUDY_FOLDER}/") for result in results)
    _write_text(folder / PAGE_NAME, "\n\n".join([head.rstrip(), *sections]) + "\n")
    return folder / PAGE_NAME


def render_section(result: Result, beside: str = "") -> str:
    """Return a study's heading, command, table and picture in Markdown; pictures lie in the folder
    `beside`.

    `beside`: ends in a slash, or is empty.
    """
    names = ", ".join([result["name"], *result["also"]])
    has_best = "best_seconds" in result
    header = [*result["columns"], f"ours ({result['figure']})", "spread", "paper"]
    if has_best:
        header += ["best of ours", "by", "against the paper"]
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
    if not _is_compared(row):
        return [*cells, "", "", ""]
    mark = "below" if row["best"]["percent"] < row["paper"] else "above"
    return [*cells, f"{row['best']['percent']:.2f}", row["best"]["setting"], mark]


def _render_csv(result: Result) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    seeds = max(len(row["ours"]) for row in result["rows"])
    writer.writerow(
        [
            *result["columns"],
            "mean",
            "spread",
            "paper",
            *(("best", "by") if "best_seconds" in result else ()),
            *(f"seed {number}" for number in range(seeds)),
        ]
    )
    for row in result["rows"]:
        paper = "" if row["paper"] is None else row["paper"]
        figures = [row["mean"], row["spread"], paper]
        if "best_seconds" in result:
            best = row["best"] or {"percent": "", "setting": ""}
            figures += [best["percent"], best["setting"]]
        writer.writerow([*row["labels"], *figures, *row["ours"]])
    return text.getvalue()


def _write_text(path: Path, text: str) -> None:
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
