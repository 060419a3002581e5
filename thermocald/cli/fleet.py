"""`thermocald fleet`: all cameras of a server, and which of them somebody should look at."""

from __future__ import annotations

import math
import textwrap
from pathlib import Path
from typing import Annotated, Any

import typer

from thermocald.cli.common import write_result, write_text
from thermocald.cli.options import JsonOption

__all__ = ["fleet"]

_WIDTH = 80
_MOST_SOUND = 40
_LONGEST_NAME = 34


def fleet(
    servers: Annotated[
        list[str],
        typer.Argument(metavar="ADDRESS…", help="postgresql://USER@HOST/DATABASE?station=…"),
    ],
    report: Annotated[Path | None, typer.Option(help="Write a page, one HTML file.")] = None,
    every: Annotated[
        bool, typer.Option("--all", help="List every camera, also of a large fleet.")
    ] = False,
    json: JsonOption = None,
) -> None:
    """Show late and dead stations, sensors and clocks, odd cameras, and what needs calibration.

    Example: thermocald fleet postgresql://reader@db.example/thermocald --report fleet.html
    """
    from thermocald.fleet.document import fleet_document

    document = fleet_document([Path(server) for server in servers])
    if report is not None:
        from thermocald.output.fleet.page import render_fleet

        write_text(render_fleet(document), report)
    if write_result(document, json):
        for line in _lines(document, every):
            typer.echo(line)


def _lines(document: dict[str, Any], every: bool) -> list[str]:
    cameras = document["cameras"]
    if not cameras:
        return ["no epochs there yet; stations send theirs with `thermocald forward`"]
    summary = document["summary"]
    words = {
        "late": "late", "sensor": "with a dead sensor", "calibrate": "need calibration",
        "odd": "unlike their type", "clock": "with a wrong clock", "refused": "with refused rows",
    }  # fmt: skip
    parts = [f"{summary[kind]} {text}" for kind, text in words.items() if summary[kind]]
    head = (
        f"{summary['cameras']} cameras at {summary['stations']} stations: {summary['sound']} sound"
    )
    lines = textwrap.wrap(", ".join([head, *parts]), _WIDTH)
    shown = [c for c in cameras if c["findings"]]
    shown += [c for c in cameras if not c["findings"]][: None if every else _MOST_SOUND]
    name = min(_LONGEST_NAME, max(14, *(len(_name(c)) for c in shown)))
    heads = f"{'last':>7} {'waiting':>7} {'ok':>5} {'°C':>6} {'c µm/K':>16}"
    lines += ["", f"{'station/camera':<{name}} {heads}"]
    for camera in shown:
        lines.append(_row(camera, name))
        for finding in camera["findings"]:
            lines += textwrap.wrap(
                finding["text"],
                _WIDTH,
                initial_indent=f"  {finding['kind']}: ",
                subsequent_indent="      ",
            )
    if hidden := len(cameras) - len(shown):
        lines.append(f"and {hidden} more without a finding (--all)")
    for kind in document["types"]:
        rate = kind["rates"]["c"]
        lines += textwrap.wrap(
            f"type {kind['type']}: {len(kind['cameras'])} cameras, c {rate['value'] * 1e3:+.3f} ± "
            f"{rate['sd'] * 1e3:.3f} µm/K, between cameras ± {rate['sd_between'] * 1e3:.3f}",
            _WIDTH,
            subsequent_indent="  ",
        )
    return lines


def _row(camera: dict[str, Any], width: int) -> str:
    from thermocald.durations import short_duration

    rate = camera["rates"].get("c")
    text = "–" if rate is None else f"{rate['value'] * 1e3:+.3f} ± {rate['sd'] * 1e3:.3f}"
    waiting = "–" if camera["waiting"] is None else str(camera["waiting"])
    ok = "–" if not math.isfinite(camera["ok"]) else f"{camera['ok']:.0%}"
    degrees = camera["temperature"]
    return (
        f"{_shortened(_name(camera), width):<{width}} {short_duration(camera['lag_s']):>7} "
        f"{waiting:>7} {ok:>5} {'–' if not math.isfinite(degrees) else f'{degrees:.1f}':>6} "
        f"{text:>16}"
    )


def _name(camera: dict[str, Any]) -> str:
    return f"{camera['station']}/{camera['camera']}"


def _shortened(text: str, width: int) -> str:
    return text if len(text) <= width else f"{text[: width - 1]}…"
