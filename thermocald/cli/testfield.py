"""`thermocald testfield print | import | survey | check`: make, take, measure, assess a field."""

from __future__ import annotations

import typer

from thermocald.cli.testfield_check import check
from thermocald.cli.testfield_import import import_
from thermocald.cli.testfield_print import print_
from thermocald.cli.testfield_survey import survey

__all__ = ["group"]


group = typer.Typer(help="Test fields: print, import, survey, check.", no_args_is_help=True)
group.command("print")(print_)
group.command("import")(import_)
group.command("survey")(survey)
group.command("check")(check)
