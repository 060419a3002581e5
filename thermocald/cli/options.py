"""The options that several commands take, used as annotations: `json: opt.Json = None`."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from thermocald.cli.commands import expert

Json = Annotated[
    str | None, typer.Option("--json", metavar="FILE", help="Write JSON; - is standard output.")
]
Config = Annotated[
    Path | None,
    typer.Option(
        "--config", "-c", help="Configuration; default: ./config.yaml, /etc/thermocald/config.yaml."
    ),
]
StoreConfig = Annotated[
    Path | None,
    typer.Option("--config", "-c", help="Configuration with the store and other settings."),
]
Store = Annotated[Path | None, typer.Argument(help="The store; a daemon may be using it.")]
Photos = Annotated[
    list[Path], typer.Argument(metavar="PHOTO", help="Photographs, or folders of photographs.")
]
PixelPitch = Annotated[
    float | None,
    typer.Option(help="Pixel pitch, mm, if no camera file gives it.", min=1e-5, max=1.0),
]
Log = Annotated[Path, typer.Option("--log", help="Temperatures: log file, recording, store.")]
Model = Annotated[Path, typer.Option("--model", help="Thermal model (YAML).")]
Extrapolate = Annotated[
    bool, expert(..., "--extrapolate", help="Allow temperatures far outside the fit's range.")
]
Seed = Annotated[int, expert(..., "--seed", min=0, help="Seed of the random numbers.")]
Timezone = Annotated[
    str | None,
    typer.Option("--timezone", help="Time zone of times without one: Europe/Berlin, UTC, +02:00."),
]
Free = Annotated[
    str,
    expert(
        ...,
        "--free",
        help="Interior orientation parameters to estimate, or none; the rest is held fixed.",
    ),
]
DEFAULT_FREE = "c,x0,y0,A1,A2,A3,B1,B2"
Jobs = Annotated[
    int, expert(..., min=1, max=256, help="Number of processes; the results do not depend on it.")
]
Exterior = Annotated[
    str,
    typer.Option(
        "--exterior",
        help="Exterior orientation. per_epoch: one for each epoch; series: one for all epochs; "
        "mount: one for all epochs and random motion of the mount, whose size is estimated; auto: "
        "chosen from the data.",
    ),
]


def _log_options(
    timezone: Timezone = None,
    temperature_column: list[str] | None = typer.Option(
        None, help="Name of a temperature column; repeatable, the first is the reference."
    ),
    name: list[str] | None = typer.Option(
        None, metavar="COLUMN=LABEL", help="Label for a column of the log; repeatable."
    ),
    unit: str | None = typer.Option(None, help="Unit, if the log states none: degC, K, degF."),
    date_order: str | None = expert(
        None, help="Order of dates such as 06/07/26: dmy, mdy or ymd (year first)."
    ),
    time_column: list[str] | None = expert(
        None, help="Name of the log's time column; twice for a date and a time column."
    ),
    log_timezone: str | None = expert(
        None, help="Time zone of the logger; overrides --timezone and what the log states."
    ),
    log_clock: str = expert("0", help="Advance of the logger's clock, such as +00:03:12."),
    ambiguous: str = expert(
        "order",
        help="The hour that occurs twice in autumn: order (of rows), earlier, later, refuse.",
    ),
    encoding: str | None = expert(None, help="Encoding of the log, such as cp1251 or shift_jis."),
    separator: str | None = expert(None, help="Column separator of the log: ';' ',' tab."),
    decimal: str | None = expert(None, help="Decimal mark of the log: , or ."),
) -> Any:
    """Return the options for reading a logger's file, for every command that reads one."""
    given = locals()
    from thermocald.store.logger.options import log_options

    return log_options(**given)


def takes(name: str, function: Callable[..., Any]) -> Callable[[Callable[..., None]], Any]:
    """Return a decorator that adds a function's options to a command.

    The command receives the function's result as `name`, and also every option that its own
    signature lists.
    """
    more = inspect.signature(function, eval_str=True).parameters

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        own = inspect.signature(command, eval_str=True).parameters
        kept = [p for key, p in own.items() if key not in more and key != name]
        added = [p.replace(kind=inspect.Parameter.KEYWORD_ONLY) for p in more.values()]

        @functools.wraps(command)
        def called(**given: Any) -> None:
            options = {key: given[key] if key in own else given.pop(key) for key in more}
            command(**given, **{name: function(**options)})

        last = kept[-1].replace(kind=inspect.Parameter.KEYWORD_ONLY)
        called.__signature__ = inspect.Signature([*kept[:-1], *added, last])  # type: ignore[attr-defined]
        called.__annotations__ = {p.name: p.annotation for p in [*kept, *added]}
        return called

    return decorate


takes_log_options = takes("log_options", _log_options)
