"""Options that several commands share, and what their text stands for."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from thermocald.cli.commands import expert

JsonOption = Annotated[
    str | None, typer.Option("--json", help="Write the result as JSON; - for standard output.")
]
ConfigOption = Annotated[
    Path | None,
    typer.Option(
        "--config", "-c", help="The configuration [./config.yaml, /etc/thermocald/config.yaml]."
    ),
]
StoreArgument = Annotated[Path | None, typer.Argument(help="The store; may be in use by a daemon.")]
PhotosArgument = Annotated[
    list[Path], typer.Argument(metavar="PHOTO…", help="Photographs, or folders of them.")
]
PixelPitchOption = Annotated[
    float | None, typer.Option("--pixel-pitch", help="Size of a pixel in mm.", min=1e-5, max=1.0)
]
LogOption = Annotated[Path, typer.Option("--log", help="A logger's file, a recording, or a store.")]
ModelOption = Annotated[Path, typer.Option("--model", help="The thermal model.")]
ExtrapolateOption = Annotated[
    bool, expert("--extrapolate", help="Allow temperatures far outside the fit.")
]
SeedOption = Annotated[int, expert("--seed", min=0, help="Of all random numbers.")]
TimezoneOption = Annotated[
    str | None,
    typer.Option("--timezone", help="Of times without a zone: Europe/Berlin, UTC, +02:00."),
]
FreeOption = Annotated[
    str,
    expert(
        "--free", help="Interior orientation to estimate, separated by commas; the rest is held."
    ),
]
DEFAULT_FREE = "c,x0,y0,A1,A2,A3,B1,B2"
JobsOption = Annotated[
    int, expert(min=1, max=256, help="Processes; the results are the same to the bit.")
]
ExteriorOption = Annotated[
    str,
    typer.Option(
        "--exterior",
        help="per_epoch: every epoch has its own orientation; series: one for all epochs; mount: "
        "one and movements of the mount, whose size is estimated; auto: what the data show.",
    ),
]


LOG_OPTIONS: dict[str, tuple[Any, Any]] = {
    "timezone": (TimezoneOption, None),
    "temperature_column": (
        Annotated[
            list[str] | None,
            typer.Option(help="Of the log; the first is the reference; repeatable."),
        ],
        None,
    ),
    "name": (
        Annotated[
            list[str] | None,
            typer.Option(metavar="COLUMN=LABEL", help="What a column of the log is called."),
        ],
        None,
    ),
    "unit": (
        Annotated[
            str | None, typer.Option(help="Of the log where it does not say: degC, K, degF.")
        ],
        None,
    ),
    "date_order": (Annotated[str | None, expert(help="Of 06/07/2026: dmy or mdy.")], None),
    "time_column": (
        Annotated[list[str] | None, expert(help="Of the log; twice for a date and a time.")],
        None,
    ),
    "log_timezone": (Annotated[str | None, expert(help="The logger's own.")], None),
    "log_clock": (
        Annotated[str, expert(help="How far the logger's clock was ahead: +00:03:12.")],
        "0",
    ),
    "ambiguous": (
        Annotated[
            str,
            expert(
                help="The hour that comes twice in autumn: order (of rows), earlier, later, refuse."
            ),
        ],
        "order",
    ),
    "separator": (Annotated[str | None, expert(help="Of the log's columns: ';' ',' tab.")], None),
    "decimal": (Annotated[str | None, expert(help="The log's decimal mark: , or .")], None),
}
"""How a logger's file is to be read, wherever a command reads one: annotation and default."""


def takes_log_options(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command the options of `LOG_OPTIONS`, which it receives as `log_options`.

    Those that its own signature names it receives by themselves too.
    """
    own = inspect.signature(command, eval_str=True).parameters
    kept = [p for name, p in own.items() if name not in LOG_OPTIONS and name != "log_options"]
    added = [
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=kind)
        for name, (kind, default) in LOG_OPTIONS.items()
    ]

    @functools.wraps(command)
    def called(**given: Any) -> None:
        from thermocald.store.logger.temperatures import log_options

        said = {name: given[name] if name in own else given.pop(name) for name in LOG_OPTIONS}
        command(**given, log_options=log_options(**said))

    last = kept[-1].replace(kind=inspect.Parameter.KEYWORD_ONLY)
    called.__signature__ = inspect.Signature([*kept[:-1], *added, last])  # type: ignore[attr-defined]
    called.__annotations__ = {p.name: p.annotation for p in [*kept, *added]}
    return called
