"""Keys and answers of the proof, made up to be scored."""

from __future__ import annotations

from toys.quick_proof import THETA

from bayeskin.proof.scoring.judgement import CLEAR


def key(label: str, kind: str = "alone", size: float = 5.0, **more) -> dict:
    mechanisms = [] if kind in ("nothing", "outside") else label.split(" + ")
    base = {
        "label": label, "kind": kind, "mechanisms": mechanisms, "size": size, "floor_n": 2e-3,
        "windows": [(10.0, 20.0)], "theta": THETA, "values": {},
        "sizes": dict.fromkeys(mechanisms, 2e-3 * size),
    }  # fmt: skip
    return base | more


def said(*names: str, **more) -> dict:
    mechanisms = [{"name": name, "probability": 0.9, "group": [name], "parameters": {}} for name in names]
    verdict = "named" if names else "nothing-missing"
    return {"verdict": verdict, "mechanisms": mechanisms, "located": [], "fit": {"after": {}}} | more


def made_up() -> tuple[dict, dict]:
    fit = {
        "after": {
            "rmse_held_out": 2.5e-3,
            "theta": {"E_c": {"mean": 60e3, "sd": 1e3}, "E_s": {"mean": 30e3, "sd": 1e3}, "k_c": 1e-14},
        }
    }
    sure = said("force-offset", fit=fit, located=[{"t0": 10.0, "t1": 20.0}])
    sure["mechanisms"][0]["parameters"] = {"F0": {"mean": -0.05, "sd": 0.01, "unit": "N"}}
    off = said("sensor-drift")
    off["mechanisms"][0]["parameters"] = {"drift": {"mean": 1e-4, "sd": 1e-6, "unit": "N/s"}}
    pairs = [
        (key("nothing", "nothing", 0.0, windows=[]), said()),
        (key("nothing", "nothing", 0.0, windows=[]), said()),
        (key("nothing", "nothing", 0.0, windows=[]), said("sensor-drift")),
        (key("force-offset", values={"F0": -0.045}), sure),
        (key("sensor-drift", size=CLEAR, values={"drift": 2e-4}), off),
        (key("device-friction", size=12.0), said("viscous-drag")),
        (key("fluid-leakage", size=4.0), said()),
        (key("fluid-leakage", size=1.2), said()),
        (key("thick-arm", "outside", 6.0), said(verdict="unknown")),
        (key("peeling", "outside", 6.0), said("strain-stiffening")),
    ]
    numbered = {f"{i + 1:03d}": pair for i, pair in enumerate(pairs)}
    return {n: k for n, (k, _) in numbered.items()}, {n: a for n, (_, a) in numbered.items()}
