"""`thermocald discover`: where simulation and measurement disagree, why, and the proof."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from thermocald.cli.commands import expert
from thermocald.cli.common import progress, say, write_result
from thermocald.cli.options import JobsOption, JsonOption
from thermocald.errors import UsageError


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
        Path | None, expert(help="Write what was found as an effect file (YAML).")
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
    strength: Annotated[float, expert(min=0.001, help="With --plan: size of an effect, px.")] = 0.1,
    seeds: Annotated[int, expert(min=1, max=50, help="With --plan: repetitions.")] = 2,
) -> None:
    """Find where simulation and measurement disagree, name the missing effect, prove it.

    Example: thermocald discover M1 --verify M2 --model-out camera.yaml --report discovery.html
    """
    import thermocald as tc

    if plan:
        with progress(None, "planning") as advance:
            planned = tc.plan(
                None if recording is None else tc.open(recording), preset=preset, model=model,
                testfield=testfield, programme=programme, strength_px=strength, seeds=seeds,
                progress=advance,
            )  # fmt: skip
        if write_result(planned.as_dict(), json):
            typer.echo(str(planned))
        return
    if recording is None:
        raise UsageError("M1 is missing: the folder of the recording to explain")
    others = [tc.open(path) for path in verify or ()]
    found = tc.discover(tc.open(recording), verify=others, model=model, jobs=jobs, say=say)
    document = found.as_dict()
    if model_out is not None:
        document["model"] = str(found.save(model_out))
    if effect_out is not None and found.save_effects(effect_out) is None:
        say(f"{effect_out} is not written: nothing was found that another recording would show too")
    if report is not None:
        found.report(report)
    if write_result(document, json):
        typer.echo(str(found))
