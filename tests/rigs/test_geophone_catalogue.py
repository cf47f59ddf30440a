"""Real SEED RESP files: every number against the file's own name, and files broken on purpose."""

from __future__ import annotations

import numpy as np
import pytest

from avis_ctrl.errors import InputError
from avis_ctrl.rigs.geophone_catalogue import check_against_name, read_response

GOOD_NAME = "RESP.XX.NS388..SHZ.GS11D.4_5.380.1740.26_2"
# The form of a RESP file, written here; poles of 4.5 Hz with damping 0.7.
GOOD = """B053F03     Transfer function type:                A [Laplace Transform (Rad/sec)]
B053F05     Response in units lookup:              M/S - Velocity in Meters Per Second
B053F06     Response out units lookup:             V - Volts
B053F07     A0 normalization factor:               1.0E+00
B053F08     Normalization frequency:               1.0E+02
B053F09     Number of zeroes:                      2
B053F14     Number of poles:                       2
B053F10-13    0  0.0  0.0  0.0  0.0
B053F10-13    1  0.0  0.0  0.0  0.0
B053F15-18    0 -19.792  20.192  0.0  0.0
B053F15-18    1 -19.792 -20.192  0.0  0.0
B058F03     Stage sequence number:                 1
B058F04     Gain:                                  2.62e+01
B058F03     Stage sequence number:                 0
B058F04     Sensitivity:                           2.62e+01
"""


@pytest.fixture
def catalogue(data):
    return [read_response(path) for path in sorted((data / "geophone_responses").glob("RESP.*"))]


@pytest.fixture
def write(tmp_path):
    def make(text, name=GOOD_NAME):
        path = tmp_path / name
        path.write_text(text)
        return path

    return make


def open_gain(entry, others):
    """Median gain of the same model and coil without its shunt R, which loads it by R / (R + coil); with this shunt."""

    def divider(one):
        return 1.0 if one.shunt_ohm is None else one.shunt_ohm / (one.shunt_ohm + one.coil_ohm)

    opened = [
        one.gain_Vs_per_m / divider(one)
        for one in others
        if one is not entry and (one.model, one.coil_ohm) == (entry.model, entry.coil_ohm)
    ]
    return np.median(opened) * divider(entry) if opened else None


def test_every_real_file_is_read_and_exactly_one_contradicts_itself(catalogue):
    assert len(catalogue) == 18
    found = {entry.file: wrong for entry in catalogue if (wrong := check_against_name(entry))}
    assert list(found) == ["RESP.XX.NS534..SLZ.HG6.375.1000.10.21"]
    assert found["RESP.XX.NS534..SLZ.HG6.375.1000.10.21"] == ["gain is 2.1 V s/m, the name's 21 V s/m"]


def test_the_voltage_divider_of_its_siblings_says_that_the_name_is_right(catalogue):
    bad = next(entry for entry in catalogue if "NS534" in entry.file)
    assert open_gain(bad, catalogue) == pytest.approx(21.0, rel=0.01)


def test_shunted_gains_of_the_gs11d_follow_the_voltage_divider(catalogue):
    for entry in catalogue:
        predicted = open_gain(entry, catalogue) if entry.model == "GS11D" else None
        if predicted is not None:
            assert entry.gain_Vs_per_m == pytest.approx(predicted, rel=0.005)


def test_shunt_damping_of_the_gs11d_is_inverse_to_the_circuit_resistance(catalogue):
    # zeta = open-circuit damping + c/(coil + shunt): two shunts of the 380 ohm coil give the same c.
    coil = {e.shunt_ohm: e for e in catalogue if e.model == "GS11D" and e.coil_ohm == 380.0}
    c = [(coil[shunt].damping - coil[None].damping) * (380.0 + shunt) for shunt in (1740.0, 4420.0)]
    assert c[0] == pytest.approx(c[1], rel=0.005)


def test_a_well_formed_file_reads_and_agrees(write):
    entry = read_response(write(GOOD))
    assert not check_against_name(entry)
    assert (entry.model, entry.coil_ohm, entry.shunt_ohm) == ("GS11D", 380.0, 1740.0)
    assert entry.damping == pytest.approx(0.7, rel=1e-3)


def test_a_wrong_corner_and_a_wrong_normalisation_are_found(write):
    slow = GOOD.replace("19.792", "9.896").replace("20.192", "10.096")
    assert "corner" in check_against_name(read_response(write(slow)))[0]
    scaled = GOOD.replace("factor:               1.0E+00", "factor:               8.0E+02")
    assert "normalisation" in check_against_name(read_response(write(scaled)))[0]


@pytest.mark.parametrize(
    ("change", "field"),
    [
        (lambda t: t[: t.index("B053F15-18    1")], "poles"),
        (lambda t: t[: t.index("B058F03")], "B058F04"),
        (lambda t: t[:40], "B053"),
        (lambda t: "", "B053F03"),
        (lambda t: t.replace("-19.792  20.192", "nan  20.192"), "B053F15-18"),
        (lambda t: t.replace("-19.792", "19.792"), "poles"),
        (lambda t: t.replace("M/S - Velocity in Meters Per Second", "M/S**2 - Acceleration"), "B053F05"),
        (lambda t: t.replace("V - Volts", "MV - Millivolts"), "B053F06"),
        (lambda t: t.replace("A [Laplace Transform (Rad/sec)]", "B [Analog (Hz)]"), "B053F03"),
        (lambda t: t.replace("B053F10-13    1  0.0", "B053F10-13    1  3.0"), "zeros"),
        (lambda t: t.replace("2.62e+01", "-26.2"), "B058F04"),
        (lambda t: t.replace("2.62e+01", "inf"), "B058F04"),
        (
            lambda t: t.replace(
                "Number of poles:                       2", "Number of poles:                       two"
            ),
            "B053F14",
        ),
    ],
)
def test_a_broken_file_is_refused_naming_file_and_field(write, change, field):
    with pytest.raises(InputError, match=field) as caught:
        read_response(write(change(GOOD)))
    assert GOOD_NAME in str(caught.value)


@pytest.mark.parametrize(
    "name", ["RESP.XX.short", "RESP.XX.N..SHZ.GS11D.4_5.380.NONE.abc", "RESP.XX.N..SHZ.S13.NONE.629"]
)
def test_a_name_that_cannot_be_read_is_refused(write, name):
    with pytest.raises(InputError, match="name"):
        read_response(write(GOOD, name))


def test_a_binary_file_is_refused(tmp_path):
    path = tmp_path / GOOD_NAME
    path.write_bytes(bytes(range(256)))
    with pytest.raises(InputError, match="ASCII"):
        read_response(path)
