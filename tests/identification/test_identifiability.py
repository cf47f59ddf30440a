"""Rank, null spaces and sentences, against rational algebra and against responses that must or must not differ."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from avis_ctrl.errors import InputError
from avis_ctrl.identification.identifiability import identifiability_report
from avis_ctrl.identification.information import Information
from avis_ctrl.identification.response import ResponseModel
from avis_ctrl.identification.sparse_space import components, reduced_rows, sparse_rows, whole_numbers
from avis_ctrl.identification.structural_identifiability import structural_null_space
from avis_ctrl.rigs import load_rig

MOUNTS = [f"isolator{i}.{kind}_{axis}" for i in (1, 2, 3, 4) for kind in "kc" for axis in "xyz"]
BODY = ["mass", "J1", "J2", "J3"]
OMEGA = 2 * np.pi * np.geomspace(0.5, 60, 40)


def sets(rig):
    channels = [f"actuator.{m.name}" for m in rig.motors] + [f"sensor.{name}" for name in rig.geophones.names]
    fixed = ("isolator1.k_x", "isolator1.c_x")
    return {26: [n for n in BODY + MOUNTS if n not in fixed], 28: BODY + MOUNTS, 42: BODY + MOUNTS + channels}


def information(model, noise=0.01, omega=OMEGA):
    """Of responses to each actuator with white relative noise."""
    U = np.zeros((len(omega), len(model.inputs), len(model.actuators)), complex)
    U[:, : len(model.actuators)] = np.eye(len(model.actuators))
    found = model.driven(omega, U)
    level = noise * np.sqrt(np.mean(np.abs(found.Y) ** 2, axis=(1, 2)))
    J = np.sqrt(2) * (found.dY / level[:, None, None]).reshape(len(model.names), -1)
    return Information(model.names, model.values, model.units, np.real(J.conj() @ J.T), np.abs(model.values))


# An oracle of its own: K = sum G^T K_i G over the rationals, from the design's equations and not from the package.


def rational_rank(rows):
    rows, rank = [[Fraction(v) for v in row] for row in rows], 0
    for j in range(len(rows[0]) if rows else 0):
        pivot = next((i for i in range(rank, len(rows)) if rows[i][j]), None)
        if pivot is None:
            continue
        rows[rank], rows[pivot] = rows[pivot], rows[rank]
        for i in range(rank + 1, len(rows)):
            if factor := rows[i][j] / rows[rank][j]:
                rows[i] = [a - factor * b for a, b in zip(rows[i], rows[rank], strict=True)]
        rank += 1
    return rank


def point_row(place, axis):
    """Displacement along an axis of a point: row of [I, -S(p)]."""
    x, y, z = place
    return [[1, 0, 0, 0, z, -y], [0, 1, 0, -z, 0, x], [0, 0, 1, y, -x, 0]][axis]


def outer(a, b):
    return [[p * q for q in b] for p in a]


def exact_model(rig):
    """M, C, K (6, 6), T (6, 8), R (6, 6), S (6) and derivatives of M, C, K by name, as fractions."""

    def F(x):
        return Fraction(x).limit_denominator(10**6)

    places = [[F(v) for v in one.position] for one in rig.isolators]
    dM = {
        name: [[Fraction(int(i == j and i in where)) for j in range(6)] for i in range(6)]
        for name, where in (("mass", (0, 1, 2)), ("J1", (3,)), ("J2", (4,)), ("J3", (5,)))
    }
    dD = {
        (f"isolator{i}.{kind}_{axis}", kind): outer(point_row(p, a), point_row(p, a))
        for i, p in enumerate(places, 1)
        for kind in "kc"
        for a, axis in enumerate("xyz")
    }
    columns = {m.name: point_row(places[m.isolator - 1], "xyz".index(m.axis)) for m in rig.motors}
    g = rig.geophones
    R = [point_row(places[i - 1], "xyz".index(a)) for i, a in zip(g.isolator, g.axis, strict=True)]
    return F, dM, dD, columns, R


def exact_rank(rig, names):
    """Rank of the free parameters in the response, over the rationals.

    S R inv(D) T is unchanged to first order exactly where six coordinate forces F (6, 6) exist with dD = F D + D E for
    all s and dT = F T, E = inv(R) dS/S R; unknown F and E's sensor gains are columns of the system. Needs R and T of
    rank six.
    """
    F, dM, dD, columns, R = exact_model(rig)
    values = {name: F(p.value) for name, p in rig.parameters().items()}
    zero = [[Fraction(0)] * 6 for _ in range(6)]

    def total(parts):
        out = [row[:] for row in zero]
        for value, matrix in parts:
            out = [[a + value * b for a, b in zip(x, y, strict=True)] for x, y in zip(out, matrix, strict=True)]
        return out

    matrices = [
        total([(values[n], m) for n, m in dM.items()]),
        *(total([(values[n], m) for (n, kind), m in dD.items() if kind == which]) for which in "ck"),
    ]
    T = [[values[f"actuator.{name}"] * v for v in column] for name, column in columns.items()]  # rows: actuators

    def flat(M, C, K, acts):
        return [v for matrix in (M, C, K) for row in matrix for v in row] + [v for row in acts for v in row]

    none = [[Fraction(0)] * 6 for _ in T]
    own, gauge = [], []
    inverse = invert([[Fraction(v) for v in row] for row in R])
    for name in names:
        if name in dM:
            own.append(flat(dM[name], zero, zero, none))
        elif name.startswith("isolator"):
            kind = name.rpartition(".")[2][0]
            own.append(flat(zero, *((dD[name, kind], zero) if kind == "c" else (zero, dD[name, kind])), none))
        elif name.startswith("actuator"):
            own.append(flat(zero, zero, zero, [c if f"actuator.{a}" == name else [0] * 6 for a, c in columns.items()]))
        else:
            k = rig.geophones.names.index(name.removeprefix("sensor."))
            E = outer([row[k] for row in inverse], R[k])
            # D E moves the response like dS; its parameter is the relative gain.
            own.append(
                flat(
                    *(
                        [[-sum(D[i][m] * E[m][j] for m in range(6)) for j in range(6)] for i in range(6)]
                        for D in matrices
                    ),
                    none,
                )
            )
    for i in range(6):
        for j in range(6):
            moved = [[[D[j][c] if r == i else Fraction(0) for c in range(6)] for r in range(6)] for D in matrices]
            gauge.append(flat(*moved, [[column[j] if r == i else Fraction(0) for r in range(6)] for column in T]))
    return rational_rank(own + gauge) - rational_rank(gauge)


def invert(A):
    n = len(A)
    rows = [row[:] + [Fraction(int(i == j)) for j in range(n)] for i, row in enumerate(A)]
    for j in range(n):
        pivot = next(i for i in range(j, n) if rows[i][j])
        rows[j], rows[pivot] = rows[pivot], rows[j]
        rows[j] = [v / rows[j][j] for v in rows[j]]
        for i in range(n):
            if i != j:
                rows[i] = [a - rows[i][j] * b for a, b in zip(rows[i], rows[j], strict=True)]
    return [row[n:] for row in rows]


@pytest.mark.parametrize(("count", "rank"), [(26, 20), (28, 20), (42, 32)])
def test_ranks_are_those_of_rational_algebra(avis, count, rank):
    names = sets(avis)[count]
    assert len(names) == count and exact_rank(avis, names) == rank
    model = ResponseModel.of(avis, names)
    assert count - structural_null_space(model).shape[1] == rank
    assert information(model).rank == rank


@pytest.mark.parametrize("factor", [1e-6, 0.0])
def test_a_weak_actuator_tells_as_much_as_a_strong_one(avis, factor):
    """The structural rank is that of exact algebra, whatever the size of a response; a broken drive moves nothing."""
    name = f"actuator.{avis.motors[0].name}"
    rig = avis.with_parameters({name: factor * avis.parameters()[name].value})
    null = structural_null_space(ResponseModel.of(rig, sets(rig)[42]))
    assert 42 - null.shape[1] == exact_rank(rig, sets(rig)[42])


def test_eight_stiffness_numbers_not_twelve(avis):
    """The 12 stiffnesses span 8 dimensions of K; those of one horizontal axis two, the vertical ones four."""
    _, _, dD, _, _ = exact_model(avis)

    def rank(axes):
        return rational_rank(
            [
                [Fraction(v) for row in m for v in row]
                for (name, kind), m in dD.items()
                if kind == "k" and name[-1] in axes
            ]
        )

    assert (rank("xyz"), rank("x"), rank("y"), rank("z")) == (8, 2, 2, 4)


@pytest.mark.parametrize("count", [26, 28, 42])
def test_stated_directions_change_nothing_and_others_do(avis, count):
    """Finite moves, not derivatives: sums as they stand, scalings by a factor."""
    model = ResponseModel.of(avis, sets(avis)[count])
    report = identifiability_report(information(model), model)
    still = model.response(OMEGA)[:, :, :8]

    def change(values):
        return np.max(np.abs(model.at(values).response(OMEGA)[:, :, :8] - still)) / np.max(np.abs(still))

    for row in report.unseen:
        step = np.array([row.get(name, 0.0) for name in model.names])
        assert change(model.values + 0.3 * step / np.max(np.abs(step / model.values))) < 1e-9
    for scaling in report.structure.scalings:
        assert change(model.values * 1.3**scaling.exponents) < 1e-9
    for one in report.combinations:
        step = np.array([one.weights.get(name, 0.0) for name in model.names]) * model.values**2
        assert change(model.values + 0.05 * step / np.max(np.abs(step / model.values))) > 1e-5
    unseen = len(report.structure.scalings) + sum(len(group.unseen) for group in report.structure.groups)
    assert unseen == count - report.rank and len(report.combinations) == report.rank


def pins(report):
    """Parameters that the ratios refer to."""
    return {report.information.names[one.pin] for one in report.structure.scalings}


def test_the_28_in_words(avis):
    model = ResponseModel.of(avis, sets(avis)[28])
    for structure in (model, None):
        report = identifiability_report(information(model), structure)
        text = "\n".join(report.sentences)
        for pair, axis in (((1, 2), "x"), ((3, 4), "x"), ((1, 4), "y"), ((2, 3), "y")):
            for kind in "kc":
                one, two = (f"isolator{i}.{kind}_{axis}" for i in pair)
                assert f"{one} and {two} are determined only as their sum" in text
        alone = [*BODY, *(name for name in MOUNTS if name.endswith("_z"))]
        (said,) = (one for one in report.sentences if one.startswith("Determined individually (12)"))
        assert set(said.partition(": ")[2].removesuffix(".").split(", ")) == set(alone)
        group = next(one for one in report.structure.groups if model.names.index("isolator1.k_x") in one.members)
        assert [model.names[j] for j in group.members] == ["isolator1.k_x", "isolator2.k_x"]
    combination = next(one for one in report.combinations if one.words == "isolator1.k_x + isolator2.k_x")
    assert combination.value == 41500 and 0 < combination.standard_deviation < 415


def test_the_42_in_words(avis):
    model = ResponseModel.of(avis, sets(avis)[42])
    report = identifiability_report(information(model), model)
    text = "\n".join(report.sentences)
    assert "only as ratios: a common factor" in text and "sensor sensitivities are determined only as products" in text
    assert "Determined individually" not in text and pins(report) == {"mass", "actuator.Ay1"}
    assert any(one.words == "sensor.Sy1 * actuator.Ay1 / mass" for one in report.combinations)
    assert all(one.determined for one in report.combinations)


def test_the_standard_deviation_of_a_sum_is_that_of_fitting_the_sum(avis):
    """With one spring of each pair held, the other's error is the sum's: a regular matrix, inverted by itself."""
    model = ResponseModel.of(avis, sets(avis)[28])
    info = information(model)
    held = [
        "isolator2.k_x",
        "isolator4.k_x",
        "isolator4.k_y",
        "isolator3.k_y",
        "isolator2.c_x",
        "isolator4.c_x",
        "isolator4.c_y",
        "isolator3.c_y",
    ]
    free = [j for j, name in enumerate(info.names) if name not in held]
    sigma = np.sqrt(np.diag(np.linalg.inv(info.relative[np.ix_(free, free)]))) * info.scale[free]
    report = identifiability_report(info, model)
    for one in report.combinations:
        k = next(free.index(j) for j, name in enumerate(info.names) if name in one.weights and j in free)
        assert one.standard_deviation == pytest.approx(sigma[k], rel=1e-5)


def test_priors_determine_what_data_do_not_and_the_report_says_so(avis):
    model = ResponseModel.of(avis, sets(avis)[28])
    data = information(model)
    priors = {name: 0.2 * value for name, value in zip(model.names, model.values, strict=True)}
    both = data.with_priors(priors)
    report = identifiability_report(both, model, priors=priors)
    assert report.rank == 28 and not report.unseen
    assert "8 of the combinations are determined by the priors" in report.sentences[-1]
    assert sum("is determined only to" in sentence for sentence in report.sentences) >= 8
    # Two like priors and an exact sum: each is left with 1/sqrt(2) of its prior.
    k = model.names.index("isolator1.k_x")
    a, b = 20e3, 21.5e3
    assert both.standard_deviation[k] == pytest.approx(0.2 * a * b / np.hypot(a, b), rel=1e-3)
    one = identifiability_report(data.with_priors({"isolator1.k_x": 100.0}), model)
    assert one.rank == 21 and len(one.unseen) == 7


def test_halcyonics(avis):
    rig = load_rig("halcyonics")
    names = [n for n in rig.parameters() if n != "k_s" and not n.startswith("L")]
    model = ResponseModel.of(rig, names)
    report = identifiability_report(information(model, omega=2 * np.pi * np.geomspace(2, 60, 40)), model)
    text = "\n".join(report.sentences)
    assert report.rank == len(names) - 3 and pins(report) == {"mass"}
    assert "M2_arm has no influence on the responses" in text and "only as ratios" in text


def test_a_mount_pattern_without_symmetry_leaves_three_numbers_of_four(avis):
    """Attachments at one height but at no rectangle: sum k, sum y k and, where |y| differs, sum y^2 k; no pairs."""
    rig = avis.with_parameters({"isolator1.p_y": -0.31, "isolator3.p_y": 0.29})
    names = [f"isolator{i}.k_x" for i in (1, 2, 3, 4)]
    model = ResponseModel.of(rig, names)
    report = identifiability_report(information(model), model)
    structure = report.structure
    assert len(structure.groups) == 1 and len(report.unseen) == 1
    assert report.combinations and len(report.combinations) == 3
    y = np.array([one.position[1] for one in rig.isolators])
    v = np.array([report.unseen[0].get(name, 0.0) for name in names])
    for weights in (np.ones(4), y, y**2):
        assert abs(v @ weights) < 1e-9 * np.abs(v) @ np.abs(weights)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.integers(0, 10**6), st.integers(3, 12), st.integers(1, 4))
def test_whole_number_directions_are_found_again(seed, n, d):
    """Random information with a null space of whole numbers on parts that share no parameter."""
    rng = np.random.default_rng(seed)
    parts = np.array_split(rng.permutation(n), min(d, n // 2))
    N = np.zeros((len(parts), n))
    for row, part in zip(N, parts, strict=True):
        chosen = part[: max(2, len(part) - 1)]
        row[chosen] = rng.choice([-3, -2, -1, 1, 2, 3], len(chosen))
    scale = 10 ** rng.uniform(3, 4.3, n)
    Q = np.linalg.svd(N * (1 / scale))[2][len(N) :]
    F = Q.T @ np.diag(10 ** rng.uniform(2, 6, len(Q))) @ Q / np.outer(scale, scale)
    names = tuple(f"p{j}" for j in range(n))
    report = identifiability_report(Information(names, scale, ("m",) * n, F, scale))
    assert report.rank == n - len(N)
    found = {tuple(sorted(row.items())) for row in report.unseen}
    wanted = set()
    for row in N:
        whole = row / np.gcd.reduce(row.astype(int))
        whole *= np.sign(whole[np.flatnonzero(whole)[0]])
        wanted.add(tuple(sorted((names[j], float(whole[j])) for j in np.flatnonzero(row))))
    assert found == wanted


@settings(max_examples=40, deadline=None, derandomize=True)
@given(st.integers(0, 10**6))
def test_sparse_rows_span_what_they_were_given(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 9))
    basis = rng.integers(-2, 3, (n, int(rng.integers(1, n)))).astype(float)
    rank = np.linalg.matrix_rank(basis)
    rows = sparse_rows(np.linalg.svd(basis)[0][:, :rank]) if rank else np.zeros((0, n))
    assert np.linalg.matrix_rank(np.vstack([rows, basis.T])) == len(rows) == rank
    covered = [j for _, columns in components(rows) for j in columns]
    assert len(covered) == len(set(covered))
    assert np.count_nonzero(rows) <= np.count_nonzero(reduced_rows(np.linalg.svd(basis)[0][:, :rank]))


def test_whole_numbers():
    assert whole_numbers(np.array([0.5, -0.75, 0.0])).tolist() == [2, -3, 0]
    assert whole_numbers(np.array([-np.pi, 1.0])).tolist() == pytest.approx([1.0, -1 / np.pi])


def test_round_off_is_no_information():
    """However precise the rest, a direction without information stays without."""
    for power in (6, 12, 20, 26):
        J = 10.0 ** (power / 2) * np.random.default_rng(power).normal(size=(50, 5))
        J[:, 4] = J[:, 3]
        info = Information(tuple("abcde"), np.ones(5), ("m",) * 5, J.T @ J, np.ones(5))
        assert info.rank == 4 and np.isinf(info.of([0, 0, 0, 1, -1])[1]) and np.isfinite(info.of([0, 0, 0, 1, 1])[1])


def test_a_small_share_in_a_weak_direction_counts():
    """Known to 0.9 relative along (0.05, 1): the first parameter is not as sure as its own direction."""
    v, w = np.array([0.05, 1.0]), np.array([1.0, -0.05])
    v, w = v / np.linalg.norm(v), w / np.linalg.norm(w)
    for sigma in (0.9, 1.5, 15.0):
        F = 1e8 * np.outer(w, w) + np.outer(v, v) / sigma**2
        info = Information(("a", "b"), np.ones(2), ("m", "m"), F, np.ones(2))
        exact = np.sqrt(np.linalg.inv(F)[0, 0])
        assert info.standard_deviation[0] == pytest.approx(exact, rel=1e-6)
        assert exact > 100e-4


@pytest.mark.parametrize("sigma", [0.9, 0.01])
def test_the_worst_known_direction_is_said_where_it_is_weak(sigma):
    """a known to 1e-4, b to sigma."""
    info = Information(("a", "b"), np.ones(2), ("m", "m"), np.diag([1e8, sigma**-2]), np.ones(2))
    said = [one for one in identifiability_report(info).sentences if "least precise combination" in one]
    assert [("changing b by +90 %" in one, " a by" in one) for one in said] == ([(True, False)] if sigma == 0.9 else [])


def test_wrong_calls_are_answered(avis):
    info = Information(("a", "b"), np.ones(2), ("m", "m"), np.eye(2), np.ones(2))
    with pytest.raises(InputError, match="free parameters a, b"):
        identifiability_report(info, ResponseModel.of(avis, ["mass"]))
    with pytest.raises(InputError, match="weights"):
        info.of([1.0])
    for sigma in (0.0, -1.0, np.inf):
        with pytest.raises(InputError, match="prior of a"):
            info.with_priors({"a": sigma})
    with pytest.raises(InputError, match="positive sizes"):
        Information(("a",), np.ones(1), ("m",), np.eye(1), np.zeros(1))


def test_nothing_measured_is_said(avis):
    info = Information(("a", "b"), np.ones(2), ("m", "m"), np.zeros((2, 2)), np.ones(2))
    report = identifiability_report(info)
    assert report.rank == 0 and "none of the combinations" in report.sentences[0]
