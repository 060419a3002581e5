"""Idle values: what chips report without having measured, one row per family with its source.

A chip that was just powered up, that lost its supply or its bus, or whose probe is open returns a
fixed word, and firmware and kernel drivers convert it to a temperature like any other. The value is
a property of the chip; only a reading shortly before can distinguish it from a real temperature
(`support.CheckedThermometer`). Words are given before offset, scale and unit.
"""

from __future__ import annotations

import math
import re
from typing import NamedTuple

# idle words of any chip: no conversion yet, a bus that is held low, a bus that nothing drives
# (all ones in 8 to 24 bits, with status bits masked), the ends of a converter's scale
ANY_WORDS = frozenset(
    [0, -1, 0x8000, 0x80000]
    + [2**bits - 1 for bits in range(8, 25)]
    + [-(2**bits) for bits in range(7, 24)]
    + [0xFFFF & ~low for low in (0, 1, 3, 7, 15, 63)]
)
# idle °C of any kernel input: not connected, and the ends of the commonest scale
ANY_C = (0.0, -40.0, 125.0)
ALL_ONES_C = (-1.0, -0.5, -0.25, -0.125, -0.0625, -0.03125, -0.015625, -0.0078125, -0.00390625)
"""The °C of 8 to 16 bits that nothing drives."""
ENDS_C = (-99.0, -99.9, -99.99, -100.0, 99.9, 199.9, 999.9, -200.0, 850.0, -270.0, 1372.0)
"""The °C that displays, transmitters (PT100, type K) and loggers report out of their range."""


class Chip(NamedTuple):
    """A family of chips and its idle values.

    names: the members, as the kernel, a driver or a library calls them; celsius: the idle values,
    °C; words: the same as the chip sends them, if not in ANY_WORDS.
    """

    names: str = ""
    celsius: tuple[float, ...] = ()
    words: tuple[int, ...] = ()


CHIPS = (  # each with its data sheet or survey
    # 1-wire: power-on, firmware without an answer, all ones, a failed conversion, a clone
    # Maxim 19-7487, 19-5474; DallasTemperature DEVICE_DISCONNECTED_C; survey of C. Petrich
    Chip("ds18b20 ds1822 ds18s20 ds1825 ds28ea00 w1_slave_temp gx20mh01",
         (85.0, -127.0, -0.0625, -0.5, 127.9375, 25.0), (0x0550, 0x00AA, 0x0190)),
    # Maxim 19-6171
    Chip("max31850", (85.0, -0.0625), (0x0550,)),
    # humidity and temperature
    # Sensirion SHT3x-DIS 4.13, SHT4x 4.6, SHTC3 5.11, SCD4x 3.6; TI SNAS778: −45 + 175 S/65535
    Chip("sht3x sts3x sht30 sht31 sht35 sht85 scd30 scd4x scd40 scd41 sht4x sht40 sht41 sht45 "
         "sht43 sts30 sts31 sts35 sts40 shtc1 shtc3 shtw1 sts4x hdc3020 hdc3021 hdc3022",
         (-45.0, 130.0)),
    # Sensirion SHT21 6.2; TE HTU21D; Silicon Labs Si7021-A20 5.1.2: −46.85 + 175.72 S/65536
    Chip("sht2x sht20 sht21 sht25 htu20 htu21 htu21d tsys02d ms8607 si7006 si7013 si7020 si7021 "
         "si7050 si7051 si7053 si7054 si7055", (-46.85, 128.86, 128.87)),
    # Sensirion SHT1x 4.3: d1 by supply voltage
    Chip("sht10 sht11 sht15 sht71 sht75", (-39.4, -39.6, -39.65, -39.7, -39.8, -40.1, 123.8)),
    # Silicon Labs Si7005 5.1.2; Analog Devices TMP35/36/37; TI SNIS189: 0, 0 V or no pulse
    Chip("si7005 th02 th06 tmp36 tmp37 lm50 mcp9700 mcp9700a lmt01", (-50.0,)),
    # TI SNAS643, SNAS649, SNAS678: −40 (−40.5) + 165 S/65536
    Chip("hdc100x hdc1000 hdc1008 hdc1010 hdc1050 hdc1080 hdc2010 hdc2080 hdc2021 hdc2022",
         (-40.0, -40.5, 124.99, 124.997, 125.0)),
    # Honeywell TN 009061; IST HYT; Amphenol CC2; Renesas HS300x 6.4: 165 S/16382 − 40
    Chip("hih6130 hih6131 hih7130 hih8120 hih9130 hyt221 hyt271 hyt939 cc2 chipcap2 hs3001 "
         "hs3002 hs3003 hs3004 htu31", (-40.0, 124.99, 125.0)),
    # Aosong AHT20 6.2: 200 S/2²⁰ − 50
    Chip("aht10 aht15 aht20 aht21 aht25 aht30 dht20 am2301b", (-50.0, 150.0)),
    # Aosong AM2302: the sum of zeros is right
    Chip("dht11 dht12 dht21 dht22 am2301 am2302 am2315 am2320", (0.0, -0.1)),
    # temperature
    # NXP LM75B 7.4.2; TI SBOS288, SNIS116; ams AS6200: 0 at power-up, all ones by resolution
    Chip("lm75 lm75a lm75b ds75 ds1775 ds7505 g751 max6625 max6626 mcp980x stds75 stlm75 tcn75 "
         "tmp75 tmp75b tmp75c tmp100 tmp101 tmp105 tmp112 tmp175 tmp275 adt75 at30ts74 pct2075 "
         "as6200 tmp1075 lm76 lm92 lm70 lm71 lm74 tmp121 tmp122 tmp123 tmp124",
         (-1.0, -0.5, -0.25, -0.125, -0.0625)),
    # TI SBOS397H 7.5.2: 0 at power-up
    Chip("tmp102 tmp108 tmp144", (-0.0625, -0.015)),
    # TI SNOSD82D 7.6.1.1: 8000h before the first conversion
    Chip("tmp116 tmp117 tmp118 tmp119", (-256.0, -0.0078125)),
    # Microchip DS25095A 5.2.3; JEDEC 21-C 4.1.6: 0 at power-up
    Chip("mcp9808 mcp98242 mcp98243 mcp98244 jc42 tse2002 tse2004 se97 se98 cat6095 stts424 "
         "stts2004 adt7408 max6604", (-0.0625,), (0x1FFF,)),
    # Analog Devices ADT7420 table 8: 0 at power-up
    Chip("adt7410 adt7420 adt7422 adt7310 adt7320", (-0.0625, -0.0078125)),
    # Maxim 19-7540: −60 °C at power-up
    Chip("ds1621 ds1631 ds1721 ds620", (-60.0, -1.0)),
    # Maxim 19-5170: 0 at power-up
    Chip("ds3231 ds3232 ds3234", (-0.25,), (0xFFC0,)),
    # ST DS12606, DocID018178
    Chip("stts22h stts751", (-0.01, -0.0625)),
    # Maxim 19-8544
    Chip("max30205 max30208", (-0.00390625, -0.005)),
    # Maxim 19-7493; Corsair: °C/100
    Chip("max31760 corsaircpro corsairpsu nzxt", (-0.125,)),
    # thermocouples, resistances, infra-red
    # Maxim 19-2235, 19-5793
    Chip("max6675 max31855", (-0.25, -0.0625, 1023.75)),
    # Maxim 19-7534; DS20005426
    Chip("max31856 mcp9600 mcp9601", (-0.0078125, -0.0625)),
    # Maxim 19-6478: RTD 0 and 7FFFh
    Chip("max31865", (-242.02, -256.0, 988.79)),
    # Melexis 3901090614; Adafruit-MLX90614-Library issue 28
    Chip("mlx90614 mlx90615", (-273.15, -273.01, 54.67, 1037.55)),
    # inputs of converters
    # Linux ntc_thermistor.c: the ends of its tables
    Chip("ncp15wb473 ncp18wb473 ncp21wb473 ncp03wb473 ncp15wl333 ncp03wf104 ncp15xh103 "
         "ncp18xh103 b57330v2103 b57891s0103 b57861s0103 ntc_thermistor",
         (-55.0, -40.0, 125.0, 155.0)),
    # Microchip DS21942: 0 V
    Chip("mcp9701 mcp9701a", (-20.5, -20.51)),
    # Analog Devices AD22100: 0 V
    Chip("ad22100", (-61.1,)),
    # pressure
    # TE MS5611-01BA03: coefficients that read 0 give 20.00 °C
    Chip("ms5611 ms5607 ms5637 ms5803 ms5805 ms5837 ms8607-temppressure", (20.0,)),
    # Bosch BST-BME280-DS002 5.4.8; Adafruit_BME280_Library issue 112
    Chip("bmp180 bmp280 bme280 bmp388 bme680", (-145.75, 179.55), (0x80000, 0x8000)),
    # ST DocID023722 9: 42.5 + T/480
    Chip("lps25h lps25hb lps331ap", (42.5,)),
    # motion, gas
    # InvenSense RM-MPU-6000A 4.18
    Chip("mpu3050 mpu6050 mpu6000 mpu9150", (36.53,)),
    # InvenSense RM-MPU-6500A 4.23, DS-000189: T/333.87 + 21
    Chip("mpu6500 mpu6515 mpu6880 mpu9250 mpu9255 icm20948 icm20648", (21.0,)),
    # TDK DS-000176, DS-000451; ST DocID030071 9.12; NXP FXLS8962AF; Analog Devices ADIS16480: 0 is
    # 25 °C
    Chip("icm20600 icm20602 icm20608 icm20608d icm20689 icm20690 iam20680 icm42600 icm42602 "
         "icm42605 icm42622 icm42688 lsm6ds0 lsm6ds3 lsm6ds3h lsm6ds3tr lsm6dsl lsm6dsm lsm6dso "
         "lsm6dso16is lsm6dsox lsm6dsr lsm6dsrx lsm6dst lsm6dsv ism330dhcx ism330dlc asm330lhh "
         "lsm9ds1 lsm303agr adis16480 lis2dw12 lis3mdl lsm303d lis2mdl iis2mdc iis3dwb icm42670 "
         "fxls8962af", (25.0,)),
    # Bosch BST-BMI160-DS000 2.11.8, BST-BMA400-DS000, BST-BMG160-DS000
    Chip("bmi088 bmi160 bmi260 bmi270 bmi323 bma400 bmg160", (23.0, -41.0)),
    # ams CCS811 application note 000373
    Chip("ccs811", (-25.0,)),
    # InvenSense PS-ITG-3200A: 35 + (T + 13200)/280
    Chip("itg3200", (82.14,)),
    # Bosch BST-BMA253-DS000: 0 is 24 °C
    Chip("bma250 bma250e bma253 bma254 bma255 bma280 bmc150 bmc156 bmi055", (24.0, -40.0)),
    # IST TSic 506F: −10 + 70 S/2047
    Chip("tsic506 tsic516 tsic716", (-10.0, 60.0)),
    # IST TSic 306: −50 + 200 S/2047
    Chip("tsic206 tsic306", (-50.0, 150.0)),
    # monitors of currents
    # Linux ltc2947-core.c: 0.204 T + 5.5
    Chip("ltc2947", (5.5, 5.296)),
    # boards
    # lm-sensors FAQ: constants of ACPI tables
    Chip("acpitz", (27.8, 29.8, 16.8, 8.3)),
    # Linux int3400_thermal.c: a constant
    Chip("int3400", (20.0,)),
    # Linux max77620_thermal.c: two alarms
    Chip("pmic max77620", (100.0, 120.0, 140.0)),
    # Linux coretemp.c: T_jmax less 0, of a virtual machine
    Chip("coretemp", (100.0, 105.0)),
    # Linux lm63.c: an offset of 16 °C
    Chip("lm64", (16.0, 15.875, -1.0)),
    # AMD PPR 55803: CUR_TEMP 0 with CUR_TEMP_RANGE_SEL
    Chip("k10temp zenpower", (-49.0,)),
    # ITE IT8728F 9.6; Nuvoton NCT6775F 7.6; TI LM83: 7Fh and 80h of an open diode, FFh
    Chip("it87 it8603 it8613 it8620 it8628 it8686 it8688 it8721 it8728 it8771 w83627hf w83627ehf "
         "w83781d nct6775 nct6776 nct6779 nct6791 nct6798 f71882fg lm78 lm83 lm85 lm87 adm1021 "
         "adm1031 max1617 max1619 emc1403 emc2103 sch5636", (-1.0, 127.0, 127.5, -128.0)),
    # TI SBOS371: an open diode
    Chip("lm90 lm86 lm89 lm99 adm1032 adt7461 max6646 max6657 nct1008 tmp401 tmp411 tmp421 "
         "tmp431 tmp451 tmp461", (-1.0, -64.0, 127.0, 127.875)),
    # image sensors, as libcamera reports them: a limit until something was measured
    # libcamera cam_helper_imx477: the register is clamped
    Chip("imx219 imx296 imx477 imx500 imx519 imx708 ov5647 ov64a40", (-20.0, 80.0, 0.0)),
)  # fmt: skip
_ALARM = Chip(celsius=(37.0,))  # Linux qcom-spmi-temp-alarm.c: DEFAULT_TEMP of a PMIC
BY_NAME = {name: chip for chip in CHIPS for name in chip.names.split()}

LOWEST_LIKELY_C, HIGHEST_LIKELY_C, HIGHEST_OF_A_PROCESSOR_C = -39.0, 84.0, 110.0
FIRMWARE_C = tuple(
    sorted(
        {c for chip in CHIPS for c in chip.celsius if not LOWEST_LIKELY_C < c < HIGHEST_LIKELY_C}
    )
)
"""What firmware prints without a sensor, for any sensor: unlikely temperatures."""
UNLIKELY_C = tuple(c for c in FIRMWARE_C if not LOWEST_LIKELY_C < c < HIGHEST_OF_A_PROCESSOR_C)


def idle_celsius(name: str) -> tuple[float, ...]:
    """Return a chip's idle values, °C; () if it is not in the table."""
    return (_chip(name) or Chip()).celsius


def _chip(name: str) -> Chip | None:
    """Find a chip by a name that may have a suffix (ms8607-temppressure, bq27541_0)."""
    first = re.split("[-_ ]", name.lower())[0]
    known = BY_NAME.get(name.lower()) or BY_NAME.get(first)
    return known or (_ALARM if re.fullmatch(r"pmi?\d{2,4}\w{0,2}", first) else None)


def is_idle(name: str, celsius: float) -> bool:
    """Return whether a temperature is an idle value of a chip, within 1/1000 °C.

    name: the kernel's. For a chip that is not in the table, any unlikely temperature counts as
    idle.
    """
    chip = _chip(name)
    idle = (*UNLIKELY_C, *ALL_ONES_C) if chip is None else chip.celsius
    return any(abs(celsius - one) < 1e-3 for one in (*ANY_C, *idle))


def is_idle_word(name: str, word: float) -> bool:
    """Return whether a word, before offset and scale, is an idle word of a chip."""
    return word in ANY_WORDS or word in (_chip(name) or Chip()).words


def prints(number: float, decimals: int, value: float) -> bool:
    """Return whether a number with these decimals can be `value`, rounded up, down or truncated."""
    step = 10.0**-decimals
    low = math.floor(value / step + 1e-6)
    high = math.ceil(value / step - 1e-6)
    return round(number / step) in (low, high)
