# SPDX-License-Identifier: Apache-2.0
"""Physics materials of garments: both schemas, units, where they may stand, and what is not read."""

from __future__ import annotations

import numpy as np
import pytest
from pxr import Usd, UsdGeom
from ssilk_usd.reading.mesh import display_colour, read_mesh
from ssilk_usd.reading.surface import read_surface
from ssilk_usd.units import StageUnits
from ssilk_usd.writing.surface import write_surface

from ssilk_core.errors import SsilkError
from ssilk_core.scene.assets import SurfaceMaterial

MESH = """
        point3f[] points = [(0, 0, 0), (SIDE, 0, 0), (SIDE, SIDE, 0), (0, SIDE, 0)]
        int[] faceVertexCounts = [4]
        int[] faceVertexIndices = [0, 1, 2, 3]
"""
THIN = "float[] physics:thicknesses = [0.001]"


def stage(*, material: str = "", mesh: str = "", body: str = "", schema: str = "", meters=1.0, kilograms=1.0):
    """A square with sides of 2 m below a body, and the material bound to the body."""
    text = f"""#usda 1.0
(
    metersPerUnit = {meters}
    kilogramsPerUnit = {kilograms}
)
def Xform "Dress" (prepend apiSchemas = ["PhysicsDeformableBodyAPI"])
{{
    rel material:binding:physics = </Linen>
    {body}
    def Mesh "Cape"
    {{{MESH.replace("SIDE", str(2 / meters))}
        {mesh}
    }}
}}
def Material "Linen" {f'(prepend apiSchemas = ["{schema}"])' if schema else ""}
{{
    {material}
}}
"""
    found = Usd.Stage.CreateInMemory()
    found.GetRootLayer().ImportFromString(text)
    return found


def surface_of(found: Usd.Stage, path: str = "/Dress/Cape") -> SurfaceMaterial | None:
    prim = found.GetPrimAtPath(path)
    return read_surface(prim, read_mesh(prim, StageUnits.of(found).matrix))


@pytest.mark.parametrize(("meters", "kilograms"), [(1.0, 1.0), (0.01, 1.0), (0.01, 0.001)])
def test_the_proposal_in_any_units(meters, kilograms):
    per = {"pressure": kilograms / meters, "volume": kilograms / meters**3, "bend": kilograms * meters**2}
    material = f"""
    float physics:youngsModulus = {5e5 / per["pressure"]}
    float physics:poissonsRatio = 0.25
    float physics:density = {300 / per["volume"]}
    float physics:surfaceStretchStiffness = {60 / kilograms}
    float physics:surfaceShearStiffness = -inf
    float physics:surfaceBendStiffness = {2e-5 / per["bend"]}
    float physics:dynamicFriction = 0.4"""
    mesh = f"""float[] physics:thicknesses = [{6e-4 / meters}]
        uniform token physics:thicknesses:elementType = "constant" """
    found = surface_of(stage(material=material, mesh=mesh, meters=meters, kilograms=kilograms))
    assert found is not None and found.path.endswith(":/Linen") and found.others == ("physics:dynamicFriction",)
    said = (found.youngs_modulus, found.poissons_ratio, found.density, found.stretch, found.bend, found.thickness)
    assert said == pytest.approx((5e5, 0.25, 300, 60, 2e-5, 6e-4), rel=1e-5)
    assert found.shear is None and found.area_density is None


@pytest.mark.parametrize("meters", [1.0, 0.01])
def test_omniverse_states_moduli(meters):
    material = f"""
    float omniphysics:youngsModulus = {5e5 * meters}
    float omniphysics:density = {300 * meters**3}
    float omniphysics:surfaceThickness = {5e-4 / meters}
    float omniphysics:surfaceStretchStiffness = 0
    float omniphysics:surfaceShearStiffness = {4e4 * meters}
    float omniphysics:surfaceBendStiffness = {8e4 * meters}
    float physxDeformableMaterial:bendDamping = 0.1"""
    found = surface_of(stage(material=material, meters=meters))
    assert found is not None and found.others == ("physxDeformableMaterial:bendDamping",)
    said = (found.youngs_modulus, found.poissons_ratio, found.density, found.shear, found.bend, found.thickness)
    assert said == pytest.approx((5e5, 0.45, 300, 4e4 * 5e-4, 8e4 * 5e-4**3, 5e-4), rel=1e-5)
    assert found.stretch is None  # zero leaves it to E


def test_masses_go_before_densities_and_the_body_before_its_material():
    material, square = "float physics:youngsModulus = 1e5\nfloat physics:density = 300", 4.0
    assert surface_of(stage(material=material)).area_density is None
    assert surface_of(stage(material=material, body="float physics:density = 200")).density == 200
    body = "float physics:mass = 2"
    assert surface_of(stage(material=material, body=body)).area_density == pytest.approx(2 / square)
    mesh = 'float[] physics:masses = [1, 2, 3, 4]\nuniform token physics:masses:elementType = "point"'
    assert surface_of(stage(material=material, body=body, mesh=mesh)).area_density == pytest.approx(10 / square)


def test_the_mesh_may_say_it_itself_and_thicknesses_are_averaged():
    found = surface_of(stage(mesh="float physics:youngsModulus = 7\nfloat[] physics:thicknesses = [0.001, 0.003]"))
    assert found.youngs_modulus == 7 and found.thickness == pytest.approx(0.002)
    assert found.others == ("thickness that varies",)


def test_materials_of_rigid_things_and_of_looks_are_none_of_a_surface():
    assert surface_of(stage(material="float physics:density = 300\nfloat physics:dynamicFriction = 0.3")) is None
    named = stage(material="float physics:density = 300", schema="PhysicsSurfaceDeformableMaterialAPI")
    assert surface_of(named).density == 300


@pytest.mark.parametrize(("space", "prefix"), [("physics", "Physics"), ("omniphysics", "OmniPhysics")])
def test_a_material_of_volumes_is_none_of_a_surface(space, prefix):
    solid = {
        "material": f"float {space}:youngsModulus = 5e7\nfloat {space}:density = 1000",
        "schema": f"{prefix}VolumeDeformableMaterialAPI",
    }
    assert surface_of(stage(**solid)) is None
    found = surface_of(stage(**solid, mesh=THIN))
    assert (found.youngs_modulus, found.poissons_ratio, found.density) == (None, None, None)
    assert found.thickness and found.others == (f"{space}:density", f"{space}:youngsModulus")
    both = solid | {"schema": f'{solid["schema"]}", "PhysicsSurfaceDeformableMaterialAPI'}
    assert surface_of(stage(**both)).density == 1000


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"material": "float physics:youngsModulus = nan"}, "physics:youngsModulus: it is nan; a finite number"),
        ({"material": "float physics:stretchStiffness = -2"}, r"/Linen\.physics:stretchStiffness: it is -2; a fin"),
        ({"mesh": THIN, "body": "float physics:mass = inf"}, r"/Dress\.physics:mass: it is inf; a finite"),
        ({"material": "float omniphysics:poissonsRatio = 0.7"}, "omniphysics:poissonsRatio: it is 0.7; a number"),
        ({"material": "float physics:thickness = 0"}, "physics:thickness: it is 0; a finite, positive number"),
        ({"material": 'string physics:youngsModulus = "stiff"'}, "physics:youngsModulus: it is 'stiff'; a finite"),
        ({"mesh": "float[] physics:thicknesses = [1, -1]"}, "physics:thicknesses: number 1 of 2 is -1, counted"),
        ({"mesh": 'string[] physics:thicknesses = ["thin"]'}, r"thicknesses: it is \['thin'\]; finite, pos"),
    ],
)
def test_what_cannot_be_is_refused_in_one_sentence(wrong, words):
    with pytest.raises(SsilkError, match=f"{words}.* needed; correct it, or remove the attribute.$"):
        surface_of(stage(**wrong))


@pytest.mark.parametrize(("meters", "kilograms"), [(1.0, 1.0), (0.01, 0.001)])
def test_what_is_written_reads_back(meters, kilograms):
    told = SurfaceMaterial(
        path="a.usda:/A",
        thickness=7e-4,
        area_density=0.2,
        youngs_modulus=3e5,
        poissons_ratio=0.2,
        shear=9.0,
        bend=3e-5,
    )
    found = stage(meters=meters, kilograms=kilograms)
    prim = found.GetPrimAtPath("/Dress/Cape")
    write_surface(prim, prim.GetPath().GetParentPath().AppendChild("Cape_material"), told)
    assert UsdGeom.Mesh(prim) and found.GetPrimAtPath("/Dress/Cape_material")
    read = surface_of(found)
    assert read.density * read.thickness == pytest.approx(0.2)
    for name in ("thickness", "youngs_modulus", "poissons_ratio", "stretch", "shear", "bend"):
        assert np.allclose(getattr(read, name) or 0.0, getattr(told, name) or 0.0, rtol=1e-6), name


@pytest.mark.parametrize(
    ("authored", "found"),
    [
        ("color3f[] primvars:displayColor = [(1, 0, 0), (0, 1, 0)]", (0.5, 0.5, 0.0)),
        ("color3f[] primvars:displayColor = [(1, 0, 0), (0, 1, 0)]\n"
         "int[] primvars:displayColor:indices = [0, 0, 0, 1]", (0.75, 0.25, 0.0)),
        ("color3f primvars:displayColor = (0, 0, 1)", None),
        ("color4f[] primvars:displayColor = [(1, 0, 0, 1)]", None),
        ("float[] primvars:displayColor = [1, 0, 0]", None),
        ('string primvars:displayColor = "red"', None),
        ("color3f[] primvars:displayColor = []", None),
    ],
)  # fmt: skip
def test_a_colour_of_any_type_is_read_or_none(authored, found):
    stage = Usd.Stage.CreateInMemory()
    stage.GetRootLayer().ImportFromString(f'#usda 1.0\ndef Mesh "Cape"\n{{\n{authored}\n}}\n')
    assert display_colour(stage.GetPrimAtPath("/Cape")) == found
