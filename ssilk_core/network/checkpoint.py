# SPDX-License-Identifier: Apache-2.0
"""Read and write model files: safetensors with everything that is needed to run, and the provenance in the header.

Nothing is unpickled. Tensors are named "scene.*" (the garment, its rig and the skeleton) or "model.*" (the
parameters). Each has the narrowest type that holds it. The header has one JSON document under "ssilk". Quantised
matrices are 16-bit integers, with their scales in "scale.model.*". A checksum covers everything; a file that another
program rewrote may lack it, and is read without a warning, on which nobody could act.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from .. import __version__
from ..errors import SsilkError, fail
from ..files import is_usd, replacing
from ..scene.assets import Character, Floats, Garment, Mesh, ProxyRig, Scene, Skeleton, SkinWeights
from ..scene.fabric_range import FabricRange, fabric_with, factors_of
from ..scene.fabrics import Fabric
from ..scene.family import BodyFamily
from . import fabrics as of_fabrics
from .bodies import SeenBodies, parted
from .fabrics import SeenFabrics
from .packing import dequantize, narrowest, quantize
from .parameters import Shapes, parameter_shapes
from .schemes import SCHEMES
from .settings import ModelConfig
from .tensors import pack_tensors, read_tensors

if TYPE_CHECKING:
    from .model.network import GarmentModel

FORMAT = 6  # of the models that ship; files of another are refused
HEADER_NAME = "ssilk"  # of the JSON document in the metadata
# The header's lists and tables, as empty values of their types (tuples for JSON lists).
HEADER: dict[str, Any] = {
    "joint_names": (), "proxy_names": (), "paths": {}, "config": {}, "fabric": {}, "provenance": {}, "hub": 0,
    "family": (), "body_meshes": (), "graded": False, "fabrics": {}, "scales": (),
}  # fmt: skip
WEIGHTS = ("scene.plain.weights", "scene.rig.weights")
ONE_FABRIC = (  # what is allowed, and what to do, where another fabric is asked of a model that knows none
    "it was trained for one fabric",
    "train it on with 'ssilk train --start-from MODEL --fabrics', or leave the fabric out",
)


@dataclass(frozen=True, eq=False)
class ModelFile:
    """The contents of a model file.

    Attributes:
        scene: garment, rig and skeleton (no body meshes).
        config: sizes of the network.
        fabric: material that the network was trained with, or that it was put on (`on_fabric`).
        joints: character joints in the descriptors, shape (J',).
        parameters: the network's tensors by name.
        provenance: seed, schedule, versions, hashes of the inputs and validation results.
        bodies: the family of bodies that it dresses, whose base the scene's is; None for that body alone.
        fabrics: what it knows of other fabrics than its own, as which it plays; None for that one alone.
    """

    scene: Scene
    config: ModelConfig
    fabric: Fabric
    joints: np.ndarray
    parameters: dict[str, np.ndarray]
    provenance: dict[str, Any] = field(default_factory=dict)
    bodies: SeenBodies | None = None
    fabrics: SeenFabrics | None = None

    def on_fabric(self, fabric: Fabric) -> ModelFile:
        """Return the model for a fabric of its range (`network.fabrics`), which its energies are then of as well.

        The network sees factors of its own fabric's properties, none beyond its range. Properties that it does not
        see stay those of its own fabric.

        Raises:
            SsilkError: it knows its own fabric alone, or none of this stretch model.
        """
        if self.fabrics is None:
            fail(self.scene.garment.mesh.path, f"fabric '{fabric.name}' for a model of one fabric", *ONE_FABRIC)
        factors = factors_of(self.fabric, fabric)
        biases = (
            self.fabrics.biases(self.parameters, self.fabrics.range.seen(factors)) if (factors != 1).any() else {}
        )
        fabric = fabric_with(self.fabric, factors, fabric.name)
        return replace(self, fabric=fabric, parameters={**self.parameters, **biases}, fabrics=None)

    def on_body(self, coordinates: Floats) -> ModelFile:
        """Return the model for one body of its family, at coordinates (K,) (`network.bodies`).

        Raises:
            SsilkError: these are no coordinates of its family.
        """
        where, coordinates = self.scene.garment.mesh.path, np.asarray(coordinates, np.float64)
        if self.bodies is None:
            fail(where, "a model of one body, put on one of a family", "it has no other", "leave coordinates out")
        size = self.bodies.family.bodies.size
        if coordinates.shape != (size,) or not np.isfinite(coordinates).all():
            found = f"coordinates {np.array2string(coordinates, precision=3, threshold=8)} of a body"
            fail(where, found, f"bodies of its family have {size} finite numbers each")
        if not coordinates.any():
            return self.on_base()
        scene = self.bodies.family.scene_at(self.scene, coordinates)
        parameters = {**self.parameters, **self.bodies.parameters(self.parameters, coordinates)}
        return replace(self, scene=scene, parameters=parameters, bodies=None)

    def on_base(self) -> ModelFile:
        """Return the model for the first body of its family."""
        return replace(self, bodies=None)

    def need_body(self) -> None:
        """Raise `SsilkError` for a model of a family that was put on no body: nothing plays it as it is."""
        if self.bodies is not None:
            names = self.bodies.family.bodies.names
            fail(
                self.scene.garment.mesh.path,
                f"a model of a family of bodies ({', '.join(names[:3])}{', ...' if len(names) > 3 else ''})",
                "what plays a model plays it on one body",
                "name a stage with that body, or from Python take ModelFile.on_body or on_base",
            )


def save_model(path: str | Path, model: ModelFile, *, pack: bool = False) -> None:
    """Write a model file completely or not at all.

    Args:
        path: the file, .safetensors.
        model: contents of the file.
        pack: store parameter matrices in 16 bits and skinning weights in single precision, which halves the size
            of the file. `benchmarks/precision.py` measures the effect on the result.
    """
    arrays = {name: narrowest(np.ascontiguousarray(value)) for name, value in _tensors(model).items()}
    words = {HEADER_NAME: json.dumps(_document(model))}
    with replacing(path) as temporary:
        temporary.write_bytes(pack_tensors(_packed(arrays) if pack else arrays, words))


def _tensors(model: ModelFile) -> dict[str, Any]:
    """Return a model's tensors by their names in a file."""
    scene = model.scene
    skeleton, mesh, rig = scene.character.skeleton, scene.garment.mesh, scene.rig
    return {
        "scene.skeleton.parents": skeleton.parents,
        "scene.skeleton.bind_transforms": skeleton.bind_transforms,
        "scene.skeleton.rest_transforms": skeleton.rest_transforms,
        "scene.mesh.points": mesh.points,
        "scene.mesh.faces": mesh.faces,
        "scene.mesh.polygon_counts": mesh.polygon_counts,
        "scene.mesh.polygon_indices": mesh.polygon_indices,
        "scene.classes": scene.classes,
        "scene.plain.indices": scene.lbs_skin.indices,
        "scene.plain.weights": scene.lbs_skin.weights,
        "scene.rig.parents": rig.parents,
        "scene.rig.bind_transforms": rig.bind_transforms,
        "scene.rig.indices": rig.skin.indices,
        "scene.rig.weights": rig.skin.weights,
        "joints": model.joints,
        **({} if mesh.uvs is None else {"scene.mesh.uvs": mesh.uvs}),
        **({} if mesh.stiffness is None else {"scene.mesh.stiffness": mesh.stiffness}),
        **({} if (sewn := scene.garment.sewn) is None else {"scene.mesh.sewn": sewn}),
        **{f"model.{name}": value for name, value in model.parameters.items()},
        **({} if model.bodies is None else model.bodies.stored().tensors()),
        **({} if model.fabrics is None else model.fabrics.tensors()),
    }


def _document(model: ModelFile) -> dict[str, Any]:
    """Return the JSON document of a model's header."""
    skeleton, mesh, rig = model.scene.character.skeleton, model.scene.garment.mesh, model.scene.rig
    return {
        "format": FORMAT,
        "ssilk": __version__,
        "joint_names": skeleton.joint_names,
        "proxy_names": rig.joint_names,
        "paths": {"skeleton": skeleton.path, "garment": mesh.path, "rig": rig.path},
        "config": asdict(model.config),
        "fabric": asdict(model.fabric),
        "provenance": model.provenance,
        **({} if (colour := model.scene.garment.colour) is None else {"colour": colour}),
        **({"graded": True} if model.scene.garment.graded else {}),
        **({"hub": skeleton.hub} if skeleton.hub else {}),
        **({} if model.bodies is None else _names(model.bodies.family.bodies)),
        **({} if model.fabrics is None else {"fabrics": model.fabrics.document()}),
        **({} if skeleton.placement is None else {"placement": skeleton.placement.tolist()}),
        **({} if skeleton.scales is None else {"scales": skeleton.scales.tolist()}),
    }


def _names(bodies: BodyFamily) -> dict[str, tuple[str, ...]]:
    return {"family": bodies.names, "body_meshes": bodies.meshes}


def _packed(tensors: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the tensors of a file with quantised matrices.

    Vectors keep their precision, because errors in beta accumulate over time.
    """
    weights = {name: tensors[name].astype(np.float32) for name in WEIGHTS}
    matrices = {
        name: quantize(value) for name, value in tensors.items() if name.startswith("model.") and value.ndim > 1
    }
    steps = {name: pair[0] for name, pair in matrices.items()}
    return {**tensors, **weights, **steps, **{f"scale.{name}": pair[1] for name, pair in matrices.items()}}


def load_model(path: str | Path, shapes: Callable[[ModelFile], Shapes] | None = None) -> ModelFile:
    """Read a model file.

    Args:
        path: the file, .safetensors.
        shapes: returns the shapes that its parameters must have; by default those of a `GarmentModel`.

    Raises:
        SsilkError: the file is missing, truncated, not a model file or of an unsupported format, or its parameters
            do not match the sizes in its header.
    """
    tensors, document = _read(Path(path))
    try:
        _need_header(document)
        model = _model_of(tensors, document)
        _need_fit(model, (shapes or _implied)(model))
        return model
    except SsilkError as error:
        raise SsilkError(f"{path}: the model cannot be used: {error}") from error
    except (KeyError, TypeError, ValueError) as error:
        first = str(error).partition("\n")[0]
        raise SsilkError(
            f"{path}: the model file is incomplete or inconsistent ({type(error).__name__}: {first}); "
            "train again or fetch the file again."
        ) from error


def _read(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    if not path.is_file():
        fail(str(path), "there is no such model file", "a file written by 'ssilk train' is needed")
    try:
        tensors, words = read_tensors(path, HEADER_NAME)
    except ValueError as error:
        if is_usd(path):
            fail(
                str(path),
                "this is a USD stage",
                "a model is a .safetensors file that 'ssilk train' wrote",
                "model and stage may have been swapped",
            )
        first = str(error).partition("\n")[0]
        raise SsilkError(
            f"{path}: this is not a safetensors file, or it is truncated or damaged ({first}); train again or fetch "
            "the file again."
        ) from error
    header = words.get(HEADER_NAME, "")
    if not header:
        fail(str(path), "a safetensors file without SSILK's header", "a file written by 'ssilk train' is needed")
    try:
        document = json.loads(header)
    except (TypeError, ValueError, RecursionError) as error:
        raise SsilkError(f"{path}: the model's header is damaged ({error}); train again.") from error
    found = document.get("format") if isinstance(document, dict) else None
    if found != FORMAT:
        fail(str(path), f"model format {found}", f"this version reads format {FORMAT}", "train it again")
    return tensors, document


def _need_header(document: dict[str, Any]) -> None:
    """Raise `TypeError` unless every value in a header has the type that `save_model` writes."""
    _need_types(document, HEADER)
    _need_types(document["config"], vars(ModelConfig()))
    _need_types(document["fabric"], vars(Fabric("")))
    members, meshes = (document.get(name, []) for name in ("family", "body_meshes"))
    for words in (document["joint_names"], document["proxy_names"], document["paths"].values(), members, meshes):
        _need_types(dict(enumerate(words)), dict.fromkeys(range(len(words)), ""))
    _need_types(document.get("fabrics", {}), {"low": (), "high": (), "presets": (), "points": ()})
    seed = document["provenance"].get("seed", 0)
    if type(seed) is not int or not -(2**63) <= seed < 2**63:  # shots store it in 64 bits
        raise TypeError(f"the seed {str(seed)[:40]!r} is not a whole number of 64 bits")
    colour = document.get("colour")
    if colour is not None:
        _need_types(dict(enumerate(colour)), dict.fromkeys(range(3), 0.0))
        if not (isinstance(colour, list) and len(colour) == 3 and np.isfinite(colour).all()):
            raise TypeError(f"the colour {str(colour)[:40]} is not three finite numbers")
    widths = document["config"].get("widths", [])
    _need_types(dict(enumerate(widths)), dict.fromkeys(range(len(widths)), 0))


def _need_types(values: Mapping[Any, object], likes: Mapping[Any, object]) -> None:
    """Raise `TypeError` unless values from JSON have the types of the values of the same names in `likes`."""
    for name, value in values.items():
        kind = type(likes.get(name, value))
        if type(value) not in {float: (int, float), tuple: (list,)}.get(kind, (kind,)):
            raise TypeError(f"{name!r} is {str(value)[:40]}, which is not of type {kind.__name__}")


def _model_of(tensors: dict[str, np.ndarray], document: dict[str, Any]) -> ModelFile:
    scene = _scene_of(tensors, document)
    joints, skeleton = tensors["joints"], scene.character.skeleton
    if not (joints.ndim == 1 and np.isin(joints, np.arange(skeleton.joint_count)).all()):
        fail(
            skeleton.path,
            f"descriptors of joints {joints.tolist()}",
            f"joints must lie in 0 to {skeleton.joint_count - 1}",
            "train again",
        )
    parameters, bodies = _parameters(tensors, scene.garment.mesh.path), None
    if "family" in document:
        bodies = SeenBodies.of(tensors, tuple(document["family"]), tuple(document["body_meshes"]))
        bodies.need_fit(skeleton, scene.garment.mesh.vertex_count, scene.rig.proxy_count, parameters)
    fabrics = SeenFabrics.of(tensors, document["fabrics"]) if "fabrics" in document else None
    if fabrics:
        fabrics.need_fit(parameters)
    return ModelFile(
        scene,
        ModelConfig(**document["config"]),
        Fabric(**document["fabric"]),
        joints.astype(np.int64),
        parameters,
        document["provenance"],
        bodies,
        fabrics,
    )


def _scene_of(tensors: dict[str, np.ndarray], document: dict[str, Any]) -> Scene:
    """Return the garment, rig and skeleton of a file as a scene."""
    paths = document["paths"]

    def skin(name: str, path: str) -> SkinWeights:
        return SkinWeights(path, tensors[f"scene.{name}.indices"], tensors[f"scene.{name}.weights"])

    skeleton = Skeleton(
        paths["skeleton"],
        tuple(document["joint_names"]),
        tensors["scene.skeleton.parents"],
        tensors["scene.skeleton.bind_transforms"],
        tensors["scene.skeleton.rest_transforms"],
        document.get("hub", 0),
        np.array(document["placement"], np.float64) if "placement" in document else None,
        scales=np.array(document["scales"], np.float64) if "scales" in document else None,
    )
    mesh = Mesh(
        paths["garment"],
        tensors["scene.mesh.points"],
        tensors["scene.mesh.faces"],
        tensors["scene.mesh.polygon_counts"],
        tensors["scene.mesh.polygon_indices"],
        tensors.get("scene.mesh.uvs"),
        tensors.get("scene.mesh.stiffness"),
    )
    rig = ProxyRig(
        paths["rig"],
        tuple(document["proxy_names"]),
        tensors["scene.rig.parents"],
        tensors["scene.rig.bind_transforms"],
        skin("rig", paths["rig"]),
    )
    colour = document.get("colour")
    if colour is not None:
        red, green, blue = (min(max(float(part), 0.0), 1.0) for part in colour)
        colour = red, green, blue
    sewn = tensors.get("scene.mesh.sewn")
    graded = document.get("graded", False)
    plain = skin("plain", paths["garment"])
    garment = Garment(mesh, plain, tensors["scene.classes"], colour=colour, sewn=sewn, graded=graded)
    return Scene(Character(paths["skeleton"], skeleton, ()), garment, rig)


def _parameters(tensors: dict[str, np.ndarray], where: str) -> dict[str, np.ndarray]:
    """Return the parameters of a file by name, dequantised if necessary."""
    stored = {name: value for name, value in tensors.items() if name.startswith("model.")}
    for name, value in stored.items():
        if value.dtype.kind == "i":
            stored[name] = dequantize(value, tensors[f"scale.{name}"])
        finite = np.isfinite(stored[name]).all()
        if not finite:
            fail(where, f"parameter '{name[6:]}' holds NaN or infinity", "all must be finite", "train again")
    return {name[6:]: value for name, value in stored.items()}


def _implied(model: ModelFile) -> Shapes:
    return parameter_shapes(model.scene, model.config, model.joints)


def _need_fit(model: ModelFile, expected: Shapes) -> None:
    """Raise `SsilkError` unless the parameters have the `expected` shapes."""
    found = {name: value.shape for name, value in model.parameters.items()}
    odd = next((name for name in {**expected, **found} if expected.get(name) != found.get(name)), "")
    if odd:
        fail(
            f"parameter '{odd}'",
            f"the model's parameters do not fit its header: shape {found.get(odd)}",
            f"{expected.get(odd)} is needed",
            "train again",
        )


def model_file(
    model: GarmentModel, fabric: Fabric, provenance: dict[str, Any], fabrics: FabricRange | None = None
) -> ModelFile:
    """Return a network as the contents of a model file; `fabrics` that it saw, where it saw any."""
    parameters = {name: value.detach().cpu().numpy() for name, value in model.state_dict().items()}
    bodies = seen = None
    if model.family is not None:
        parameters, columns = parted(parameters)
        bodies = SeenBodies(model.family, columns)
    if fabrics is not None:
        parameters, columns = of_fabrics.parted(parameters, state_inputs(model.config))
        seen = SeenFabrics(fabrics, columns)
    return ModelFile(model.scene, model.config, fabric, model.joints, parameters, provenance, bodies, seen)


def state_inputs(config: ModelConfig) -> int:
    """Return how many inputs of S come before its features of the pose."""
    return SCHEMES[config.scheme].states * config.latent


def network(file: ModelFile, scene: Scene | None = None) -> GarmentModel:
    """Build the network of a model file, on the file's scene or on one that also has the character's body.

    Raises:
        SsilkError: it is one of a family that was put on no body.
    """
    import torch

    from .model.network import GarmentModel

    file.need_body()
    model = GarmentModel(scene or file.scene, file.config, file.joints)
    model.load_state_dict({name: torch.from_numpy(value.copy()) for name, value in file.parameters.items()})
    return model.eval()
