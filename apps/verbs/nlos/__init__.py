"""`tofclip nlos`: imaging around corners, one module for each verb."""

from __future__ import annotations

import typer

from apps.verbs.nlos import compare, demo, film, info, reconstruct, simulate

app = typer.Typer()
app.command()(reconstruct.reconstruct)
app.command()(film.film)
app.command()(compare.compare)
app.command()(simulate.simulate)
app.command()(info.info)
app.command()(demo.demo)


@app.callback(invoke_without_command=True)
def _show_help(context: typer.Context) -> None:
    """Image the scene hidden around a corner."""
    if context.invoked_subcommand is None:
        print(context.get_help())
