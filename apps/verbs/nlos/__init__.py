"""`tofclip nlos`: imaging around corners, one module for each verb."""

from __future__ import annotations

import typer

from apps.help import VerbTable, make_lazy_group

VERBS: VerbTable = {
    "reconstruct": "Image the hidden scene from the transients on a relay wall.",
    "stream": "Image every capture of a stream by one plan, and tell rate and latency.",
    "film": "Film the hidden scene while the laser's flash passes through it.",
    "compare": "Image one capture by several methods, and show images, time, memory and figures of merit side by side.",
    "simulate": "Simulate the capture of a known hidden scene before a relay wall.",
    "info": "Report a capture's geometry and sampling, usable wavelengths, resolution, and which methods suit it.",
    "demo": "Hide two characters before a curved wall, simulate what the wall shows, and image them by two methods.",
}
"""Each verb's module and its line in the list of commands."""

app = typer.Typer(cls=make_lazy_group("apps.verbs.nlos", VERBS))


@app.callback(invoke_without_command=True)
def _show_help(context: typer.Context) -> None:
    """Image the scene hidden around a corner."""
    if context.invoked_subcommand is None:
        print(context.get_help())
