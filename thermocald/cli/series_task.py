"""One series analysed on its own, wherever that is: what `reprocess` hands to many processes."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from thermocald.errors import DataError, OutputError, ThermocaldError, UsageError
from thermocald.files import make_folder, write_text
from thermocald.result import jsonable
from thermocald.store.server.connection import ServerAddress, is_server
from thermocald.store.sources import source_name

ANALYSES = ("discover", "study")


@dataclass(frozen=True, slots=True)
class SeriesTask:
    """An analysis of one series: a recording's folder or an address that selects it.

    target: the JSON file it writes; sets: of the study's Monte-Carlo simulation.
    """

    analysis: str
    source: Path
    target: Path
    sets: int = 100_000


@dataclass(frozen=True, slots=True)
class SeriesOutcome:
    """What became of a task; `error` is empty where its file is written.

    not_written: the exit status where it is the file that could not be written, else 0.
    """

    task: SeriesTask
    error: str = ""
    not_written: int = 0


def find_series_tasks(sources: list[Path], out: Path, analysis: str, sets: int) -> list[SeriesTask]:
    """A task for every series below some folders, or at some addresses, that is not done yet.

    Raises DataError where there is none, UsageError for an unknown analysis.
    """
    if analysis not in ANALYSES:
        raise UsageError(f"--do {analysis}: there are calibrate, {', '.join(ANALYSES)}")
    found: dict[str, Path] = {}
    for source in sources:
        places = _at_server(source) if is_server(source) else _recordings(source)
        for name, place in places:
            if name in found:
                raise DataError(
                    f"{source_name(place)} and {source_name(found[name])} are the same series "
                    f"{name}; analyse them into folders of their own"
                )
            found[name] = place
    if not found:
        raise DataError(f"{', '.join(map(source_name, sources))}: no series is there")
    tasks = [SeriesTask(analysis, place, out / f"{name}.json", sets)
             for name, place in sorted(found.items())]  # fmt: skip
    return [task for task in tasks if not task.target.exists()]


def analyse(task: SeriesTask) -> SeriesOutcome:
    """Do one task and write its file, whole or not at all; never raises for its data."""
    try:
        document = _discovered(task) if task.analysis == "discover" else _studied(task)
        make_folder(task.target.parent)
        write_text(task.target, json.dumps(jsonable(document), indent=1, allow_nan=False) + "\n")
    except OutputError as error:
        return SeriesOutcome(task, str(error), error.exit_status)
    except (ThermocaldError, OSError) as error:
        return SeriesOutcome(task, str(error))
    return SeriesOutcome(task)


def lost(task: SeriesTask, why: str) -> SeriesOutcome:
    """The outcome of a task whose process died."""
    return SeriesOutcome(task, why)


def _discovered(task: SeriesTask) -> dict[str, Any]:
    import thermocald as tc

    return tc.discover(tc.open(task.source)).as_dict()


def _studied(task: SeriesTask) -> dict[str, Any]:
    import thermocald as tc

    return tc.study(*tc.open_all(task.source), sets=task.sets).as_dict()


def _recordings(folder: Path) -> list[tuple[str, Path]]:
    from thermocald.store.recording.head import read_head

    found = sorted({p.parent for p in folder.rglob("recording.yaml")})
    heads = [(read_head(path), path) for path in found]
    return [(_file_name(head.camera.name, head.series), path) for head, path in heads]


def _at_server(address: Path) -> list[tuple[str, Path]]:
    from thermocald.store.server.reader import ServerStore

    with ServerStore.open(address) as store:
        every = store.all_series()
    found = []
    for series in every:
        chosen = {"station": str(series.identity["station"]), "camera": series.camera,
                  "series": series.name}  # fmt: skip
        found.append((_file_name(*chosen.values()), ServerAddress.narrowed(address, **chosen)))
    return found


def _file_name(*parts: str) -> str:
    return "-".join(parts).replace(os.sep, "_")
