"""`thermocald session`: take a measurement series, up to its recording and report."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import thermocald as tc
from thermocald.cli import options as opt
from thermocald.cli.commands import expert, subcommands
from thermocald.cli.common import require_config, say, session_line, show
from thermocald.errors import DataError, UsageError
from thermocald.files import make_folder

if TYPE_CHECKING:
    from thermocald.config import Config
    from thermocald.daemon.desk import Watch
    from thermocald.daemon.session import Session

CameraOption = Annotated[
    str | None, typer.Option("--camera", help="Camera, if the configuration has several.")
]


def start(
    camera: CameraOption = None,
    series: str = typer.Option("M1", help="Name of the series; an unfinished one is resumed."),
    condition: str = typer.Option("", "--start", help="Start condition, such as cold or warm."),
    epochs: int = typer.Option(150, min=1, help="Number of epochs."),
    config: opt.Config = None,
    mock: bool = typer.Option(False, "--mock", help="Use a rendered camera, without hardware."),
    programme: Path | None = typer.Option(None, help="Programme of the heating output (YAML)."),
    output: Path = typer.Option(Path(), "--output", "-o", help="Folder for recording and report."),
    check: bool = typer.Option(
        True, "--check/--no-check", help="Check light, focus and geometry first."
    ),
    report: bool = typer.Option(True, "--report/--no-report", help="Finish with a study's report."),
    wait: bool = typer.Option(
        True, "--wait/--no-wait", help="Wait until a running daemon has taken all epochs."
    ),
    until_separated: str | None = typer.Option(
        None, metavar="A,B", help="Plan the heating to separate two effects; stop once they are."
    ),
    evidence: Path | None = expert(None, help="A recording that could not separate A and B."),
    max_temperature: float | None = expert(
        None, help="Highest temperature of a planned programme, °C; default: the output's limit."
    ),
    max_rate: float = expert(3.0, min=0.1, max=60.0, help="Fastest planned rise, K/min."),
    max_duty: float = expert(0.8, min=0.05, max=1.0, help="Largest share of time with heating."),
    dry_run: bool = expert(False, "--dry-run", help="Print the planned programme and exit."),
) -> None:
    """Take a series of epochs, showing progress, then write its recording and its report.

    A daemon that runs with this configuration takes the epochs; if none runs, this command does.
    If it was interrupted, the same command continues the series.

    Example: thermocald session start --camera phone-1 --series M1 --start cold --epochs 150
    """
    from thermocald.daemon import desk
    from thermocald.daemon.control import ask
    from thermocald.daemon.live_state import find_state

    read = _configuration(config, mock)
    session = desk.session_of(read, camera, series, condition, epochs, programme, check)
    watch: Watch | None = None
    if until_separated is not None:
        known = None if evidence is None else tc.open(evidence).observed()
        text, session, watch = desk.plan_separation(
            read, session, until_separated, known, say, max_temperature, max_rate, max_duty
        )
        (typer.echo if dry_run else say)(text)
        if dry_run:
            return
    path = output / f"{session.camera}-{series}"
    if path.exists():
        raise DataError(f"{path}: the recording exists already; choose another --series")
    folder, wait = find_state(read.store.path), wait or watch is not None
    try:
        if ask(folder, "session status") is None:
            make_folder(output)
            desk.take_on_the_desk(read, session, say, watch)
        else:
            desk.take_in_the_daemon(folder, session, wait, say, watch)
            if not wait:
                return
            make_folder(output)
    finally:
        if watch is not None:
            watch.close()
    _finish(read, session, path, report)


def status(config: opt.Config = None, json: opt.Json = None) -> None:
    """Show the sessions of a running daemon, in progress or last finished.

    Example: thermocald session status --config /etc/thermocald/config.yaml
    """
    sessions = _ask(_configuration(config), "session status")["sessions"]
    lines = map(session_line, sessions.values()) if sessions else ["no sessions"]
    show({"format": "thermocald-sessions/1", "sessions": sessions}, json, *lines)


def stop(camera: CameraOption = None, config: opt.Config = None) -> None:
    """Stop a session of a running daemon early; the epochs taken so far stay in the store.

    Example: thermocald session stop --camera phone-1
    """
    from thermocald.daemon.desk import only_camera

    read = _configuration(config)
    name = only_camera(read, camera)
    one = _ask(read, "session stop", camera=name)["session"]
    say(f"{name}/{one['series']}: {one['taken']} of {one['epochs']} epochs, stopped")


def _configuration(config: Path | None, mock: bool | None = None) -> Config:
    """Read the configuration; mock: whether to use that of the rendered camera, None: never."""
    from thermocald.config import load_config
    from thermocald.hal import load_driver

    if mock:
        from thermocald.daemon.plan import mock_config

        if config is not None:
            raise UsageError("give --config or --mock, not both")
        return mock_config()
    instead = "--config FILE" + ", or --mock" * (mock is not None)
    return load_config(require_config(config, instead), load_driver)


def _ask(config: Config, do: str, **values: Any) -> dict[str, Any]:
    from thermocald.daemon.control import ask
    from thermocald.daemon.live_state import find_state

    answer = ask(find_state(config.store.path), do, **values)
    if answer is None:
        raise DataError(
            f"no daemon is running for {config.store.path}; start it with `thermocald run`"
        )
    return answer


def _finish(config: Config, session: Session, path: Path, report: bool) -> None:
    from thermocald.store.archive import archive_series
    from thermocald.store.database.store import Store

    with Store.open(config.store.path) as store:
        found = store.find_series(session.camera, session.series)
        archive_series(store, found, path, config.frames.folder)
        status = store.series_columns(found, ["status"])["status"]
    say(f"\nrecording: {path} ({(status == 'ok').sum()} of {len(status)} epochs calibrated)")
    if not report:
        return
    target = path.with_suffix(".html")
    title = f"{session.camera}, series {session.series}"
    tc.study(*tc.open_all(path)).report(target, title)
    say(f"report: {target}")


group = subcommands(start=start, status=status, stop=stop)
