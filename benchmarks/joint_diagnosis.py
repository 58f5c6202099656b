"""What diagnoses by the reduced model make of recordings whose keys are known, beside the stored verdicts.

    OMP_NUM_THREADS=1 MKL_NUM_THREADS=1 python benchmarks/joint_diagnosis.py --folder F [development/009 ...]

The verdicts that stand beside these recordings are of the version that learnt effects one by one. Here the
reduced model solves all mechanisms of a set together. What is said of verdict and values is kept in
`benchmarks/results/joint_diagnosis.jsonl`, with the commit that said it, so that a second start goes on;
`--part 1/2` takes every second recording, for two processes side by side. Verdicts are what the present rule
makes of kept evidences. Effects that were outside of the catalogue when a set was made, and are in it now,
count as what they are here, and as outside for the stored verdicts.

Prints a row for each recording: what was concealed and how large it is (in noise floors), what is named, the
probability that nothing is missing, how many of the skin's and the effect's parameters lie in their 90 %
intervals, RMS residuals before and after, by how much the reduced model is off at the end, seconds, which are
those of the last start where a diagnosis was interrupted, and the commit. Then both scoreboards of the same
recordings, and what other thresholds of the verdict would have made of the kept evidences.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import rows

from bayeskin.mechanisms import catalogue
from bayeskin.mismatch import hypotheses
from bayeskin.proof.score import score
from bayeskin.workflow.diagnosis import diagnose

DATA = Path(__file__).parent.parent / "data"
KEPT = Path(__file__).parent / "results" / "joint_diagnosis.jsonl"
NOW_KNOWN = {
    "bent-cell": "cell-nonlinearity", "breathing": "periodic-motion", "slow-amplifier": "amplifier-lag",
    "poisson-cutis": "skeleton-compressibility", "poisson-subcutis-high": "skeleton-compressibility",
    "poisson-subcutis-low": "skeleton-compressibility",
    "plastic-set": "plastic-set",  # which was made of the displacement; in the catalogue it is of the tissue
}  # fmt: skip
CONFIG = """name = "{name}"
[recording]
file = "{name}.h5"
[design]
workers = {workers}
"""
HEADER = (
    "recording", "concealed", "size [floors]", "named (probability)", "nothing", "skin inside",
    "effect inside", "RMS residual [mN]", "reduced model off by [mN]", "seconds", "commit",
)  # fmt: skip
SHARES = {
    "false alarms": ("false_alarms",),
    "clear effects named": ("named", "clear"),
    "clear effects named, up to look-alikes": ("named_up_to_look_alikes", "clear"),
    "smaller effects named, up to look-alikes": ("named_up_to_look_alikes", "below"),
    "names that are there": ("named_mechanisms_there",),
    "unknown where clear effects are outside": ("unknown_outside", "clear"),
    "clear effects' parameters in 90 % intervals": ("effect_in_interval", "clear"),
    "skin's parameters beside them in 90 % intervals": ("base_in_interval", "clear"),
    "skin's parameters where nothing is concealed": ("base_in_interval_nothing",),
}
RULES: dict[str, dict[str, float]] = {
    "as it is": {"PROBABLE": hypotheses.PROBABLE},
    "named whatever the set explains": {"MOST_OF_IT": 0.0},
    "only if it explains 0.8": {"MOST_OF_IT": 0.8},
    "only if it explains 0.95": {"MOST_OF_IT": 0.95},
    "named from 0.8 on": {"PROBABLE": 0.8},
    "named from 0.95 on": {"PROBABLE": 0.95},
    "a prior of 0.01": {"ODDS": float(np.log(0.01 / 0.99))},
    "a prior of 0.2": {"ODDS": float(np.log(0.2 / 0.8))},
}  # a prior before the recording is seen, of each mechanism and of what has no name
WEIGHED = (
    "false alarms", "clear effects named, up to look-alikes", "smaller effects named, up to look-alikes",
    "names that are there", "unknown where clear effects are outside",
)  # fmt: skip


def answered(case: str, folder: Path, workers: int) -> dict[str, Any]:
    """What is said of one recording, such as "development/009"; from where it is kept, if it is."""
    which, number = case.split("/")
    name = f"{which}-{number}"
    if case in (known := kept()):
        return known[case]
    config = folder / f"{name}.toml"
    if not config.exists():
        shutil.copy(DATA / which / "recordings" / f"{number}.h5", folder / f"{name}.h5")
        config.write_text(CONFIG.format(name=name, workers=workers))
    said = {"case": case, "commit": commit(), **essential(diagnose(config, rows.Log()))}
    with open(KEPT, "a", encoding="utf-8") as handle:  # one line at a time, from two processes
        handle.write(json.dumps(said) + "\n")
    return said


def kept() -> dict[str, dict[str, Any]]:
    """What was said of recordings, the last of each."""
    if not KEPT.exists():
        return {}
    lines = [json.loads(line) for line in KEPT.read_text(encoding="utf-8").splitlines()]
    return {one["case"]: one for one in lines}


def commit() -> str:
    """Returns the commit of the sources that diagnose."""
    command = ["git", "-C", str(DATA), "rev-parse", "--short", "HEAD"]
    return subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()


def essential(said: Mapping[str, Any]) -> dict[str, Any]:
    """What scores and the table need of an answer."""
    if "fit" not in said:
        return {"message": said["message"]}
    fits = {
        when: {
            "rmse": one["rmse"], "rmse_held_out": one["rmse_held_out"],
            "theta": {name: {key: its[key] for key in ("mean", "interval90")}
                      for name, its in one["theta"].items()},
        }
        for when, one in said["fit"].items()
    }  # fmt: skip
    same = ("verdict", "nothing_probability", "smooth_probability", "explained", "mechanisms", "sets",
            "best_set", "full_model", "seconds")  # fmt: skip
    located = [{"t0": one["t0"], "t1": one["t1"]} for one in said["located"]]
    return {**{name: said[name] for name in same}, "located": located, "fit": fits}


def key_of(case: str, known: bool = False) -> dict[str, Any]:
    """What is concealed in a recording; of what is `known` now its mechanism."""
    which, number = case.split("/")
    key = dict(json.loads((DATA / which / "seals" / f"{number}.json").read_text()))
    if known and (name := NOW_KNOWN.get(key["label"])):
        key |= {"kind": "alone", "label": name, "mechanisms": [name], "sizes": {name: key["size_n"]}}
    return key


def stored(case: str) -> dict[str, Any]:
    """The verdict that stands beside a recording."""
    which, number = case.split("/")
    return dict(json.loads((DATA / which / "verdicts" / f"{number}.json").read_text())["answer"])


def row(case: str, said: Mapping[str, Any]) -> list[str]:
    """The table's row of one recording."""
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
    named = [f"{one['name']} ({one['probability']:.2f})" for one in said["mechanisms"]]
    return [
        case, key["label"], f"{key['size']:.1f}",
        ", ".join(named) or said["verdict"],
        f"{said['nothing_probability']:.2f}", _inside(key["theta"], values), _inside(key["values"], values),
        f"{1e3 * fit['before']['rmse']:.1f} to {1e3 * fit['after']['rmse']:.1f}",
        full.get("message") or f"{1e3 * full['fit_off_by']:.2f}", f"{said['seconds']:.0f}",
        said["commit"],
    ]  # fmt: skip


def _inside(truth: Mapping[str, float], values: Mapping[str, Any]) -> str:
    """How many of the true values lie in their 90 % intervals, of those that were fitted."""
    known = {name: value for name, value in truth.items() if name in values and name != "p_init"}
    ends = {name: values[name]["interval90"] for name in known}
    return f"{sum(ends[n][0] <= v <= ends[n][1] for n, v in known.items())} of {len(known)}"


def scoreboard(said: Mapping[str, Mapping[str, Any]]) -> str:
    """Both scoreboards of recordings, side by side; times are those by the reduced model."""
    keys, now = {case: key_of(case) for case in said}, {case: key_of(case, known=True) for case in said}
    judged = {case: one if "verdict" in one else {"verdict": "failed"} for case, one in said.items()}
    boards = score(keys, {case: stored(case) for case in said}), score(now, judged)
    table = [[what, *(_share(board, path) for board in boards)] for what, path in SHARES.items()]
    seconds = [one["seconds"] for one in said.values() if "seconds" in one]
    if seconds:
        table.append(
            ["seconds, median and 95 %", "", "{:.0f}, {:.0f}".format(*np.quantile(seconds, (0.5, 0.95)))]
        )
    header = [f"{len(said)} recordings", "effects learnt one by one", "all solved together"]
    return rows.markdown(header, table)


def ablation(said: Mapping[str, Mapping[str, Any]]) -> str:
    """What becomes of the same evidences by other thresholds of `bayeskin.mismatch.hypotheses`."""
    keys = {case: key_of(case, known=True) for case in said}
    judged = {case: one for case, one in said.items() if "verdict" in one}
    table = []
    for what, changed in RULES.items():
        with mock.patch.multiple(hypotheses, **changed):
            board = score(keys, {case: by_present_rule(one) for case, one in judged.items()})
        table.append([what, *(_share(board, SHARES[name]).split(" (")[0] for name in WEIGHED)])
    return rows.markdown((f"{len(judged)} recordings", *WEIGHED), table)


def by_present_rule(said: Mapping[str, Any]) -> dict[str, Any]:
    """An answer with the verdict that follows from its evidences; one of a failure as it is."""
    if "sets" not in said:
        return dict(said)
    weighed = {tuple(one["mechanisms"]): one for one in said["sets"]}
    family = hypotheses.Family([
        one for names, its in weighed.items()
        for one in hypotheses.hypotheses_of(
            names, hypotheses.Evidences(its["log_evidence_alone"], its["log_evidence_with_smooth"])
        )
    ])  # fmt: skip
    found = hypotheses.judge_family(family, catalogue(), said["explained"])
    values = said["fit"]["after"]["theta"]
    named = [
        {"name": one.name, "probability": one.probability,
         "parameters": {p.name: values[p.name] for p in catalogue()[one.name].parameters if p.name in values}}
        for one in found.named
    ]  # fmt: skip
    return {**said, "verdict": found.verdict, "mechanisms": named}


def _share(board: Mapping[str, Any], path: tuple[str, ...]) -> str:
    found: Any = board
    for key in path:
        found = found[key]
    if not found["of"]:
        return "none"
    return f"{found['hits']} of {found['of']} ({found['low']:.2f} to {found['high']:.2f})"


def cases_of(sets: list[str], part: str) -> list[str]:
    """Recordings of sets, every n-th of them from the k-th on for "k/n"."""
    number, count = (int(one) for one in part.split("/"))
    found = [
        f"{one}/{path.stem}" for one in sets for path in sorted((DATA / one / "recordings").glob("*.h5"))
    ]
    return found[number - 1 :: count]


def main() -> None:
    """Prints the table and the scoreboards."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--folder", type=Path, required=True, help="where runs stay")
    parser.add_argument("--sets", nargs="+", default=["development"], help="whose recordings are diagnosed")
    parser.add_argument("--part", default="1/1", help="k/n: every n-th recording, from the k-th on")
    parser.add_argument("--workers", type=int, default=2, help="processes of a diagnosis")
    parser.add_argument("--kept", action="store_true", help="only what is kept, nothing new")
    parser.add_argument("cases", nargs="*", help="such as development/009, instead of whole sets")
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    cases = options.cases or cases_of(options.sets, options.part)
    if options.kept:
        known = kept()
        cases = [case for case in cases if case in known]
    said, table = dict[str, dict[str, Any]](), list[list[str]]()
    for case in cases:
        said[case] = by_present_rule(answered(case, options.folder, options.workers))
        table.append(row(case, said[case]))
        rows.say(" | ".join(table[-1]))
    print(rows.markdown(HEADER, table))
    print(scoreboard(said))
    print(ablation(said))


if __name__ == "__main__":
    main()
