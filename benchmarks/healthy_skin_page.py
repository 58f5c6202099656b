"""Writes the diagnosis of the article's recording as tables and figures of docs/mismatch-scoreboard.md.

    bayeskin import Healthy_skin.xlsx -o runs/healthy-skin.h5
    cp Mesh_SKIN.msh runs/
    python benchmarks/healthy_skin_page.py

The first two commands take their files from the article's supplement. The program diagnoses the recording by
both observations of the force, and skips what is finished already. It writes the tables between the markers
of the page, and copies the figures in 256 colours.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import rows
from demo_gallery import FIGURES, ROOT, called, smaller

from bayeskin.types import PHASE_KINDS

PAGE = ROOT / "docs" / "mismatch-scoreboard.md"
WHOLE_MN, HELD_OUT_MN = "9 mN", "18 mN"  # the aims of this project on this recording
RUNS = {
    "healthy-skin": ("located", "before_after", "candidates"),
    "healthy-skin-article": ("before_after", "contributions"),
}


def fits(answer: Mapping[str, Any]) -> str:
    """Returns a table of the errors before and after the diagnosis, and of a run of the full model."""
    fit_pair, full = [answer["fit"][when] for when in ("before", "after")], answer["full_model"]
    table = [
        ["RMSE over the whole recording", *_mn(fit_pair, "rmse"), WHOLE_MN],
        [f"RMSE by phase: {' / '.join(PHASE_KINDS)}", *(_by_phase(fit) for fit in fit_pair), ""],
        ["RMSE after the second hold, of a fit up to its end", *_mn(fit_pair, "rmse_held_out"),
         HELD_OUT_MN],
        ["full model at the best values, RMSE", "",
         full["message"] if "message" in full else f"{1e3 * full['rmse']:.1f} mN", ""],
        ["recorded bins inside the 90 % band", *(f"{100 * fit['coverage90']:.0f} %" for fit in fit_pair), ""],
        ["windows in which recording and model differ",
         *(str(len(answer[where])) for where in ("located", "remaining")), ""],
    ]  # fmt: skip
    return rows.markdown(("", "base model", "with the best set", "aim"), table)


def named(answer: Mapping[str, Any]) -> str:
    """Returns the verdict in sentences, and a table of named mechanisms, the largest contribution first."""
    best_set = ", ".join(answer["best_set"]) or "none"
    verdict = (
        f"The verdict is `{answer['verdict']}`. Best set: {best_set}, which explains "
        f"{100 * answer['explained']:.1f} % of the squared residual; R-hat of its draws {_rhat(answer)}. "
        "The probability of an unnamed smooth discrepancy is "
        f"{answer['smooth_probability']:.2f}. Time: {answer['seconds'] / 60.0:.0f} minutes."
    )
    table = [
        [
            mechanism["name"],
            f"{mechanism['probability']:.2f}",
            *_mn([mechanism], "contribution_n"),
            mechanism["statement"],
        ]
        for mechanism in sorted(
            answer["mechanisms"], key=lambda mechanism: -(mechanism["contribution_n"] or 0.0)
        )
    ]
    if not table:
        return verdict
    return verdict + "\n\n" + rows.markdown(("named", "probability", "contribution, RMS", "as fitted"), table)


def _rhat(answer: Mapping[str, Any]) -> str:
    """Returns R-hat of the draws as text, and whether they have settled."""
    sampled = answer["fit"]["after"]["sampled"]
    return f"{sampled['rhat']:.2f} ({'settled' if sampled['settled'] else 'not settled'})"


def _mn(some: list[Mapping[str, Any]], what: str) -> list[str]:
    """Returns one value of each entry in mN as text."""
    return ["not available" if entry[what] is None else f"{1e3 * entry[what]:.1f} mN" for entry in some]


def _by_phase(fit: Mapping[str, Any]) -> str:
    """Returns the RMSE of each kind of phase in mN as text."""
    return " / ".join(f"{1e3 * fit['rmse_by_phase'][kind]:.0f}" for kind in PHASE_KINDS) + " mN"


def main() -> None:
    for run, figures in RUNS.items():
        called("diagnose", f"runs/{run}.toml")
        folder = ROOT / "runs" / run / "diagnose"
        answer = json.loads((folder / "diagnosis.json").read_text())
        block = f"{fits(answer)}\n\n{named(answer)}"
        rows.into_docs(PAGE, run, block)
        print(block)
        for name in figures:
            smaller(folder / f"{name}.png", FIGURES / f"{run}-{name.replace('_', '-')}.png")


if __name__ == "__main__":
    main()
