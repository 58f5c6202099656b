"""Writes the answer of `bayeskin diagnose` as text."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from bayeskin.report.conclusion import conclusion_of
from bayeskin.report.words import agreement_in_words, full_run_in_words, informed_in_words, markers_in_words


def in_words(answer: Mapping[str, Any]) -> str:
    """Returns the answer as text, which ends with the sentences of its conclusion and with the page."""
    lines = [f"verdict: {answer['verdict']}"]
    lines += [f"  {mechanism['name']} (probability {mechanism['probability']:.2f}): {mechanism['statement']}"
              for mechanism in answer["mechanisms"]]  # fmt: skip
    lines.append(f"  nothing is missing: probability {answer['nothing_probability']:.2f}")
    lines.append(f"  an unnamed smooth discrepancy: probability {answer['smooth_probability']:.2f}")
    windows = len(answer["located"])
    lines.append(
        f"The model deviates from the recording in {windows} window{'s' * (windows != 1)}, "
        f"and in {len(answer['remaining'])} with {', '.join(answer['best_set']) or 'no mechanism'}."
    )
    for recording in answer["recordings"]:
        lines += [agreement_in_words(recording), informed_in_words(recording)]
    if "on_skin" in answer["fit"]["after"]:
        lines += markers_in_words(answer["fit"]["after"]["on_skin"])
    lines.append(full_run_in_words(answer["full_model"]))
    after = answer["fit"]["after"]
    if not (after["emulator"]["settled"] and after["sampled"]["settled"]):
        lines.append("The intervals are approximate, because their runs or draws have not converged.")
    best = ", ".join(
        f"{candidate['name']} {candidate['delta_score']:+.1f}" for candidate in answer["candidates"][:5]
    )
    if best:
        lines.append(f"gain of log-evidence by single mechanisms: {best}")
    conclusion = conclusion_of(answer)
    lines += [f"outputs in {answer['folder']}", f"{conclusion.verdict}.", *conclusion.sentences]
    return "\n".join([*lines, f"report: {answer['page']}"])
