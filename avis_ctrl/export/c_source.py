"""C99 source of a controller: one struct, `init` and `step`; no heap, no globals, float or double."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.export.protection import Protection
from avis_ctrl.export.sampled_controller import SampledController

HEADER, SOURCE = "avis_controller.h", "avis_controller.c"

_HEADER = """\
{comment}
#ifndef AVIS_CONTROLLER_H
#define AVIS_CONTROLLER_H

#include <stdint.h>

#define AVIS_CONTROLLER_INPUTS {n_y}
#define AVIS_CONTROLLER_OUTPUTS {n_u}
#define AVIS_CONTROLLER_STATES {n_x}

typedef {real} real_t;

typedef struct {{
    real_t x[{room}];  /* states of the linear controller */
    real_t excess[AVIS_CONTROLLER_OUTPUTS]; /* what the limits cut off, passed through a lag */
    real_t gain;    /* 0: drives at zero, 1: the linear controller */
    uint32_t wait;  /* samples of valid inputs to come before the gain rises */
}} avis_controller_t;

/* At rest with the drives at zero; they come in over {start_s:g} s of valid inputs. */
void avis_controller_init(avis_controller_t *c);

/* One sample, every {period_s:g} s: y[AVIS_CONTROLLER_INPUTS] volts of {inputs};
   u[AVIS_CONTROLLER_OUTPUTS] volts of {outputs}. */
void avis_controller_step(avis_controller_t *c, const real_t y[], real_t u[]);

#endif
"""

_SOURCE = """\
{comment}
#include "avis_controller.h"
#include <float.h>

/* The largest finite number. */
#define LARGEST {largest}

enum {{ NX = AVIS_CONTROLLER_STATES, NY = AVIS_CONTROLLER_INPUTS, NU = AVIS_CONTROLLER_OUTPUTS }};

/* x+ = A x + B v, u = C x + D v; row i of A is zero but for columns FROM[i] to TO[i] - 1. */
{constants}
void avis_controller_init(avis_controller_t *c)
{{
    for (int i = 0; i < NX; i++) {{
        c->x[i] = {zero};
    }}
    for (int i = 0; i < NU; i++) {{
        c->excess[i] = {zero};
    }}
    c->gain = {zero};
    c->wait = WAIT;
}}

/* v = y within the converter's range, zero where y is not finite; returns whether all of y was inside it. */
static int read_inputs(const real_t y[], real_t v[])
{{
    int valid = 1;
    for (int i = 0; i < NY; i++) {{
        if (y[i] > -INPUT_LIMIT[i] && y[i] < INPUT_LIMIT[i]) {{
            v[i] = y[i];
        }} else {{
            valid = 0;
            v[i] = {zero};
            if (y[i] >= -LARGEST && y[i] <= LARGEST) {{
                v[i] = y[i] > {zero} ? INPUT_LIMIT[i] : -INPUT_LIMIT[i];
            }}
        }}
    }}
    return valid;
}}

/* The gain rises after enough valid inputs and falls while one is missing. */
static void move_gain(avis_controller_t *c, int valid)
{{
    if (!valid) {{
        c->wait = WAIT;
    }} else if (c->wait > 0u) {{
        c->wait--;
    }}
    if (c->wait > 0u) {{
        c->gain = c->gain > FALL ? c->gain - FALL : {zero};
    }} else {{
        c->gain = c->gain + RISE < {one} ? c->gain + RISE : {one};
    }}
}}

void avis_controller_step(avis_controller_t *c, const real_t y[], real_t u[])
{{
    real_t v[NY], next[{room}];

    move_gain(c, read_inputs(y, v));
    for (int i = 0; i < NU; i++) {{
        real_t sum = {zero};
        for (int j = 0; j < NX; j++) {{
            sum += C[i][j] * c->x[j];
        }}
        for (int j = 0; j < NY; j++) {{
            sum += D[i][j] * v[j];
        }}
        sum = c->gain * (sum - c->excess[i]);
        u[i] = sum > LIMIT[i] ? LIMIT[i] : (sum < -LIMIT[i] ? -LIMIT[i] : sum);
        c->excess[i] = KEEP * c->excess[i] + FEED * (sum - u[i]); /* anti-windup */
    }}
    for (int i = 0; i < NX; i++) {{
        real_t sum = {zero};
        for (int j = FROM[i]; j < TO[i]; j++) {{
            sum += A[i][j] * c->x[j];
        }}
        for (int j = 0; j < NY; j++) {{
            sum += B[i][j] * v[j];
        }}
        next[i] = sum;
    }}
    for (int i = 0; i < NX; i++) {{
        c->x[i] = next[i];
    }}
}}
"""


@dataclass(frozen=True)
class Provenance:
    """Content of the header comment, one entry per line."""

    lines: tuple[str, ...]

    def comment(self) -> str:
        """The lines as a C comment."""
        text = "\n".join(f" * {_harmless(line)}" for line in self.lines)
        return f"/*\n{text}\n */"


def _harmless(line: str) -> str:
    """One line of printable ASCII that cannot end a C comment, whatever a title contains."""
    plain = "".join(one if " " <= one <= "~" else "?" for one in line)
    return plain.replace("*/", "* /").replace("/*", "/ *").replace("??/", "?? /").rstrip("\\")


def c_files(controller: SampledController, guard: Protection, provenance: Provenance) -> dict[str, str]:
    """avis_controller.h and avis_controller.c, by name."""
    K, single = controller.system, controller.arithmetic == "float32"
    n_x, n_y, n_u = K.nstates, K.ninputs, K.noutputs
    first, last = _filled(K.A)
    suffix = "f" if single else ""

    def number(value: float) -> str:
        text = str(np.float32(value)) if single else repr(float(value))
        return (text if re.search(r"[.e]", text) else f"{text}.0") + suffix

    def matrix(name: str, values: np.ndarray) -> str:
        rows = ",\n".join("    {" + ", ".join(map(number, row)) + "}" for row in values)
        return f"static const real_t {name}[{values.shape[0]}][{values.shape[1]}] = {{\n{rows}\n}};\n"

    def vector(name: str, values: np.ndarray) -> str:
        return f"static const real_t {name}[{values.size}] = {{{', '.join(map(number, values))}}};\n"

    def places(name: str, values: np.ndarray) -> str:
        return f"static const int {name}[{values.size}] = {{{', '.join(map(str, values))}}};\n"

    shown = {
        name: values if values.size else np.zeros((1, max(values.shape[1], 1)))
        for name, values in controller.matrices().items()
    }
    shown["C"] = K.C if n_x else np.zeros((n_u, 1))
    most = float(np.finfo(controller.dtype).max)
    constants = "".join(
        [
            *(matrix(name, values) for name, values in shown.items()),
            places("FROM", first if n_x else np.zeros(1, int)),
            places("TO", last if n_x else np.zeros(1, int)),
            vector("LIMIT", controller.limits_V),
            vector("INPUT_LIMIT", np.minimum(guard.input_limit_V, most)),
            f"static const real_t RISE = {number(guard.rise)}, FALL = {number(guard.fall)};\n",
            f"static const real_t KEEP = {number(guard.anti_windup.keep)}, FEED = {number(guard.anti_windup.feed)};\n",
            f"static const uint32_t WAIT = {guard.wait}u;\n",
        ]
    )
    common = {
        "comment": provenance.comment(),
        "n_x": n_x,
        "n_y": n_y,
        "n_u": n_u,
        "room": max(n_x, 1),
        "zero": number(0.0),
        "one": number(1.0),
        "largest": "FLT_MAX" if single else "DBL_MAX",
        "real": "float" if single else "double",
        "period_s": K.dt,
        "start_s": K.dt * guard.wait + K.dt / guard.rise,
        "inputs": _harmless(", ".join(K.inputs)),
        "outputs": _harmless(", ".join(K.outputs)),
    }
    return {HEADER: _HEADER.format(**common), SOURCE: _SOURCE.format(**common, constants=constants)}


def _filled(A: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(n,) first nonzero column of each row, and one past the last."""
    spans = [np.flatnonzero(row) for row in A]
    return (
        np.array([span[0] if span.size else 0 for span in spans], int),
        np.array([span[-1] + 1 if span.size else 0 for span in spans], int),
    )


def constants_of(source: str, dtype: type[np.floating]) -> dict[str, np.ndarray]:
    """Arrays in the text of avis_controller.c by name, as the processor stores them. Raises InputError."""
    found = {}
    for name, shape, body in re.findall(r"static const real_t (\w+)((?:\[\d+\])+) = \{(.*?)\};", source, re.DOTALL):
        sizes = [int(one) for one in re.findall(r"\d+", shape)]
        numbers = [float(one.rstrip("f")) for one in re.findall(r"[-+0-9.][-+0-9.einf]*", body)]
        if len(numbers) != int(np.prod(sizes)):
            raise InputError(f"expected {sizes} numbers", field=name, value=len(numbers))
        found[name] = np.array(numbers).astype(dtype).astype(float).reshape(sizes)
    return found
