"""Tests which second recording tells look-alikes apart: the proposed one, a slow one, or a repetition.

One mechanism of a group of look-alikes is concealed in a skin. A first recording, of two pulls at 1 mm/s, is
diagnosed. If it leaves open which mechanism of the group acts, a second recording of the same skin is made,
and both are diagnosed together. There are three kinds of second recording:

- `proposed`: the test that `bayeskin experiment` proposes,
- `slow`: the first test at 0.1 mm/s,
- `repeated`: the first test once more.

The recordings are runs of the full model on the mesh of the proof, with white and slow noise. Skins and
strengths of the mechanisms are drawn; the initial pressure is drawn for each recording. A diagnosis is
*right* if it gives the concealed mechanism a probability of at least 0.9, and no look-alike of the group has
as much. It is *wrong* if another mechanism of the group has this probability, and *open* otherwise.

    export OMP_NUM_THREADS=1
    python benchmarks/second_recording.py --folder F                    # some 20 minutes for a skin
    python benchmarks/second_recording.py --folder F --groups friction  # a single group
    python benchmarks/second_recording.py --folder F --kept             # prints the stored rows

Finished diagnoses are rows of benchmarks/results/second_recording.csv. A diagnosis that was stopped continues
in the folder. Skins are drawn until each group has enough of them that the first recording leaves open.
"""

from __future__ import annotations

import argparse
import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rows
from noisy_recordings import RATE_HZ, correlated_noise, random_skin
from scipy.stats import binomtest

import bayeskin.mismatch
from bayeskin import storage
from bayeskin.finite_element.problem import PARAMETERS, material
from bayeskin.finite_element.simulate import simulate_on
from bayeskin.geometry import Geometry
from bayeskin.mechanisms import catalogue, laws, observed, solved
from bayeskin.mismatch.hypotheses import VerdictSettings
from bayeskin.proof.conceal import CELL_STEP_N, LVDT_STEP_M, TOLERANCE, problem_of
from bayeskin.types import PadMotion, Recording
from bayeskin.workflow.diagnosing import diagnose
from bayeskin.workflow.experiment import choose

SPREAD, MOST_TRIES = 0.25, 12
OPENING_M, HOLD_S, REST_S, CYCLES = 6e-3, 40.0, 30.0, 2
SECOND = ("proposed", "slow", "repeated")
# Groups of look-alikes, with the values of each mechanism. The first value, the strength, is drawn about it.
GROUPS: dict[str, dict[str, dict[str, float]]] = {
    "relaxation in holds": {
        "solid-viscoelasticity": {"g_1": 0.15, "tau_1": 4.0, "g_2": 0.15, "tau_2": 40.0},
        "skeleton-compressibility": {"nu_c": 0.3, "nu_s": 0.25},
        "strain-dependent-permeability": {"M_k": -20.0},
        "friction-creep": {"Fc": 0.03, "presliding": 4e-5, "friction_start": 0.0, "friction_tau": 40.0},
    },
    "friction": {
        "device-friction": {"Fc": 0.02, "presliding": 4e-5, "friction_start": 0.0},
        "viscous-drag": {"drag": 15.0},
        "plastic-set": {"set_share": 0.1, "yield_stretch": 1.08},
    },
    "later cycles": {
        "preconditioning": {"damage": 0.15, "damage_energy": 1e3},
        "pad-slip": {"slip_rate": 3e-6, "slip_threshold": 0.1},
        "slow-recovery": {"recovery_compliance": 1e-4, "recovery_time": 30.0},
    },
    "stiffening": {
        "pre-stretch": {"opening": 0.06},
        "strain-stiffening": {"fibre_stress": 1e4, "k2": 4.0, "dispersion": 0.1},
    },
    "offset": {
        "force-offset": {"F0": -0.03},
        "device-friction": {"Fc": 0.02, "presliding": 4e-5, "friction_start": -0.7},
    },
}  # fmt: skip
TABLE = rows.Rows(
    rows.RESULTS / "second_recording.csv",
    ("sources", "group", "skin", "second"),
    ("mechanism", "result", "probabilities", "verdict", "bits", "seconds"),
)
SOURCES = rows.code_digest(Path(bayeskin.mismatch.__file__).parent.glob("*.py"))


def pulls(speed_m_s: float) -> PadMotion:
    """Returns pulls with holds and rests, at one speed."""
    time_s, at_m = [0.0, 5.0], [0.0, 0.0]
    for _ in range(CYCLES):
        for level_m, pause_s in ((OPENING_M, HOLD_S), (0.0, REST_S)):
            arrival_s = time_s[-1] + OPENING_M / speed_m_s
            time_s += [arrival_s, arrival_s + pause_s]
            at_m += [level_m, level_m]
    return PadMotion(np.array(time_s), np.array(at_m))


FIRST, SLOW = pulls(1e-3), pulls(1e-4)


@dataclass(frozen=True)
class Skin:
    """A skin in which a mechanism of a group is concealed; the same group and number give the same skin."""

    group: str
    number: int

    @property
    def mechanism(self) -> str:
        """Returns the concealed mechanism; the mechanisms of a group take turns."""
        names = list(GROUPS[self.group])
        return names[(self.number - 1) % len(names)]

    def rng(self, purpose: int) -> np.random.Generator:
        """Returns the generator of the numbers for one purpose."""
        return np.random.default_rng([list(GROUPS).index(self.group), self.number, purpose, 83])

    @property
    def values(self) -> dict[str, float]:
        """Returns the parameters of the skin and of the mechanism, SI."""
        rng, concealed = self.rng(0), dict(GROUPS[self.group][self.mechanism])
        strength = next(iter(concealed))
        concealed[strength] *= float(np.exp(SPREAD * rng.standard_normal()))
        return {**random_skin(rng, SPREAD), **concealed}

    @property
    def names(self) -> tuple[str, ...]:
        """Returns the concealed mechanism and those that it needs."""
        return (self.mechanism, *catalogue()[self.mechanism].needs)


def make(file: Path, skin: Skin, motion: PadMotion, purpose: int) -> None:
    """Writes a recording of a skin, unless it exists. Ends the program if the model fails.

    purpose : number of the recording of this skin; each has its own noise and its own initial pressure
    """
    if file.exists():
        return
    rng, problem = skin.rng(purpose), problem_of(False, Geometry())
    theta = {**skin.values, "p_init": float(rng.uniform(-300.0, 1500.0))}
    mechanisms = [catalogue()[name] for name in skin.names]
    solved_names = {p.name for mechanism in solved(mechanisms) for p in mechanism.parameters}
    skin_alone = {name: value for name, value in theta.items() if name in {*PARAMETERS, *solved_names}}
    solid = material(skin_alone, problem.mesh.cutis)
    run = simulate_on(problem, solid, TOLERANCE, motion, skin_alone, laws(mechanisms))
    if run.status != "ok":
        raise SystemExit(f"{skin.group}, skin {skin.number}: {run.message}")
    values = {name: np.array([value]) for name, value in theta.items()}
    time_s = np.arange(0.0, motion.time_s[-1] + 0.5 / RATE_HZ, 1.0 / RATE_HZ)
    force = observed(mechanisms, values, motion, lambda t: np.atleast_2d(run.at(t)))
    force_n = CELL_STEP_N * np.round((force(time_s)[0] + correlated_noise(rng, len(time_s))) / CELL_STEP_N)
    displacement_m = LVDT_STEP_M * np.round(motion.at(time_s) / LVDT_STEP_M)
    sha256 = hashlib.sha256(force_n.tobytes()).hexdigest()
    storage.save(file, Recording(time_s, displacement_m, force_n, file.stem, sha256))


def diagnosed(folder: Path, skin: Skin, second: str, files: Sequence[Path], bits: float) -> rows.Row:
    """Returns the row of a diagnosis: of the first recording alone, or of both together."""
    key = {"sources": SOURCES, "group": skin.group, "skin": skin.number, "second": second or "none"}
    known = TABLE.find(**key)
    if known is not None:
        return known
    config = folder / f"{second or 'first'}.toml"
    section = "[recording]" if len(files) == 1 else "[[recordings]]"
    config.write_text("\n".join([f'name = "{config.stem}"',
                                 *(f'{section}\nfile = "{file.name}"' for file in files)]))  # fmt: skip
    said = diagnose([config], rows.Log())
    probabilities = {m["name"]: m["probability"] for m in said.get("mechanisms", [])}
    return TABLE.append(
        **key, mechanism=skin.mechanism, result=result_of(skin, probabilities),
        probabilities=json.dumps(probabilities), verdict=said.get("verdict", "failed"), bits=bits,
        seconds=round(said.get("seconds", 0.0)),
    )  # fmt: skip


def result_of(skin: Skin, probabilities: Mapping[str, float]) -> str:
    """Returns "right", "wrong" or "open" for the probabilities of the named mechanisms."""
    probable = {name for name, value in probabilities.items() if value >= VerdictSettings().probable}
    if (probable - set(skin.names)) & set(GROUPS[skin.group]):
        return "wrong"
    return "right" if skin.mechanism in probable else "open"


def followed(folder: Path, skin: Skin) -> bool:
    """Diagnoses a skin's first recording and, if it leaves the group open, the three kinds of second ones.

    Returns whether the first recording left the group open.
    """
    folder = folder / f"{list(GROUPS).index(skin.group)}-{skin.number}"
    folder.mkdir(parents=True, exist_ok=True)
    first = folder / "first.h5"
    make(first, skin, FIRST, 1)
    if diagnosed(folder, skin, "", [first], 0.0)["result"] != "open":
        return False
    motions: dict[str, PadMotion] = {"slow": SLOW, "repeated": FIRST}
    bits = dict.fromkeys(SECOND, 0.0)
    proposal: dict[str, Any] = choose([folder / "first.toml"], rows.Log())
    if proposal.get("experiments"):
        table = np.loadtxt(folder / "first" / "experiment" / "next.csv", delimiter=",", skiprows=1)
        motions["proposed"] = PadMotion(table[:, 0], 1e-3 * table[:, 1])
        bits["proposed"] = float(proposal["experiments"][0]["gain_bits"])
    for number, second in enumerate(SECOND, 2):
        if second in motions:
            file = folder / f"second-{second}.h5"
            make(file, skin, motions[second], number)
            diagnosed(folder, skin, second, [first, file], bits[second])
    return True


def main() -> None:
    """Runs the missing diagnoses and prints the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--folder", type=Path, required=True, help="folder that keeps the runs")
    parser.add_argument("--groups", nargs="+", choices=list(GROUPS), default=list(GROUPS))
    parser.add_argument("--skins", type=int, default=4, help="open first recordings of each group")
    parser.add_argument("--kept", action="store_true", help="print the stored rows, diagnose nothing")
    options = parser.parse_args()
    for group in [] if options.kept else options.groups:
        left = options.skins
        for number in range(1, MOST_TRIES + 1):
            left -= followed(options.folder, Skin(group, number))
            if left == 0:
                break
    finished = [row for row in TABLE.read() if row["sources"] == SOURCES]
    print(summary(finished))
    print(each(finished))


def summary(finished: Sequence[rows.Row]) -> str:
    """Returns the table of the results of each kind of second recording."""
    table = []
    for second in SECOND:
        results = [row["result"] for row in finished if row["second"] == second]
        if not results:
            continue
        right = results.count("right")
        interval = binomtest(right, len(results)).proportion_ci(0.9)
        share = f"{right} of {len(results)} ({interval.low:.2f} to {interval.high:.2f})"
        table.append([second, share, str(results.count("wrong")), str(results.count("open"))])
    return rows.markdown(("second recording", "resolved rightly, 90 % interval", "wrongly", "open"), table)


def each(finished: Sequence[rows.Row]) -> str:
    """Returns the table of all diagnoses."""
    columns = ("group", "skin", "mechanism", "second", "result", "probabilities", "bits", "seconds")
    return rows.markdown(columns, [[row[column] for column in columns] for row in finished])


if __name__ == "__main__":
    main()
