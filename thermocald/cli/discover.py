"""`thermocald discover`: where simulation and measurement disagree, why, and the proof."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from thermocald.cli.common import say, write_result, write_text
from thermocald.cli.options import JobsOption, JsonOption
from thermocald.errors import UsageError

if TYPE_CHECKING:
    from thermocald.discovery.verdict.result import Discovery

__all__ = ["discover"]


def discover(
    recording: Annotated[
        Path | None,
        typer.Argument(metavar="M1", help="What to explain: a recording, a store, postgresql://…"),
    ] = None,
    verify: Annotated[
        list[Path] | None,
        typer.Option(help="M2: another recording of this camera, to prove it on; repeatable."),
    ] = None,
    model: Annotated[
        Path | None, typer.Option(help="The model so far (YAML) [base model].")
    ] = None,
    json: JsonOption = None,
    model_out: Annotated[
        Path | None, typer.Option(help="Write the model with what was found.")
    ] = None,
    effect_out: Annotated[
        Path | None, typer.Option(help="Write what was found as an effect file (YAML).")
    ] = None,
    report: Annotated[Path | None, typer.Option(help="Write a report, one HTML file.")] = None,
    jobs: JobsOption = 1,
    plan: Annotated[
        bool,
        typer.Option("--plan", help="Which effects a set-up would show, before heating anything."),
    ] = False,
    preset: Annotated[
        str | None, typer.Option(help="With --plan: a camera of the reference study.")
    ] = None,
    testfield: Annotated[str | None, typer.Option(help="With --plan: a testfield.csv.")] = None,
    programme: Annotated[
        Path | None, typer.Option(help="With --plan: what is done to the camera.")
    ] = None,
    strength: Annotated[
        float, typer.Option(min=0.001, help="With --plan: size of an effect, px.")
    ] = 0.1,
    seeds: Annotated[int, typer.Option(min=1, max=50, help="With --plan: repetitions.")] = 2,
) -> None:
    """Find where simulation and measurement disagree, name the missing effect, prove it.

    Example: thermocald discover M1 --verify M2 --model-out camera.yaml --report discovery.html
    """
    if plan:
        _plan(recording, model, preset, testfield, programme, strength, seeds, json)
        return
    if recording is None:
        raise UsageError("M1 is missing: the folder of the recording to explain")
    found = _examined(recording, verify or [], model, jobs)
    written: str | None = None
    if model_out is not None:
        from thermocald.discovery.verdict.model import model_of
        from thermocald.simulation.model_file import read_model, write_model

        write_model(model_out, model_of(found, read_model(model) if model else None))
        written = str(model_out)
    if effect_out is not None:
        _write_effects(effect_out, found)
    if report is not None:
        from thermocald.output.discovery.report import report_html
        from thermocald.store.sources import source_name

        write_text(report_html(found, source_name(recording).rsplit("/", 1)[-1]), report)
    if write_result(found.as_json(written), json):
        for line in _lines(found):
            typer.echo(line)


def _examined(recording: Path, verify: list[Path], model: Path | None, jobs: int) -> Discovery:
    from thermocald.discovery.evidence.pair import load_together
    from thermocald.discovery.verdict.found import terms_of
    from thermocald.discovery.verdict.result import discover_series
    from thermocald.reduction.reduce import reduce_together
    from thermocald.simulation.model_file import read_model

    old = read_model(model) if model is not None else None
    inputs = load_together(recording, verify, say, jobs)
    say("reducing the epochs to normal equations")
    evidence = reduce_together(inputs, old.T0 if old else None)
    return discover_series(evidence, say, terms_of(old) if old else (), jobs)


def _write_effects(path: Path, found: Discovery) -> None:
    from thermocald.discovery.verdict.found import effects_of
    from thermocald.simulation.effect_file import write_effects

    effects = [one for entry in found.effects for one in effects_of(entry)]
    if not effects:
        say(f"{path} is not written: nothing was found that another recording would show too")
        return
    document = found.as_json(None)
    write_effects(
        path,
        effects,
        "; ".join(e.statement for e in found.effects),
        {"verdict": found.verdict, "gap": document["gap"]},
    )


def _lines(found: Discovery) -> list[str]:
    """The result for people."""
    from thermocald.discovery.verdict.field import field_lines
    from thermocald.discovery.verdict.mount import mount_lines
    from thermocald.output.figures.numbers import with_sd

    first, last = found.stages[0], found.stages[-1]
    lines = [f"verdict: {found.headline}"]
    if found.verdict == "adequate":
        lines.append("the model reproduces the recording; nothing is missing that it could show")
    for effect in found.effects:
        lines.append(f"{effect.effect}: {effect.statement}")
        for name, e in effect.estimates.items():
            if isinstance(e["value"], float):
                sd = math.nan if e["sd"] is None else e["sd"]
                lines.append(f"    {name} = {with_sd(e['value'], sd, e['unit'])}")
        if "false_alarm_probability" in effect.evidence:
            surrogates = effect.evidence["surrogates"]
            lines.append(
                f"    probability of a false name {effect.evidence['false_alarm_probability']:.3f} "
                f"(gain {surrogates['gain']:.0f}; the largest of {surrogates['count']} surrogates "
                f"{surrogates['gains_of_surrogates'][-1]:.0f})"
            )
        if proposal := effect.evidence.get("proposal"):
            lines.append(
                f"    constants of the first recording explain "
                f"{proposal['closed_on_verify_by_fit']:.0%} of the misfit of the second; "
                f"probability of a false formula {proposal['false_alarm_probability']:.3f}"
            )
        lines += [
            f"    not excluded: {a['effect']}; {a['experiment']}"
            for a in effect.alternatives
            if not a.get("resembles")
        ]
    lines += [*mount_lines(found.examination), *field_lines(found.examination)]
    names = [Path(e.source.name).name or e.source.name for e in found.examination.fitter.series]
    gaps = zip((first.fit, *first.others), (last.fit, *last.others), strict=True)
    for name, (before, after) in zip(names, gaps, strict=True):
        lines.append(
            f"gap on {name}: {before.rms_px:.4f} → {after.rms_px:.4f} px RMS, reduced χ² "
            f"{before.chi2_reduced:.3f} → {after.chi2_reduced:.3f}, "
            f"{before.object_mm_at_10m:.2f} → {after.object_mm_at_10m:.2f} mm at 10 m"
        )
    return lines


def _plan(
    recording: Path | None,
    model: Path | None,
    preset: str | None,
    testfield: str | None,
    programme: Path | None,
    strength: float,
    seeds: int,
    json: str | None,
) -> None:
    from thermocald.cli.common import progress
    from thermocald.discovery.plan import plan_power, set_ups

    with progress(None, "planning") as advance:
        inputs = set_ups(recording, model, preset, testfield, programme, seeds)
        result = plan_power(inputs, strength, lambda: advance(1))
    if write_result(result.as_json(), json):
        for line in result.lines():
            typer.echo(line)
