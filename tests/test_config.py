"""config.yaml: bounds, unknown keys with the nearest known one, paths relative to the file."""

from __future__ import annotations

import os
import re
from datetime import date
from pathlib import Path
from typing import get_args

import pytest

from thermocald.config import Config, InteriorName, ParameterName, load_config, parse_config
from thermocald.errors import ConfigurationError
from thermocald.hal import driver_names, load_driver
from thermocald.photogrammetry.camera.camera_model import DEFAULT_FREE, IOP_NAMES, PARAMETER_NAMES
from thermocald.photogrammetry.epoch.adjustment import AdjustmentSettings


def document(**changes) -> dict:
    camera = {"name": "river", "driver": "mock", "thermometers": ["lens"], "seed": 3}
    return {
        "cameras": [camera],
        "thermometers": [{"name": "lens", "driver": "mock", "period_s": 5}],
        **changes,
    }


def camera(**changes) -> dict:
    doc = document()
    doc["cameras"][0] |= changes
    return doc


SENSOR = {"width_px": 3280, "height_px": 2464, "pixel_pitch_mm": 0.00112}


def parse(doc: dict, **kwargs) -> Config:
    return parse_config(doc, Path("/etc/thermocald/config.yaml"), **kwargs)


def test_the_shipped_file_and_the_defaults():
    shipped = load_config(Path(__file__).parents[1] / "config.yaml", load_driver)
    assert [(c.name, c.driver) for c in shipped.cameras] == [("demo", "mock")]
    assert shipped.cameras[0].options == {"testfield": "markers", "seed": 1}
    config = parse(document(outputs=[{"name": "river", "driver": "mock"}]))  # the name of a camera
    assert shipped.frames == config.frames.model_copy(update={"folder": shipped.frames.folder})
    assert config.store.durable
    assert config.cameras[0].period_s == 10.0
    assert config.cameras[0].calibration is None
    assert config.dashboard.host == "127.0.0.1"


def test_names_are_those_of_the_camera_model():
    """config is a layer below photogrammetry, so that it repeats them."""
    assert get_args(InteriorName) == IOP_NAMES
    assert get_args(ParameterName) == PARAMETER_NAMES
    assert parse(document()).calibration.free == DEFAULT_FREE
    assert parse(document()).calibration.snooping_alpha == AdjustmentSettings().snooping_alpha


def test_paths_are_relative_to_the_file(tmp_path):
    (tmp_path / "field.csv").touch()
    doc = camera(
        testfield="field.csv", sensor=SENSOR, recording="./M1", plain="M1",
        options={"testfield": "../f.csv", "list": [{"a": "./b"}]},
    )  # fmt: skip
    doc |= {"store": {"path": "data/x.db"}, "dashboard": {"token_file": "~/token"}}
    config = parse_config(doc, tmp_path / "config.yaml")
    assert config.store.path == tmp_path / "data" / "x.db"
    assert config.frames.folder == tmp_path / "frames"
    assert config.dashboard.token_file == Path("~/token").expanduser()
    assert config.cameras[0].testfield == tmp_path / "field.csv"
    assert config.cameras[0].options == {
        "seed": 3, "recording": str(tmp_path / "M1"), "plain": "M1",
        "testfield": str(tmp_path / "../f.csv"), "list": [{"a": str(tmp_path / "b")}],
    }  # fmt: skip


def sensor(**changes) -> dict:
    return camera(sensor={**SENSOR, **changes})


BAD = [
    ({}, "neither a camera nor a thermometer"),
    ({"camera": []}, "camera: unknown; is 'cameras' meant?"),
    ({"format": "thermocald-model/1"}, "is a thermocald-model/1 file, not a configuration"),
    (document(store={"path": ""}), "store.path: is ''; must not be empty"),
    (document(store={"xyz": 1}), "store.xyz: unknown; known are: path, durable"),
    (document(STORE={"path": "x"}), "STORE: unknown; is 'store' meant?"),
    (document(forward={"station": [1]}), "forward.station: is [1]; must be text"),
    (camera(perod_s=3), "cameras[0].perod_s: unknown; is 'period_s' meant?"),
    (camera(period_s=0.01), "cameras[0].period_s: is 0.01; must be at least 0.05"),
    (camera(period_s="soon"), "cameras[0].period_s: is 'soon'; must be a number, without a unit"),
    (camera(period_s=True), "cameras[0].period_s: is true, as YAML reads yes, no, on, off; a num"),
    (camera(principal_distance_mm=0.00304), "cameras[0].principal_distance_mm: is 0.00304"),
    (camera(period_s=float("nan")), "cameras[0].period_s: is nan"),
    (camera(name=False), "cameras[0].name: is false; must be text; put it in quotes"),
    (camera(series=date(2026, 1, 2)), "cameras[0].series: is 2026-01-02; must be text"),
    (camera(thermometers="lens"), "cameras[0].thermometers: is 'lens'; must be a list: [a, b]"),
    (document(calibration={"priors": {"c": 3}}), "priors.c: is 3; must hold `key: value` lines"),
    (document(forward={"to": "mysql://a/b"}), "forward.to: is 'mysql://a/b'; must begin with post"),
    (camera(name="../x"), "cameras[0].name: is '../x'"),
    (camera(driver=None), "cameras[0].driver: is empty; must be text"),
    (camera(testfield="f.csv"), "cameras[0]: `testfield` needs `sensor: {width_px: …"),
    (sensor(pixel_pitch_mm=1.12), "cameras[0].sensor.pixel_pitch_mm: is 1.12; must be at most 0.1"),
    (camera(sensor={"width_px": 3280}), "cameras[0].sensor.height_px: is missing"),
    (camera(thermometers=["lens", "lens"]), "`thermometers` names one twice"),
    (camera(thermometers=["lense"]), "there is no thermometer 'lense'; is 'lens' meant?"),
    (document(calibration={"free": ["c", "f"]}), "calibration.free[1]: is 'f'"),
    (document(calibration={"fixed": {"A4": 0}}), "calibration.fixed.A4: is 'A4'; must be 'c'"),
    (document(calibration={"fixed": {"C1": True}}), "calibration.fixed.C1: is true, as YAML reads"),
    (document(dashboard={"host": ""}), "dashboard.host: is ''; must not be empty"),
    (document(calibration={"free": ["c", "c"]}), "names a parameter twice"),
    (document(calibration={"fixed": {"c": 3.0}}), "c is both in `free` and in `fixed`"),
    (document(calibration={"priors": {"c": {"value": 3, "sd": 0}}}), "calibration.priors.c.sd"),
    (document(calibration={"priors": {"c": {"value": 0.003, "sd": 1}}}), "calibration: c is 0.003"),
    (document(frames={"keep": "some"}), "frames.keep: is 'some'"),
    (document(dashboard={"host": "0.0.0.0"}), "give a token_file too"),
    (camera(thermal_model="m", testfield="f"), "either `testfield` or `thermal_model`"),
    (camera(thermal_model="m", thermometers=[]), "`thermal_model` needs `thermometers`"),
    (
        camera(thermal_model="m.yaml"),
        "cameras[0].thermal_model: there is no file /etc/thermocald/m",
    ),
    (camera(mount_sd_deg=0.01), "`mount_sd_deg` needs a `thermal_model`"),
    (camera(thermal_model="m", control_reference="r"), "`control_reference` needs `control_point"),
    (document(frames={"corrected": True}), "corrected needs a camera with a thermal_model"),
    (document(cameras=[{"name": "a", "driver": "m"}] * 2), "cameras: the name 'a' is duplicated"),
    (document(cameras=[{"name": "status", "driver": "m"}]), "choose another name"),
]
OF_DRIVERS = [
    (camera(sed=4), "cameras[0].sed: unknown; neither a key of this camera nor an option of"),
    (camera(seed="b"), "cameras[0]: seed: is 'b'; must be a whole nu"),
    (camera(driver="nikon"), "cameras[0].driver: there is no camera driver"),
]


@pytest.mark.parametrize(("doc", "message"), [*BAD, *OF_DRIVERS])
def test_what_is_wrong_is_named(doc, message):
    load = load_driver if (doc, message) in OF_DRIVERS else None
    with pytest.raises(ConfigurationError, match=re.escape(message)) as caught:
        parse(doc, load_driver=load)
    assert str(caught.value).startswith("/etc/thermocald/config.yaml: ")
    assert "\n" not in str(caught.value)


def test_the_comments_of_config_yaml_name_drivers_that_exist():
    """They are in the file that every user starts from, after `driver: mock   #`."""
    text = (Path(__file__).parents[1] / "config.yaml").read_text()
    sections = re.split(r"^(cameras|thermometers|outputs):", text, flags=re.M)
    seen = 0
    for kind, section in zip(sections[1::2], sections[2::2], strict=True):
        named = re.findall(r"driver: *(\w+)(?: *# ([^\n:…]*))?", section)
        for driver, others in named:
            words = {driver, *re.findall(r"\w+", others)}
            assert words <= set(driver_names(kind.removesuffix("s")))
            seen += len(words)
    assert seen >= 8


PLACES = {
    **dict.fromkeys(("./t.db", "./t.db-wal", "./t.db-shm", "./link", "./hard", "./a/../t.db"),
                    "is the store"),
    "./config.yaml": "is the configuration",
    "./one.jsonl": "is the file of output one",
    "./alias": "is the file of output one",
}  # fmt: skip


@pytest.mark.parametrize("place", PLACES)
def test_outputs_do_not_write_into_what_is_not_theirs(tmp_path, place):
    """Lines of JSON must not go into a store or among those of another output."""
    (tmp_path / "t.db").write_bytes(b"store")
    (tmp_path / "link").symlink_to("t.db")
    (tmp_path / "alias").symlink_to("one.jsonl")
    os.link(tmp_path / "t.db", tmp_path / "hard")
    (tmp_path / "a").mkdir()

    def parse_places(two, one="./one.jsonl", **more):
        outputs = [
            {"name": n, "driver": "jsonl", "path": p} for n, p in (("one", one), ("two", two))
        ]
        doc = document(store={"path": "t.db"}, outputs=outputs, **more)
        return parse_config(doc, tmp_path / "config.yaml")

    with pytest.raises(ConfigurationError, match=rf"outputs\[1\]\.path.* {PLACES[place]}"):
        parse_places(place)
    parse_places("./two.jsonl")
    with pytest.raises(ConfigurationError, match=r"frames\.folder: is the store"):
        parse_places("./two.jsonl", frames={"folder": "./t.db"})
    parse_places("/dev/null", "/dev/null")  # several outputs may write to one device
