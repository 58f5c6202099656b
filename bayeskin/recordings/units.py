"""Units of time, displacement and force: their factors to SI, and how laboratories spell them."""

from __future__ import annotations

import unicodedata

QUANTITIES = ("time", "displacement", "force")

UNITS: dict[str, dict[str, float]] = {
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "min": 60.0, "h": 3600.0},
    "displacement": {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "nm": 1e-9, "in": 0.0254},
    "force": {
        "N": 1.0, "kN": 1e3, "daN": 10.0, "cN": 1e-2, "mN": 1e-3, "uN": 1e-6,
        "gf": 9.80665e-3, "kgf": 9.80665, "lbf": 4.4482216152605,
    },
}  # fmt: skip

# Spellings are compared without accents, in lower case. MN is therefore read as mN: no skin test reaches a
# meganewton. A quantity has its own spellings, because the French mn is a minute of time.
_OTHER_SPELLINGS = {
    "time": {
        "s": "sec secs second seconds seconde secondes sek sekunde sekunden seg segundo segundos secondi 秒",
        "ms": "msec millisecond milliseconds",
        "us": "μs usec",
        "min": "mn mins minute minutes minuten minuto minutos minuti 分",
        "h": "hr hrs hour hours heure heures stunde stunden hora horas ore",
    },
    "displacement": {
        "m": "metre metres meter meters",
        "cm": "centimetre centimetres centimeter centimeters",
        "mm": "millimetre millimetres millimeter millimeters milimetro milimetros millimetri ミリ",
        "um": "μm micron microns micrometre micrometres micrometer micrometers mikrometer",
        "nm": "nanometre nanometer nanometres nanometers",
        "in": "inch inches pouce pouces zoll",
    },
    "force": {
        "N": "newton newtons ニュートン",
        "kN": "kilonewton kilonewtons",
        "daN": "decanewton",
        "cN": "centinewton",
        "mN": "millinewton millinewtons",
        "uN": "μn micronewton micronewtons",
        "gf": "g gram grams gramme grammes gramm",
        "kgf": "kg kp kilogram kilograms kilopond",
        "lbf": "lb lbs pound pounds",
    },
}


def plain(text: str) -> str:
    """Returns a text in lower case, without accents, with one sign for micro and without wide letters."""
    decomposed = unicodedata.normalize("NFKD", text)
    bare = "".join(c for c in decomposed if not unicodedata.combining(c) or c in "\u3099\u309a")
    return unicodedata.normalize("NFC", bare).lower().strip()


_SPELLINGS = {
    quantity: {plain(name): name for name in UNITS[quantity]}
    | {plain(word): name for name, words in others.items() for word in words.split()}
    for quantity, others in _OTHER_SPELLINGS.items()
}


def unit_of(text: str, quantity: str) -> str | None:
    """Returns the standard name of a unit of a quantity ("mm" for "Millimètres"), or None."""
    return _SPELLINGS[quantity].get(plain(text).rstrip("."))


def is_unit(text: str) -> bool:
    """Returns whether a text is a unit of time, displacement or force."""
    return any(unit_of(text, quantity) for quantity in QUANTITIES)
