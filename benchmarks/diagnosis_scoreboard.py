"""Diagnoses recordings with known keys by the reduced model, and compares with the stored verdicts.

    OMP_NUM_THREADS=1 python benchmarks/diagnosis_scoreboard.py --folder F [development/009 ...]

The verdicts stored beside these recordings are by a former version, which learnt the effects of mechanisms
separately. In the present version the reduced model solves all mechanisms of a set together. Verdict and
values of each recording are kept in `benchmarks/results/diagnosis_scoreboard.jsonl`, with the commit of the
sources, so that a second start continues from there. The verdicts are derived from the stored log-evidences
by the present rule. Some effects were outside the catalogue when a set was made, and have joined it since.
Here they count as mechanisms of the catalogue; for the stored verdicts they count as outside.

The program prints a row for each recording. It has what is concealed and its size (in noise floors), what is
named, the probability that nothing is missing, and how many of the skin's and the effect's parameters lie in
their 90 % intervals. It also has the RMS residuals before and after, the error of the reduced model at the
end, the seconds (those of the last start where a diagnosis was interrupted), and the commit. Then the program
prints both scoreboards of the same recordings, and the scores that other thresholds of the verdict would give
from the stored log-evidences.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import rows
from scipy.stats import binomtest

from bayeskin.mechanisms import catalogue
from bayeskin.mismatch import hypotheses
from bayeskin.mismatch.hypotheses import VerdictSettings
from bayeskin.proof import score
from bayeskin.workflow.diagnosing import diagnose

DATA = Path(__file__).parent.parent / "data"
KEPT = Path(__file__).parent / "results" / "diagnosis_scoreboard.jsonl"
NOW_KNOWN = {
    "bent-cell": "cell-nonlinearity", "breathing": "periodic-motion", "slow-amplifier": "amplifier-lag",
    "poisson-cutis": "skeleton-compressibility", "poisson-subcutis-high": "skeleton-compressibility",
    "poisson-subcutis-low": "skeleton-compressibility",
    "plastic-set": "plastic-set",  # concealed in the displacement; in the catalogue it acts on tissue
}  # fmt: skip
CONFIG = """name = "{name}"
[recording]
file = "{name}.h5"
[design]
workers = {workers}
"""
HEADER = (
    "recording", "concealed", "size [noise floors]", "named (probability)",
    "probability that nothing is missing", "base parameters inside", "effect's parameters inside",
    "RMS residual, before to after [mN]", "error of the reduced model [mN]", "seconds", "commit",
)  # fmt: skip
SHARES = {
    "false alarms": ("false_alarms",),
    "clear effects named": ("named", "clear"),
    "clear effects named, up to look-alikes": ("named_up_to_look_alikes", "clear"),
    "smaller effects named, up to look-alikes": ("named_up_to_look_alikes", "below"),
    "named mechanisms that were concealed": ("named_mechanisms_there",),
    "`unknown` for clear effects outside the catalogue": ("unknown_outside", "clear"),
    "clear effects' parameters in 90 % intervals": ("effect_in_interval", "clear"),
    "base parameters beside a clear effect in 90 % intervals": ("base_in_interval", "clear"),
    "base parameters where nothing is concealed": ("base_in_interval_nothing",),
}
RULES = {
    "rule in use": VerdictSettings(),
    "log-evidences without an error": VerdictSettings(evidence_sd=0.0),
    "log-evidences with an error of 2 nats": VerdictSettings(evidence_sd=2.0),
    "log-evidences with an error of 4 nats": VerdictSettings(evidence_sd=4.0),
    "log-evidences with an error of 6 nats": VerdictSettings(evidence_sd=6.0),
    "no condition on the explained share": VerdictSettings(most_of_it=0.0),
    "explained share of at least 0.8": VerdictSettings(most_of_it=0.8),
    "explained share of at least 0.95": VerdictSettings(most_of_it=0.95),
    "named from a probability of 0.8": VerdictSettings(probable=0.8),
    "named from a probability of 0.95": VerdictSettings(probable=0.95),
    "prior probability of 0.01": VerdictSettings(prior=0.01),
    "prior probability of 0.2": VerdictSettings(prior=0.2),
}  # the priors are those of each mechanism and of the unnamed smooth discrepancy
WEIGHED = (
    "false alarms", "clear effects named, up to look-alikes", "smaller effects named, up to look-alikes",
    "named mechanisms that were concealed", "`unknown` for clear effects outside the catalogue",
)  # fmt: skip


def answered(case: str, folder: Path, workers: int) -> dict[str, Any]:
    """Returns the answer for one recording, such as "development/009": the stored one, if any."""
    set_name, number = case.split("/")
    name = f"{set_name}-{number}"
    if case in (answers := kept()):
        return answers[case]
    config = folder / f"{name}.toml"
    if not config.exists():
        shutil.copy(DATA / set_name / "recordings" / f"{number}.h5", folder / f"{name}.h5")
        config.write_text(CONFIG.format(name=name, workers=workers))
    answer = {"case": case, "commit": commit(), **essential(diagnose([config], rows.Log()))}
    with open(KEPT, "a", encoding="utf-8") as handle:  # two processes may append; each writes whole lines
        handle.write(json.dumps(answer) + "\n")
    return answer


def kept() -> dict[str, dict[str, Any]]:
    """Returns the stored answers by recording; where there are several, the last one."""
    if not KEPT.exists():
        return {}
    answers = [json.loads(line) for line in KEPT.read_text(encoding="utf-8").splitlines()]
    return {answer["case"]: answer for answer in answers}


def commit() -> str:
    """Returns the commit of the sources that diagnose."""
    command = ["git", "-C", str(DATA), "rev-parse", "--short", "HEAD"]
    return subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()


def essential(said: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the parts of an answer that the scores and the table need."""
    if "fit" not in said:
        return {"message": said["message"]}
    fits = {
        when: {
            "rmse": fit["rmse"], "rmse_held_out": fit["rmse_held_out"],
            "theta": {name: {key: estimate[key] for key in ("mean", "interval90")}
                      for name, estimate in fit["theta"].items()},
        }
        for when, fit in said["fit"].items()
    }  # fmt: skip
    copied_keys = ("verdict", "nothing_probability", "smooth_probability", "explained", "mechanisms", "sets",
            "best_set", "full_model", "seconds")  # fmt: skip
    located = [{"t0": window["t0"], "t1": window["t1"]} for window in said["located"]]
    return {**{name: said[name] for name in copied_keys}, "located": located, "fit": fits}


def key_of(case: str, known: bool = False) -> dict[str, Any]:
    """Returns the key of a recording, which says what is concealed.

    known : True to count an effect that has joined the catalogue since as its mechanism
    """
    set_name, number = case.split("/")
    key = dict(json.loads((DATA / set_name / "seals" / f"{number}.json").read_text()))
    if known and (name := NOW_KNOWN.get(key["label"])):
        key |= {"kind": "alone", "label": name, "mechanisms": [name], "sizes": {name: key["size_n"]}}
    return key


def stored(case: str) -> dict[str, Any]:
    """Returns the stored verdict beside a recording."""
    set_name, number = case.split("/")
    return dict(json.loads((DATA / set_name / "verdicts" / f"{number}.json").read_text())["answer"])


def row(case: str, said: Mapping[str, Any]) -> list[str]:
    """Returns the table's row of one recording."""
    key = key_of(case)
    if "fit" not in said:
        return [
            case,
            key["label"],
            f"{key['size']:.1f}",
            f"failed: {said['message']}",
            *[""] * 6,
            said["commit"],
        ]
    values, fit, full = said["fit"]["after"]["theta"], said["fit"], said["full_model"]
    named = [f"{mechanism['name']} ({mechanism['probability']:.2f})" for mechanism in said["mechanisms"]]
    return [
        case, key["label"], f"{key['size']:.1f}",
        ", ".join(named) or said["verdict"],
        f"{said['nothing_probability']:.2f}", _inside(key["theta"], values), _inside(key["values"], values),
        f"{1e3 * fit['before']['rmse']:.1f} to {1e3 * fit['after']['rmse']:.1f}",
        full.get("message") or f"{1e3 * full['fit_off_by']:.2f}", f"{said['seconds']:.0f}",
        said["commit"],
    ]  # fmt: skip


def _inside(truth: Mapping[str, float], values: Mapping[str, Any]) -> str:
    """Returns how many true values of the fitted parameters lie in their 90 % intervals, as text."""
    fitted = {name: value for name, value in truth.items() if name in values and name != "p_init"}
    intervals = {name: values[name]["interval90"] for name in fitted}
    return f"{sum(intervals[n][0] <= v <= intervals[n][1] for n, v in fitted.items())} of {len(fitted)}"


def scoreboard(said: Mapping[str, Mapping[str, Any]]) -> str:
    """Returns both scoreboards of the recordings side by side; seconds are those of the present version."""
    keys, keys_now = {case: key_of(case) for case in said}, {case: key_of(case, known=True) for case in said}
    judged = {case: answer if "verdict" in answer else {"verdict": "failed"} for case, answer in said.items()}
    boards = score(keys, {case: stored(case) for case in said}), score(keys_now, judged)
    table = [[label, *(_share(board, path) for board in boards)] for label, path in SHARES.items()]
    seconds = [answer["seconds"] for answer in said.values() if "seconds" in answer]
    if seconds:
        table.append(
            ["seconds, median and 95 %", "", "{:.0f}, {:.0f}".format(*np.quantile(seconds, (0.5, 0.95)))]
        )
    header = [f"{len(said)} recordings", "former version", "present version"]
    return rows.markdown(header, table)


def ablation(said: Mapping[str, Mapping[str, Any]]) -> str:
    """Returns the scores that other thresholds of `bayeskin.mismatch.hypotheses` would give.

    The log-evidences stay the same.
    """
    keys = {case: key_of(case, known=True) for case in said}
    judged = {case: answer for case, answer in said.items() if "verdict" in answer}
    table = []
    for label, settings in RULES.items():
        board = score(keys, {case: by_present_rule(answer, settings) for case, answer in judged.items()})
        table.append([label, *(_share(board, SHARES[name]).split(" (")[0] for name in WEIGHED)])
    return rows.markdown((f"{len(judged)} recordings", *WEIGHED), table)


def coverage(answers: Mapping[str, Mapping[str, Any]]) -> str:
    """Returns a table of the parameters' true values in their 90 % intervals, where the set named is right.

    A recording whose effect is outside of the catalogue has no right set.
    """
    counts: dict[str, list[int]] = {}
    for case, said in answers.items():
        key = key_of(case, known=True)
        named = {mechanism["name"] for mechanism in said.get("mechanisms", [])}
        if "fit" not in said or key["kind"] == "outside" or named != set(key["mechanisms"]):
            continue
        values = said["fit"]["after"]["theta"]
        for name, truth in (key["theta"] | key["values"]).items():
            if name in values and name != "p_init":
                low, high = values[name]["interval90"]
                of_what = name if name in key["theta"] else "parameters of mechanisms"
                count = counts.setdefault(of_what, [0, 0, 0])
                count[0 if truth < low else 2 if truth > high else 1] += 1
    table = [
        [name, f"{inside} of {below + inside + above} ({share(inside, below + inside + above)})", str(below),
         str(above)]
        for name, (below, inside, above) in counts.items()
    ]  # fmt: skip
    return rows.markdown(("parameter", "in its 90 % interval", "below it", "above it"), table)


def share(hits: int, count: int) -> str:
    """Returns a share and its 95 % binomial interval (Clopper & Pearson 1934), as text."""
    interval = binomtest(hits, count).proportion_ci()
    return f"{hits / count:.2f}, {interval.low:.2f} to {interval.high:.2f}"


def by_present_rule(
    said: Mapping[str, Any], settings: VerdictSettings = RULES["rule in use"]
) -> dict[str, Any]:
    """Returns an answer with the verdict that the present rule derives from its log-evidences.

    The answer of a failed diagnosis is returned unchanged.
    """
    if "sets" not in said:
        return dict(said)
    evidences_of = {tuple(tested["mechanisms"]): tested for tested in said["sets"]}
    compared = [
        hypothesis for names, evidence in evidences_of.items()
        for hypothesis in hypotheses.hypotheses_of(
            names,
            hypotheses.Evidences(evidence["log_evidence_alone"], evidence["log_evidence_with_smooth"]),
            settings,
        )
    ]  # fmt: skip
    family = hypotheses.Family(compared, settings.evidence_sd)
    judgement = hypotheses.judge_family(family, catalogue(), said["explained"], settings)
    values = said["fit"]["after"]["theta"]
    named = [
        {"name": mechanism.name, "probability": mechanism.probability,
         "parameters": {p.name: values[p.name] for p in catalogue()[mechanism.name].parameters
                        if p.name in values}}
        for mechanism in judgement.named
    ]  # fmt: skip
    return {
        **said, "verdict": judgement.verdict, "mechanisms": named,
        "nothing_probability": judgement.nothing_probability,
    }  # fmt: skip


def _share(board: Mapping[str, Any], path: tuple[str, ...]) -> str:
    """Returns a share of a scoreboard with its interval, as text."""
    share: Any = board
    for key in path:
        share = share[key]
    if not share["of"]:
        return "none"
    return f"{share['hits']} of {share['of']} ({share['low']:.2f} to {share['high']:.2f})"


def cases_of(sets: list[str]) -> list[str]:
    """Returns the recordings of some sets."""
    return [
        f"{name}/{path.stem}" for name in sets for path in sorted((DATA / name / "recordings").glob("*.h5"))
    ]


def main() -> None:
    """Prints the table and the scoreboards."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--folder", type=Path, required=True, help="folder that keeps the runs")
    parser.add_argument(
        "--sets", nargs="+", default=["development"], help="sets whose recordings are diagnosed"
    )
    parser.add_argument("--workers", type=int, default=2, help="number of processes of a diagnosis")
    parser.add_argument("--kept", action="store_true", help="use only stored answers, diagnose nothing")
    parser.add_argument("cases", nargs="*", help="recordings such as development/009, instead of whole sets")
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    cases = options.cases or cases_of(options.sets)
    if options.kept:
        stored_answers = kept()
        cases = [case for case in cases if case in stored_answers]
    answers, table = dict[str, dict[str, Any]](), list[list[str]]()
    for case in cases:
        answers[case] = by_present_rule(answered(case, options.folder, options.workers))
        table.append(row(case, answers[case]))
        rows.say(" | ".join(table[-1]))
    print(rows.markdown(HEADER, table))
    print(scoreboard(answers))
    print(ablation(answers))
    print(coverage(answers))


if __name__ == "__main__":
    main()
