"""The tables of docs/export.md: the shipped designs, exported with float64 and float32 numbers.

    python -m benchmarks.shipped_designs [avis_z_phix ...]

Each design of designs/*.toml is computed and exported, and its column of each table is printed. For avis_z_phix,
`--order 6` is computed, too. Half an hour for all four. On another type of processor D-K iteration may end
at slightly different controllers.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Sequence
from pathlib import Path

import avis_ctrl as ac
from avis_ctrl.export.design_folder import DesignFolder, open_design
from avis_ctrl.export.fewer_states import with_fewer_states
from avis_ctrl.export.package import Package, make_package
from avis_ctrl.lti.norms import decibels

DESIGNS = Path(__file__).parents[1] / "designs"
NAMES = ("avis_z_phix", "halcyonics_z_phix", "avis_six_axes", "halcyonics_six_axes")
PEAK, BAND = "worst_case_peak_transmissibility_dB", "worst_case_band_transmissibility_dB"


def designed(name: str, folder: Path) -> DesignFolder:
    """The folder of a design of designs/*.toml, read for export."""
    ac.design(DESIGNS / f"{name}.toml").save(folder)
    return open_design(folder)


def figures(folder: DesignFolder, packages: Sequence[Package]) -> dict[str, str]:
    """A column of the table "The shipped designs" of docs/export.md, by row; packages : float64, float32."""
    worst = folder.result["worst_cases"]["mu"]
    mu, peak, band = worst["mu"]["upper"], decibels(worst["peak"]["upper"]), decibels(worst["band"]["upper"])
    found = [json.loads(one.contents["certificate.json"]) for one in packages]

    def each(key: str, digits: str) -> str:
        return ", ".join(f"{one[key]:{digits}}" for one in found)

    def tolerances(key: str) -> str:
        return ", ".join(f"{one[key]['tolerance_V']:.1e}" for one in found)

    def source(one: Package) -> str:
        return f"{sum(len(text) for name, text in one.contents.items() if name[-2:] in ('.c', '.h')) / 1000:.1f}"

    rest, n = found[0]["at_rest"], packages[0].controller.system.nstates
    simulated = [decibels(one.replay.gain) if one.replay else float("nan") for one in packages]
    return {
        "mu at most: design, float64, float32": f"{mu:.3f}, {each('mu_upper', '.3f')}",
        "mu at least: float64, float32": each("mu_lower", ".3f"),
        "worst-case peak: design, float64, float32": f"{peak:.2f}, {each(PEAK, '.2f')}",
        "worst-case band: design, float64, float32": f"{band:.2f}, {each(BAND, '.2f')}",
        "worst plant simulated with the compiled code, peak": ", ".join(f"{value:.2f}" for value in simulated),
        "gain at zero frequency [V/V], [N s/m]": f"{rest['gain_V_per_V']:.0f}, {rest['gain_Ns_per_m']:.1e}",
        "offset [mV]; drive voltage [V]": f"{1e3 * rest['offset_V']:.2f}; {rest['drive_V']:.2f}",
        "rounding noise at most [m/s]": each("rounding_noise_m_per_s", ".1e"),
        "test_vectors.csv agrees within [V]": tolerances("test_vectors"),
        "restart_vectors.csv agrees within [V]": tolerances("restart_vectors"),
        "states; execution time per sample [us]": f"{n}; {each('step_time_us', '.2g')}",
        "kilobytes of C and header": ", ".join(source(one) for one in packages),
    }


def anti_windup(package: Package) -> list[str]:
    """A column of the table "Which anti-windup is exported"."""
    chosen = package.anti_windup.as_dict()
    law = "none" if chosen["corner_Hz"] is None else f"lag of {chosen['corner_Hz']:g} Hz, gain {chosen['gain']:g}"
    rows = [
        ", ".join(f"{1e3 * value:.3f}" for value in chosen[which][key])
        for key in ("rms_m_per_s", "late_peak_m_per_s")
        for which in ("recovery_without", "recovery")
    ]
    return [law, *rows]


def fewer_states(folder: DesignFolder) -> list[str]:
    """The table of `--order 6`."""
    small, name = with_fewer_states(folder, "mu", 6)
    code = make_package(small, name).certificate.content
    rows = [f"{states} states: {mu:.3f}" for states, mu in small.added[name].orders]
    return [*rows, f"code: {code['mu_upper']:.3f}, {code['mu_lower']:.3f}; {code[PEAK]:.2f}, {code[BAND]:.2f} dB"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", default=list(NAMES), metavar="NAME", help=", ".join(NAMES))
    for name in parser.parse_args().names:
        with tempfile.TemporaryDirectory() as folder:
            design = designed(name, Path(folder) / name)
            packages = [make_package(design, "mu", arithmetic) for arithmetic in ("float64", "float32")]
            print(f"\n{name}", flush=True)
            for row, text in figures(design, packages).items():
                print(f"  {row}: {text}")
            print("  anti-windup:", "\n    ".join(anti_windup(packages[0])), sep="\n    ")
            if name == "avis_z_phix":
                print("  --order 6:", "\n    ".join(fewer_states(design)), sep="\n    ", flush=True)


if __name__ == "__main__":
    main()
