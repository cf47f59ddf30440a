"""The certificate of the shipped AVIS design's code, against plants that are sampled and simulated on their own."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from avis_ctrl.errors import ComputationError
from avis_ctrl.export.bounds import StabilityNotProvedError, bounds
from avis_ctrl.export.c_source import Provenance, c_files
from avis_ctrl.export.certificate import certify, shipped_loop
from avis_ctrl.export.compiled import CompiledController
from avis_ctrl.export.compiled_simulation import CompiledSimulationSettings, simulate_worst_plant
from avis_ctrl.export.design_folder import Added, open_design
from avis_ctrl.export.fewer_states import mu_asked, with_fewer_states
from avis_ctrl.export.package import CERTIFICATE, CONTINUOUS, CONTROLLER, check_package, make_package
from avis_ctrl.export.protection import Processor, protection
from avis_ctrl.export.rounding import rounding_noise
from avis_ctrl.export.sampled_controller import parse_controller
from avis_ctrl.export.sampled_response import SampledAxes
from avis_ctrl.lti import lft_lower
from avis_ctrl.rigs.rigid_body import COORDINATES
from avis_ctrl.robust.mu_gain import worst_gain
from avis_ctrl.robust.mu_peak import mu_peak
from avis_ctrl.robust.slycot_adapter import hinf_norm_slicot
from avis_ctrl.simulation.discrete import spectral_radius
from avis_ctrl.simulation.loop import simulate
from avis_ctrl.simulation.sampled_loop import NO_ANTI_WINDUP, AntiWindup, lever_arms
from avis_ctrl.study.controllers import mu_optimal
from avis_ctrl.study.design_result import Candidate
from avis_ctrl.study.random_plants import random_perturbations
from avis_ctrl.study.simulation import with_delta

pytestmark = pytest.mark.slow

DESIGNS = Path(__file__).resolve().parents[2] / "designs"


@pytest.fixture(scope="module")
def package(shipped):
    return make_package(shipped, "mu", "float32")


@pytest.fixture(scope="module")
def stored(package):
    return json.loads(package.contents[CONTROLLER])


def ratio(dB: float) -> float:
    return 10 ** (dB / 20)


def vertices(folder, count: int, rng) -> list[np.ndarray]:
    """Real parameters at their ends, chains of full size and any phase."""
    blocks = folder.plant.synthesis.blocks
    return [
        blocks.assemble(
            [
                rng.choice([-1.0, 1.0]) if block.kind == "real" else np.exp(2j * np.pi * rng.uniform())
                for block in blocks.blocks
            ]
        )
        for _ in range(count)
    ]


def sampled_transmissibility(
    folder, stored, deltas, omega, images: int = 20, accelerometers: bool = False
) -> np.ndarray:
    """(n_delta, n_omega) largest singular value of floor to payload, of the loop that runs the stored numbers.

    The design's continuous plant, its own Pade delay taken out, under hold and delay, with all images up to `images`
    folded in; gains, places and lever arms of sensors and drives from the rig.
    """
    rig, plant, T = folder.rig, folder.plant, 1 / stored["sample_rate_Hz"]
    A, B, C, D = (np.array(stored[name]) for name in "ABCD")
    kept = [COORDINATES.index(name) for name in folder.design.keep]
    arms = lever_arms(rig)[kept]
    forces = rig.equations_of_motion().T[kept] / arms[:, None]
    volts = np.array([one.gain for one in rig.sensors()])[:, None] * rig.sensor_rows()[1][:, kept] / arms
    tau = rig.loop_delay_s + 0.5 * T
    leak = 2 * np.pi * folder.design.loop.integrator_corner_Hz
    P, blocks, n = plant.full.P, plant.full.blocks, len(kept)
    P = P.select(
        [*P.outputs[: blocks.n_z], *plant.velocities, *plant.full.y],
        [*P.inputs[: blocks.n_w], *plant.floor_velocities, *plant.full.u],
    )

    @cache
    def open_plant(k):
        at = omega + 2 * np.pi * k / T
        M = P.frequency_response(np.abs(at))
        return at, np.where((at < 0)[:, None, None], M.conj(), M)

    def closed(k, delta):
        at, M = open_plant(k)
        s = 1j * at
        n_z, n_w = blocks.n_z, blocks.n_w
        G = M[:, n_z:, n_w:] + M[:, n_z:, :n_w] @ delta @ np.linalg.solve(
            np.eye(n_z) - M[:, :n_z, :n_w] @ delta, M[:, :n_z, n_w:]
        )
        pade = (1 - s * tau / 2 + (s * tau) ** 2 / 12) / (1 + s * tau / 2 + (s * tau) ** 2 / 12)
        held = (1 - np.exp(-s * T)) / (s * T) * np.exp(-s * stored["delay_samples"] * T) / pade
        G[:, :, n:] *= held[:, None, None]
        if accelerometers:  # what the code integrates itself
            G[:, n:] *= (s + leak)[:, None, None]
        return G

    z = np.exp(1j * omega * T)
    K = forces @ (C @ np.linalg.solve(z[:, None, None] * np.eye(len(A)) - A, B.astype(complex)) + D) @ volts
    found = []
    for delta in deltas:
        base = closed(0, delta)
        loop = base[:, n:, n:] + sum(closed(k, delta)[:, n:, n:] for k in range(-images, images + 1) if k)
        u = np.linalg.solve(np.eye(n) - K @ loop, K @ base[:, n:, :n])
        found.append(np.linalg.norm(base[:, :n, :n] + base[:, :n, n:] @ u, ord=2, axis=(1, 2)))
    return np.array(found)


def test_no_sampled_plant_exceeds_the_certificate(shipped, package, stored, rng):
    certificate = package.certificate.content
    omega = 2 * np.pi * np.geomspace(0.03, 120.0, 60)
    deltas = [*random_perturbations(shipped.plant, 40, 5), *vertices(shipped, 40, rng), package.certificate.worst.delta]
    sigma = sampled_transmissibility(shipped, stored, deltas, omega)
    low, high = shipped.design.transmissibility.band_Hz
    band = (omega >= 2 * np.pi * low) & (omega <= 2 * np.pi * high)
    assert np.max(sigma) <= ratio(certificate["worst_case_peak_transmissibility_dB"])
    assert np.max(sigma[:, band]) <= ratio(certificate["worst_case_band_transmissibility_dB"])
    # The worst plant found is that bad: the bound is not loose.
    at = sampled_transmissibility(
        shipped, stored, [package.certificate.worst.delta], np.array([package.certificate.worst.omega])
    )[0, 0]
    assert at == pytest.approx(package.certificate.worst.gain, rel=5e-3)
    assert at > 0.97 * ratio(certificate["worst_case_peak_transmissibility_dB"])


def test_all_axes_stay_stable_with_200_plants(shipped, package, stored, rng):
    """Poles of the sampled loop of six degrees of freedom, hold and delay exact."""
    nominal = shipped_loop(shipped, parse_controller(package.contents[CONTROLLER]))
    deltas = [*random_perturbations(shipped.plant, 100, 7), *vertices(shipped, 100, rng)]
    radii = [
        spectral_radius(
            with_delta(shipped.rig, shipped.plant, nominal, "one", delta, 2 * np.pi * 10 ** rng.uniform(0, 2))
        )
        for delta in deltas
    ]
    assert max(radii) < 1


def test_figures_are_near_those_of_the_design(shipped, package):
    """1 kHz and float32 cost this design little; what they cost is in the certificate."""
    from avis_ctrl.study.analysis import analyse

    K = shipped.controller("mu")
    designed = analyse(
        shipped.design, shipped.plant, Candidate("mu", "mu", "mu", K), random_perturbations(shipped.plant, 1, 1)
    )
    found = package.certificate.content
    assert designed.mu.lower <= found["mu_upper"] <= 1.01 * designed.mu.upper
    assert found["mu_lower"] <= found["mu_upper"] <= 1.03 * found["mu_lower"]
    assert found["stable"] and found["guaranteed"]
    assert designed.worst_peak.lower <= ratio(found["worst_case_peak_transmissibility_dB"])
    between = found["between_samples"]["worst_case_gain_dB"]
    assert (
        found["worst_case_peak_transmissibility_dB"]
        <= between + 0.01
        < found["worst_case_peak_transmissibility_dB"] + 0.1
    )


def test_offset_at_the_inputs_costs_the_voltage_that_is_certified(shipped, package):
    """The code's arithmetic, long after a step of every input by its offset, with the signs that are worst."""
    found, controller = package.certificate.content["at_rest"], package.controller
    processor = Processor(controller, protection(controller, shipped.rig))
    processor.gain, processor.wait = 1.0, 0
    drive = controller.system.outputs.index(found["drive"])
    K = controller.system
    by_input = K.C @ np.linalg.solve(np.eye(K.nstates) - K.A, K.B) + K.D
    y = np.copysign(found["offset_V"], by_input[drive])
    slowest = np.max(np.abs(np.linalg.eigvals(K.A)))
    for _ in range(int(np.log(1e-5) / np.log(slowest))):
        u = processor.step(y)
    assert u[drive] == pytest.approx(found["drive_V"], rel=1e-3)
    assert np.max(np.abs(u)) <= 1.001 * found["drive_V"]
    assert found["percent_of_limit"] == pytest.approx(100 * u[drive] / controller.limits_V[drive], rel=1e-3)
    # At rest the response of the design's own controller is met exactly.
    K0 = shipped.controller("mu")(0.0)
    assert found["gain_Ns_per_m"] == pytest.approx(np.linalg.norm(K0, 2), rel=1e-3)
    assert found["percent_of_limit"] <= shipped.design.control_effort.offset_percent


@pytest.fixture(scope="module")
def louder(shipped, package, gcc):
    """The replay with ten times the floor motion, beside which the same noise is a tenth as large."""
    files = {name: data.decode() for name, data in package.contents.items() if name.startswith("avis_controller.")}
    settings = CompiledSimulationSettings(velocity_rms=10 * CompiledSimulationSettings().velocity_rms)
    return simulate_worst_plant(shipped, package.certificate, package.controller, files, settings)


def test_the_worst_plant_replayed_through_the_code(package, louder, gcc):
    """On the nonlinear table with six axes, in time: near what the frequency domain says, and below the bound, which
    excludes the rounding of single precision: it changes the gain by less than a thousandth at ten times the floor
    motion."""
    assert not package.replay.record.diverged
    assert package.replay.gain == pytest.approx(package.certificate.worst.gain, rel=0.02)
    assert louder.gain <= 1.001 * ratio(package.certificate.content["worst_case_peak_transmissibility_dB"])


def test_the_replay_does_not_measure_noise(package, louder, gcc):
    """With ten times the floor motion, the gain is the same. The rounding of single precision is not subtracted; it
    changes the gain by less than 1 %."""
    assert louder.gain == pytest.approx(package.replay.gain, rel=1e-2)


def test_rounding_stays_below_its_bound(shipped, package, gcc):
    """The compiled float32 code against double arithmetic with the same numbers, in closed loop."""
    controller = package.controller
    guard = protection(controller, shipped.rig)
    loop = shipped_loop(shipped, controller)
    bound = rounding_noise(controller, loop)
    loop = replace(loop, sensors=replace(loop.sensors, converter=None))
    code = CompiledController(c_files(controller, guard, Provenance(())), controller)
    exact = Processor(controller, guard)
    code.state.gain, code.state.wait = 1.0, 0  # as after the start
    exact.gain, exact.wait = 1.0, 0
    rounded, smooth = (simulate(loop, 20.0, 3, settle_s=5.0, nonlinear=False, code=one.step) for one in (code, exact))
    error = np.max(np.abs(rounded.q_dot - smooth.q_dot), axis=0) * lever_arms(shipped.rig)
    assert np.all(error <= bound)
    assert np.max(error) > 1e-4 * np.max(bound)  # a bound, not a wild guess
    assert package.certificate.content["rounding_noise_m_per_s"] == pytest.approx(np.linalg.norm(bound), rel=1e-6)


@pytest.mark.parametrize(
    ("matrix", "place", "figure"),
    [("C", (1, 10), "mu_upper"), ("A", (12, 12), "no certificate"), ("D", (0, 0), "rounding_noise")],
)
def test_a_changed_coefficient_is_found_by_hash_and_by_certificate(shipped, package, tmp_path, matrix, place, figure):
    """One of the mu controller's coefficients; a pole, beyond the unit circle; one of the other axes' loops."""
    for name, content in package.contents.items():
        (tmp_path / name).write_bytes(content)
    text = json.loads(package.contents[CONTROLLER])
    text[matrix][place[0]][place[1]] = float(np.float32(1.05 * text[matrix][place[0]][place[1]]))
    (tmp_path / CONTROLLER).write_text(json.dumps(text))
    found = check_package(shipped, tmp_path)
    assert any("hash" in one for one in found)
    assert any(f"{matrix} in avis_controller.c" in one for one in found)
    assert any(f"{matrix} in controller.mat" in one for one in found)
    assert [one for one in found if one.startswith(figure)]


def test_only_what_was_changed_is_named(shipped, package, tmp_path):
    """A figure of the certificate altered: all the others are found again."""
    for name, content in package.contents.items():
        (tmp_path / name).write_bytes(content)
    altered = re.sub(rb'"mu_upper": 0\.\d', b'"mu_upper": 0.7', package.contents[CERTIFICATE])
    (tmp_path / CERTIFICATE).write_bytes(altered)
    found = check_package(shipped, tmp_path)
    assert len(found) == 2
    assert "content_sha256 differs" in found[0] and found[1].startswith("mu_upper: 0.7")


def test_the_code_of_another_design_is_named_as_such(shipped, package, tmp_path):
    """Its bounds, computed with this design's controller, would say that a sound code is unstable."""
    for name, data in package.contents.items():
        (tmp_path / name).write_bytes(data)
    made = shipped.result["provenance"] | {"inputs_sha256": "0" * 64}
    other = replace(shipped, result=shipped.result | {"provenance": made})
    (line,) = check_package(other, tmp_path)
    assert line.startswith("this code was exported from another design: SHA-256 of its inputs")


def test_a_mu_above_the_requirement_is_refused(shipped, package, monkeypatch):
    monkeypatch.setattr("avis_ctrl.export.package.certify", lambda *arguments: package.certificate)
    asked = mu_asked(shipped.design)
    assert asked == 1.0  # designs/avis_z_phix.toml
    with pytest.raises(ComputationError, match=r"at most 0\.5; nothing was written"):
        make_package(shipped, "mu", "float32", mu_at_most=0.5 * asked)


def test_six_states_by_descent_on_mu_are_certified(shipped, package, tmp_path, rng):
    """Truncation to ten states takes mu beyond 1.7; asked is 15 % more than the full controller's, and below 1."""
    folder, name = with_fewer_states(shipped, "mu", 6)
    made = make_package(folder, name, mu_at_most=1.0)
    K = folder.controller(name)
    assert K.nstates <= 6
    assert made.controller.system.nstates < package.controller.system.nstates
    assert made.certificate.content["mu_upper"] < 1.15 * package.certificate.content["mu_upper"]
    # The loop formed anew: the peak of mu without sampling, as the picture of the orders has it.
    orders, P = folder.added[name].orders, shipped.plant.synthesis
    peak = mu_peak(lft_lower(P.P, K), P.all_blocks)
    assert orders[-1][0] == K.nstates and peak.guaranteed
    assert peak.lower <= orders[-1][1] <= 1.01 * peak.upper
    # At the last order modes are exchanged, which leaves the number of states and lowers the peak.
    assert orders[0][0] == shipped.controller("mu").nstates
    assert all(more[0] > fewer[0] or (more[0] == fewer[0] and more[1] > fewer[1]) for more, fewer in pairwise(orders))
    # The loop gain of the nominal table on a dense grid, hold and all images left out.
    omega = np.geomspace(np.pi * shipped.rig.sample_rate_Hz, 1e6, 2000)
    table = P.P.select(P.y, P.u).frequency_response(omega)
    assert np.max(np.linalg.norm(table @ K.frequency_response(omega), 2, (1, 2))) < 0.5
    # Transmissibility of sampled plants, from the numbers in the file; the worst one comes near the bound.
    found, omega = made.certificate.content, 2 * np.pi * np.geomspace(0.03, 120.0, 60)
    numbers, worst = json.loads(made.contents[CONTROLLER]), made.certificate.worst
    sigma = sampled_transmissibility(
        folder, numbers, [worst.delta, *vertices(folder, 40, rng)], np.append(omega, worst.omega)
    )
    low, high = folder.design.transmissibility.band_Hz
    band = np.flatnonzero((omega >= 2 * np.pi * low) & (omega <= 2 * np.pi * high))
    assert 0.97 * ratio(found["worst_case_peak_transmissibility_dB"]) < np.max(sigma)
    assert np.max(sigma) <= ratio(found["worst_case_peak_transmissibility_dB"])
    assert np.max(sigma[:, band]) <= ratio(found["worst_case_band_transmissibility_dB"])
    # By another route: H-infinity norm of the nominal loop by SLICOT; without uncertainty mu is at most this much.
    nominal = shipped.plant.synthesis.nominal().closed(folder.controller(name))
    assert hinf_norm_slicot(nominal) <= made.certificate.content["mu_upper"]
    for file, content in made.contents.items():
        (tmp_path / file).write_bytes(content)
    assert check_package(shipped, tmp_path) == []
    (tmp_path / CONTINUOUS).write_bytes(made.contents[CONTINUOUS].replace(b"1", b"2", 1))
    assert check_package(shipped, tmp_path) == [f"{CONTINUOUS} is not the file that was exported: its hash differs"]


def test_an_unstable_controller_has_no_certificate(shipped, package):
    """All gains times twenty."""
    K = package.controller.system
    loud = replace(package.controller, system=replace(K, C=20 * K.C, D=20 * K.D))
    with pytest.raises(ComputationError, match="unstable"):
        certify(shipped, loud)


def test_a_proof_that_cannot_succeed_ends_before_the_bounds_that_take_minutes(shipped, monkeypatch):
    """A direct term, as descent on mu alone leaves it: above half the sample rate the table cannot be proved to bear
    its gain. That is found before anything is bounded between frequencies."""
    monkeypatch.setattr("avis_ctrl.export.sampled_response.worst_case_gain", None)  # would be called otherwise
    K, P = shipped.controller("mu"), shipped.plant.synthesis
    half_rate = np.pi * shipped.rig.sample_rate_Hz
    nominal = np.linalg.norm(P.P.select(P.y, P.u).frequency_response(np.array([half_rate]))[0], 2)
    direct = replace(K, D=K.D + 0.15 / nominal * np.eye(2))
    folder = replace(shipped, added={"direct": Added(direct)})
    with pytest.raises(StabilityNotProvedError, match="loop gain from half the sample rate on is at least 2"):
        bounds(SampledAxes.of(folder, folder.sampled("direct")), True)
    monkeypatch.setattr("avis_ctrl.export.certificate.rounding_noise", lambda *arguments: np.zeros(6))
    monkeypatch.setattr("avis_ctrl.export.package.choose_anti_windup", None)
    with pytest.raises(
        ComputationError,
        match=r"'direct' is not proved stable; nothing was written; measured: "
        r"nominal, gain 10%: spectral radius 1\.0.*; and 27 more of the 30 "
        r"loops; next: try a larger --order",
    ):
        make_package(folder, "direct")


def test_no_plant_exceeds_the_bound_of_the_gain_above_half_the_sample_rate(shipped, package):
    """Near half the rate, where the loop gain is largest, the bound is within 3 % of what an ascent reaches."""
    axes, plant = SampledAxes.of(shipped, package.controller), shipped.plant.full
    P, blocks = plant.P, plant.blocks
    part = P.select([*P.outputs[: blocks.n_z], *plant.y], [*P.inputs[: blocks.n_w], *plant.u])
    omega = axes.half_rate * np.geomspace(1.0, 15.0, 12)
    reached = worst_gain(part.frequency_response(omega), blocks, count=10).gain
    bound = axes.force_to_seen(omega)
    assert np.all(reached <= bound) and bound[0] <= 1.03 * reached[0] and np.all(bound <= 1.2 * reached)


def recoveries(folder, package, law, speeds, inside: bool = False) -> np.ndarray:
    """(speeds,) largest velocity of the kept axes 1 to 3 s after a floor motion of 0.2 Hz for 20 s [m/s], on the
    nonlinear table: with the compiled code, or with the controller in the simulation."""
    controller, found = package.controller, []
    loop = replace(shipped_loop(folder, controller), anti_windup=law)
    loop = replace(
        loop, sensors=replace(loop.sensors, converter=None, noise_rms_V=np.zeros(1), flicker_rms_V=np.zeros(1))
    )
    guard = protection(controller, folder.rig, law)
    guard = replace(guard, input_limit_V=np.full(controller.system.ninputs, 1e6))
    kept = [COORDINATES.index(name) for name in folder.design.keep]
    time = np.arange(23001) * loop.period_s
    for speed in speeds:
        floor = np.zeros((time.size, 6))
        floor[:, 2] = np.where(time < 20, speed * np.sin(2 * np.pi * 0.2 * time), 0.0)
        code = CompiledController(c_files(controller, guard, Provenance(())), controller)
        code.state.gain, code.state.wait = 1.0, 0  # as after the start
        record = simulate(loop, 23.0, settle_s=0.0, floor=floor, code=None if inside else code.step)
        assert not record.diverged
        assert np.sum(np.any(np.abs(record.volts) >= controller.limits_V, axis=1)) > 2000
        found.append(np.max(np.linalg.norm(record.q_dot[21000:, kept] * lever_arms(folder.rig)[kept], axis=1)))
    return np.array(found)


def test_recovery_is_never_slower_than_without_anti_windup(shipped, package, gcc):
    """Floor motion of 2 to 20 mm/s, at 20 mm/s 15 times what the drives can follow. The lag that helps the Halcyonics
    design would slow this one, so it is not exported."""
    speeds, none = (2e-3, 4e-3, 10e-3, 20e-3), NO_ANTI_WINDUP
    without = recoveries(shipped, package, none, speeds)
    chosen = package.anti_windup
    assert np.all(recoveries(shipped, package, chosen.law, speeds) <= 1.01 * without)
    assert without == pytest.approx(recoveries(shipped, package, none, speeds, inside=True), rel=0.01)
    assert np.any(recoveries(shipped, package, AntiWindup.of(0.3, 1.0, 1e-3), speeds) > 1.1 * without)
    assert chosen.law == none
    stored = json.loads(package.contents[CERTIFICATE])["anti_windup"]
    assert stored["chosen"] == "none"
    assert stored["recovery"] == stored["recovery_without"]


def test_anti_windup_of_the_halcyonics_design_shortens_the_recovery(make_folder, tmp_path, gcc):
    """Here it is exported. Drives reach their limits from 30 mm/s on."""
    folder = open_design(
        make_folder(
            tmp_path / "design", "halcyonics_z_phix", lambda design, plant, rig: mu_optimal(design, plant, rig)[0]
        )
    )
    made = make_package(folder, "mu")
    speeds, law = (40e-3, 80e-3, 120e-3), made.anti_windup.law
    without, with_it = (recoveries(folder, made, one, speeds) for one in (NO_ANTI_WINDUP, law))
    assert law.feed > 0
    assert np.all(with_it <= 1.01 * without)
    assert np.min(with_it / without) < 0.96
    assert with_it == pytest.approx(recoveries(folder, made, law, speeds, inside=True), rel=0.01)
    assert np.all(made.anti_windup.chosen <= 1.01 * made.anti_windup.without)
    assert np.max(made.anti_windup.chosen[:, 0] / made.anti_windup.without[:, 0]) < 1


@pytest.mark.parametrize("filtered", [False, True])
def test_folding_of_accelerometers_is_in_the_certificate(make_folder, tmp_path, rng, filtered):
    """The Halcyonics design: without its anti-alias filter the worst plant is worse with the images folded in, and
    still below the code's bound; with the filter the code is certified as the design is."""
    source = (DESIGNS / "halcyonics_z_phix.toml").read_text()
    if not filtered:
        source = re.sub(r"(?m)^anti_alias_.*$", "", source)
    (tmp_path / "one.toml").write_text(source)
    folder = open_design(
        make_folder(
            tmp_path / "design", str(tmp_path / "one"), lambda design, plant, rig: mu_optimal(design, plant, rig)[0]
        )
    )
    controller = folder.sampled("mu", "float32")
    found = certify(folder, controller)
    stored = json.loads(controller.as_bytes())
    worst = [found.worst.delta], np.array([found.worst.omega])
    without, folded = (
        sampled_transmissibility(folder, stored, *worst, images=k, accelerometers=True)[0, 0] for k in (0, 30)
    )
    assert without == pytest.approx(found.worst.gain, rel=5e-3)
    assert (found.content["mu_upper"] < 1) == filtered
    assert folded < 1.01 * without if filtered else folded > 1.02 * without
    omega = 2 * np.pi * np.geomspace(0.03, 120.0, 40)
    deltas = [found.worst.delta, *random_perturbations(folder.plant, 15, 5), *vertices(folder, 15, rng)]
    sigma = sampled_transmissibility(folder, stored, deltas, omega, accelerometers=True)
    low, high = folder.design.transmissibility.band_Hz
    band = (omega >= 2 * np.pi * low) & (omega <= 2 * np.pi * high)
    assert np.max(sigma) <= ratio(found.content["worst_case_peak_transmissibility_dB"])
    assert np.max(sigma[:, band]) <= ratio(found.content["worst_case_band_transmissibility_dB"])
