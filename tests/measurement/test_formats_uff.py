"""Universal files: binary ones assembled here from the format, ASCII ones written by pyuff, real samples."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from refusals import refused

from avis_ctrl.measurement.formats import read_measurements


def data_set(
    values,
    *,
    kind=1,
    name="NONE",
    node=0,
    direction=0,
    reference=("NONE", 0, 0),
    start=0.0,
    step=0.01,
    ordinate=(12, "NONE"),
    denominator=(0, "NONE"),
    abscissa=(17, "s"),
    order=None,
    double=True,
    uneven=None,
    line1="NONE",
):
    """A data set 58 (order None) or 58b (order "<" or ">"), field by field from the definition's Fortran formats."""
    values = np.asarray(values)
    parts = [values.real, values.imag] if np.iscomplexobj(values) else [values]
    code = {(1, False): 2, (1, True): 4, (2, False): 5, (2, True): 6}[len(parts), double]
    lines = [line1, "NONE", "NONE", "NONE", "NONE"]
    lines.append(
        f"{kind:5d}{0:10d}{0:5d}{0:10d} {name:<10s}{node:10d}{direction:4d} {reference[0]:<10s}"
        f"{reference[1]:10d}{reference[2]:4d}"
    )
    lines.append(f"{code:10d}{len(values):10d}{uneven is None:10d}{start:13.5E}{step:13.5E}{0.0:13.5E}")
    for type_, unit in (abscissa, ordinate, denominator, (0, "NONE")):
        lines.append(f"{type_:10d}{0:5d}{0:5d}{0:5d} {'NONE':<20s} {unit:<20s}")
    columns = ([uneven] if uneven is not None else []) + parts
    if order is None:
        body, width = "", 20 if double else 13
        for i, row in enumerate(zip(*columns, strict=True)):
            for j, number in enumerate(row):
                first = uneven is not None and j == 0
                body += f"{number:13.5E}" if first or not double else f"{number:{width}.12E}"
            per_line = {13: 6, 20: 4}[width] // len(columns)
            body += "\n" if i % max(per_line, 1) == max(per_line, 1) - 1 else ""
        return ("    -1\n    58\n" + "\n".join([*lines, body.rstrip("\n")]) + "\n    -1\n").encode("latin-1")
    body_b = b""
    for row in zip(*columns, strict=True):
        for j, number in enumerate(row):
            body_b += struct.pack(order + ("d" if double and not (uneven is not None and j == 0) else "f"), number)
    title = f"{58:6d}b{1 if order == '<' else 2:6d}{2:6d}{11:12d}{len(body_b):12d}{0:6d}{0:6d}{0:12d}{0:12d}"
    return ("    -1\n" + "\n".join([title, *lines]) + "\n").encode("latin-1") + body_b + b"\n    -1\n"


def units(length, force=1.0):
    return (
        (
            f"    -1\n   164\n{9:10d}{'own units':<20s}{1:10d}\n" + f"{length:25.17E}{force:25.17E}{1.0:25.17E}\n"
            f"{0.0:25.17E}\n    -1\n"
        )
        .replace("E", "D")
        .encode()
    )


@pytest.fixture
def path(tmp_path):
    return tmp_path / "a.uff"


@pytest.mark.parametrize("order", [None, "<", ">"])
@pytest.mark.parametrize("double", [True, False])
def test_time_responses(path, rng, order, double):
    u, y = rng.normal(size=(2, 50))
    path.write_bytes(
        data_set(u, name="Az1", ordinate=(1, "V"), order=order, double=double)
        + data_set(y, name="Sz1", ordinate=(12, "m/s^2"), order=order, double=double)
    )
    campaign = read_measurements(path, rig="avis", excitation="noise")
    record = campaign.records[0].load()
    assert (campaign.u_names, campaign.y_names, campaign.y_unit) == (("Az1",), ("Sz1",), "m/s^2")
    assert record.header.sample_rate_Hz == 100.0
    exact = {True: 1e-12, False: 1e-5 if order is None else 1e-7}[double]
    np.testing.assert_allclose(record.u[:, 0], u, rtol=exact)
    np.testing.assert_allclose(record.y[:, 0], y, rtol=exact)


@pytest.mark.parametrize("order", [None, "<", ">"])
@pytest.mark.parametrize("double", [True, False])
@pytest.mark.parametrize("even", [True, False])
def test_frequency_responses_with_coherence(path, rng, order, double, even):
    n, coherence = 9, rng.uniform(0.3, 0.99, (2, 9))
    G = rng.normal(size=(2, n)) + 1j * rng.normal(size=(2, n))
    common = {
        "start": 2.0,
        "step": 0.5,
        "abscissa": (18, "Hz"),
        "order": order,
        "double": double,
        "uneven": None if even else 2.0 + 0.5 * np.arange(n),
        "reference": ("Az1", 1, 3),
    }
    content = b""
    for i, direction in enumerate((3, -1)):
        content += data_set(
            G[i],
            kind=4,
            node=3,
            direction=direction,
            ordinate=(11, "mm/s"),
            denominator=(1, "V"),
            line1="FRF 40 averages",
            **common,
        )
        content += data_set(coherence[i], kind=6, node=3, direction=direction, ordinate=(0, "NONE"), **common)
    path.write_bytes(content)
    response = read_measurements(path)
    assert (response.inputs, response.outputs) == (("Az1",), ("node 3 +Z", "node 3 -X"))
    assert (response.input_unit, response.output_unit) == ("V", "m/s")
    np.testing.assert_allclose(response.frequency_Hz, 2.0 + 0.5 * np.arange(n))
    np.testing.assert_allclose(response.value[:, :, 0], 1e-3 * G.T, rtol=1e-4)
    expected = 1e-6 * np.abs(G) ** 2 * (1 - coherence) / (coherence * 39)
    np.testing.assert_allclose(response.entry_variance[:, :, 0], expected.T, rtol=2e-3)


def test_a_stated_rate_must_agree_with_the_increment(path, rng):
    path.write_bytes(data_set(rng.normal(size=20), **A) + data_set(rng.normal(size=20), **S))
    assert read_measurements(path, excitation="noise", sample_rate_Hz=100.05).sample_rate_Hz == 100.05
    refused(
        r"sample_rate_Hz = 50: expected 100 Hz, the rate of the time stamps",
        path,
        excitation="noise",
        sample_rate_Hz=50,
    )


def test_units_by_data_type_and_data_set_164(path):
    """The factor of length is file units per metre: 1000 for millimetres."""
    y = np.arange(1.0, 9.0)
    path.write_bytes(
        units(1000.0) + data_set(y, name="S1", ordinate=(11, "NONE")) + data_set(y, name="A1", ordinate=(13, "NONE"))
    )
    campaign = read_measurements(path, excitation="noise")
    record = campaign.records[0].load()
    assert (campaign.y_unit, record.header.u_unit) == ("m/s", "N")
    np.testing.assert_allclose(record.y[:, 0], 1e-3 * y)
    path.write_bytes(
        units(1000.0) + data_set(y, name="S1", ordinate=(11, "m/s")) + data_set(y, name="A1", ordinate=(1, "V"))
    )
    refused(r"by data set 164 it is 0.001 m/s; state the right one with y_unit", path)
    assert read_measurements(path, y_unit="mm/s").records[0].y[0, 0] == pytest.approx(1e-3)
    path.write_bytes(units(1000.0).replace(b"1.0000", b"1.0x00") + data_set(y, name="S1", ordinate=(11, "NONE")))
    refused(r"data set 1 \(byte 0\) = .*: expected positive factors of length and force", path)


def test_what_another_function_refers_to_is_an_input(path, rng):
    """A reference without node is none: the response beside it may be at node 0, as where nodes were never given."""
    u, y = rng.normal(size=(2, 20))
    path.write_bytes(
        data_set(u, node=7, direction=-3, ordinate=(1, "V"))
        + data_set(y, ordinate=(12, "m/s^2"), reference=("NONE", 7, -3))
    )
    campaign = read_measurements(path, excitation="noise")
    assert (campaign.u_names, campaign.y_names) == (("node 7 -Z",), ("node 0",))


def test_the_second_function_of_a_channel_is_the_second_record(path, rng):
    u = rng.normal(size=(2, 20))
    path.write_bytes(b"".join(data_set(u[i], name=name, ordinate=(1, "V")) for name in ("A1", "S1") for i in (0, 1)))
    campaign = read_measurements(path, excitation="noise")
    assert [r.header.name for r in campaign.records] == ["00", "01"]
    np.testing.assert_allclose(campaign.records[1].load().y[:, 0], u[1], rtol=1e-12)


def test_pyuff_writes_ascii_that_is_read_alike(path, rng):
    pyuff = pytest.importorskip("pyuff")
    G = rng.normal(size=12) + 1j * rng.normal(size=12)
    writer = pyuff.UFF(str(path))
    for node in (1, 2):
        writer.write_sets(
            pyuff.prepare_58(
                func_type=4,
                rsp_node=node,
                rsp_dir=3,
                ref_node=7,
                ref_dir=-3,
                data=G * node,
                x=np.arange(12) * 0.25,
                id1="FRF",
                rsp_ent_name="NONE",
                ref_ent_name="NONE",
                abscissa_spacing=1,
                binary=0,
                ord_data_type=6,
                abscissa_spec_data_type=18,
                ordinate_spec_data_type=12,
                orddenom_spec_data_type=13,
                abscissa_axis_units_lab="Hz",
                ordinate_axis_units_lab="m/s^2",
                orddenom_axis_units_lab="N",
            ),
            "add",
        )
    response = read_measurements(path, relative_standard_deviation=0.02)
    assert (response.inputs, response.outputs) == (("node 7 -Z",), ("node 1 +Z", "node 2 +Z"))
    read = pyuff.UFF(str(path)).read_sets(1)
    np.testing.assert_allclose(response.value[:, 1, 0], read["data"], rtol=1e-12)
    np.testing.assert_allclose(response.value[:, 0, 0], G, rtol=1e-11)
    for wrong in (0.0, -0.02):
        refused(
            r"relative_standard_deviation = .*: expected a positive number", path, relative_standard_deviation=wrong
        )


@pytest.mark.parametrize("double", [True, False])
def test_numbers_that_run_together_are_told_apart_by_their_width(path, double):
    """-1.0E+100 fills its field."""
    G = -1e100 * (1 + 1j) * np.arange(1.0, 9.0)
    path.write_bytes(
        data_set(
            G,
            kind=4,
            node=1,
            ordinate=(12, "m/s^2"),
            denominator=(13, "N"),
            abscissa=(18, "Hz"),
            double=double,
            start=1.0,
            step=1.0,
        )
    )
    assert b"E+100-" in path.read_bytes()
    response = read_measurements(path, relative_standard_deviation=0.1)
    np.testing.assert_allclose(response.value[:, 0, 0], G, rtol=1e-5)


def test_real_samples(data):
    sample = data / "uff" / "Sample_UFF58_ascii.uff"
    refused(r"no channel is recognised as an input; the file has Mic 01", sample)
    refused(r"channel Mic 01: unit = 'Pa': expected a unit of V", sample, excitation="rest")
    record = read_measurements(sample, excitation="rest", y_unit="V").records[0].load()
    assert record.header.samples == 79292 and record.header.sample_rate_Hz == 65536.0
    assert record.y[0, 0] == -1.47553e-02
    refused(r"type 1 .* or 4 .*; the file has 9 \(power spectral density\)", data / "uff" / "sample_dataset58_psd.uff")


FRF = {"kind": 4, "abscissa": (18, "Hz"), "ordinate": (12, "NONE"), "denominator": (13, "NONE"), "node": 1}
A, S = {"name": "A1", "ordinate": (1, "V")}, {"name": "S1", "ordinate": (1, "V")}
ONES = np.ones(8)
REFUSED = {
    "no errors": ([(ONES + 0j, FRF)], "pass relative_standard_deviation"),
    "lengths": ([(ONES, A), (ONES[:7], S)], "channel S1 = 7: expected 8 samples, as A1 has"),
    "rates": ([(ONES, A), (ONES, S | {"step": 0.02})], "channel S1: expected the times of A1"),
    "missing record": ([(ONES, A), (ONES, A), (ONES, S)], "channel S1: missing in record 01"),
    "complex": ([(ONES + 0j, A), (ONES, S)], "record 00: u: expected real samples"),
    "no unit": ([(ONES, A), (ONES, {"name": "S1", "ordinate": (0, "NONE")})], "not stated .* pass y_unit"),
    "missing entry": (
        [(ONES + 0j, FRF | {"reference": ("A1", 0, 0)}), (ONES + 0j, FRF | {"reference": ("A2", 0, 0), "node": 2})],
        "2 are missing, the first is",
    ),
    "twice": ([(ONES + 0j, FRF), (ONES + 0j, FRF)], "expected each pair of response and reference once"),
    "grid": ([(ONES + 0j, FRF), (ONES + 0j, FRF | {"node": 2, "step": 0.3})], "expected the 8 frequencies"),
    "step": ([(ONES, A | {"step": 0.0})], "expected a positive increment"),
}


@pytest.mark.parametrize("case", REFUSED)
@pytest.mark.parametrize("order", [None, "<"])
def test_wrong_files_in_one_line(path, case, order):
    sets, message = REFUSED[case]
    path.write_bytes(b"".join(data_set(values, order=order, **fields) for values, fields in sets))
    refused(message, path)
