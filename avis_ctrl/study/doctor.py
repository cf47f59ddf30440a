"""Checks of the installation; each solves a problem with a known solution."""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from importlib import metadata
from typing import Any

import numpy as np

from avis_ctrl.lti.statespace import gain

LIBRARIES = ("numpy", "scipy", "control", "slycot", "cvxpy", "clarabel", "matplotlib", "plotly", "typst", "numba")


@dataclass(frozen=True)
class Check:
    """A row of `avis doctor`."""

    name: str
    found: str
    works: bool


def examine() -> list[Check]:
    """Run all checks; a failure is a row, never an exception."""
    checks = [Check("python", platform.python_version(), True)]
    checks += [_attempt(name, partial(metadata.version, name)) for name in LIBRARIES]
    checks += [
        _attempt("processors and BLAS threads", _threads),
        _attempt("SLICOT H-infinity norm", _slicot),
        _attempt("clarabel solves an LMI", _clarabel),
        _attempt("mu bounds (compiled)", _mu),
        _attempt("nonlinear simulation (compiled)", _simulation),
        _attempt("model prediction (compiled)", _prediction),
        _attempt("extended Kalman filter (compiled)", _kalman),
        _attempt("gcc, for avis export", _gcc),
        _attempt("typst compiles a PDF", _typst),
        _attempt("own H-infinity synthesis", _synthesis),
    ]
    return checks


def _attempt(name: str, check: Callable[[], str]) -> Check:
    try:
        return Check(name, check(), True)
    except Exception as error:  # any failure is a result of the check
        return Check(name, f"{type(error).__name__}: {error}".splitlines()[0][:100], False)


def _near(value: float, known: float, tolerance: float) -> str:
    if not abs(value - known) <= tolerance * abs(known):
        raise ArithmeticError(f"{value:.6g} instead of {known:.6g}")
    return f"{value:.6g}"


def _threads() -> str:
    from threadpoolctl import threadpool_info

    pools = ", ".join(f"{pool['internal_api']} {pool['num_threads']}" for pool in threadpool_info())
    return f"{os.cpu_count()} processors; {pools or 'no pools'} (avis limits them to 1)"


def _slicot() -> str:
    """The resonance peak for a damping ratio zeta is 1/(2 zeta sqrt(1 - zeta^2))."""
    from avis_ctrl.lti.statespace import tf
    from avis_ctrl.robust.slycot_adapter import hinf_norm_slicot

    zeta = 0.1
    return _near(hinf_norm_slicot(tf([1.0], [1.0, 2 * zeta, 1.0])), 1 / (2 * zeta * np.sqrt(1 - zeta**2)), 1e-6)


def _clarabel() -> str:
    """The largest eigenvalue as an LMI."""
    import cvxpy as cp

    A = np.array([[2.0, 1.0], [1.0, 3.0]])
    t = cp.Variable()
    problem: Any = cp.Problem(cp.Minimize(t), [t * np.eye(2) - A >> 0])
    problem.solve(solver=cp.CLARABEL)
    return _near(float(np.asarray(t.value)), float(np.max(np.linalg.eigvalsh(A))), 1e-6)


def _mu() -> str:
    """mu of a rank-one matrix with scalar blocks is the sum of the magnitudes of its diagonal; compiles the kernels.

    The first test has complex blocks, the second one real blocks and a positive diagonal.
    """
    from avis_ctrl.robust.mu import mu
    from avis_ctrl.uncertainty.blocks import ComplexScalar, RealScalar

    M = np.outer([1.0, 2.0, 3.0], [1.0, -1.0j, 0.5])
    found = [float(mu(M, [ComplexScalar()] * 3).upper), float(mu(np.abs(M), [RealScalar()] * 3).upper)]
    return _near(max(found, key=lambda one: abs(one - 4.5)), 4.5, 1e-4)


def _simulation() -> str:
    """A table at rest on a motionless floor remains at rest; compiles the kernel."""
    from avis_ctrl.rigs.rig_file import load_rig
    from avis_ctrl.simulation.loop import simulate
    from avis_ctrl.simulation.sampled_loop import SampledLoop, rig_bank

    rig = load_rig("avis")
    silent = replace(rig_bank(rig, 1.0).white(), noise_rms_V=np.zeros(1))
    record = simulate(SampledLoop(rig, gain(np.zeros((1, 1))), ("z",), {}, silent, {}), 0.1, settle_s=0.0)
    if np.any(record.q):
        raise ArithmeticError(f"it moved by {np.max(np.abs(record.q)):.3g} m")
    return f"{record.time.size} samples at rest"


def _prediction() -> str:
    """Small motion is linear: with the terms of large motion, readings of microvolts are the same; compiles both."""
    from avis_ctrl.identification.predictor import Predictor
    from avis_ctrl.identification.response import ResponseModel
    from avis_ctrl.rigs.rig_file import load_rig

    model = ResponseModel.of(load_rig("avis"), ())
    u = 1e-6 * np.random.default_rng(1).standard_normal((200, len(model.actuators)))
    linear, large = (1e6 * np.std(Predictor(model, large_motion).read(u)) for large_motion in (False, True))
    return f"{_near(large, linear, 1e-6)} uV r.m.s."


def _kalman() -> str:
    """A filter that starts with the true parameters and sees a table at rest keeps them; compiles it."""
    from avis_ctrl.identification.ekf import ParameterFilter
    from avis_ctrl.identification.ekf_model import linear_model
    from avis_ctrl.identification.ekf_settings import SOURCE_SETTINGS
    from avis_ctrl.rigs.rig_file import load_rig

    rig = load_rig("avis")
    kalman = ParameterFilter(linear_model(rig, ("mass",)), SOURCE_SETTINGS, np.full(6, 1e-10), 1 / rig.sample_rate_Hz)
    kalman.begin(np.zeros(6))
    kalman.filter(np.zeros((100, 8)), np.zeros((100, 6)), 1)
    return f"mass {_near(float(kalman.theta[0]), rig.parameters()['mass'].value, 1e-9)} kg"


def _gcc() -> str:
    """gcc is needed only to compile the exported C code."""
    path = shutil.which("gcc")
    if path is None:
        return "not installed: exported C code is neither compiled, timed nor replayed"
    done = subprocess.run([path, "-dumpfullversion"], capture_output=True, text=True, check=True, timeout=30)
    return done.stdout.strip()


def _typst() -> str:
    import typst

    pdf = typst.compile(b"$ sum_(k=1)^n k = (n(n+1))/2 $")
    if not pdf.startswith(b"%PDF"):
        raise ArithmeticError("no PDF came out")
    return f"{len(pdf)} bytes"


def _synthesis() -> str:
    """min ||W S|| = |W(z)| for a right-half-plane zero z of the plant (Skogestad and Postlethwaite, section 5.7)."""
    from avis_ctrl.lti import connect, summing_junction, tf
    from avis_ctrl.robust.hinfsyn import hinfsyn

    weight, z = tf([1.0, 2.0], [2.0, 0.02]), 1.0
    parts = [
        tf([-1.0, z], [1.0, 3.0, 2.0], ["u"], ["g"]),
        summing_junction("e", ["w", "-g"]),
        weight.renamed(["e"], ["z"]),
        gain(1e-4, ["u"], ["z_u"]),
    ]
    made = hinfsyn(connect(parts, ["w", "u"], ["z", "z_u", "e"]), 1, 1, backoff=1e-3)
    return _near(made.gamma, abs(weight(z)[0, 0]), 1e-2)
