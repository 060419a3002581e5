"""`thermocald testfield print | import | survey | check`: make, survey and assess a test field."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import thermocald as tc
from thermocald.cli import options as opt
from thermocald.cli.commands import expert, subcommands
from thermocald.cli.common import say, show, two_numbers
from thermocald.errors import UsageError

if TYPE_CHECKING:
    from thermocald.output.testfield.sheets import Design

CameraFile = Annotated[
    Path | None,
    typer.Option("--camera", help="A camera file of any format that `camera convert` reads."),
]
Paper = Annotated[str, typer.Option("--paper", help="A4, A3, A2, A1, A0, or WIDTHxHEIGHT in mm.")]
Flat = Annotated[
    bool,
    typer.Option(
        "--flat/--corner",
        help="One flat sheet instead of a corner of three. A fixed camera cannot be calibrated "
        "from one flat sheet.",
    ),
]
Landscape = Annotated[
    bool | None,
    expert("--landscape/--portrait", help="Default: landscape for a corner, else portrait."),
]
Diameter = Annotated[
    float | None,
    typer.Option("--diameter", help="Diameter of the targets, mm; default: by paper size."),
]
Point = tuple[float, float, float]


def _board(
    charuco: str | None = typer.Option(None, help="A ChArUco board, such as 11x8 squares."),
    chessboard: str | None = typer.Option(None, help="A chessboard, such as 9x6 inner corners."),
    aprilgrid: str | None = typer.Option(None, help="An AprilGrid of Kalibr, such as 6x6 tags."),
    square: float | None = typer.Option(None, min=0.1, max=2000, help="Side of a square, mm."),
    marker: float | None = typer.Option(None, min=0.1, max=2000, help="Side of a tag, mm."),
    spacing: float = expert(0.3, min=0.01, max=10, help="Gap between AprilGrid tags, in sides."),
    dictionary: str = expert(
        "DICT_5X5_1000", help="Dictionary of a ChArUco board, by its OpenCV name."
    ),
    legacy: bool = expert(False, "--legacy", help="ChArUco as drawn by OpenCV before 4.6."),
) -> Any:
    """Return the board that these options describe, or None; a size that is not given is 0.

    Raises UsageError for two boards, or for counts that cannot be read.
    """
    from thermocald.output.testfield.sheets import Board

    named = {"charuco": charuco, "chessboard": chessboard, "aprilgrid": aprilgrid}
    given = [(kind, counts) for kind, counts in named.items() if counts]
    if len(given) > 1:
        raise UsageError(f"--{given[0][0]} and --{given[1][0]}: one board at a time")
    if not given:
        if square or marker:
            raise UsageError("--square, --marker: give --charuco, --chessboard or --aprilgrid too")
        return None
    kind, counts = given[0]
    if kind == "chessboard" and marker:
        raise UsageError("--marker: a chessboard has no tags")
    if kind == "aprilgrid" and square:
        raise UsageError("--square: the size of an AprilGrid is that of its tags: --marker")
    columns, rows = two_numbers(f"--{kind}", counts, "COLUMNSxROWS, up to 1000, such as 9x6", 1000)
    return Board(kind, columns, rows, square or 0.0, marker or 0.0, spacing, dictionary, legacy)


takes_board = opt.takes("board", _board)


@takes_board
def print_(
    out: Path = typer.Option(..., "--out", "-o", help="The folder to write into."),
    paper: Paper = "A3",
    flat: Flat = False,
    landscape: Landscape = None,
    diameter: Diameter = None,
    bits: int | None = expert(None, help="Bits of the ring codes: 12, 14, or 0 for no codes."),
    plain: bool = expert(True, "--plain/--no-plain", help="Plain circles between coded targets."),
    markers: str | None = expert(None, help="Add markers of a dictionary: DICT_APRILTAG_36h11."),
    light: bool = expert(False, "--light", help="White targets on black."),
    first_code: int = expert(0, min=0, help="Skip this many codes, for a second field."),
    pitch: float | None = expert(None, help="Spacing of the coded targets, mm."),
    force: bool = typer.Option(
        False, "--force", help="Replace a test field printed earlier into this folder."
    ),
    board: Any = None,
    json: opt.Json = None,
) -> None:
    """Draw a test field: a PDF, one SVG per sheet, and the testfield.csv with its coordinates.

    The default is a corner of three sheets; the last page of the PDF shows how to mount it.
    Print without scaling ("actual size"), measure the rulers, then survey the mounted field.

    With --charuco, --chessboard or --aprilgrid, one board of that kind is drawn, as large as the
    paper allows unless its sizes are given.

    Example: thermocald testfield print --paper A3 --out field

    Example: thermocald testfield print --aprilgrid 6x6 --paper A2 --out board
    """
    from thermocald.output.testfield import sheets

    if board is not None:  # by default the page has the orientation of the board
        page = sheets.paper_size(paper, landscape, usual=board.columns > board.rows)
        printed = sheets.print_board(sheets.filled(board, page), page, out, replace_printed=force)
    else:
        design = replace(
            _design(paper, flat, landscape, diameter),
            bits=bits, plain=plain, dictionary=markers, light=light, first_code=first_code,
            pitch=pitch,
        )  # fmt: skip
        printed = sheets.print_testfield(design, out, replace_printed=force)
    show(printed, json, *printed.lines())
    if printed.is_flat and json != "-":
        say(sheets.ONE_PLANE)


@takes_board
def import_(
    source: Path | None = typer.Argument(
        None,
        metavar="FILE",
        help="Kalibr's target.yaml, OpenCV's board parameters, a calib.io file, or a target list.",
    ),
    out: Path = typer.Option(
        Path("testfield.csv"), "--out", "-o", help="The testfield.csv to write."
    ),
    rings: int | None = expert(None, help="FILE lists targets with ring codes of 12 or 14 bits."),
    diameter: float | None = typer.Option(None, min=0.1, help="Diameter of the coded targets, mm."),
    sigma: float | None = typer.Option(
        None, min=1e-4, help="Standard deviation of a coordinate, mm, if the board was measured."
    ),
    force: bool = typer.Option(False, "--force", help="Replace an existing file."),
    board: Any = None,
    json: opt.Json = None,
) -> None:
    """Make a testfield.csv for a board that you own: ChArUco, chessboard, AprilGrid, coded rings.

    One flat board suffices to calibrate a camera from several poses (`thermocald calibrate`). For a
    series with a fixed camera, mount several boards at an angle to each other and survey them
    together.

    Example: thermocald testfield import april_6x6.yaml --out aprilgrid.csv

    Example: thermocald testfield import --charuco 11x8 --square 30 --marker 22 --dictionary
    DICT_5X5_250 --out charuco.csv
    """
    from thermocald.store.recording.testfield_file import read_board, read_rings, write_testfield

    if (source is None) == (board is None):
        raise UsageError(
            "give a file, or one of --charuco, --chessboard, --aprilgrid with its sizes"
        )
    if out.exists() and not force:
        raise UsageError(f"{out}: exists already; give another name, or --force to replace it")
    if source is not None and rings is not None:
        if diameter is None:
            raise UsageError("--rings needs the --diameter of the targets, mm")
        if rings not in (12, 14):
            raise UsageError(f"--rings {rings}: must be 12 or 14 bits")
        field, kind = read_rings(source, rings, diameter, sigma), f"rings of {rings} bits"
    else:
        board = read_board(source) if source is not None else board
        for option, size, needless in (
            ("--square", board.square, "aprilgrid"), ("--marker", board.marker, "chessboard"),
        ):  # fmt: skip
            if not size and board.kind != needless:
                raise UsageError(f"{option} is missing (mm)")
        field, kind = board.field(sigma), board.name
        if source is not None:  # the sizes that were read, in mm
            kind += f" ({board.measures})"
    out.absolute().parent.mkdir(parents=True, exist_ok=True)
    write_testfield(out, field)
    extent = [float(v) for v in field.points.max(axis=0) - field.points.min(axis=0)]
    document = {
        "format": "thermocald-testfield-import/1", "testfield": out, "what": kind,
        "targets": len(field), "extent": extent,
    }  # fmt: skip
    show(
        document, json, f"{out}: {kind}, {len(field)} targets, {extent[0]:.1f} × {extent[1]:.1f} mm"
    )


def survey(
    photos: opt.Photos,
    out: Path = typer.Option(..., "--out", "-o", help="The testfield.csv to write."),
    scale: tuple[str, str, float] | None = typer.Option(
        None, metavar="A B MM", help="Two targets and their measured distance, mm."
    ),
    scale_sd: float = expert(0.1, min=1e-6, help="Standard deviation of the --scale distance, mm."),
    distances: Path | None = expert(
        None, help="CSV of further measured distances: a, b, length, sigma in mm."
    ),
    field: Path | None = typer.Option(
        None, help="The nominal testfield.csv, as printed; needed for plain circles."
    ),
    camera: CameraFile = None,
    hold_camera: bool = expert(
        False, "--hold-camera", help="Hold the interior orientation of --camera fixed."
    ),
    pixel_pitch: opt.PixelPitch = None,
    camera_out: Path | None = typer.Option(None, help="Write the estimated camera (JSON)."),
    json: opt.Json = None,
) -> None:
    """Survey a test field from photographs: coordinates and their standard deviations.

    Take 8 to 12 photographs from all sides with one camera, without touching focus or zoom; in some
    of them the camera is rotated by 90°. Do not rotate or crop the photographs afterwards.

    Example: thermocald testfield survey photos/ --field field/testfield.csv --scale R65 R89 340.12
    --out surveyed.csv
    """
    result = tc.survey_testfield(
        photos, scale=scale, scale_sd=scale_sd, distances=distances, field=field, camera=camera,
        hold_camera=hold_camera, pixel_pitch=pixel_pitch, out=out, camera_out=camera_out, say=say,
    )  # fmt: skip
    show({**result.as_dict(), "testfield": out}, json, f"{out}: {result}")


def check(
    field: Path | None = typer.Argument(
        None, metavar="FIELD", help="A testfield.csv; default: the field that `print` would draw."
    ),
    paper: Paper = "A3",
    flat: Flat = False,
    landscape: Landscape = None,
    diameter: Diameter = None,
    camera: CameraFile = None,
    pixel_pitch: opt.PixelPitch = None,
    place: Point | None = typer.Option(
        None, "--from", metavar="X Y Z", help="Position of the camera, mm."
    ),
    at: Point | None = expert(
        None,
        metavar="X Y Z",
        help="Point that the camera looks at, mm; default: the field's centre.",
    ),
    roll: float = expert(0.0, help="Rotation of the camera about its optical axis, degrees."),
    sigma: float = expert(0.03, min=1e-4, help="Standard deviation of an image coordinate, px."),
    report: Path | None = typer.Option(None, help="Write a report to an HTML file."),
    json: opt.Json = None,
) -> None:
    """Assess a test field: what a camera sees of it, how well it would be calibrated, what to add.

    Without FIELD, assess the field that `testfield print` would draw with the same --paper, --flat,
    --landscape and --diameter: do this before you print. Without --from, the camera is placed where
    the field just fills its image. Without --camera, a Raspberry Pi camera v2.1 is assumed.

    Example: thermocald testfield check --paper A4

    Example: thermocald testfield check field/testfield.csv --from 900 900 700
    """
    from thermocald.output.testfield.sheets import field_of, lay_out

    drawn = _design(paper, flat, landscape, diameter)
    targets = field_of(lay_out(drawn)) if field is None else tc.read_testfield(field)
    if camera is None:
        say(
            "no --camera: a Raspberry Pi camera v2.1 (3280 × 2464 px of 1.12 µm, 3.04 mm) is "
            "assumed"
        )
    found = tc.check_testfield(
        targets, camera=camera, pixel_pitch=pixel_pitch, place=place, look_at=at,
        roll=roll, sigma_px=sigma,
    )  # fmt: skip
    if report is not None:
        found.report(report)
    show(found, json)


def _design(paper: str, flat: bool, landscape: bool | None, diameter: float | None) -> Design:
    """Return the print that these options describe; UsageError for an unknown paper size."""
    from thermocald.output.testfield.sheets import Design, default_diameter, paper_size

    page = paper_size(paper, landscape, usual=not flat)
    return Design(
        page, diameter if diameter is not None else default_diameter(page), sheets=1 if flat else 3
    )


group = subcommands(print_=print_, import_=import_, survey=survey, check=check)
