"""The daemon's status in lines for a terminal of 80 columns, or for a pipe.

A block for each camera, because a table of all that is known of one does not fit; a line for each
other device. Nothing is cut off: long reasons are left to the terminal to wrap.
"""

from __future__ import annotations

import math
import textwrap
from typing import Any

from thermocald.names import WITH_VALUES
from thermocald.numbers import duration, with_sd

WIDTH = 79
_OLD_S = 10.0


def status_lines(document: dict[str, Any]) -> list[str]:
    """Lines of a `thermocald-status/1` document; the first is the headline."""
    lines = [_headline(document), ""]
    for name, camera in document["cameras"].items():
        lines += _camera(name, camera)
    for one in document["sessions"].values():
        lines += _wrapped(_session(one))
    others = [
        (name, device)
        for kind in ("thermometers", "outputs")
        for name, device in document[kind].items()
    ]
    wide = max((len(name) for name, _ in others), default=0)
    for name, device in others:
        lines += _wrapped(f"{name:<{wide}}  {_device(device)}", wide + 2)
    lines += [part for text in status_warnings(document) for part in _wrapped(f"! {text}")]
    return lines


def _wrapped(text: str, indent: int = 2) -> list[str]:
    """A line in lines of 79 characters, between words; a path is never broken."""
    return textwrap.wrap(
        text, WIDTH, subsequent_indent=" " * indent, break_long_words=False,
        break_on_hyphens=False,
    ) or [""]  # fmt: skip


def _headline(document: dict[str, Any]) -> str:
    running = duration(max(0.0, document["utc"] - document["started"]))
    text = f"thermocald {document['version']}, pid {document['pid']}, for {running}"
    if document["age_s"] > _OLD_S:
        text += f"; this is {duration(document['age_s'])} old: it does not answer"
    return text


def _camera(name: str, camera: dict[str, Any]) -> list[str]:
    last = camera.get("last") or {}
    title = f"{name}/{camera['series']}" if camera["series"] else f"{name}, idle"
    lines = [f"{title}: {camera['device']}"]
    if last:
        temperature = last.get("temperature")
        at = "" if temperature is None else f" at {temperature:.2f} °C"
        lines[0] += f", epoch {last.get('epoch', '?')}{at}"
        if last.get("status") in WITH_VALUES:
            lines += _orientation(last)
            lines += _wrapped(f"  {_movement(last)}")
            if said := (last.get("online") or {}).get("orientation"):
                lines += _wrapped(f"  {said}")
        else:
            lines += _wrapped(f"  {last.get('status', '')}: {last.get('reason', '')}")
    late = 1000 * camera["late_p99_s"]
    count = f"  {camera['lost']} lost, {camera['skipped']} skipped"
    return [*lines, f"{count}; 99 % at most {late:.0f} ms late", ""]


def _orientation(last: dict[str, Any]) -> list[str]:
    """c, x0, y0 with their standard deviations and drifts, a line each."""
    lines = []
    for name in ("c", "x0", "y0"):
        value, sd = last.get(name), last.get(f"sd_{name}")
        if value is None or not math.isfinite(value):
            continue
        line = f"  {name:<2} {with_sd(value, math.nan if sd is None else sd, 'mm')}"
        drift, sd_drift = last.get(f"drift_{name}_px"), last.get(f"sd_drift_{name}_px")
        if drift is not None and sd_drift is not None:
            line = f"{line:<34}moved {with_sd(drift, sd_drift, 'px')} since the start"
        lines.append(line)
    return lines


def _movement(last: dict[str, Any]) -> str:
    online = last.get("online") or {}
    said = str(online.get("sentence") or last.get("state", ""))
    sigma0 = last.get("sigma0")
    fit = "" if sigma0 is None or not math.isfinite(sigma0) else f"σ₀ {sigma0:.2f}"
    return ", ".join(part for part in (fit, said) if part)


def _device(device: dict[str, Any]) -> str:
    shown = [
        f"{value:.2f} °C" if name == "temperature" else f"{name.replace('_', ' ')} {value:.2f}"
        for name, value in device.get("last", {}).items()
        if value is not None
    ]
    last = ", ".join(shown)
    text: str = device["device"] + (f", {last}" if last else "")
    if device["faults"]:
        text += f", {device['faults']} fault{'' if device['faults'] == 1 else 's'}"
    return text + (f": {device['why']}" if device["why"] else "")


def _session(one: dict[str, Any]) -> str:
    why = f": {one['why']}" if one["why"] else ""
    start = f", {one['start']}" if one["start"] else ""
    taken = f"{one['taken']} of {one['epochs']} epochs"
    return f"session {one['camera']}/{one['series']}{start}: {taken}, {one['state']}{why}"


def status_warnings(document: dict[str, Any]) -> list[str]:
    """What a person should know, a sentence each."""
    found = list(document["stalled"])
    store = document["store"]
    if store["state"] != "ok":
        found.append(f"store: {store['state']}: {store['why']} ({store['waiting']} epochs wait)")
    if store["lost"]:
        found.append(f"{store['lost']} epochs are lost, taken and not kept: {store['lost_why']}")
    if store.get("notice"):
        found.append(f"store: {store['notice']}")
    if document.get("dashboard", {}).get("why"):
        found.append(document["dashboard"]["why"])
    if document["frames"]["paused"]:
        found.append(document["frames"]["paused"])
    if not document["clock"]["trusted"]:
        found.append("the clock is not synchronised: times may be wrong")
    if not document["frames"].get("ages_known", True):
        found.append("no frame is deleted for its age until the clock can be trusted")
    for kind in ("camera", "thermometer", "output"):
        for name, device in document[f"{kind}s"].items():
            found += [f"{kind} {name}: {text}" for text in device.get("warnings", ())]
    for name, camera in document["cameras"].items():
        if camera["why"]:
            found.append(f"camera {name}: {camera['why']}")
        if camera["deferred"] > camera["caught_up"]:
            found.append(
                f"camera {name}: {camera['deferred'] - camera['caught_up']} epochs are still to be "
                "calibrated"
            )
    return found
