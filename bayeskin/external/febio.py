"""Writes materials for FEBio.

FEBio's biphasic material has the same equations as the model of this package, apart from the compressibility
of the fluid and of the grains, which FEBio does not know. Its solid `neo-Hookean` has the same strain energy.
Its permeability is that of this package divided by the fluid's viscosity.

Source: FEBio User's Manual 4, sections on the materials "biphasic", "neo-Hookean" and "perm-const-iso".
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from xml.etree import ElementTree as ET


@dataclass(frozen=True)
class Biphasic:
    """One biphasic material.

    solid_fraction : volume fraction of the solid; poisson_ratio : of the drained solid
    permeability_m4_ns : hydraulic permeability [m^4/(N s)]
    """

    name: str
    solid_fraction: float
    young_pa: float
    poisson_ratio: float
    permeability_m4_ns: float


def febio_file(materials: Sequence[Biphasic], remark: str) -> bytes:
    """Returns an FEBio file with materials in SI units; remark : comment at the top of the file."""
    spec = ET.Element("febio_spec", version="4.0")
    spec.append(ET.Comment(f" {remark.replace('--', '-')} "))
    ET.SubElement(spec, "Module", type="biphasic")
    section = ET.SubElement(spec, "Material")
    for number, layer in enumerate(materials, 1):
        material = ET.SubElement(section, "material", id=str(number), name=layer.name, type="biphasic")
        _value(material, "phi0", layer.solid_fraction)
        solid = ET.SubElement(material, "solid", type="neo-Hookean")
        _value(solid, "E", layer.young_pa)
        _value(solid, "v", layer.poisson_ratio)
        permeability = ET.SubElement(material, "permeability", type="perm-const-iso")
        _value(permeability, "perm", layer.permeability_m4_ns)
    ET.indent(spec)
    return b'<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(spec, encoding="utf-8") + b"\n"


def _value(parent: ET.Element, name: str, value: float) -> None:
    """Adds an element that contains a number."""
    ET.SubElement(parent, name).text = f"{value:.10g}"
