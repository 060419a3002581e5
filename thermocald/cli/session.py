"""`thermocald session`: from a plugged-in camera to epochs, a recording and the report."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from thermocald.atomic_file import make_folder
from thermocald.cli.common import default_config, say, write_json
from thermocald.cli.options import ConfigOption, JsonOption
from thermocald.errors import ConfigurationError, DataError, UsageError

if TYPE_CHECKING:
    from thermocald.cli.session_separate import Watch
    from thermocald.config import Config
    from thermocald.daemon.session import Session

__all__ = ["group"]

_LOOK_EVERY_S = 0.5
_WAIT_FOR_DAEMON_S = 300.0

CameraOption = Annotated[
    str | None, typer.Option("--camera", help="Which of the configuration's cameras.")
]


def start(
    camera: CameraOption = None,
    series: Annotated[str, typer.Option(help="Name of the series; resumes it.")] = "M1",
    condition: Annotated[
        str, typer.Option("--start", help="Start condition, such as cold or warm.")
    ] = "",
    epochs: Annotated[int, typer.Option(min=1, help="How many epochs.")] = 150,
    config: ConfigOption = None,
    mock: Annotated[bool, typer.Option("--mock", help="Without hardware.")] = False,
    programme: Annotated[
        Path | None, typer.Option(help="Steps of a heating output: YAML list.")
    ] = None,
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder for recording and report.")
    ] = Path(),
    check: Annotated[
        bool, typer.Option("--check/--no-check", help="Look at light, focus, geometry first.")
    ] = True,
    report: Annotated[
        bool, typer.Option("--report/--no-report", help="End with the study's report.")
    ] = True,
    wait: Annotated[
        bool, typer.Option("--wait/--no-wait", help="Wait for a daemon to take all epochs.")
    ] = True,
    until_separated: Annotated[
        str | None,
        typer.Option(
            metavar="A,B", help="Heat so that two effects separate, and stop when they are."
        ),
    ] = None,
    evidence: Annotated[
        Path | None, typer.Option(help="A recording that could not separate them.")
    ] = None,
    max_temperature: Annotated[
        float | None, typer.Option(help="Highest °C of a planned programme [the output's].")
    ] = None,
    max_rate: Annotated[
        float, typer.Option(min=0.1, max=60.0, help="Fastest planned rise, K/min.")
    ] = 3.0,
    max_duty: Annotated[
        float, typer.Option(min=0.05, max=1.0, help="Share of time with heat.")
    ] = 0.8,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Print the planned programme and end.")
    ] = False,
) -> None:
    """Take a series of epochs with progress, then write its recording and its report.

    A daemon that runs with this configuration takes them; where none runs, this command does.
    Interrupted, the same command goes on where it stopped.

    Example: thermocald session start --camera phone-1 --series M1 --start cold --epochs 150
    """
    from thermocald.cli.session_desk import take_on_the_desk

    read = _configuration(config, mock)
    session = _session(read, camera, series, condition, epochs, programme, check)
    watch: Watch | None = None
    if until_separated is not None:
        from thermocald.cli.session_separate import Heating, separating

        heating = Heating(max_temperature, max_rate, max_duty)
        planned = separating(read, session, until_separated, evidence, heating, dry_run)
        if planned is None:
            return
        session, watch = planned
    elif dry_run or evidence is not None:
        raise UsageError("--dry-run and --evidence are for --until-separated A,B")
    path = output / f"{session.camera}-{series}"
    if path.exists():
        raise DataError(f"{path}: the recording exists already; choose another --series")
    folder = _daemon(read)
    try:
        if folder is None:
            make_folder(output)
            read = take_on_the_desk(read, session, watch)
        else:
            _take_in_the_daemon(folder, session, wait or watch is not None, watch)
            if not wait and watch is None:
                return
            make_folder(output)
    finally:
        if watch is not None:
            watch.close()
    _finish(read, session, path, report)


def status(config: ConfigOption = None, json: JsonOption = None) -> None:
    """The sessions of a running daemon: under way, or the last that ended.

    Example: thermocald session status --config /etc/thermocald/config.yaml
    """
    sessions = _ask(config, "session status")["sessions"]
    if json is not None:
        write_json({"format": "thermocald-sessions/1", "sessions": sessions}, json)
    if json == "-":
        return
    for name, one in sessions.items():
        why = f": {one['why']}" if one["why"] else ""
        start = f" ({one['start']})" if one["start"] else ""
        taken = f"{one['taken']} of {one['epochs']}"
        say(f"{name}/{one['series']}{start}: {taken}, {one['state']}{why}")
    if not sessions:
        say("no sessions")


def stop(camera: CameraOption = None, config: ConfigOption = None) -> None:
    """End a session of a running daemon before its time; what was taken stays.

    Example: thermocald session stop --camera phone-1
    """
    name = camera or _only_camera(_configuration(config, False))
    told = _ask(config, "session stop", camera=name)["session"]
    say(f"{name}/{told['series']}: {told['taken']} of {told['epochs']} epochs, stopped")


def _configuration(config: Path | None, mock: bool) -> Config:
    from thermocald.config import load_config
    from thermocald.hal import option_names

    if mock:
        from thermocald.cli.run import mock_config

        if config is not None:
            raise UsageError("give --config or --mock, not both")
        return mock_config()
    path = config or default_config()
    if path is None or not path.exists():
        raise UsageError(
            f"{path or 'config.yaml'}: there is no configuration; give --config FILE, or --mock"
        )
    return load_config(path, option_names)


def _only_camera(config: Config) -> str:
    names = [c.name for c in config.cameras]
    if len(names) != 1:
        raise UsageError(f"which camera? give --camera, one of: {', '.join(names) or 'none'}")
    return names[0]


def _session(
    config: Config, camera: str | None, series: str, condition: str, epochs: int,
    programme: Path | None, check: bool,
) -> Session:  # fmt: skip
    from pydantic import ValidationError

    from thermocald.daemon.session import Session

    names = [c.name for c in config.cameras]
    if camera is None:
        camera = _only_camera(config)
    if camera not in names:
        raise UsageError(f"there is no camera {camera!r}; there are: {', '.join(names) or 'none'}")
    steps = [] if programme is None else _steps(programme)
    asked = {"camera": camera, "series": series, "start": condition, "epochs": epochs}
    try:
        return Session.model_validate({**asked, "programme": steps, "check": check})
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        raise UsageError(f"--{key}: {first['msg']}") from error


def _steps(path: Path) -> list[Any]:
    from thermocald.yaml_file import read_yaml

    steps = read_yaml(path, ConfigurationError).get("programme")
    if not isinstance(steps, list) or not steps:
        raise ConfigurationError(f"{path}: must hold `programme:`, a list of steps")
    return [
        {key: float(v) if isinstance(v, int) else v for key, v in step.items()}
        if isinstance(step, dict)
        else step
        for step in steps
    ]


def _daemon(config: Config) -> Path | None:
    """The live folder of the daemon that listens for this configuration's store."""
    from thermocald.daemon.control import ask
    from thermocald.daemon.live_state import find_state

    folder = find_state(config.store.path)
    return None if ask(folder, "session status") is None else folder


def _ask(config: Path | None, do: str, **values: Any) -> dict[str, Any]:
    from thermocald.daemon.control import ask
    from thermocald.daemon.live_state import find_state

    read = _configuration(config, False)
    told = ask(find_state(read.store.path), do, **values)
    if told is None:
        raise DataError(f"no daemon listens for {read.store.path}; is it running?")
    return told


def _take_in_the_daemon(
    folder: Path, session: Session, wait: bool, watch: Watch | None = None
) -> None:
    """Have a running daemon take the session, and look on."""
    from thermocald.cli.session_progress import Progress
    from thermocald.daemon.control import DaemonBusy, ask

    told = ask(folder, "session start", session=session.model_dump(mode="json"))
    if told is None:
        raise DataError("the daemon ended just now; give the command again")
    say(f"{session.camera}/{session.series}: taken by the daemon; Ctrl-C leaves it to that")
    if not wait:
        return
    progress, seen, away_since = Progress(session.epochs), 0, 0.0
    while True:
        time.sleep(_LOOK_EVERY_S)
        try:
            told = ask(folder, "session status")
        except DaemonBusy:
            told = None
        if told is None:
            if not away_since:
                away_since = time.monotonic()
                say("the daemon does not answer; it goes on when it is back")
            if time.monotonic() - away_since > _WAIT_FOR_DAEMON_S:
                raise DataError("the daemon is gone; when it runs again the session goes on")
            continue
        away_since = 0.0
        one = told["sessions"].get(session.camera, {})
        if one.get("series") != session.series:
            raise DataError("the daemon ended before the session began; give the command again")
        for sentence in one["found"][seen:]:
            say(sentence)
        seen = max(seen, len(one["found"]))
        progress.show(one.get("last", {}), one["why"] if one["state"] == "paused" else "")
        if watch is not None and watch.look(one["taken"]):
            ask(folder, "session stop", camera=session.camera)
            return
        if one["state"] == "done":
            return
        if one["state"] in ("refused", "stopped"):
            raise DataError(f"{one['taken']} of {one['epochs']} epochs: {one['why']}")


def _finish(config: Config, session: Session, path: Path, report: bool) -> None:
    from thermocald.store.database.archive import archive_series
    from thermocald.store.database.store import Store

    with Store.open(config.store.path) as store:
        found = store.find_series(session.camera, session.series)
        archive_series(store, found, path, config.frames.folder)
        status = store.series_columns(found, ["status"])["status"]
    say(f"\nrecording: {path} ({int(np.sum(status == 'ok'))} of {len(status)} epochs calibrated)")
    if not report:
        return
    from thermocald.analysis.study.input import load_series
    from thermocald.analysis.study.study import study
    from thermocald.output.study.report import render_report, write_report

    target = path.with_suffix(".html")
    title = f"{session.camera}, series {session.series}"
    write_report(target, render_report(study(load_series(path)), title))
    say(f"report: {target}")


group = typer.Typer(help="One measurement series, from the check to the report.")
group.command("start")(start)
group.command("status")(status)
group.command("stop")(stop)
