"""`thermocald testfield print | survey | check`: make a test field, measure it, judge it."""

from __future__ import annotations

import typer

from thermocald.cli.testfield_check import check
from thermocald.cli.testfield_print import print_
from thermocald.cli.testfield_survey import survey

__all__ = ["register"]


def register(app: typer.Typer) -> None:
    """Add the group of commands."""
    group = typer.Typer(help="Test fields: print, survey, check.", no_args_is_help=True)
    group.command("print")(print_)
    group.command("survey")(survey)
    group.command("check")(check)
    app.add_typer(group, name="testfield")
