"""Ranges of the properties of real tables. A rig file outside a wide range is rejected, outside a narrow one it gets
a warning.

They cover tables from 0.3 kg to 100 t, on springs, air, rubber, magnets or piezo stacks, in laboratories and factories.
A wrong unit is an error by a factor of 6 (rad/s) to 1e9; the ranges are only as wide as real tables need.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import log10
from types import MappingProxyType


@dataclass(frozen=True)
class Range:
    """Values outside low .. high are unusual, values outside lowest .. highest are rejected; all in `unit`.

    why : the reason for the range.
    """

    lowest: float
    low: float
    high: float
    highest: float
    unit: str
    why: str

    def beyond(self, value: float) -> tuple[float, float]:
        """Decades by which a positive value exceeds the (possible, usual) range, 0 inside."""
        return tuple(
            max(log10(low / value) if low else 0.0, log10(value / high), 0.0)  # type: ignore[return-value]
            for low, high in ((self.lowest, self.highest), (self.low, self.high))
        )

    def off_centre(self, value: float) -> float:
        """Distance of a positive value from the middle of the usual range, 1 at its ends; 0 without a lower end."""
        if not 0 < self.low < self.high:
            return 0.0
        return abs(log10(value / self.low) + log10(value / self.high)) / log10(self.high / self.low)


@dataclass(frozen=True)
class PlausibleRanges:
    """Ranges of the properties of the table as a whole, and of single keys of its file.

    Attributes
    ----------
    mode_Hz : every natural frequency. slowest_Hz : the lowest one. sag_m : g over the square of the lowest angular
        frequency of vertical motion, the sag of a plain spring (levelled mounts and mounts of negative stiffness sag
        less, but are as hard to build). spread : highest natural frequency over lowest.
    damping : smallest and largest modal damping ratio; zero is not judged.
    slab_kg_per_m2 : mass over the area of the circle through the outermost mount. gyration : each sqrt(J / m), and
        mounts_height the distance of the centre of mass from the mounts' centre, over the radius of that circle.
    outlier : distance of a point from the mounts' centre over the median of the mounts' distances.
    unequal : one of several similar entries (stiffness of a mount along an axis, force constant, sensitivity) over
        their median.
    acceleration : force of all drives at their limit over the mass, in the direction where it is largest. travel_m :
        the same force over the stiffness. travel_share : travel_m over the radius of the mounts' circle.
    samples_per_cycle : of the fastest mode. delay_cycles : loop delay in cycles of the fastest mode.
    full_scale_m_per_s : converter range over sensitivity and gain of a velocity sensor.
    noise_ratio : noise of a velocity sensor (its own or the converter's) over the floor velocity.
    floor_share : voltage due to floor motion over the converter range.
    keys : single keys of a rig file, by name; zero is always allowed.
    """

    mode_Hz: Range = Range(0.03, 0.15, 400.0, 1500.0, "Hz", "pendulums reach 0.1 Hz, stiff piezo mounts 100 Hz")
    slowest_Hz: Range = Range(0.03, 0.15, 110.0, 160.0, "Hz", "above 100 Hz a table is bolted down, not isolated")
    sag_m: Range = Range(1e-6, 5e-6, 1.35, 2.0, "m", "a vertical 0.45 Hz is the softest mount on the market")
    spread: Range = Range(1.0, 1.0, 30.0, 80.0, "", "one table does not hang at 0.2 Hz and stand at 20 Hz")
    damping: Range = Range(3e-4, 1e-3, 1.5, 6.0, "", "jointed steel has 0.001, thick rubber 0.3, dashpots 1")
    slab_kg_per_m2: Range = Range(1.0, 4.0, 8e3, 2e4, "kg/m^2", "a breadboard has 10, a metre of steel 7850")
    gyration: Range = Range(0.04, 0.1, 3.5, 8.0, "", "a plate over its mounts has 0.4 to 0.6")
    mounts_height: Range = Range(0.0, 0.0, 2.0, 5.0, "", "a table whose weight is that far from its feet falls over")
    outlier: Range = Range(0.0, 0.0, 4.0, 8.0, "", "drives and sensors are on the table")
    unequal: Range = Range(1 / 150, 1 / 30, 30.0, 150.0, "", "like parts of one table are alike")
    acceleration: Range = Range(
        3e-4, 1e-3, 100.0, 400.0, "m/s^2", "weaker ones do not answer a footstep, stronger ones throw the table off"
    )
    travel_m: Range = Range(6e-7, 1.5e-6, 0.1, 1.0, "m", "the shortest piezo stack moves by micrometres")
    travel_share: Range = Range(0.0, 0.0, 0.25, 0.6, "", "drives do not push a table by its own size")
    samples_per_cycle: Range = Range(3.0, 6.0, 1e6, 1e8, "", "a loop needs several samples in a cycle of its modes")
    delay_cycles: Range = Range(0.0, 0.0, 0.4, 1.5, "", "a loop that is late by a cycle of the modes damps none")
    full_scale_m_per_s: Range = Range(
        2e-5, 1e-4, 0.5, 3.0, "m/s", "a table moves by micrometres to millimetres a second"
    )
    noise_ratio: Range = Range(0.0, 0.0, 12.0, 50.0, "", "a sensor that does not hear the floor measures nothing")
    floor_share: Range = Range(0.0, 0.0, 0.1, 0.3, "", "the floor alone must not fill the converter")
    keys: Mapping[str, Range] = field(
        default_factory=lambda: MappingProxyType(
            {
                "mass_kg": Range(0.02, 0.3, 1e5, 1e6, "kg", "from a mirror to a foundation"),
                "reaction_mass_kg": Range(1e-5, 1e-3, 50.0, 500.0, "kg", "the moving part of a drive"),
                "limit_V": Range(0.02, 0.5, 1e3, 3e3, "V", "amplifiers give 1 V to 1 kV"),
                "drive_limit_V": Range(0.02, 0.5, 1e3, 3e3, "V", "amplifiers give 1 V to 1 kV"),
                "adc_range_V": Range(0.02, 0.4, 50.0, 200.0, "V", "converters take 1 V to 10 V"),
                "sample_rate_Hz": Range(10.0, 100.0, 2e5, 5e6, "Hz", "loops of tables run at 0.2 kHz to 100 kHz"),
                "loop_delay_s": Range(1e-9, 1e-8, 0.05, 0.3, "s", "a loop delay is a few samples"),
                "suspension_Hz": Range(3e-3, 0.02, 60.0, 300.0, "Hz", "seismometers have 0.008, geophones 1 to 28"),
                "compensated_Hz": Range(1e-3, 4e-3, 60.0, 300.0, "Hz", "filters lower the corner of a geophone"),
                "low_corner_Hz": Range(1e-5, 1e-3, 15.0, 100.0, "Hz", "charge amplifiers begin at 0.01 to 5"),
                "bandwidth_Hz": Range(0.5, 5.0, 1e7, 1e9, "Hz", "of a position sensor"),
                "suspension_damping": Range(0.01, 0.1, 3.0, 10.0, "", "a damping ratio, 0.7 as a rule"),
                "compensated_damping": Range(0.01, 0.1, 3.0, 10.0, "", "a damping ratio, 0.7 as a rule"),
                "sensitivity_Vs_per_m": Range(
                    0.3, 3.0, 3e3, 5e4, "V s/m", "geophones have 10 to 400, seismometers 2000"
                ),
                "sensitivity_Vs2_per_m": Range(
                    2e-3, 5e-3, 200.0, 2e3, "V s^2/m", "100 mV/g are 0.01; 10 V/g, amplified, 100"
                ),
                "sensitivity_V_per_m": Range(1.0, 50.0, 1e8, 1e10, "V/m", "from long inductive to capacitive sensors"),
                "preamplifier_gain": Range(1e-3, 0.05, 1e5, 1e7, "", "of a preamplifier"),
                "noise_m_per_s2_rtHz": Range(1e-11, 1e-9, 1e-2, 0.3, "m/s^2/sqrt(Hz)", "1e-9 to 1e-3 can be bought"),
                "noise_m_rtHz": Range(1e-17, 1e-15, 1e-5, 1e-3, "m/sqrt(Hz)", "from interferometers to potentiometers"),
                "noise_rms_m_per_s": Range(1e-12, 1e-10, 1e-4, 1e-2, "m/s", "noise of a floor sensor"),
                "floor_velocity_rms_m_per_s": Range(
                    1e-10, 1e-9, 2e-4, 1.5e-3, "m/s", "a quiet cave 1e-9, a workshop 8e-4"
                ),
                "sensor_noise_rms_V": Range(1e-9, 1e-8, 0.1, 1.0, "V", "noise of one sample"),
                "noise_rms_V": Range(1e-9, 1e-8, 0.1, 1.0, "V", "noise of one sample"),
            }
        )
    )


RANGES = PlausibleRanges()
