"""Writes the materials of both layers of the skin for FEBio.

FEBio's biphasic material has the same equations as the model of this package, apart from the compressibility
of the fluid and of the grains, which FEBio does not know. Its solid `neo-Hookean` has the same strain energy.
Its permeability is that of this package divided by the fluid's viscosity.

Source: FEBio User's Manual 4, sections on the materials "biphasic", "neo-Hookean" and "perm-const-iso".
"""

from __future__ import annotations

from collections.abc import Mapping
from xml.etree import ElementTree as ET

from bayeskin.finite_element.problem import Constants

LAYERS = {"c": "cutis", "s": "subcutis"}  # by the letter that ends the names of their parameters


def febio_materials(theta: Mapping[str, float], remark: str) -> bytes:
    """Returns an FEBio file with the materials of both layers, in SI units.

    theta : E_c, E_s [Pa], k_c, k_s [m^2]; remark : comment at the top of the file
    """
    spec, fixed = ET.Element("febio_spec", version="4.0"), Constants()
    spec.append(ET.Comment(f" {remark.replace('--', '-')} "))
    ET.SubElement(spec, "Module", type="biphasic")
    materials = ET.SubElement(spec, "Material")
    for number, (letter, layer) in enumerate(LAYERS.items(), 1):
        ratio = theta.get(f"nu_{letter}", getattr(fixed, f"nu_{letter}"))
        porosity = getattr(fixed, f"porosity_{letter}")
        material = ET.SubElement(materials, "material", id=str(number), name=layer, type="biphasic")
        _value(material, "phi0", 1.0 - porosity)
        solid = ET.SubElement(material, "solid", type="neo-Hookean")
        _value(solid, "E", theta[f"E_{letter}"])
        _value(solid, "v", ratio)
        permeability = ET.SubElement(material, "permeability", type="perm-const-iso")
        _value(permeability, "perm", theta[f"k_{letter}"] / fixed.viscosity_pa_s)
    ET.indent(spec)
    return b'<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(spec, encoding="utf-8") + b"\n"


def _value(parent: ET.Element, name: str, value: float) -> None:
    """Adds an element that contains a number."""
    ET.SubElement(parent, name).text = f"{value:.10g}"
