"""Draws the figures of a diagnosis."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from bayeskin import report
from bayeskin.mismatch.assess import Diagnosis
from bayeskin.mismatch.context import DiagnosisContext


def draw(
    folder: Path, made_by: str, context: DiagnosisContext, diagnosis: Diagnosis,
    candidates: Sequence[Mapping[str, Any]],
) -> list[Path]:  # fmt: skip
    """Writes the figures into a folder and returns their paths.

    made_by : description of the run, which is stored in the figures' metadata
    candidates : gains of single mechanisms, as the answer lists them
    """
    binned, motion = context.binned, context.motion
    before, after, explanation = diagnosis.before, diagnosis.after, diagnosis.explanation
    split_s = None if explanation.beginning is None else explanation.split_s
    figures = {
        "located": report.figure_located(binned, motion, before.located, before.force_n),
        "candidates": report.figure_candidates(candidates),
        "before_after": report.figure_before_after(binned, motion, before, after, split_s),
        "residual_by_phase": report.figure_residual_by_phase(binned, motion, before.located, after.located),
        "base_parameters": report.figure_base_parameters(
            context.base.parameters, before.values, after.values
        ),
    }
    if diagnosis.contributions:
        figures["contributions"] = report.figure_contributions(binned, motion, diagnosis.contributions)
    if diagnosis.remainder is not None:
        figures["discrepancy"] = report.figure_discrepancy(binned, motion, diagnosis.remainder.discrepancy)
    return [
        path
        for name, figure in figures.items()
        for path in report.save_figure(figure, folder / name, made_by)
    ]
