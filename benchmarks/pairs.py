"""What two tissue mechanisms do together, beside what each does alone.

Surrogates of effects add up (`bayeskin/surrogates/effects.py`), and an effect that has an estimate is taken
of the force that those before it make. On the skins of the shipped design that the healthy-skin recording
leaves plausible, with each mechanism as strong as makes its effect a fifth of the force (or as it can be),
every pair is run together, each alone, and neither, on the coarsest bricks. Printed are medians over the
skins, of forces brought to a peak of 1 N, as RMS over the recording:

- together: what the pair does to the force;
- added: by how much the sum of what each does is off;
- composed: by how much it is off as surrogates put it together;
- left: what of that remains when the base's parameters and both mechanisms' are fitted again, by straight
  lines within the prior: a pair whose own surrogate would show something that a search does not find.

    OMP_NUM_THREADS=1 MKL_NUM_THREADS=1 python benchmarks/pairs.py

Finished runs are rows of benchmarks/results/pairs.csv, which a later start does not repeat. Writes the table
between the markers of docs/mechanisms.md.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from itertools import combinations
from pathlib import Path

import healthy_skin
import numpy as np
import rows
from scipy.optimize import lsq_linear

from bayeskin import storage
from bayeskin.mechanisms import catalogue
from bayeskin.mismatch.corrected import slopes
from bayeskin.model.simulate import ModelSpec
from bayeskin.pipeline.reported import FullForce
from bayeskin.proof.cases import shipped_screen
from bayeskin.shipped import shipped
from bayeskin.surrogates import Effect, composed, with_effects
from bayeskin.types import Array, Design, ParameterSpace
from bayeskin.workers import Lost, run_parallel

SHARE = 0.2  # of the force that an effect is
LEVELS = 200  # of strength that are tried for it
FLOOR_MN = 3.0  # largest noise floor of the recording's means over 0.5 s
SPEC = ModelSpec(mesh="bricks", refinement=0)
DOCS = Path(__file__).parents[1] / "docs"
ROWS = rows.Rows(
    rows.RESULTS / "pairs.csv", ("skin", "first", "second", "values", "model_hash"), ("force_mn", "code")
)
HEADER = ("pair", "together [mN]", "added [mN]", "composed [mN]", "left [mN]", "skins")


def skins(count: int) -> Array:
    """Base parameters (count, 5): rows of the shipped design's second wave."""
    design = storage.load(shipped("surrogates/healthy-skin-reaction-design.h5"), Design)
    return design.theta[(design.wave == 1) & design.training][:count]


def strong(effect: Effect, theta: Array, base_n: Array, seed: int) -> Array:
    """The effect's own parameters (k,): the strength that makes it `SHARE` of the force, the others drawn."""
    own = ParameterSpace(effect.space.parameters[-len(effect.own) :])
    rng = np.random.default_rng([seed, *effect.part.encode()])
    unit = np.tile(rng.uniform(0.1, 0.9, own.dim), (LEVELS, 1))
    unit[:, 0] = np.linspace(0.02, 0.98, LEVELS)
    values = own.from_unit(unit)
    point = np.concatenate([np.tile(theta, (LEVELS, 1)), values], axis=1)
    size = _rms(effect.predict_mean(point, np.tile(base_n, (LEVELS, 1)))) / _rms(base_n)
    return values[np.argmin(np.abs(np.log(size / SHARE)))]


def _rms(values: Array) -> Array:
    return np.asarray(np.sqrt(np.mean(values**2, axis=-1)))


def run(case: tuple[Sequence[str], Mapping[str, float]]) -> Array | str:
    """Bin means [N] of a coarse run."""
    force = FullForce(SPEC, healthy_skin.HEALTHY_SKIN, shipped_screen().refit.surrogate.edges_s)
    return force(case)


def together(
    effects: tuple[Effect, Effect], theta: Array, own: tuple[Array, Array], runs: Sequence[Array]
) -> dict[str, float]:
    """Of one skin and pair, in mN at a peak of 1 N; runs: neither, each alone, both."""
    neither, *alone, both = runs
    to_skin = 1e3 / float(np.abs(neither).max())
    estimates = [effect.estimate for effect in effects]
    sides = [one[None] for one in alone]
    made = composed(neither[None], sides, [values[None] for values in own], estimates)[0]
    surrogate = with_effects(shipped_screen().refit.surrogate, effects)
    unit = surrogate.space.to_unit(np.concatenate([theta, *own])[None])[0]
    miss = both - made
    by = slopes(surrogate, np.concatenate([theta, *own]))
    found = lsq_linear(by, miss, bounds=(np.minimum(-unit, -1e-9), np.maximum(1.0 - unit, 1e-9)))
    values = {
        "together": _rms(both - neither), "added": _rms(both + neither - sum(alone)),
        "composed": _rms(miss), "left": _rms(miss - by @ found.x),
    }  # fmt: skip
    return {name: to_skin * float(value) for name, value in values.items()}


def forces(needed: dict[tuple[int, str, str, str], tuple[Sequence[str], Mapping[str, float]]]) -> None:
    """Runs what is missing of these cases by (skin, first, second, values)."""
    known = {ROWS.key_of(row) for row in ROWS.read()}
    keys = [dict(zip(ROWS.key, (*key, SPEC.hash), strict=True)) for key in needed]
    missing = [i for i, key in enumerate(keys) if ROWS.key_of(key) not in known]
    cases = list(needed.values())
    for count, (place, found) in enumerate(run_parallel(run, [cases[i] for i in missing], 2), start=1):
        force = "failed" if isinstance(found, Lost | str) else " ".join(f"{1e3 * v:.6g}" for v in found)
        ROWS.append(**keys[missing[place]], force_mn=force, code=rows.CODE)
        if count % 20 == 0:
            rows.say(f"{count} of {len(missing)} runs")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--skins", type=int, default=6)
    parser.add_argument("--docs", type=Path, default=DOCS, help="folder of mechanisms.md")
    asked = parser.parse_args()
    screen = shipped_screen()
    parts = {effect.part: effect for effect in screen.effects if len(effect.mechanisms) == 1}
    pairs = [(a, b) for a, b in combinations(parts, 2) if parts[a].mechanisms != parts[b].mechanisms]
    theta = skins(asked.skins)
    base_n = screen.refit.force(theta)
    own = {(i, name): strong(effect, theta[i], base_n[i], i)
           for i in range(len(theta)) for name, effect in parts.items()}  # fmt: skip
    neutral = {name: value for m in catalogue().values() for name, value in m.neutral.items()}
    needed: dict[tuple[int, str, str, str], tuple[Sequence[str], Mapping[str, float]]] = {}

    def key(skin: int, *names: str) -> tuple[int, str, str, str]:
        values = {name: float(f"{value:.10g}") for name, value in zip(
            screen.refit.surrogate.space.names, theta[skin], strict=True)}  # fmt: skip
        for name in names:
            values |= dict(zip(parts[name].own, map(float, own[skin, name]), strict=True))
        text = " ".join(f"{name}={value:.8g}" for name, value in values.items())
        found = (skin, *(*names, "", "")[:2], text)
        mechanisms = [parts[name].mechanisms[0] for name in names]
        needed[found] = (mechanisms, {**neutral, **values})
        return found

    wanted = {(i, *pair): [key(i), key(i, pair[0]), key(i, pair[1]), key(i, *pair)]
              for i in range(len(theta)) for pair in pairs}  # fmt: skip
    forces(needed)
    known = {ROWS.key_of(row): row["force_mn"] for row in ROWS.read()}
    found: dict[tuple[str, str], list[dict[str, float]]] = {pair: [] for pair in pairs}
    for (skin, *names), keys in wanted.items():
        texts = [known[ROWS.key_of(dict(zip(ROWS.key, (*k, SPEC.hash), strict=True)))] for k in keys]
        if "failed" not in texts:
            runs = [1e-3 * np.array(text.split(), dtype=float) for text in texts]
            a, b = names
            found[a, b].append(
                together((parts[a], parts[b]), theta[skin], (own[skin, a], own[skin, b]), runs)
            )
    block = table({pair: many for pair, many in found.items() if many})
    print(block)
    rows.into_docs(asked.docs / "mechanisms.md", "pairs", block)


def table(found: Mapping[tuple[str, str], Sequence[Mapping[str, float]]]) -> str:
    """Pairs with the most that is left first."""
    medians = {
        pair: {name: float(np.median([one[name] for one in many])) for name in many[0]}
        for pair, many in found.items()
    }
    order = sorted(medians, key=lambda pair: -medians[pair]["left"])
    lines = [[" + ".join(f"`{name}`" for name in pair),
              *(f"{medians[pair][name]:.3g}" for name in ("together", "added", "composed", "left")),
              str(len(found[pair]))] for pair in order]  # fmt: skip
    above = sum(one["left"] > FLOOR_MN for one in medians.values())
    said = f"{above} of {len(medians)} pairs leave more than {FLOOR_MN:g} mN (median over skins)."
    return f"{rows.markdown(HEADER, lines)}\n\n{said}"


if __name__ == "__main__":
    main()
