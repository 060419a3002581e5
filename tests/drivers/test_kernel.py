"""hwmon, iio and thermal zones over a sysfs tree, and each of its faults."""

from __future__ import annotations

import shutil

import pytest

from tests.drivers.fakes.sysfs import Sysfs
from thermocald.errors import (
    BadReading,
    ConfigurationError,
    DeviceGone,
    DeviceNotFound,
    TransientDeviceError,
    WrongDevice,
)
from thermocald.hal import VirtualClock, open_device


@pytest.fixture
def sysfs(tmp_path):
    return Sysfs(tmp_path)


def thermometer(driver, sysfs, **options):
    return open_device("thermometer", driver, {"sysfs": str(sysfs.root), **options}, VirtualClock())


def test_a_single_input_is_called_temperature(sysfs):
    sysfs.hwmon(0, "amdgpu", temp1_input="28000", temp1_crit="80000")
    with thermometer("hwmon", sysfs, chip="amdgpu") as device:
        assert device.read().values == {"temperature": 28.0}


def test_inputs_are_called_by_their_labels(sysfs):
    # lm-sensors issue 100: some folders hold temp2 and temp4 only
    sysfs.hwmon(0, "it87", temp2_input="51000", temp4_input="-2500", temp4_label="board")
    with thermometer("hwmon", sysfs, chip="it87") as device:
        assert device.read().values == {"temp2": 51.0, "board": -2.5}


def test_channels_are_chosen_by_input_or_label(sysfs):
    sysfs.hwmon(0, "it87", temp2_input="51000", temp4_input="31000", temp4_label="board")
    with thermometer("hwmon", sysfs, chip="it87", channels={"lens": "board"}) as device:
        assert device.read().values == {"lens": 31.0}


def test_a_channel_that_is_not_there(sysfs):
    sysfs.hwmon(0, "it87", temp2_input="51000")
    with pytest.raises(WrongDevice, match=r"temp1.*there is temp2"):
        thermometer("hwmon", sysfs, chip="it87", channels={"lens": "temp1"}).open()


def test_an_open_diode_is_not_a_temperature(sysfs):
    # it87 issue 59: a disconnected diode reads +127.0
    sysfs.hwmon(0, "it87", temp1_input="51000", temp2_input="127000")
    with thermometer("hwmon", sysfs, chip="it87") as device:
        reading = device.read()
    assert reading.values == {"temp1": 51.0}
    assert "127 °C is outside" in reading.metadata["missing"]["temp2"]


def test_the_fault_flag_counts(sysfs):
    sysfs.hwmon(0, "lm90", temp1_input="21000", temp1_fault="1")
    with (
        thermometer("hwmon", sysfs, chip="lm90") as device,
        pytest.raises(BadReading, match="fault"),
    ):
        device.read()


def test_an_input_of_a_sleeping_device_is_absent(sysfs):
    # a folder in place of the file: the read fails with an errno, as EINVAL does on the real one
    folder = sysfs.hwmon(0, "amdgpu", temp1_input="28000", temp2_input="1")
    with thermometer("hwmon", sysfs, chip="amdgpu") as device:
        (folder / "temp2_input").unlink()
        (folder / "temp2_input").mkdir()
        assert device.read().values == {"temp1": 28.0}


@pytest.mark.parametrize(
    "content", ["", "hot", "28000 mC", "nan", "inf", "28_000", "1e300", "٢٨٠٠٠", "28,5"]
)
def test_garbage_is_no_value(sysfs, content):
    sysfs.hwmon(0, "lm75", temp1_input=content)
    with thermometer("hwmon", sysfs, chip="lm75") as device, pytest.raises(BadReading):
        device.read()


def test_nothing_there_and_vanished_are_different(sysfs):
    device = thermometer("hwmon", sysfs, chip="lm75")
    with pytest.raises(DeviceNotFound, match="'lm75' is not there"):
        device.open()
    folder = sysfs.hwmon(3, "lm75", temp1_input="21000")
    device.open()
    shutil.rmtree(folder)
    with pytest.raises(DeviceGone):
        device.read()
    device.close()
    with pytest.raises(DeviceGone):
        device.open()
    sysfs.hwmon(4, "lm75", temp1_input="22000")
    device.open()
    assert device.read().values == {"temperature": 22.0}


def test_a_number_handed_on_to_another_chip_is_noticed(sysfs):
    folder = sysfs.hwmon(3, "lm75", temp1_input="21000")
    with thermometer("hwmon", sysfs, chip="lm75") as device:
        (folder / "name").write_text("cpu_thermal\n")
        with pytest.raises(DeviceGone, match="'cpu_thermal' now"):
            device.read()


def test_two_chips_of_one_name_need_the_address(sysfs):
    sysfs.hwmon(0, "lm75", "1-0048", temp1_input="21000")
    sysfs.hwmon(1, "lm75", "1-0049", temp1_input="22000")
    with pytest.raises(WrongDevice, match="write chip: 1-0048, 1-0049"):
        thermometer("hwmon", sysfs, chip="lm75").open()
    with thermometer("hwmon", sysfs, chip="1-0049") as device:
        assert device.read().values == {"temperature": 22.0}


def test_permission_denied(sysfs, monkeypatch):
    # root reads everything: the errno is injected at the file
    folder = sysfs.hwmon(0, "lm75", temp1_input="21000")
    with thermometer("hwmon", sysfs, chip="lm75") as device:
        original = type(folder).read_text

        def read_text(path, *args):
            if path.name == "temp1_input":
                raise PermissionError(13, "Permission denied")
            return original(path, *args)

        monkeypatch.setattr(type(folder), "read_text", read_text)
        with pytest.raises(TransientDeviceError, match="Permission denied"):
            device.read()


def test_iio_raw_offset_and_scale(sysfs):
    # bmp280 family: raw only; ABI: (raw + offset) * scale in m°C
    sysfs.iio(0, "tmp006", in_temp_ambient_raw="731", in_temp_scale="31.25", in_temp_offset="10")
    with thermometer("iio", sysfs, chip="tmp006") as device:
        assert device.read().values == {"temperature": (731 + 10) * 31.25 / 1000}


def test_iio_processed_wins(sysfs):
    sysfs.iio(0, "bme280", in_temp_input="21530", in_temp_raw="1", in_temp_scale="1")
    with thermometer("iio", sysfs, chip="bme280") as device:
        assert device.read().values == {"temperature": 21.53}


def test_iio_raw_without_scale_is_refused(sysfs):
    sysfs.iio(0, "adc", in_temp_raw="731")
    with thermometer("iio", sysfs, chip="adc") as device, pytest.raises(BadReading, match="scale"):
        device.read()


def test_the_power_on_value_of_a_1_wire_sensor_under_hwmon(sysfs):
    sysfs.hwmon(0, "w1_slave_temp", temp1_input="85000")
    sysfs.hwmon(1, "it87", temp1_input="85000")
    with (
        thermometer("hwmon", sysfs, chip="w1_slave_temp") as device,
        pytest.raises(BadReading, match="power-on"),
    ):
        device.read()
    with thermometer("hwmon", sysfs, chip="it87") as device:
        assert device.read().values == {"temperature": 85.0}


def test_a_zone_of_another_quantity_needs_its_unit(sysfs):
    with pytest.raises(ConfigurationError, match="write unit: thousandths"):
        thermometer("thermal_zone", sysfs, zone="pm8150b-vbat-lvl0")
    sysfs.zone(0, "soc", "310")
    with thermometer("thermal_zone", sysfs, zone="soc", unit="tenths") as device:
        assert device.read().values == {"temperature": 31.0}


def test_a_zone_that_is_not_fitted(sysfs):
    sysfs.zone(0, "camera-therm-usr", "-40000")
    with (
        thermometer("thermal_zone", sysfs, zone="camera-therm-usr") as device,
        pytest.raises(BadReading, match="not fitted"),
    ):
        device.read()


def test_thermal_zone_by_type(sysfs):
    sysfs.zone(0, "cpu-thermal", "48312")
    sysfs.zone(1, "gpu-thermal", "-274000")  # THERMAL_TEMP_INVALID
    with thermometer("thermal_zone", sysfs, zone="cpu-thermal") as device:
        assert device.read().values == {"temperature": 48.312}
    with (
        thermometer("thermal_zone", sysfs, zone="gpu-thermal") as device,
        pytest.raises(BadReading, match="outside"),
    ):
        device.read()
