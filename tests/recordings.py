"""A recording (CONVENTIONS §3) written with no code of the program's."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import yaml

Rows = Iterable[Sequence[object]]


def write_recording(
    folder: Path, head: dict[str, Any], epochs: Rows, observations: Rows = (), field: Rows = ()
) -> None:
    """Write the files of a recording; those without rows, observations or field, are left out."""
    folder.mkdir(parents=True, exist_ok=True)
    head = {"format": "thermocald-recording/1", **head}
    (folder / "recording.yaml").write_text(yaml.safe_dump(head, sort_keys=False))
    temperatures = ["epoch", "frame_time", "temperature_time", *head["temperatures"], "frame"]
    write_table(folder / "epochs.csv", temperatures, epochs)
    if observations:
        columns = ["epoch", "target", "x", "y", "sx", "sy"]
        write_table(folder / "observations.csv", columns, observations)
    if field:
        columns = ["target", "X", "Y", "Z", "diameter", "sX", "sY", "sZ"]
        write_table(folder / "testfield.csv", columns, field)


def write_table(path: Path, columns: Sequence[str], rows: Rows) -> None:
    """Write a CSV file."""
    with path.open("w", newline="") as out:
        table = csv.writer(out, lineterminator="\n")
        table.writerow(columns)
        table.writerows(rows)


def read_rows(path: Path) -> list[dict[str, str]]:
    """Read a CSV file."""
    with path.open() as table:
        return list(csv.DictReader(table))


def write_rows(path: Path, rows: Sequence[dict[str, str]]) -> None:
    """Write rows of a CSV file that was read."""
    write_table(path, list(rows[0]), [list(row.values()) for row in rows])
