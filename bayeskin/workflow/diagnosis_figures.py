"""Draws the figures of a diagnosis."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from bayeskin import report
from bayeskin.mismatch.assess import Diagnosis
from bayeskin.mismatch.context import DiagnosisContext
from bayeskin.types.joint import figure_name
from bayeskin.workflow.diagnosis_forces import in_recording


def _of_recording(
    context: DiagnosisContext, diagnosis: Diagnosis, number: int
) -> Iterator[tuple[str, Figure]]:
    """Yields the names and the figures of one of several recordings, or of a single one."""
    whole, explanation = context.binned, diagnosis.explanation
    bins, binned, motion = whole.slices[number], whole.parts[number], context.motion.parts[number]
    before, after = (in_recording(fit, whole, number) for fit in (diagnosis.before, diagnosis.after))
    split_s = None if explanation.beginning is None else explanation.split_s
    if split_s is not None and whole.spans:
        span = whole.spans[number]
        split_s = split_s - span.start_s if span.start_s <= split_s < span.end_s else None
    yield "located", report.figure_located(binned, motion, before.located, before.force_n)
    yield "before_after", report.figure_before_after(binned, motion, before, after, split_s)
    yield (
        "residual_by_phase",
        report.figure_residual_by_phase(binned, motion, before.located, after.located),
    )
    if diagnosis.contributions:
        parts = [replace(part, force_n=part.force_n[bins]) for part in diagnosis.contributions]
        yield "contributions", report.figure_contributions(binned, motion, parts)


def draw(
    folder: Path, made_by: str, context: DiagnosisContext, diagnosis: Diagnosis,
    candidates: Sequence[Mapping[str, Any]],
) -> list[Path]:  # fmt: skip
    """Writes the figures into a folder and returns their paths.

    made_by : description of the run, which is stored in the figures' metadata
    candidates : gains of single mechanisms, as the answer lists them
    """
    binned, motion = context.binned, context.motion
    figures = {
        "candidates": report.figure_candidates(candidates),
        "base_parameters": report.figure_base_parameters(
            context.base.parameters, diagnosis.before.values, diagnosis.after.values
        ),
    }
    for number in range(len(binned.parts)):
        of_recording = _of_recording(context, diagnosis, number)
        figures |= {figure_name(name, number): figure for name, figure in of_recording}
    for name, fit in (("on_skin_before", diagnosis.before), ("on_skin_after", diagnosis.after)):
        if fit.on_skin is not None:
            figures[name] = report.figure_on_skin(fit.on_skin, context.forward.spec.geometry)
    if diagnosis.remainder is not None:
        figures["discrepancy"] = report.figure_discrepancy(binned, motion, diagnosis.remainder.discrepancy)
    return [
        path
        for name, figure in figures.items()
        for path in report.save_figure(figure, folder / name, made_by)
    ]
