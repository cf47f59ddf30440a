"""What the gates say of the records: what warns first, what is well in small."""

from __future__ import annotations

from collections.abc import Sequence

from avis_ctrl.measurement.gates.finding import SEVERITIES, Finding, Picture
from avis_ctrl.report.identification.gate_figures import figure_of
from avis_ctrl.report.pieces import Cell, Fold, Mark, Paragraph, Piece, Section, table
from avis_ctrl.study.identification import Identification

MARKS: dict[str, Cell] = {"ok": Mark("ok", True), "note": "note", "warning": Mark("WARNING", False),
                          "stop": Mark("STOP", False)}
TOGETHER = 6


def gates(found: Identification) -> Section:
    """Table of all findings, and their pictures."""
    return gates_of(found.findings)


def gates_of(findings: Sequence[Finding]) -> Section:
    """The same of findings by themselves."""
    if not findings:
        return Section("Gates", "gates", (Paragraph("The gates (automatic checks of the data) need records in the time "
                                                    "domain; there were none."),))
    ordered = sorted(findings, key=lambda f: -SEVERITIES.index(f.severity))
    together = _together(ordered)
    rows = [(gate, MARKS[severity], text) for gate, severity, text in together]
    listed = [severity for _, severity, _ in together]
    counts = ", ".join(f"{n} {s}{'s' * (n > 1 and s != 'ok')}" for s in reversed(SEVERITIES) if (n := listed.count(s)))
    pieces: list[Piece] = [
        table(f"The gates: automatic checks of the data before any fit, the most serious findings first ({counts}). A "
              "note is for information, a warning means less accurate results, a stop means wrong results.",
              ("gate", "severity", "finding"), rows, "lcl")]
    grave = [f for f in ordered if f.severity in ("warning", "stop")]
    for k, (picture, sentences) in enumerate(_pictures(grave)):
        pieces.append(figure_of(f"gate_{k}", " ".join(sentences), [picture]))
    notes = [p for p, _ in _pictures([f for f in ordered if f.severity == "note"])]
    pieces += _small("gate_notes", "Gates with a note; limits dashed.", notes)
    well = [p for p, _ in _pictures([f for f in ordered if f.severity == "ok"])]
    small = _small("gate_ok", "Gates without findings; limits dashed.", well)
    if small:
        pieces.append(Fold(f"The {len(well)} figures of gates without findings", tuple(small)))
    return Section("Gates", "gates", tuple(pieces))


def _together(findings: Sequence[Finding]) -> list[tuple[str, str, str]]:
    """(gate, severity, text): what differs by channel only in its first sentence shares the rest."""
    grouped: dict[tuple[str, str, str], list[str]] = {}
    for f in findings:
        first, _, rest = f.sentence.partition(". ")
        grouped.setdefault((f.gate, f.severity, rest), []).append(first.rstrip("."))
    return [(gate, severity, f"{'; '.join(firsts)}. {rest}".rstrip()) for (gate, severity, rest), firsts
            in grouped.items()]


def _pictures(findings: list[Finding]) -> list[tuple[Picture, list[str]]]:
    """Each picture once, with the sentences that it belongs to; those without data are left out."""
    seen: dict[tuple, tuple[Picture, list[str]]] = {}
    for finding in findings:
        p = finding.picture
        if p is None or not any(len(s.x) for s in p.series):
            continue
        key = (p.title, p.y_label, tuple((s.name, s.x.tobytes(), s.y.tobytes()) for s in p.series))
        seen.setdefault(key, (p, []))[1].append(finding.sentence)
    return list(seen.values())


def _small(name: str, caption: str, pictures: list[Picture]) -> list[Piece]:
    # Those with a curve for each channel share a legend; among others it would name what they do not have.
    many = [p for p in pictures if len(p.series) > 2]
    few = [p for p in pictures if len(p.series) <= 2]
    groups = [of[k:k + TOGETHER] for of in (many, few) for k in range(0, len(of), TOGETHER)]
    return [figure_of(f"{name}_{k}", caption + (f" Part {k + 1} of {len(groups)}." if len(groups) > 1 else ""), group,
                      2, 0.75) for k, group in enumerate(groups)]
