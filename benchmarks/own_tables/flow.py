"""From a campaign to a verdict, and an independent second opinion, on each of the five tables.

    .venv/bin/python -m benchmarks.own_tables.flow --out FOLDER [--only tripod] [--form logical] [--seed 1]

The independent simulator makes a campaign of the true table. `avis identify` and `avis design` see only that campaign
and the rig file in designs/rigs. The sampled controller that they deliver then runs on the independent nonlinear table:
on the nominal one and on the true one, which differs within tolerances. The last column says whether they agree: the
package's simulation of the identified table and the independent one of the nominal table are both stable or both
unstable, and where the verdict is "stable", the true table is stable. What is asked of each design is in `ASKED`; a
design that misses it is a result, not a failure.
"""

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path

from benchmarks.own_tables.campaign import Settings, write_campaign
from benchmarks.own_tables.closed_loop import Controller, linearise, run
from benchmarks.own_tables.tables import NOMINAL, truth

ROOT = Path(__file__).resolve().parents[2]
DESIGN = """title = "{name}"
rig = "{rig}"
keep = {keep}

[uncertainty]
parameters_percent = {{ mass = 5.0, "isolator*.k_z" = 10.0, "isolator*.c_z" = 30.0 }}

[uncertainty.actuator_chains]
low_percent = 10.0
crossover_Hz = 100.0
high_percent = 400.0

[transmissibility]
peak_dB = 6.0
band_dB = {band_dB}
band_Hz = [{low}, {high}]

[control_effort]
floor_velocity_m_per_s = {floor}
bandwidth_Hz = 100.0

[synthesis]
max_iterations = 6
target_mu = 0.95

[simulation]
duration_s = 20.0
random_plants = 5

[[requirement]]
quantity = "mu_upper"
at_most = 1.0
"""
# Bands about each table's vertical modes, and a floor that uses a decent part of the drives.
BOTH = '["z", "phi_x"]'
# On the granite only z is measured absolutely; rotations are measured relative to the floor, which gives no isolation.
ASKED = {
    "tripod": (BOTH, -6.0, 2.0, 8.0, 2e-5),
    "four_vertical": (BOTH, -6.0, 3.0, 12.0, 2e-5),
    "twelve_sensors": (BOTH, -6.0, 2.0, 10.0, 2e-5),
    "skewed": (BOTH, -3.0, 8.0, 20.0, 2e-5),
    "granite": ('["z"]', -3.0, 2.0, 6.0, 2e-5),
}
COMMAND = [sys.executable, "-c", "from avis_ctrl.cli import main; main()"]


def command(*words: object) -> tuple[int, str, float]:
    """(exit code, last line on standard error, seconds) of an avis command."""
    began = time.monotonic()
    done = subprocess.run([*COMMAND, *map(str, words)], capture_output=True, text=True, cwd=ROOT)
    said = (done.stderr.strip().splitlines() or [""])[-1]
    return done.returncode, said, time.monotonic() - began


def flow(name: str, form: str, seed: int, out: Path) -> dict:
    """One table from campaign to second opinion."""
    out.mkdir(parents=True, exist_ok=True)
    rig = ROOT / "designs" / "rigs" / f"{name}.toml"
    campaign, made = out / "campaign.h5", out / "design"
    write_campaign(truth(name, seed), form, campaign, seed=seed, floor_measured=True, settings=Settings(noise_s=60.0))
    keep, band_dB, low, high, floor = ASKED[name]
    (out / "asked.toml").write_text(
        DESIGN.format(name=name, rig=rig, keep=keep, band_dB=band_dB, low=low, high=high, floor=floor)
    )
    row: dict = {"table": name, "form": form}
    row["identify"], row["identify_said"], row["identify_s"] = command(
        "identify", campaign, "--rig", rig, "--design", out / "asked.toml", "--out", out / "identified"
    )
    source = out / "identified" / "design.toml" if row["identify"] == 0 else out / "asked.toml"
    row["design"], row["design_said"], row["design_s"] = command("design", source, "--out", made)
    if (made / "result.json").exists():
        result = json.loads((made / "result.json").read_text())
        mu = next(one for one in result["controllers"] if one["name"] == "mu")
        row |= {"verdict": result["verdict"], "says_stable": result["stable"], "mu_upper": mu["mu_upper"]}
        controller = Controller.read(made / "sampled_controller.json")
        for kind, table in (("nominal", NOMINAL[name]()), ("true", truth(name, seed))):
            linear, record = linearise(table, controller), run(table, controller, seconds=40.0)
            row[f"{kind}_radius"], row[f"{kind}_stable"] = linear.spectral_radius, bool(linear.stable and record.stable)
        identified = next(one for one in result["simulation"]["plants"] if one["name"] == "nominal")
        row |= {"package_radius": identified["spectral_radius"], "package_nominal_stable": identified["stable"]}
        # A verdict "unstable" may rest on a single perturbed plant, which the true table need not resemble.
        row["agree"] = row["package_nominal_stable"] == row["nominal_stable"] and (
            row["true_stable"] or not row["says_stable"]
        )
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--only", choices=sorted(NOMINAL), action="append")
    parser.add_argument("--form", default="logical")
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    for name in given.only or ASKED:
        row = flow(name, given.form, given.seed, given.out / name)
        (given.out / name / "row.json").write_text(json.dumps(row, indent=1))
        print(json.dumps(row, indent=1), flush=True)


if __name__ == "__main__":
    main()
