"""What a diagnosis says of the article's recording, as tables and figures of docs/mismatch.md.

    bayeskin import Healthy_skin.xlsx -o runs/healthy-skin.h5
    cp Mesh_SKIN.msh runs/
    python benchmarks/healthy_skin_page.py

The first two take their files from the article's supplement. Diagnoses the recording by both observations,
where what is done is skipped, writes between the markers of the page and copies the figures, in 256 colours.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import rows
from demo_gallery import FIGURES, ROOT, called, smaller

PAGE = ROOT / "docs" / "mismatch.md"
WHOLE_MN, HELD_OUT_MN = "12 mN", "18 mN"  # this project's aims on this recording
KINDS = ("rest", "load", "hold", "unload")
RUNS = {
    "healthy-skin": ("located", "before_after", "candidates"),
    "healthy-skin-article": ("before_after", "contributions"),
}


def fits(answer: Mapping[str, Any]) -> str:
    """Errors before and after, and that of a full run at the best values."""
    both, full = [answer["fit"][when] for when in ("before", "after")], answer["full_model"]
    table = [
        ["RMSE over the whole recording", *_mn(both, "rmse"), WHOLE_MN],
        [f"its {' / '.join(KINDS)}", *(_by_phase(one) for one in both), ""],
        ["fitted up to the end of the second hold, RMSE on what follows", *_mn(both, "rmse_held_out"),
         HELD_OUT_MN],
        ["a run of the full model at the best values, RMSE", "",
         full["message"] if "message" in full else f"{1e3 * full['rmse']:.1f} mN", ""],
        ["recorded bins in the 90 % band", *(f"{100 * one['coverage90']:.0f} %" for one in both), ""],
        ["windows in which they differ",
         *(str(len(answer[where])) for where in ("located", "remaining")), ""],
    ]  # fmt: skip
    return rows.markdown(("", "base model", "with what was found", "to reach"), table)


def named(answer: Mapping[str, Any]) -> str:
    """The verdict, and what was named, the largest contribution first."""
    best = ", ".join(answer["best_set"]) or "none"
    verdict = (
        f"The verdict is `{answer['verdict']}`. Best set: {best}, which explains "
        f"{100 * answer['explained']:.1f} % of the squared residual; R-hat of its draws {_rhat(answer)}. "
        "Something smooth that is not in the catalogue: "
        f"probability {answer['smooth_probability']:.2f}. {answer['seconds'] / 60.0:.0f} minutes."
    )
    table = [
        [one["name"], f"{one['probability']:.2f}", *_mn([one], "contribution_n"), one["statement"]]
        for one in sorted(answer["mechanisms"], key=lambda one: -(one["contribution_n"] or 0.0))
    ]
    if not table:
        return verdict
    return verdict + "\n\n" + rows.markdown(("named", "probability", "contributes, RMS", "as fitted"), table)


def _rhat(answer: Mapping[str, Any]) -> str:
    sampled = answer["fit"]["after"]["sampled"]
    return f"{sampled['rhat']:.2f} ({'settled' if sampled['settled'] else 'not settled'})"


def _mn(some: list[Mapping[str, Any]], what: str) -> list[str]:
    return ["none" if one[what] is None else f"{1e3 * one[what]:.1f} mN" for one in some]


def _by_phase(one: Mapping[str, Any]) -> str:
    return " / ".join(f"{1e3 * one['rmse_by_phase'][kind]:.0f}" for kind in KINDS) + " mN"


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
