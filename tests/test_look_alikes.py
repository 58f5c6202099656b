"""Look-alikes are stated once, and complete each other in the catalogue."""

from __future__ import annotations

from importlib import import_module

from bayeskin.mechanisms import catalogue

KNOWN = catalogue()


def stated(name: str) -> tuple[str, ...]:
    """Returns the look-alikes that a mechanism's own file states."""
    module = import_module(f"bayeskin.mechanisms.{name.replace('-', '_')}")
    return tuple(module.MECHANISM.look_alikes)


def test_each_pair_is_stated_in_one_file_only() -> None:
    pairs = [frozenset((name, other)) for name in KNOWN for other in stated(name)]
    assert len(pairs) == len(set(pairs))
    assert all(len(pair) == 2 for pair in pairs)


def test_the_catalogue_completes_both_of_a_pair() -> None:
    for name, mechanism in KNOWN.items():
        assert set(stated(name)) <= set(mechanism.look_alikes) <= set(KNOWN)
        assert all(name in KNOWN[other].look_alikes for other in mechanism.look_alikes)
        assert mechanism.group == (name, *mechanism.look_alikes, *mechanism.also_possible)


def test_a_mechanism_that_is_also_possible_is_no_look_alike() -> None:
    for mechanism in KNOWN.values():
        assert set(mechanism.also_possible) <= set(KNOWN) - set(mechanism.look_alikes)
    assert "device-friction" in KNOWN["force-offset"].group
    assert "force-offset" not in KNOWN["device-friction"].group
