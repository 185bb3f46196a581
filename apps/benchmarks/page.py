"""The page of a run's figures, in Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

PAGE_HEADER = """\
# Benchmarks

Made by `{command}`; do not edit. Every figure comes from one run on one machine:

{machine}

Each size and number of threads is a fresh process. Times are medians after one warm-up, with the least and the greatest
of the repeats; memory is the peak of the process with its libraries and inputs, and how much of it the work itself
added. *Floor* is what the work cannot do without, measured beside it on the same data and threads; *growth* the power
of the size with which the time grows between the first and the last size.
"""

GROUP_TITLES = {
    "recovery": "Recovery of shots (7 views, 1344 slit pixels, 174 x 174 pixels)",
    "clip": "Rendered light fields from few measurements of their true views (8 x 8 views)",
    "depth": "Ranges (the demo's instrument)",
    "streaming": "Shots to clouds (the demo's instrument)",
    "rsd": "Around the corner: phasor fields",
    "propagation": "Around the corner: propagation",
    "confocal": "Around the corner: confocal",
    "backprojection": "Around the corner: back-projection",
    "decode": "Instruments",
}
STUDY_TITLES = {
    "camera": "Light-field cameras: one model each way",
    "quality": "Quality of pictures of recorded light fields",
    "accuracy": "Ranges from counted photons",
    "device": "The same on another device",
    "corner": "Around the corner: beyond lattices",
    "sequence": "Many shots",
    "driver": "Instruments, the whole path",
    "viewer": "The viewer in a browser",
}
TABLE_COLUMNS = ("", "size", "threads", "time", "rate", "memory", "floor", "x floor", "growth")


def render_page(figures: Mapping[str, Any], command: str) -> str:
    """Return the page of the figures that a run of `command` gave.

    `figures`: ``machine`` and ``entries``. Returns markdown.
    """
    parts = [
        PAGE_HEADER.format(command=command, machine=_format_machine(figures["machine"])).rstrip()
    ]
    for group, title in {**GROUP_TITLES, **STUDY_TITLES}.items():
        entries = [
            entry for entry in figures["entries"] if entry["name"].partition("-")[0] == group
        ]
        if entries:
            parts.append(_format_section(title, entries))
    return "\n\n".join(parts) + "\n"


def _format_machine(known: Mapping[str, Any]) -> str:
    libraries = ", ".join(f"{name} {version}" for name, version in known["libraries"].items())
    return "\n".join(
        [
            f"* {known['processor']}, {known['cores']} cores, {known['memory_gib']} GiB, {known['system']}",
            f"* devices: {', '.join(known['devices'])}",
            f"* other processes that wanted a core in the minute before: {known['load']}",
            f"* tofclip {known['tofclip']}, Python {known['python']}, {libraries}",
        ]
    )


def _format_section(title: str, entries: Iterable[Mapping[str, Any]]) -> str:
    lines, notes = [_format_row(TABLE_COLUMNS), _format_row(["---"] * len(TABLE_COLUMNS))], []
    for entry in entries:
        lines.extend(_format_row(_format_cells(entry, run)) for run in entry["runs"])
        notes.append(
            f"* {entry['title']}: sizes are {entry['size']}, the floor is {entry['floor']}."
            f"{_format_peers(entry)}{_format_figures(entry)}"
        )
    return "\n".join([f"## {title}", "", *lines, "", *notes])


def _format_row(cells: Iterable[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _format_cells(entry: Mapping[str, Any], run: Mapping[str, Any]) -> list[str]:
    first = [entry["title"], str(run["size"]), str(run["threads"])]
    if "problem" in run:
        return [*first, run["problem"], "", "", "", "", ""]
    time = run["seconds"]
    median, least, greatest = (
        _format_seconds(time[name]) for name in ("median", "least", "greatest")
    )
    spread = f"{median} ({least} to {greatest})"
    last = run is entry["runs"][-1]
    return [
        *first,
        spread,
        f"{_format_digits(run['per_second'])} {entry['unit']}/s",
        f"{run['peak_mib']:.0f} MiB, own {run['own_mib']:.0f}",
        _format_seconds(run["floor_seconds"]),
        f"{run['times_floor']:.2f}",
        f"{entry['growth']:.1f}" if last and entry["growth"] is not None else "",
    ]


def _format_peers(entry: Mapping[str, Any]) -> str:
    """Sentences about other programs, of the runs in which they were asked for."""
    comparisons: dict[str, list[str]] = {}
    absent: dict[str, str] = {}
    for run in entry["runs"]:
        for name, found in run.get("peers", {}).items():
            if "seconds" in found:
                ratio = found["seconds"] / run["seconds"]["median"]
                size = (
                    f"{run['size']}, {run['threads']} threads"
                    if run["threads"] > 1
                    else f"{run['size']}, 1 thread"
                )
                comparisons.setdefault(name, []).append(
                    f"{_format_seconds(found['seconds'])} at {size} ({ratio:.1f} times ours)"
                )
            else:
                absent[name] = found["absent"]
    sentences = [f" {name}: {'; '.join(found)}." for name, found in comparisons.items()]
    sentences += [
        f" Not compared: {reason}." for name, reason in absent.items() if name not in comparisons
    ]
    return "".join(sentences)


def _format_figures(entry: Mapping[str, Any]) -> str:
    """A sentence about each size that has more to say than its times."""
    sentences = []
    for run in entry["runs"]:
        said = [f"{name} {value:.3g}" for name, value in run.get("figures", {}).items()]
        if said:
            sentences.append(f" At {run['size']}, threads {run['threads']}: {', '.join(said)}.")
    return "".join(sentences)


def _format_seconds(value: float) -> str:
    for unit, scale in (("s", 1.0), ("ms", 1e-3)):
        if value >= scale:
            return f"{_format_digits(value / scale)} {unit}"
    return f"{_format_digits(value / 1e-6)} us"


def _format_digits(value: float) -> str:
    """Three digits that count, without powers of ten."""
    return f"{value:.3g}" if value < 1000 else f"{value:.0f}"
