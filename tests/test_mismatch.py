"""A concealed mechanism is found on the toy, nothing is found where nothing is; the parts of the chain."""

from __future__ import annotations

import copy
import dataclasses
import json
from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import toy
from scipy.stats import kstest, norm
from toy_inference import NOISE, TRUTH, ToySurrogate, line_problem, toy_problem

from bayeskin.errors import InputError
from bayeskin.inference import LogPosterior, NoisePriors, find_map
from bayeskin.inference.convergence import Limits
from bayeskin.inference.gauss_newton import gauss_newton, promise, surrogate_error
from bayeskin.inference.model_error import ModelError
from bayeskin.inference.straighten import find_shear
from bayeskin.mechanisms import catalogue
from bayeskin.mechanisms.mechanism import Instrument
from bayeskin.mismatch.blocked import errors_left_out, without
from bayeskin.mismatch.fit import (
    APART,
    Fit,
    _times,
    fit,
    fit_base,
    fit_near,
    likely,
    other_skins,
    other_tops,
    restored,
    soft_on_stiff,
    stored,
)
from bayeskin.mismatch.full_fit import ENOUGH, at_run, fit_full
from bayeskin.mismatch.locate import _chance, locate, model_error
from bayeskin.mismatch.observed import ObservedSurrogate
from bayeskin.mismatch.resample import resample
from bayeskin.mismatch.search import PRIOR, Made, Search, search, sure, weight
from bayeskin.mismatch.verdict import Evidence, _named, judge, set_probability, unknown_probability
from bayeskin.mismatch.wrapper import Sure, Wrapper, innermost, skins
from bayeskin.proof.cases import shipped_screen
from bayeskin.proof.protocol import MOTION
from bayeskin.surrogates.effects import WithEffects
from bayeskin.types import ParameterSpace

KNOWN = {
    name: catalogue()[name] for name in ("force-offset", "sensor-drift", "viscous-drag", "sensor-events")
}
NEUTRAL = {name: value for one in KNOWN.values() for name, value in one.neutral.items()}
QUIET = NoisePriors(sd_n=(1e-4, 6e-3), tau_s=(0.1, 5.0), nu=(4.0, 100.0))


def concealing(seed: int, names: Sequence[str] = (), **values: float) -> LogPosterior:
    """The toy's recording with mechanisms at work, and the posterior that knows of none."""
    plain = toy_problem(seed)
    mechanisms = tuple(KNOWN[name] for name in names)
    theta = [*TRUTH.values(), *(values[p.name] for one in mechanisms for p in one.parameters)]
    seen = ObservedSurrogate(ToySurrogate(), mechanisms, toy.MOTION).predict([theta]).mean[0]
    alone = ToySurrogate().predict([list(TRUTH.values())]).mean[0]
    binned = dataclasses.replace(plain.binned, force_n=plain.binned.force_n + seen - alone)
    return dataclasses.replace(plain, binned=binned, noise_priors=QUIET)


def building(alone: LogPosterior, names: Sequence[str]) -> LogPosterior:
    mechanisms = tuple(KNOWN[name] for name in names)
    if not mechanisms:
        return alone
    return dataclasses.replace(alone, surrogate=ObservedSurrogate(alone.surrogate, mechanisms, toy.MOTION))


@pytest.mark.parametrize(
    ("names", "values"),
    [
        (("force-offset",), {"F0": -0.04}),
        (("viscous-drag",), {"drag": 30.0}),
        (
            ("sensor-events",),
            {"event_1_at": 0.3, "event_1_step": 0.03, "event_2_at": 0.7, "event_2_step": -0.04},
        ),
    ],
)
def test_a_concealed_mechanism_is_named_and_its_parameters_are_right(
    names: tuple[str, ...], values: dict[str, float]
) -> None:
    alone = concealing(0, names, **values)
    found = search(lambda these: building(alone, these), KNOWN, 1)
    before, after = (locate(one, found.best.theta, 1) for one in (found.base, found.best))
    verdict = judge(found, KNOWN, before, after)
    assert verdict.verdict == "named"
    assert judge(found, KNOWN, before, after, (0.0, 1.0)) == verdict
    refused = judge(found, KNOWN, before, after, (1.0, 0.0))
    assert (refused.verdict, refused.named) == ("unknown", ())
    assert refused.unknown_probability > 0.99
    assert verdict.believed
    assert not refused.believed
    assert judge(found, KNOWN, before, after, (None, 1.0)) == verdict
    assert (
        judge(found, KNOWN, before, after, (0.0, None)) == refused
    )  # the full model fails with the set alone
    assert judge(found, KNOWN, before, after, (0.0, 1.0), 0.95) == verdict
    assert judge(found, KNOWN, before, after, left_out_n=(4e-3, 2e-3)) == verdict
    assert judge(found, KNOWN, before, after, left_out_n=(2e-3, 4e-3)) == refused
    assert judge(found, KNOWN, before, after, (0.0, 1.0), 0.85) == refused
    assert [one.name for one in verdict.named] == list(names)
    assert before.windows
    assert verdict.explained > 0.8
    assert verdict.unknown_probability < 0.5
    for name in (name for name in values if not name.startswith("event")):
        draws = found.best.draws(1000, 0)[:, found.best.log_posterior.names.index(name)]
        assert abs(values[name] - draws.mean()) < 4.0 * draws.std(), name
    if names == ("sensor-events",):
        moments = sorted(found.best.theta[f"event_{i}_at"] for i in (1, 2))
        np.testing.assert_allclose(moments, [0.3, 0.7], atol=0.02)


def test_nothing_is_missing_where_nothing_is() -> None:
    """Of four recordings one may be a false alarm: each of the four has one chance in twenty or so."""
    verdicts = []
    for seed in range(4):
        alone = concealing(seed)
        found = search(lambda these, alone=alone: building(alone, these), KNOWN, 1)  # type: ignore[misc]
        before, after = (locate(one, found.best.theta, 1) for one in (found.base, found.best))
        verdicts.append(judge(found, KNOWN, before, after).verdict)
    assert verdicts.count("nothing-missing") >= 3


def test_the_chance_of_the_farthest_window_is_uniform_where_nothing_is_missing() -> None:
    fits = [fit_base(alone, 1, find_shear(alone)) for alone in map(concealing, range(12))]
    chances = [locate(one, one.theta, 1).chance for one in fits]
    assert kstest(chances, "uniform").pvalue > 0.01
    off = concealing(0, ("viscous-drag",), drag=30.0)
    assert locate(fit_base(off, 1, find_shear(off)), fits[0].theta, 1).chance < 1e-6


@pytest.mark.parametrize("share", [1e-3, 1e-2])
def test_what_the_model_is_wrong_by_is_no_mismatch(share: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """In each phase by another amount, of a sd that is allowed for, below the noise's and above."""
    monkeypatch.setattr("bayeskin.mismatch.locate.MESH_ERROR", share)
    chances = []
    for seed in range(30):
        alone = concealing(seed)
        binned = alone.binned
        error_n = model_error(alone) * np.random.default_rng([seed, 1]).standard_normal(len(binned.phases))
        binned = dataclasses.replace(binned, force_n=binned.force_n + error_n[binned.phase])
        off = dataclasses.replace(alone, binned=binned)
        at = Fit((), off, {**TRUTH, **NOISE}, 0.0, 0.0, 1e-6 * np.eye(off.dim), np.zeros(3))
        chances.append(locate(at, at.theta, seed).chance)
    assert np.sum(np.array(chances) < 0.05) <= 5


def test_a_look_alike_that_is_named_too_lends_no_probability(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rubbing is sure, and an offset beside it is not, though each could stand for the other."""
    known = catalogue()
    alone = concealing(0)
    found = Search()
    names: tuple[str, ...]
    for names, worth in (
        ((), 0.0),
        (("device-friction",), 20.0),
        (("device-friction", "force-offset"), 23.0),
    ):
        found.add(Made(Fit(names, alone, {}, 0.0, worth, np.eye(1), np.zeros(1)), True))
    monkeypatch.setattr("bayeskin.mismatch.verdict.explains", lambda *_: 1.0)
    rubs, offset = (_named(found, known[name]) for name in ("device-friction", "force-offset"))
    assert {"device-friction", "force-offset"} <= set(offset.group)
    assert rubs.group_probability > 0.99
    assert 0.4 < offset.group_probability < 0.6


@pytest.mark.parametrize("scale", [1.0, 0.7])
def test_the_chance_of_a_window_farther_than_all_draws_is_read_from_their_tail(scale: float) -> None:
    """Of the largest of 200 Gaussians of one sd or another."""
    found = []
    for seed in range(20):
        tall = scale * np.abs(np.random.default_rng(seed).standard_normal((1000, 200))).max(axis=1)
        for chance in (0.3, 1e-3, 1e-5):
            height = scale * norm.isf(0.5 * (1.0 - (1.0 - chance) ** (1.0 / 200.0)))
            found.append(np.log(_chance(tall, height) / chance))
    by_chance = np.reshape(found, (20, 3))
    assert np.all(np.abs(by_chance.mean(axis=0)) < np.log([1.05, 1.3, 2.0]))
    assert np.all(by_chance.std(axis=0) < np.log([1.1, 1.7, 3.0]))


def test_a_set_pays_for_its_mechanisms_and_what_has_no_name_for_being_one_more() -> None:
    odds = np.log(PRIOR / (1.0 - PRIOR))
    nowhere = -np.inf
    even = set_probability(["a"], Evidence(nowhere, 3.0), Evidence(3.0, nowhere))
    assert even == pytest.approx(0.5)  # each is one thing more than nothing
    two = set_probability(["a", "b"], Evidence(nowhere, 3.0), Evidence(3.0, nowhere))
    assert two == pytest.approx(1.0 / (1.0 + np.exp(-odds)))
    assert set_probability(["a"], Evidence(0.0, nowhere), Evidence(0.0, nowhere)) == pytest.approx(PRIOR)
    beside = set_probability(["a"], Evidence(nowhere, 10.0), Evidence(0.0, 20.0))  # the set and more
    assert beside == pytest.approx(1.0 / (1.0 + np.exp(-10.0 - odds)))


def test_the_probability_of_unknown_is_the_bound_of_sellke_bayarri_and_berger() -> None:
    """Their table 1: at even odds, by p, what the null keeps at least."""
    even = {0.05: 0.289, 0.01: 0.111, 0.001: 0.0184}
    for chance, null in even.items():
        odds = PRIOR / (1.0 - PRIOR) * (1.0 - null) / null
        assert unknown_probability(chance) == pytest.approx(odds / (1.0 + odds), rel=5e-3)
    assert unknown_probability(0.0) == 1.0
    assert unknown_probability(1.0) == unknown_probability(0.4) == pytest.approx(PRIOR)


def test_a_search_that_was_stopped_goes_on_without_repeating_a_fit() -> None:
    alone = concealing(3, ("force-offset",), F0=-0.04)
    made: list[Made] = []
    first = search(lambda these: building(alone, these), KNOWN, 1, on_fit=made.append)
    kept = [(json.loads(json.dumps(stored(one.fit))), one.counts) for one in made]
    done = [Made(restored(one, building(alone, one["names"])), counts) for one, counts in kept]
    again: list[Made] = []
    second = search(lambda these: building(alone, these), KNOWN, 1, done=done, on_fit=again.append)
    assert not again
    assert second.best.names == first.best.names
    np.testing.assert_array_equal(second.best.force_n, first.best.force_n)


def wild() -> LogPosterior:
    """What no mechanism of the toy's explains is left beside two that are concealed."""
    alone = concealing(2, ("force-offset", "viscous-drag"), F0=-0.04, drag=20.0)
    left = 0.01 * np.sin(np.arange(len(alone.binned.force_n)) / 3.0)
    binned = dataclasses.replace(alone.binned, force_n=alone.binned.force_n + left)
    return dataclasses.replace(alone, binned=binned, noise_priors=QUIET)


def test_where_much_is_left_a_search_goes_on_from_the_best_of_another_that_knows_less() -> None:
    """The other has seen no unloading and no noise of it."""
    alone = wild()
    loads = [phase for phase in alone.binned.phases if phase.kind == "unload"]
    begun = dataclasses.replace(alone, fit_windows=((0.0, loads[0].start_s),))
    assert not set(alone.names) <= set(begun.names)
    first = search(lambda these: building(begun, these), KNOWN, 1)
    known = {name: KNOWN[name] for name in first.best.names}
    second = search(lambda these: building(alone, these), known, 1, another=lambda: first.best)
    assert set(second.fits) >= {(), first.best.names}
    assert second.best.value > second.base.value + 10.0


def test_a_set_tried_again_from_another_search_is_kept_where_it_is_better_and_not_made_again() -> None:
    alone = wild()
    made: list[Made] = []
    better = search(lambda these: building(alone, these), KNOWN, 1, on_fit=made.append).best

    def run(done: Sequence[Made], on_fit: Callable[[Made], None]) -> Search:
        return search(
            lambda these: building(alone, these), KNOWN, 1, done=done, on_fit=on_fit, another=lambda: better
        )

    made.clear()
    first = run((), made.append)
    names = [one.fit.names for one in made]
    assert names.count(better.names) > 1
    assert weight(first.fits[better.names]) == max(weight(o.fit) for o in made if o.fit.names == better.names)
    for stopped in (1, len(made) // 2, len(made) - 1, len(made)):
        again: list[Made] = []
        second = run(made[:stopped], again.append)
        assert [one.fit.names for one in again] == names[stopped:]
        assert second.best.value == first.best.value


class Landscape:
    """Stands for the fits of a search: by set and the set that one starts from, the tops in turn."""

    def __init__(self, tops: dict[str, dict[str, list[float]]], left: float, monkeypatch: Any) -> None:
        self.tops, self.left = copy.deepcopy(tops), left
        for name, stand_in in (
            ("fit_base", lambda posterior, seed, straight: self.fit((), posterior, "")),
            ("fit", lambda names, posterior, theta, *rest: self.fit(names, posterior, theta["from"])),
            ("find_shear", lambda posterior: None), ("sure", lambda *rest: True),
            ("promised", lambda posterior, *rest: 1.0), ("_new", lambda *rest: []),
        ):  # fmt: skip
            monkeypatch.setattr(f"bayeskin.mismatch.search.{name}", stand_in)

    def fit(self, names: Sequence[str], posterior: Any, start: str) -> Fit:
        tops = self.tops["".join(names)][start]
        top = tops.pop(0) if len(tops) > 1 else tops[0]
        nothing = np.zeros((1, 1))
        return Fit(tuple(names), posterior, {"from": "".join(names)}, top, top, nothing, nothing[0])  # type: ignore[dict-item]

    def build(self, names: Sequence[str]) -> Any:
        """A posterior of one coordinate, the noise of rests."""
        return SimpleNamespace(
            names=("sd_rest",), bounds=(np.zeros(1), np.ones(1)), vector=lambda theta: np.array([self.left]),
            surrogate=SimpleNamespace(space=SimpleNamespace(dim=4)), of="".join(names),
        )  # fmt: skip

    def best(
        self, known: str, another: Callable[[], Fit | None] = lambda: None, exchanges: bool = True
    ) -> tuple[str, float]:
        """What a search among mechanisms of one letter ends at."""
        letters = dict.fromkeys(known, KNOWN["force-offset"])
        found = search(self.build, letters, 1, another=another, exchanges=exchanges).best
        return "".join(found.names), found.value


def test_a_smaller_set_is_climbed_again_from_a_larger_and_a_larger_from_a_smaller_that_is_ahead(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    tops = {
        "": {"": [0.0], "a": [0.0], "b": [0.0]},
        "a": {"": [5.0], "ab": [40.0]},  # the larger set shows the way
        "b": {"": [10.0], "ab": [10.0]},
        "ab": {"b": [30.0], "a": [60.0]},
    }
    assert Landscape(tops, 0.5, monkeypatch).best("ab") == ("ab", 60.0)
    tops["ab"] = {"b": [30.0], "a": [41.0]}  # no more than what a mechanism costs
    assert Landscape(tops, 0.5, monkeypatch).best("ab") == ("a", 40.0)


def test_where_much_is_left_each_mechanism_is_searched_for_again_beside_the_others(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    tops = {"": {"": [0.0], "a": [2.0]}, "a": {"": [20.0, 35.0, 35.5, 36.0]}}
    assert Landscape(tops, 0.5, monkeypatch).best("a") == ("a", 20.0)
    assert Landscape(tops, 1.0, monkeypatch).best("a") == ("a", 35.0)


def test_another_mechanism_is_tried_in_the_place_of_each_of_several(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    single = {"": [10.0], "ab": [10.0], "bc": [10.0], "abc": [10.0]}
    tops = {
        "": {name: [0.0] for name in ("", "a", "b", "c", "ab", "bc")},
        "a": single, "b": single, "c": {"": [5.0], "ac": [5.0], "bc": [5.0]},
        "ab": {"a": [30.0], "b": [30.0], "abc": [30.0]}, "ac": {"a": [11.0], "c": [11.0]},
        "bc": {"b": [60.0], "c": [60.0], "abc": [60.0]},
        "abc": {"ab": [31.0], "bc": [61.0]},
    }  # fmt: skip
    promises = {"ab": 3.0, "ac": 2.0, "bc": 1.0}
    landscape = Landscape(tops, 0.5, monkeypatch)
    known = lambda posterior, *rest: promises.get(posterior.of, 0.0)  # noqa: E731
    monkeypatch.setattr("bayeskin.mismatch.search.promised", known)
    monkeypatch.setattr("bayeskin.mismatch.search.SHORTLIST", 1)
    assert landscape.best("abc") == ("bc", 60.0)
    assert landscape.best("abc", exchanges=False) == ("ab", 30.0)
    monkeypatch.setattr("bayeskin.mismatch.search.EXCHANGES", 0)
    assert landscape.best("abc") == ("ab", 30.0)


def test_a_fit_where_nothing_is_possible_has_no_weight_and_does_not_count() -> None:
    alone = dataclasses.replace(concealing(0), excludes=lambda space, theta: np.ones(len(theta), bool))
    middle = alone.named(alone.from_sampling(np.mean(alone.bounds, axis=0)))
    found = fit_near((), alone, middle, None)
    assert weight(found) == found.value == -np.inf
    assert np.all(np.isfinite(found.covariance))
    assert not sure(found, lambda names: alone, KNOWN)


@pytest.mark.parametrize("left", [0.5, 1.0])
def test_another_search_shows_where_no_path_of_its_own_leads(
    left: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    singles = {"": [1.0], "ab": [1.0]}
    tops = {
        "": {"": [0.0], "a": [0.0], "b": [0.0]},
        "a": singles, "b": singles, "ab": {"a": [1.0], "b": [1.0], "elsewhere": [50.0]},
    }  # fmt: skip
    landscape = Landscape(tops, left, monkeypatch)
    other = landscape.fit(("a", "b"), landscape.build(()), "elsewhere")
    other = dataclasses.replace(other, theta={"from": "elsewhere"})  # type: ignore[dict-item]
    assert landscape.best("ab") == ("", 0.0)
    assert landscape.best("ab", lambda: other) == ("ab", 50.0)


def test_means_alone_are_those_of_whole_predictions_of_all_that_is_shipped() -> None:
    """Every effect, with estimates too, behind every mechanism of the instrument."""
    screen = shipped_screen()
    instrument = tuple(m for m in catalogue().values() if isinstance(m.act, Instrument))
    learnt = WithEffects(screen.refit.surrogate, screen.effects)
    seen = ObservedSurrogate(learnt, instrument, MOTION)
    assert innermost(seen) is learnt  # with parameters of tissue mechanisms
    assert skins(seen) == (screen.refit.surrogate.space.dim, learnt.space.dim)
    assert skins(learnt.base) == (screen.refit.surrogate.space.dim,)
    theta = seen.space.box.from_unit(np.random.default_rng(4).uniform(size=(3, seen.space.dim)))
    theta = theta[[0, 1, 1, 2]]
    theta[2, -1] = theta[0, -1]  # one skin, seen through two instruments
    whole = seen.predict(theta).mean
    assert np.ptp(whole[1] - whole[2]) > 0.0
    rounding = 1e-9 * np.abs(whole).max()  # of some tens of newtons
    np.testing.assert_allclose(seen.predict_mean(theta), whole, rtol=1e-7, atol=rounding)


def test_what_is_off_at_infinity_is_climbed_to_from_there() -> None:
    """Creep of friction has an infinite time constant where there is none."""
    both = tuple(catalogue()[name] for name in ("device-friction", "friction-creep"))
    names = tuple(one.name for one in both)
    truth = {"Fc": 0.08, "presliding": 5e-5, "friction_start": 0.0, "friction_tau": 15.0}
    seen = ObservedSurrogate(ToySurrogate(), both, toy.MOTION)
    plain = concealing(0)
    gap = (
        seen.predict([[*TRUTH.values(), *truth.values()]]).mean
        - ToySurrogate().predict([[*TRUTH.values()]]).mean
    )
    binned = dataclasses.replace(plain.binned, force_n=plain.binned.force_n + gap[0])
    wide = dataclasses.replace(plain, binned=binned, surrogate=seen)
    base = fit_base(dataclasses.replace(plain, binned=binned), 1, None)
    neutral = {name: value for one in both for name, value in one.neutral.items()}
    parts = [part for one in both for part in one.whole_or_parts]
    found = fit(names, wide, base.theta, neutral, 1, None, parts)
    best = fit_near(names, wide, {**base.theta, **TRUTH, **truth}, None)
    assert found.value > best.value - 0.5
    assert found.theta["friction_tau"] == pytest.approx(15.0, rel=0.3)
    assert _times(2.0, 30.0, np.inf) == 15.0
    assert _times(-1.0, 30.0, np.inf) == np.inf
    assert _times(2.0, 0.3, 0.1) == pytest.approx(0.5)


def test_whole_skins_are_drawn_anew_and_no_instrument_also_from_a_bound() -> None:
    """All that the innermost surrogate has is drawn; rounding loses none."""
    plain = concealing(0)
    inner = ObservedSurrogate(ToySurrogate(), (KNOWN["sensor-drift"],), toy.MOTION)
    wide = dataclasses.replace(plain, surrogate=inner)
    low, high = wide.bounds
    for shear in (None, find_shear(plain)):
        shear = shear and shear.among(plain.names, wide.names)
        vector = 0.5 * (low + high)
        vector[-1] = np.nextafter(high[-1], np.inf)
        trials = other_skins(vector, wide, shear, 1, innermost(wide.surrogate).space.dim)
        assert len(trials) > 20
        spread = np.ptp(trials, axis=0)
        assert np.all(spread[: len(TRUTH)] > 0.5 * (high - low)[: len(TRUTH)])
        assert np.all(spread[len(TRUTH) :] == 0.0)
        assert np.all((trials >= low) & (trials <= high))


def test_other_tops_are_apart_and_have_the_right_one_where_a_fit_is_of_another(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    alone = concealing(0)
    shear, best = find_shear(alone), fit_base(alone, 1, None)
    elsewhere = {**best.theta, "E_c": 4.0 * best.theta["E_c"], "E_s": 0.1 * best.theta["E_s"]}
    wrong = dataclasses.replace(best, theta=elsewhere, value=float("-inf"))
    tops = other_tops(wrong, shear, 1, 3)
    assert 1 <= len(tops) <= 3
    assert max(one.value for one in tops) > best.value - 0.5
    for found, others in ((wrong, tops), (best, other_tops(best, shear, 1, 3))):
        skin = [one.unit[: len(TRUTH)] for one in (found, *others)]
        apart = [np.max(np.abs(a - b)) for i, a in enumerate(skin) for b in skin[:i]]
        assert min(apart, default=1.0) > APART
    hopes = [one.value + one.hope for one in tops]
    assert hopes == sorted(hopes, reverse=True)
    low, high = alone.bounds
    same = low + best.unit * (high - low)
    monkeypatch.setattr("bayeskin.mismatch.fit._other_starts", lambda *rest: [same, same])
    assert other_tops(best, shear, 1, 3) == []
    assert len(other_tops(wrong, shear, 1, 3)) == 1


@pytest.mark.parametrize("allowed", [0.0, 0.01])
def test_what_a_surrogate_s_error_costs_is_what_it_would_gain_without_one(allowed: float) -> None:
    """Where nothing is left of the force; what is allowed for the mesh stays."""
    alone = concealing(0)
    names = alone.surrogate.space.names
    mean = alone.surrogate.predict([[TRUTH[name] for name in names]]).mean[0]
    alone = dataclasses.replace(alone, binned=dataclasses.replace(alone.binned, force_n=mean))

    def by(surrogate: Any) -> Any:
        return dataclasses.replace(alone, surrogate=surrogate, model_error=allowing(allowed))

    low, high = alone.bounds
    noise = alone.named(alone.from_sampling(0.5 * (low + high)))
    vector = alone.vector({**noise, **TRUTH})
    theta = alone.named(alone.from_sampling(vector))
    found = dataclasses.replace(fit_base(by(alone.surrogate), 1, None), theta=theta)
    exact, free = (
        float(by(one).log_prob(vector[None])[0]) for one in (Sure(alone.surrogate), alone.surrogate)
    )
    assert found.hope > 1.0
    assert found.hope == pytest.approx(exact - free, abs=1e-6)


def tried(weights: dict[tuple[str, ...], float]) -> Search:
    """A search that has tried sets of these weights; what x, y and z do was learnt, of drift it is exact."""
    base = fit_base(concealing(0), 1, None)
    odds = float(np.log(PRIOR / (1.0 - PRIOR)))
    found = Search(learnt=frozenset("xyz"))
    for names, nats in weights.items():
        found.add(Made(dataclasses.replace(base, names=names, log_evidence=nats - len(names) * odds), True))
    return found


def test_the_full_model_s_word_on_some_sets_moves_all_like_them() -> None:
    found = tried(
        {(): 0.0, ("x",): 90.0, ("drift", "x"): 100.0, ("y",): 70.0, ("drift",): 95.0, ("y", "z"): 60.0}
    )
    assert found.best.names == ("drift", "x")
    assert found.probability(["y"]) < 1e-9
    found.full = {(): 5.0, ("drift", "x"): 80.0, ("y",): 120.0}
    assert found.best.names == ("y",)
    assert found.weight(found.fits["x",]) == pytest.approx(70.0)
    assert found.weight(found.fits["drift",]) == pytest.approx(100.0)  # as the model without any
    assert found.weight(found.fits["y", "z"]) == pytest.approx(60.0)  # of which nothing was said
    assert found.probability(["y"]) > 0.9999
    found.full = {(): 5.0, ("drift", "x"): 80.0, ("x",): 79.0, ("y",): -np.inf}  # no run of it converges
    assert found.weight(found.fits["x",]) == 79.0
    assert found.best.names == ("drift", "x")
    assert found.probability(["y"]) < 0.01


def test_each_mechanism_of_the_best_has_a_rival_that_may_come_out_ahead() -> None:
    found = tried({(): 99.0, ("x", "y"): 100.0, ("x",): 90.0, ("y", "z"): 80.0, ("drift",): 70.0})
    hope = found.base.hope
    assert hope > 0.0

    def rivals(full_weight: float | None) -> set[tuple[str, ...]]:
        return {one.names for one in found.rivals(full_weight)}

    assert rivals(100.0 + hope) == set()
    assert rivals(90.0 + hope - 1e-6) == {("x",)}
    assert rivals(80.0 + hope - 1e-6) == {("y", "z"), ("x",)}
    assert rivals(None) == {("y", "z"), ("x",)}  # it could not be fitted
    assert not tried({(): 0.0, ("drift",): 50.0}).rivals(None)


def test_the_full_model_is_asked_about_the_most_hopeful_rivals_only() -> None:
    found = tried({(): 0.0, ("x", "y", "z"): 100.0, ("x", "y"): 70.0, ("y", "z"): 90.0, ("x", "z"): 80.0})
    assert [one.names for one in found.rivals(None)] == [("y", "z"), ("x", "z")]


def test_a_set_that_counts_is_not_unsure_too() -> None:
    base = fit_base(concealing(0), 1, None)
    for order in ((True, False), (False, True)):
        found = Search()
        for counts in order:
            found.add(Made(base, counts))
        assert set(found.fits) == {()}
        assert not found.unsure


def test_evidence_is_that_of_a_line_in_closed_form() -> None:
    problem = line_problem()
    priors = dataclasses.replace(problem.noise_priors, nu=(1e4, 1.001e4))  # at 1e6 lgamma rounds
    problem = dataclasses.replace(problem, noise_priors=priors)
    found = fit_base(problem, 1, None)
    columns, sd = problem.surrogate.columns, 0.05  # type: ignore[attr-defined]
    noise = (sd**2 + 1e-6) * np.eye(columns.shape[1]) + 1e-4 * np.outer(columns[1], columns[1])
    force = problem.chain.force_n
    precision = columns @ np.linalg.solve(noise, columns.T)
    best = np.linalg.solve(precision, columns @ np.linalg.solve(noise, force))
    left = force - best @ columns
    peak = -0.5 * (left @ np.linalg.solve(noise, left) + np.linalg.slogdet(2.0 * np.pi * noise)[1])
    exact = peak + np.log(2.0 * np.pi) - 0.5 * np.linalg.slogdet(precision)[1] - np.log(4.0)
    assert found.log_evidence == pytest.approx(exact, abs=0.05)


def test_climbs_reach_at_least_what_the_global_search_finds() -> None:
    problem = toy_problem()
    searched = find_map(problem, seed=1, starts=3, evaluations=12000)
    assert fit_base(problem, 1, find_shear(problem)).value > searched.value - 0.2


def test_a_climb_never_ends_below_its_start_nor_outside_the_box() -> None:
    problem = toy_problem()
    low, high = problem.bounds
    for x in np.random.default_rng(4).uniform(low, high, (4, problem.dim)):
        top = gauss_newton(problem, x, None, 6)
        assert top.value >= problem.log_prob(x[None])[0]
        assert np.all((top.vector >= low) & (top.vector <= high))


def test_a_quick_climb_goes_on_as_far_as_a_thorough_one() -> None:
    """From noise that is much too large; the surrogate's error is not small."""
    problem = toy_problem()
    assert problem.predict(problem.from_sampling(np.mean(problem.bounds, axis=0))).factor[0].any()
    start = problem.vector({**TRUTH, **NOISE})
    kinds = [i for i, name in enumerate(problem.names) if name.startswith("sd_")]
    start[kinds] = problem.bounds[1][kinds]
    quick, thorough = (gauss_newton(problem, start, None, quick=quick) for quick in (True, False))
    assert quick.value > float(problem.log_prob(start[None])[0]) + 50.0
    assert quick.value > thorough.value - 2.0


def test_a_promise_points_at_the_moment_of_a_step() -> None:
    values = {"event_1_at": 0.4, "event_1_step": 0.03, "event_2_at": 0.5, "event_2_step": 0.0}
    alone = concealing(3, ("sensor-events",), **values)
    wide = building(alone, ("sensor-events",))
    vector = wide.vector({**NEUTRAL, **TRUTH, **NOISE, "nu_noise": 20.0})
    at, step = (wide.names.index(name) for name in ("event_1_at", "event_1_step"))
    trials = np.tile(vector, (99, 1))
    trials[:, at], trials[:, step] = np.linspace(0.01, 0.99, 99), 0.01
    free = np.array([not name.startswith("event") for name in wide.names])
    row, gain, multiple, _ = promise(wide, vector, trials, free, 1)[0]
    assert trials[row, at] == pytest.approx(0.4, abs=0.011)
    assert gain > 20.0
    assert multiple == pytest.approx(3.0, rel=0.3)


def test_what_the_surrogate_does_not_know_is_not_searched() -> None:
    problem = dataclasses.replace(toy_problem(), sure_within_n=1e-9)
    vector = problem.vector({**TRUTH, **NOISE})
    assert problem.log_prob(vector[None])[0] == -np.inf
    assert np.isfinite(dataclasses.replace(problem, sure_within_n=1.0).log_prob(vector[None])[0])


def test_a_mechanism_that_does_nothing_gains_nothing() -> None:
    alone = concealing(2)
    base = fit_base(alone, 1, None)
    wide = building(alone, ("sensor-drift",))
    more = fit(("sensor-drift",), wide, base.theta, NEUTRAL, 1, None, KNOWN["sensor-drift"].whole_or_parts)
    assert more.log_evidence < base.log_evidence + 2.0


def allowing(amplitude: float) -> ModelError | None:
    """Errors of the toy whose factor has this sd; none of 0."""
    return ModelError(toy.MOTION, ToySurrogate().edges_s, amplitude) if amplitude else None


def test_a_mesh_that_is_off_by_a_factor_stays_inside_the_intervals() -> None:
    right = concealing(0)
    off = dataclasses.replace(right.binned, force_n=1.004 * right.binned.force_n)
    truth = right.surrogate.predict([list(TRUTH.values())]).mean[0].max()
    for allows, inside in ((False, False), (True, True)):
        skin = ToySurrogate(sd_n=1e-9)
        error = allowing(0.004 if allows else 0.0)
        alone = dataclasses.replace(right, binned=off, surrogate=skin, model_error=error)
        found = resample(fit_base(alone, 1, None), find_shear(alone), 1)
        force = skin.predict(found.draws[:, : len(TRUTH)]).mean.max(axis=1)
        low, high = np.quantile(force, [0.05, 0.95])
        assert (low < truth < high) == inside, (low, truth, high)


def test_draws_are_the_same_however_often_it_is_asked_whether_they_do(monkeypatch) -> None:
    alone = concealing(0)
    base, shear = fit_base(alone, 1, None), find_shear(alone)

    def drawn(legs: tuple[int, ...], effective: float) -> np.ndarray:
        monkeypatch.setattr("bayeskin.mismatch.resample.LEGS", legs)
        monkeypatch.setattr("bayeskin.mismatch.resample.LIMITS", Limits(effective, 5.0, 1.1))
        return resample(base, shear, 1).draws

    whole = drawn((400,), np.inf)
    np.testing.assert_array_equal(drawn((200, 400), np.inf), whole)
    assert 0 < len(drawn((200, 400), 50.0)) < len(whole)


class Unsure(ToySurrogate):
    """Claims an error of one more shape (m,)."""

    def __init__(self, shape: np.ndarray) -> None:
        super().__init__()
        self._shape = shape

    def predict(self, theta):
        found = super().predict(theta)
        more = np.broadcast_to(self._shape[None, :, None], (*found.mean.shape, 1))
        return dataclasses.replace(found, factor=np.concatenate([found.factor, more], axis=2))


def test_a_set_of_which_the_surrogate_is_unsure_does_not_count() -> None:
    alone = concealing(0, ("viscous-drag",), drag=30.0)
    lucky = Unsure(alone.binned.force_n - toy_problem(0).binned.force_n)

    def build(names: Sequence[str]) -> LogPosterior:
        these = building(alone, names)
        if "sensor-drift" not in names:
            return these
        return dataclasses.replace(these, surrogate=dataclasses.replace(these.surrogate, inner=lucky))

    known = {name: KNOWN[name] for name in ("viscous-drag", "sensor-drift")}
    found = search(build, known, 1)
    assert ("sensor-drift",) in found.unsure
    assert found.unsure["sensor-drift",].log_evidence > found.base.log_evidence
    assert found.best.names == ("viscous-drag",)
    assert found.probability(["sensor-drift"]) == 0.0


def test_a_set_that_something_else_refutes_does_not_count() -> None:
    steps = {"event_1_at": 0.3, "event_1_step": 0.03, "event_2_at": 0.7, "event_2_step": -0.04}
    alone = concealing(0, ("sensor-events",), **steps)
    known = {name: KNOWN[name] for name in ("sensor-events", "viscous-drag")}

    def build(names: Sequence[str]) -> LogPosterior:
        return building(alone, names)

    assert search(build, known, 1).best.names == ("sensor-events",)
    found = search(build, known, 1, refuted=lambda one: "sensor-events" in one.names)
    assert not any("sensor-events" in names for names in found.fits)
    assert found.unsure["sensor-events",].log_evidence > found.base.log_evidence


class Wrong(ToySurrogate):
    """Off by some percent of the force and of the slopes, and sure of itself."""

    def predict(self, theta):
        theta = np.atleast_2d(np.asarray(theta, dtype=float))
        found = super().predict(np.clip(theta * 1.04, self.space.lower, self.space.upper))
        return dataclasses.replace(found, mean=0.9 * found.mean, factor=0.0 * found.factor)


def test_the_full_model_s_own_maximum_is_found_with_a_surrogate_s_wrong_slopes() -> None:
    right = dataclasses.replace(concealing(0, ("force-offset",), F0=-0.04), noise_priors=QUIET)
    right = building(right, ("force-offset",))
    wrong = dataclasses.replace(right, surrogate=dataclasses.replace(right.surrogate, inner=Wrong()))
    truth = [*TRUTH.values(), -0.04]
    noise = [2e-3] * (right.dim - len(truth) - 2) + [0.5, 20.0]
    start = gauss_newton(wrong, np.clip(right.to_sampling([*truth, *noise]), *right.bounds), None).vector
    sure = dataclasses.replace(right.surrogate, inner=ToySurrogate(sd_n=1e-9))
    best = gauss_newton(dataclasses.replace(right, surrogate=sure), start, None)
    made = []

    def force(theta):
        return right.surrogate.predict([theta[name] for name in right.surrogate.space.names]).mean[0]

    def full(theta, changes):
        made.append(theta)
        moved = [force({**theta, name: theta[name] + 1e-4 * by}) for name, by in changes.items()]
        return force(theta), (np.array(moved) - force(theta)).T / 1e-4

    found, corrected = fit_full(wrong, wrong.named(wrong.from_sampling(start)), full, ("F0",), 12, 1)
    assert corrected.inner is wrong.surrogate
    assert len(corrected.runs) == len(made)
    assert found.runs == len(made)
    assert found.gained > 1.0
    assert best.value - ENOUGH < found.value < best.value + 0.1
    np.testing.assert_allclose(found.force_n, force(found.theta), atol=1e-6)
    assert not found.mesh_n.any()


def test_a_full_fit_has_in_its_force_what_its_mesh_is_wrong_by() -> None:
    """The full model pulls two hundredths too hard, its parameters held: the recording shows that."""
    alone = dataclasses.replace(concealing(0), noise_priors=QUIET, model_error=allowing(0.02))
    noise = {f"sd_{kind}": 2e-3 for kind in ("rest", "load", "hold", "unload")}
    start = {**TRUTH, **noise, "tau_noise": 0.5, "nu_noise": 50.0}
    right = alone.surrogate.predict([TRUTH[n] for n in alone.surrogate.space.names]).mean[0]
    found, _ = fit_full(alone, start, lambda theta, changes: (1.02 * right, None), (), 1, 1)
    np.testing.assert_allclose(found.force_n, right, atol=2e-3)
    np.testing.assert_allclose(found.force_n - found.mesh_n, 1.02 * right)


@pytest.mark.parametrize(("of_sd", "there"), [(2.0, False), (30.0, True)])
def test_what_is_allowed_for_takes_up_no_more_than_is_believed_of_it(of_sd: float, there: bool) -> None:
    """A force that bends with displacement as a mesh's error does, by so many sd of what that may be."""
    alone = concealing(0)
    allowed = dataclasses.replace(alone, surrogate=Sure(alone.surrogate), model_error=allowing(0.01))
    factor = allowed.predict([TRUTH[n] for n in alone.surrogate.space.names]).factor[0]
    bend = 2  # column of the factor: `Sure` has one, of no error, and the scale is the next
    binned = dataclasses.replace(alone.binned, force_n=alone.binned.force_n + of_sd * factor[:, bend])
    latent = np.zeros(factor.shape[1])
    latent[bend] = min(of_sd, 3.0)
    off = dataclasses.replace(allowed, binned=binned)
    at = Fit((), off, {**TRUTH, **NOISE}, 0.0, 0.0, 1e-6 * np.eye(off.dim), latent)
    assert (locate(at, at.theta, 1).chance < 0.01) == there
    np.testing.assert_allclose(at.force_n, at.mean_n + factor @ latent, atol=1e-9)
    assert np.max(np.abs(at.force_n - at.mean_n)) > 1e-3


def test_a_mismatch_is_located_beside_the_run_and_not_beside_what_the_surrogate_might_be() -> None:
    """A surrogate so unsure that its error could take up all that the run leaves."""
    alone = dataclasses.replace(concealing(0), noise_priors=QUIET)
    noise = {f"sd_{kind}": 2e-3 for kind in ("rest", "load", "hold", "unload")}
    start = {**TRUTH, **noise, "tau_noise": 0.5, "nu_noise": 50.0}
    right = alone.surrogate.predict([TRUTH[n] for n in alone.surrogate.space.names]).mean[0]
    full, corrected = fit_full(alone, start, lambda theta, changes: (0.8 * right, None), (), 1, 1)
    unsure = fit_near((), dataclasses.replace(alone, surrogate=corrected), full.theta, None)
    there = at_run(
        dataclasses.replace(unsure, log_posterior=dataclasses.replace(alone, surrogate=Sure(corrected))), full
    )
    np.testing.assert_allclose(there.force_n, full.force_n, atol=1e-9)
    assert {name: there.theta[name] for name in TRUTH} == pytest.approx(
        {name: full.theta[name] for name in TRUTH}
    )
    found = locate(there, noise | {"tau_noise": 0.5, "nu_noise": 50.0}, 1)
    np.testing.assert_allclose(found.residual_n, (alone.binned.force_n - full.force_n)[found.bins], atol=1e-9)


def test_a_full_fit_whose_runs_fail_keeps_what_it_has() -> None:
    alone = concealing(0)
    start = dict(
        zip(alone.names, [*TRUTH.values(), *[2e-3] * (alone.dim - len(TRUTH) - 2), 0.5, 20.0], strict=True)
    )
    assert fit_full(alone, start, lambda theta, changes: "did not converge", (), 5, 1) == "did not converge"
    made = []

    def once(theta, changes):
        made.append(theta)
        if len(made) > 1:
            return "did not converge"
        force = alone.surrogate.predict([theta[name] for name in alone.surrogate.space.names]).mean[0]
        return 1.2 * force, np.zeros((len(force), len(changes)))

    found, _ = fit_full(alone, start, once, (), 5, 1)
    assert found.gained == 0.0
    assert found.theta["E_c"] == pytest.approx(start["E_c"])


def test_without_slopes_of_its_own_the_full_model_is_fitted_with_the_surrogate_s() -> None:
    """The full model pulls a twentieth harder than the surrogate says, whose slopes are as much off."""
    alone = dataclasses.replace(concealing(0), noise_priors=QUIET)
    harder = np.array(alone.binned.force_n) * 1.05
    recorded = dataclasses.replace(alone, binned=dataclasses.replace(alone.binned, force_n=harder))
    noise = {f"sd_{kind}": 2e-3 for kind in ("rest", "load", "hold", "unload")}
    start = {**TRUTH, **noise, "tau_noise": 0.5, "nu_noise": 20.0, "E_c": 1.1 * TRUTH["E_c"]}

    def full(theta, changes):
        return 1.05 * alone.surrogate.predict([theta[n] for n in alone.surrogate.space.names]).mean[0], None

    answer = fit_full(recorded, start, full, (), 6, 1)
    assert not isinstance(answer, str)
    found, _ = answer
    at_truth = {**found.theta, **TRUTH}
    truth = dataclasses.replace(recorded, surrogate=Scaled(alone.surrogate, 1.05))
    assert found.value > float(truth.log_prob(truth.vector(at_truth)[None])[0]) - 0.5


def test_a_full_fit_that_is_not_worth_having_is_left_after_two_runs() -> None:
    """The full model's cutis stiffens with the cube of what the surrogate thinks, so that runs are many."""
    alone = dataclasses.replace(concealing(0), noise_priors=QUIET)
    noise = {f"sd_{kind}": 2e-3 for kind in ("rest", "load", "hold", "unload")}
    start = {**TRUTH, **noise, "tau_noise": 0.5, "nu_noise": 20.0, "E_c": 1.1 * TRUTH["E_c"]}

    def full(theta, changes):
        bent = {**theta, "E_c": TRUTH["E_c"] * (theta["E_c"] / TRUTH["E_c"]) ** 3}
        return alone.surrogate.predict([bent[n] for n in alone.surrogate.space.names]).mean[0], None

    answers = [fit_full(alone, start, full, (), 12, 1)]
    assert not isinstance(answers[0], str)
    whole = answers[0][0]
    answers += [
        fit_full(alone, start, full, (), 12, 1, at_least=at_least)
        for at_least in (whole.value - 50.0, whole.value + 50.0)
    ]
    assert [one[0].runs for one in answers if not isinstance(one, str)] == [whole.runs, whole.runs, 2]
    assert whole.runs > 2


def test_a_full_fit_that_leaves_much_settles_for_what_much_is() -> None:
    """Nats of a residual of many times the noise are many times as many."""
    normal = dataclasses.replace(QUIET, nu=(50.0, 100.0))
    alone = dataclasses.replace(concealing(0), noise_priors=normal)
    noise = {f"sd_{kind}": 6e-3 for kind in ("rest", "load", "hold", "unload")}
    start = {**TRUTH, **noise, "tau_noise": 0.5, "nu_noise": 50.0, "E_c": 1.05 * TRUTH["E_c"]}
    waves = 0.1 * np.sin(np.arange(len(alone.binned.force_n)))

    def full(theta, changes):
        return alone.surrogate.predict([theta[n] for n in alone.surrogate.space.names]).mean[0], None

    runs = []
    for left_n in (0.0 * waves, waves):
        force = np.array(alone.binned.force_n) + left_n
        recorded = dataclasses.replace(alone, binned=dataclasses.replace(alone.binned, force_n=force))
        answer = fit_full(recorded, start, full, (), 6, 1)
        assert not isinstance(answer, str)
        assert answer[0].settled
        runs.append(answer[0].runs)
    assert runs[0] > runs[1] == 1


@dataclasses.dataclass(frozen=True)
class Scaled(Wrapper):
    """A surrogate without error whose force is so many times another's."""

    factor: float

    def predict(self, theta):
        found = self.inner.predict(theta)
        return dataclasses.replace(
            found, mean=self.factor * found.mean, factor=0.0 * found.factor, diagonal=0.0 * found.diagonal
        )

    def predict_mean(self, theta):
        return self.predict(theta).mean


def test_a_subcutis_much_stiffer_than_the_cutis_is_not_believed() -> None:
    problem = dataclasses.replace(toy_problem(), excludes=soft_on_stiff)
    for ratio, possible in ((1.9, True), (2.1, False)):
        theta = {**TRUTH, **NOISE, "E_c": TRUTH["E_s"] / ratio}
        assert np.isfinite(problem.log_prob(problem.vector(theta)[None])[0]) == possible
    line = line_problem()
    assert np.isfinite(dataclasses.replace(line, excludes=soft_on_stiff).log_prob(sum(line.bounds)[None] / 2))


def test_an_error_that_the_surrogate_denies_is_held_by_its_spring() -> None:
    problem = line_problem()
    slope = 0.01 * problem.surrogate.columns[1]
    binned = dataclasses.replace(problem.binned, force_n=40.0 * slope)
    near = tuple(dataclasses.replace(p, lower=-1e-4, upper=1e-4) for p in problem.surrogate.space.parameters)
    held = dataclasses.replace(problem, binned=binned, material=ParameterSpace(near))
    found = gauss_newton(held, np.mean(held.bounds, axis=0), None)
    information = np.sum(slope**2) / (0.05**2 + 1e-6)
    expected = (40.0 * information + 300.0) / (information + 101.0)
    np.testing.assert_allclose(found.latent, [expected], rtol=1e-3)
    # what is known of the line is what the density's curvature says, by differences along each parameter
    low, high = held.bounds
    step = np.diag(0.1 * (high - low))[:2]
    middle = np.mean(held.bounds, axis=0)
    middle[2:] = found.vector[2:]
    up, here, down = (held.log_prob(middle + sign * step) for sign in (1, 0, -1))
    at = gauss_newton(held, middle, None, 0)
    np.testing.assert_allclose(np.diag(at.information)[:2], (2 * here - up - down) / 0.01, rtol=0.02)


def test_starts_are_among_those_that_can_be() -> None:
    problem = dataclasses.replace(toy_problem(), excludes=soft_on_stiff)
    low, high = problem.bounds
    trials = np.random.default_rng(3).uniform(low, high, (400, problem.dim))
    ratio = problem.from_sampling(trials)[:, 1] / problem.from_sampling(trials)[:, 0]
    assert (ratio > 2.0).sum() > 50
    possible = trials[ratio <= 2.0]
    for one, other in zip(likely(problem, trials, 6), likely(problem, possible, 6), strict=True):
        np.testing.assert_array_equal(one, other)


def test_what_a_posterior_rules_out_is_part_of_what_it_is() -> None:
    plain = toy_problem()
    others = [
        dataclasses.replace(plain, excludes=soft_on_stiff),
        dataclasses.replace(plain, sure_within_n=1.0),
    ]
    assert len({one.identity["parameters"] for one in (plain, *others)}) == 3


def test_a_prior_without_a_skin_that_can_be_is_refused() -> None:
    alone = dataclasses.replace(toy_problem(), excludes=lambda space, theta: np.ones(len(theta), dtype=bool))
    with pytest.raises(InputError, match="none but skins that a diagnosis rules out"):
        fit_base(alone, 1, None)


def test_a_phase_is_predicted_by_a_fit_without_it() -> None:
    """A hold in which all pulls harder: the whole fit leans toward it, one without that hold does not."""
    alone = dataclasses.replace(concealing(0), noise_priors=QUIET)
    holds = [i for i, phase in enumerate(alone.binned.phases) if phase.kind == "hold"]
    other = np.where(alone.binned.phase == holds[-1], 1.1, 1.0) * alone.binned.force_n
    alone = dataclasses.replace(alone, binned=dataclasses.replace(alone.binned, force_n=other))
    base = fit_base(alone, 1, None)
    errors, bins = errors_left_out(base, None), alone.chain.bins
    of_hold = alone.binned.phase[bins] == holds[-1]
    left_in = (alone.binned.force_n - base.force_n)[bins][of_hold]
    assert np.mean(errors[of_hold]) > np.mean(left_in) + 10e-3
    hold = alone.binned.phases[holds[-1]]
    spans = ((float(alone.binned.edges_s[0]), float(alone.binned.edges_s[-1])),)
    part = dataclasses.replace(alone, fit_windows=without(spans, hold.start_s, hold.end_s))
    apart = fit_near((), part, base.theta, None)
    np.testing.assert_allclose(errors[of_hold], (other - apart.force_n)[bins][of_hold], atol=5e-4)


@pytest.mark.parametrize(
    ("spans", "left"),
    [
        (((0.0, 10.0),), ((0.0, 3.0), (5.0, 10.0))),
        (((3.0, 5.0),), ()),
        (((0.0, 4.0), (6.0, 9.0)), ((0.0, 3.0), (6.0, 9.0))),
        (((6.0, 9.0),), ((6.0, 9.0),)),
    ],
)
def test_windows_lose_what_is_left_out(
    spans: tuple[tuple[float, float], ...], left: tuple[tuple[float, float], ...]
) -> None:
    assert without(spans, 3.0, 5.0) == left


def test_the_most_probable_error_of_a_surrogate_that_knows_nothing_is_found() -> None:
    """Beside columns that are alike and huge their prior is lost to rounding in a normal equation."""
    rng = np.random.default_rng(0)
    residual, column = rng.standard_normal((2, 400))
    for size in (1.0, 1e12):
        latent = surrogate_error(residual, size * np.repeat(column[:, None], 3, axis=1), 50.0)
        assert size * latent.sum() == pytest.approx(column @ residual / (column @ column), rel=0.1)
