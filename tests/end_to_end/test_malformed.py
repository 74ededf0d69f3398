# SPDX-License-Identifier: Apache-2.0
"""Malformed inputs to every command: one clear sentence, a non-zero exit, no traceback, and no file left behind."""

from __future__ import annotations

import json
import os
import resource
import shlex
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdSkel
from safetensors import safe_open
from safetensors.numpy import save_file

from ssilk_core.cli import main

Damage = Callable[[Path], object]

INSPECT = "inspect hero.usda --garment Skirt"
RIG = "rig hero.usda --garment Skirt -o new.usda"
TRAIN = "train rigged.usda --motions clip.usda -o new.safetensors TRAINING"
BAKE = "bake model.safetensors --stage rigged.usda --motion clip.usda -o new.usdc"
VERIFY = "verify shot.usda"
VIEW = "view shot.usda -o new.png"


@dataclass(frozen=True)
class Case:
    """A command that must fail: what is wrong, what it must say, and what was done to its files beforehand."""

    name: str
    command: str
    says: tuple[str, ...]
    damage: Damage = lambda folder: None
    code: int = 2


# --- ways to damage files -----------------------------------------------------------------------------------------


def edited(file: str, change: Callable[[Usd.Stage], object]) -> Damage:
    def damage(folder: Path) -> None:
        stage = Usd.Stage.Open(str(folder / file))
        change(stage)
        stage.GetRootLayer().Save()

    return damage


def attribute(file: str, prim: str, name: str, change: Callable[[np.ndarray], object]) -> Damage:
    """Replace an attribute's value by `change` of it."""

    def edit(stage: Usd.Stage) -> None:
        target = stage.GetPrimAtPath(prim).GetAttribute(name)
        value = target.Get(Usd.TimeCode.EarliestTime())
        changed = change(np.array(value))
        kind = type(value)
        target.Set(kind.FromNumpy(np.ascontiguousarray(changed)) if hasattr(kind, "FromNumpy") else kind(changed))

    return edited(file, edit)


def with_rows(rows: object, value: object) -> Callable[[np.ndarray], np.ndarray]:
    def change(array: np.ndarray) -> np.ndarray:
        array = array.copy()
        array[rows] = value
        return array

    return change


def joints(file: str, *names: str) -> Damage:
    return edited(file, lambda stage: stage.GetPrimAtPath("/Hero/Rig").GetAttribute("joints").Set(list(names)))


def without(file: str, prim: str) -> Damage:
    return edited(file, lambda stage: stage.RemovePrim(prim))


def text(file: str, words: str | bytes) -> Damage:
    return lambda folder: (folder / file).write_bytes(words if isinstance(words, bytes) else words.encode())


def truncated(file: str, share: float = 0.5) -> Damage:
    return lambda folder: os.truncate(folder / file, int((folder / file).stat().st_size * share))


def as_crate(file: str) -> Damage:
    """Write clip.usda as a truncated binary file."""

    def damage(folder: Path) -> None:
        Sdf.Layer.FindOrOpen(str(folder / "clip.usda")).Export(str(folder / file))
        truncated(file)(folder)

    return damage


def both(*damages: Damage) -> Damage:
    return lambda folder: [damage(folder) for damage in damages]


def folder_at(name: str) -> Damage:
    return lambda folder: (folder / name).mkdir()


def tensors(file: str, change: Callable[[dict, dict], object]) -> Damage:
    """Rewrite a safetensors file after `change` of its tensors and its JSON header."""

    def damage(folder: Path) -> None:
        with safe_open(folder / file, "numpy") as stream:
            values = {name: stream.get_tensor(name).copy() for name in stream.keys()}  # noqa: SIM118
            document = json.loads(stream.metadata()["ssilk"])
        change(values, document)
        save_file(values, folder / file, {"ssilk": json.dumps(document)})

    return damage


def second_garment(stage: Usd.Stage) -> None:
    Sdf.CopySpec(stage.GetRootLayer(), "/Hero/Skirt", stage.GetRootLayer(), "/Hero/Apron")


def second_hero(stage: Usd.Stage) -> None:
    Sdf.CopySpec(stage.GetRootLayer(), "/Hero", stage.GetRootLayer(), "/Villain")


def scaled_bind(stage: Usd.Stage) -> None:
    binds = stage.GetPrimAtPath("/Hero/Rig").GetAttribute("bindTransforms")
    binds.Set([Gf.Matrix4d().SetScale((1, 2, 1)), *list(binds.Get())[1:]])


def turned_bind(stage: Usd.Stage) -> None:
    """Turn the bind pose of the second joint by 90 degrees where it stands."""
    attribute = stage.GetPrimAtPath("/Hero/Rig").GetAttribute("bindTransforms")
    binds = list(attribute.Get())
    binds[1] = Gf.Matrix4d().SetRotate(Gf.Rotation((0, 1, 0), 90)) * binds[1]
    attribute.Set(binds)


def unheld_island(stage: Usd.Stage) -> None:
    """Add a triangle two metres off to the skirt."""
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/Hero/Skirt"))
    points = list(mesh.GetPointsAttr().Get())
    mesh.GetPointsAttr().Set([*points, (2, 1, 0), (2.1, 1, 0), (2, 1.1, 0)])
    mesh.GetFaceVertexCountsAttr().Set([*mesh.GetFaceVertexCountsAttr().Get(), 3])
    mesh.GetFaceVertexIndicesAttr().Set(
        [*mesh.GetFaceVertexIndicesAttr().Get(), *range(len(points), len(points) + 3)]
    )


def painted(classes: Callable[[int], list[int]]) -> Damage:
    def edit(stage: Usd.Stage) -> None:
        prim = stage.GetPrimAtPath("/Hero/Skirt")
        primvar = UsdGeom.PrimvarsAPI(prim).CreatePrimvar("ssilk:class", Sdf.ValueTypeNames.IntArray, "vertex")
        primvar.Set(classes(len(UsdGeom.Mesh(prim).GetPointsAttr().Get())))

    return edited("hero.usda", edit)


SKIRT, BODY, RIGGED = "/Hero/Skirt", "/Hero/Body", "/Hero/Rig"
POINTS, WEIGHTS, INDICES = "points", "primvars:skel:jointWeights", "primvars:skel:jointIndices"
THREE = ("Hips", "Hips/Spine", "Hips/Spine/Head")

STAGES = [
    Case("no such stage", "inspect nobody.usda", ("nobody.usda", "there is no such file")),
    Case("stage is a folder", "inspect folder.usda", ("folder.usda",), folder_at("folder.usda")),
    Case(
        "stage is garbage text", INSPECT, ("hero.usda", "cannot be read as USD"), text("hero.usda", "not usd at all")
    ),
    Case(
        "stage is garbage bytes",
        "inspect x.usdc",
        ("x.usdc", "cannot be read as USD"),
        text("x.usdc", bytes(range(256))),
    ),
    Case("stage is empty", INSPECT, ("hero.usda", "cannot be read as USD"), text("hero.usda", "")),
    Case("stage is truncated", RIG, ("hero.usda", "cannot be read as USD"), truncated("hero.usda")),
    Case("stage is no USD file", "inspect hero.txt", ("hero.txt",), text("hero.txt", "#usda 1.0")),
    Case("missing skeleton", RIG, ("hero.usda", "no SkelRoot with a Skeleton"), without("hero.usda", RIGGED)),
    Case("missing character", INSPECT, ("hero.usda", "no SkelRoot"), text("hero.usda", "#usda 1.0\n")),
    Case("skeleton without joints", RIG, ("/Hero/Rig", "no joints"), joints("hero.usda")),
    Case(
        "unordered joints",
        RIG,
        ("/Hero/Rig", "out of order"),
        joints("hero.usda", "Hips/Spine", "Hips", "Hips/Spine/Head"),
    ),
    Case(
        "cyclic joints",
        RIG,
        ("/Hero/Rig", "joint"),
        joints("hero.usda", "Hips", "Hips/Spine", "Hips/Spine/../../Hips"),
    ),
    Case("repeated joints", RIG, ("'Hips'", "is listed twice"), joints("hero.usda", "Hips", "Hips/Spine", "Hips")),
    Case(
        "bind count mismatch",
        INSPECT,
        ("/Hero/Rig", "3 bindTransforms for 2 joints"),
        joints("hero.usda", "Hips", "Hips/Spine"),
    ),
    Case("scaled bind", RIG, ("/Hero/Rig", "'Hips'", "scales"), edited("hero.usda", scaled_bind)),
    Case(
        "wrong rest pose",
        RIG,
        ("/Hero/Rig", "restTransforms"),
        edited(
            "hero.usda",
            lambda stage: UsdSkel.Skeleton(stage.GetPrimAtPath(RIGGED)).CreateRestTransformsAttr(
                [Gf.Matrix4d(0)] * 3
            ),
        ),
    ),
    Case(
        "NaN bind", RIG, ("/Hero/Rig", "NaN"), attribute("hero.usda", RIGGED, "bindTransforms", with_rows(1, np.nan))
    ),
    Case(
        "bad units",
        RIG,
        ("hero.usda", "metersPerUnit"),
        edited("hero.usda", lambda stage: stage.SetMetadata("metersPerUnit", 0.0)),
    ),
    Case("two characters", RIG, ("/Villain", "--root"), edited("hero.usda", second_hero)),
    Case("unknown root", f"{RIG} --root Nobody", ("'Nobody'", "--root")),
    Case("unknown wearer", BAKE.replace("safetensors", "safetensors:/Nobody"), ("'/Nobody'", "MODEL:/ROOT")),
    Case("unknown body", f"{RIG} --body Nobody", ("'Nobody'", "--body")),
    Case("unknown body to leave out", f"{RIG} --body ^Nobody", ("'Nobody'", "--body")),
    Case("missing body", RIG, ("/Hero", "no skinned body mesh"), without("hero.usda", BODY)),
]

MESHES = [
    Case(
        "NaN points",
        RIG,
        (SKIRT, "1 of 312 points", "NaN"),
        attribute("hero.usda", SKIRT, POINTS, with_rows(3, np.nan)),
    ),
    Case("NaN body", INSPECT, (BODY, "NaN"), attribute("hero.usda", BODY, POINTS, with_rows(3, np.inf))),
    Case(
        "empty garment",
        RIG,
        (SKIRT, "no points"),
        both(
            attribute("hero.usda", SKIRT, POINTS, lambda a: a[:0]),
            attribute("hero.usda", SKIRT, "faceVertexCounts", lambda a: a[:0]),
            attribute("hero.usda", SKIRT, "faceVertexIndices", lambda a: a[:0]),
        ),
    ),
    Case(
        "garment without faces",
        RIG,
        (SKIRT, "no faces"),
        both(
            attribute("hero.usda", SKIRT, "faceVertexCounts", lambda a: a[:0]),
            attribute("hero.usda", SKIRT, "faceVertexIndices", lambda a: a[:0]),
        ),
    ),
    Case(
        "counts and indices disagree",
        INSPECT,
        (SKIRT, "add up"),
        attribute("hero.usda", SKIRT, "faceVertexIndices", lambda a: a[:-2]),
    ),
    Case(
        "face of no point",
        INSPECT,
        (SKIRT, "outside 0 to 311"),
        attribute("hero.usda", SKIRT, "faceVertexIndices", with_rows(0, 999)),
    ),
    Case(
        "faces of two corners",
        INSPECT,
        (SKIRT, "fewer than three"),
        attribute("hero.usda", SKIRT, "faceVertexCounts", with_rows(0, 2)),
    ),
    Case(
        "zero-area faces",
        TRAIN,
        (SKIRT, "area"),
        attribute("rigged.usda", SKIRT, "faceVertexIndices", with_rows(slice(0, 3), [5, 5, 6])),
    ),
    Case(
        "flattened garment", TRAIN, (SKIRT, "area"), attribute("rigged.usda", SKIRT, POINTS, lambda a: a * 0 + a[:1])
    ),
    Case(
        "negative weights", TRAIN, (SKIRT, "negative"), attribute("rigged.usda", SKIRT, WEIGHTS, with_rows(0, -0.5))
    ),
    Case("negative body weights", RIG, (BODY, "negative"), attribute("hero.usda", BODY, WEIGHTS, with_rows(0, -1))),
    Case("NaN weights", TRAIN, (SKIRT, "NaN"), attribute("rigged.usda", SKIRT, WEIGHTS, with_rows(0, np.nan))),
    Case("weights of no joint", RIG, (BODY, "joint"), attribute("hero.usda", BODY, INDICES, with_rows(0, 7))),
    Case(
        "too few weights", RIG, (BODY, "257 values for 258"), attribute("hero.usda", BODY, WEIGHTS, lambda a: a[:-1])
    ),
    Case(
        "vertices without weight",
        RIG,
        (BODY, "no skinning weight"),
        attribute("hero.usda", BODY, WEIGHTS, with_rows(0, 0)),
    ),
    Case("garment held nowhere", RIG, (SKIRT, "rest nowhere"), edited("hero.usda", unheld_island)),
    Case("classes out of range", RIG, (SKIRT, "not 0, 1 or 2"), painted(lambda count: [3] * count)),
    Case("too few classes", RIG, (SKIRT, "311 vertex classes for 312"), painted(lambda count: [1] * (count - 1))),
    Case("all loose", RIG, (SKIRT, "pinned or tight"), painted(lambda count: [2] * count)),
    Case(
        "two garments",
        "rig hero.usda -o new.usda",
        ("hero.usda", "--garment"),
        both(painted(lambda count: [1] * count), edited("hero.usda", second_garment)),
    ),
    Case("no garment marked", "rig hero.usda -o new.usda", ("hero.usda", "--garment")),
    Case("unknown garment", "rig hero.usda --garment Hat -o new.usda", ("'Hat'", SKIRT)),
    Case("no such garment file", "rig hero.usda --garment hat.usda -o new.usda", ("hat.usda", "no such file")),
]

ANOTHER = ["Root", "Root/A", "Root/A/B", "Root/A/C"]
NO_SAMPLES = '#usda 1.0\ndef SkelAnimation "Clip" {}\n'


def one_frame(stage: Usd.Stage) -> None:
    for moved in (clip(stage).GetRotationsAttr(), clip(stage).GetTranslationsAttr()):
        for time in moved.GetTimeSamples()[1:]:
            moved.ClearAtTime(time)


def clip(stage: Usd.Stage) -> UsdSkel.Animation:
    return UsdSkel.Animation(stage.GetPrimAtPath("/Clip"))


MOTIONS = [
    Case("no such motion", "train rigged.usda --motions no.usda -o new.safetensors", ("no.usda", "no such file")),
    Case("no such motion to bake", BAKE.replace("clip", "no"), ("no.usda", "no such file")),
    Case(
        "motion of another skeleton",
        BAKE,
        ("/Clip", "another skeleton"),
        edited("clip.usda", lambda stage: clip(stage).GetJointsAttr().Set(ANOTHER[:3])),
    ),
    Case("motion without animation", BAKE, ("clip.usda", "SkelAnimation"), without("clip.usda", "/Clip")),
    Case("motion without samples", BAKE, ("/Clip",), text("clip.usda", NO_SAMPLES)),
    Case(
        "motion with too few rotations",
        BAKE,
        ("/Clip", "2 joints"),
        edited("clip.usda", lambda stage: clip(stage).GetRotationsAttr().Set([Gf.Quatf(1)] * 2, 5)),
    ),
    Case(
        "NaN motion",
        BAKE,
        ("/Clip", "NaN"),
        edited("clip.usda", lambda stage: clip(stage).GetTranslationsAttr().Set([Gf.Vec3f(np.nan)] * 3, 5)),
    ),
    Case(
        "zero quaternions",
        BAKE,
        ("/Clip", "zero quaternion"),
        edited("clip.usda", lambda stage: clip(stage).GetRotationsAttr().Set([Gf.Quatf(0)] * 3, 5)),
    ),
    Case(
        "scaled motion",
        BAKE,
        ("/Clip", "scaled"),
        edited("clip.usda", lambda stage: clip(stage).CreateScalesAttr([Gf.Vec3h(2)] * 3)),
    ),
    Case(
        "motion in other units",
        BAKE,
        ("/Clip", "metersPerUnit"),
        edited("clip.usda", lambda stage: UsdGeom.SetStageMetersPerUnit(stage, 0.01)),
    ),
    Case(
        "truncated motion",
        BAKE.replace("clip.usda", "cut.usdc"),
        ("cut.usdc", "cannot be read"),
        as_crate("cut.usdc"),
    ),
    Case(
        "empty folder of motions",
        TRAIN.replace("clip.usda", "none"),
        ("none", "holds no USD files"),
        folder_at("none"),
    ),
    Case("folder to bake", BAKE.replace("clip.usda", "none"), ("none", "file"), folder_at("none")),
    Case("one-frame motion to train on", TRAIN, ("clip.usda", "one frame"), edited("clip.usda", one_frame)),
]

OPTIONS = [
    Case("no verb", "", ("VERB",)),
    Case("unknown verb", "trian hero.usda", ("trian", "'train'")),
    Case("missing option", "train rigged.usda", ("ssilk train", "--motions")),
    Case("unknown option", f"{RIG} --magic", ("--magic",)),
    Case("unknown preset", f"{TRAIN} --preset lavish", ("--preset", "lavish", "one of draft, ")),
    Case("unknown fabric", f"{TRAIN} --fabric tweed", ("--fabric", "tweed", " silk, ")),
    Case("unknown setting", f"{TRAIN} --set magic=1", ("--set magic=1", "no such setting", "iterations", "latent")),
    Case("setting of the wrong type", f"{TRAIN} --set iterations=many", ("--set iterations=many: 'many' is", "int")),
    Case("setting without a value", f"{TRAIN} --set latent", ("--set latent: a name without a value", "NAME=VALUE")),
    Case("unknown scheme", f"{TRAIN} --set scheme=euler", ("'euler'", "spring_verlet")),
    Case("no iterations", f"{TRAIN} --set iterations=0", ("'iterations'", "0", "between 1 and")),
    Case("zero-length window", f"{TRAIN} --set window=0", ("window of 0 poses", "at least 3")),
    Case("window longer than the clip", f"{TRAIN} --set window=500", ("500", "--set window=")),
    Case("NaN rate", f"{TRAIN} --set learning_rate=nan", ("'learning_rate'", "nan", "between")),
    Case("infinite noise", f"{TRAIN} --set noise=inf", ("noise", "inf")),
    Case("negative rate", f"{TRAIN} --set learning_rate=-1", ("learning_rate", "-1")),
    Case("huge seed", f"{TRAIN} --set seed=99999999999999999999999", ("seed",)),
    Case("unknown property of the fabric", f"{TRAIN} --material silkiness=1", ("silkiness", "density")),
    Case("negative density", f"{TRAIN} --material density=-1", ("density", "-1")),
    Case("negative tightness", f"{RIG} --tightness -1", ("--tightness", "'-1' is not a number from 0 to 1")),
    Case("no roots", f"{RIG} --roots 0", ("--roots", "a whole number from 1 to 1000")),
    Case("negative proxies", f"{RIG} --proxies -3", ("--proxies", "a whole number from 0 to 1000")),
    Case("no such device to train", f"{TRAIN} --device abacus", ("--device abacus", "'cpu'")),
    Case("no such device to bake", f"{BAKE} --device abacus", ("--device abacus", "'cpu'")),
    Case("no such GPU", f"{TRAIN} --device cuda:77", ("--device cuda:77", "'cpu'")),
    Case("frame rate of zero", f"{BAKE} --fps 0", ("--fps", "a number from 0.01 to 10000")),
    Case("negative frame rate", f"{BAKE} --fps -24", ("--fps", "a number from 0.01 to 10000")),
    Case("frame rate that is no number", f"{BAKE} --fps nan", ("--fps", "a number from 0.01 to 10000")),
    Case("frame rate in words", f"{BAKE} --fps film", ("--fps", "film")),
    Case("film at no rate", "view shot.usda -o new.mp4 --fps 0", ("--fps", "a number from 0.01 to 10000")),
    Case("film at a NaN rate", "view shot.usda -o new.mp4 --fps nan", ("--fps", "a number from 0.01 to 10000")),
    Case("picture of nonsense size", f"{VIEW} --size big", ("--size big", "WIDTHxHEIGHT")),
    Case("picture of no size", f"{VIEW} --size 0x0", ("0 x 0 pixels", "16")),
    Case("enormous picture", f"{VIEW} --size 999999x999999", ("999999 pixels", "8192")),
    Case("sheet without columns", f"{VIEW} --columns 0", ("--columns", "a whole number from 1 to 100")),
    Case("view from nowhere", f"{VIEW} --azimuth nan", ("--azimuth", "not a number from -3600 to 3600")),
]

FILES = [
    Case("rig with another suffix", RIG.replace("new.usda", "new.fbx"), ("new.fbx", ".usdc")),
    Case("model with another suffix", TRAIN.replace("new.safetensors", "new.pt"), ("new.pt", ".safetensors")),
    Case("shot with another suffix", BAKE.replace("new.usdc", "new.abc"), ("new.abc", ".usdc")),
    Case("repair with another suffix", f"{INSPECT} --fix new.obj", ("new.obj", ".usdc")),
    Case("picture with another suffix", "view shot.usda -o new.gif", ("new.gif", ".png")),
    Case("rig over its stage", RIG.replace("new.usda", "hero.usda"), ("hero.usda", "never overwritten")),
    Case("shot over its stage", BAKE.replace("new.usdc", "rigged.usda"), ("rigged.usda", "never overwritten")),
    Case("shot over its motion", BAKE.replace("new.usdc", "./clip.usda"), ("clip.usda", "never overwritten")),
    Case("output is a folder", RIG, ("new.usda", "folder"), folder_at("new.usda")),
    Case(
        "file in place of the output's folder",
        RIG.replace("new.usda", "clip.usda/new.usda"),
        ("clip.usda: this is a file", "the output is a folder"),
    ),
    Case(
        "model in an unwritable folder",
        TRAIN.replace("new.saf", "/proc/new.saf"),
        ("/proc/new.safetensors", "cannot be written"),
    ),
    Case(
        "shot in an unwritable folder",
        BAKE.replace("new.usdc", "/proc/new.usdc"),
        ("/proc/new.usdc", "cannot be written"),
    ),
    Case(
        "picture in an unwritable folder",
        VIEW.replace("new.png", "/proc/new.png"),
        ("/proc/new.png", "cannot be written"),
    ),
    Case("name longer than any file's", RIG.replace("new", "n" * 300), ("nnn.usda", "File name too long")),
]


def state_header(words: str) -> Damage:
    def damage(folder: Path) -> None:
        path = folder / "model.resume.safetensors"
        save_file({"x": np.zeros(3)}, path, {"ssilk_state": words})

    return damage


RESUME = "train rigged.usda --motions clip.usda -o model.safetensors --resume TRAINING"
MODELS = [
    Case("resumed without a state", f"{TRAIN} --resume", ("new.resume.safetensors", "no training to resume")),
    Case(
        "resumed with other settings",
        f"{RESUME} --set learning_rate=1e-3",
        ("model.resume", "another learning_rate", "same"),
    ),
    Case(
        "resumed on other motion",
        RESUME,
        ("model.resume", "another clip.usda"),
        edited("clip.usda", lambda stage: clip(stage).GetTranslationsAttr().ClearAtTime(39)),
    ),
    Case("truncated state", RESUME, ("model.resume", "damaged"), truncated("model.resume.safetensors")),
    Case("foreign state", RESUME, ("model.resume", "damaged"), state_header("{}")),
    Case("damaged state", RESUME, ("model.resume", "damaged"), state_header("{")),
    Case("state of another version", RESUME, ("format 9", "without --resume"), state_header('{"format": 9}')),
    Case("no such model", BAKE.replace("model.", "no."), ("no.safetensors", "no such model")),
    Case(
        "model is a folder",
        BAKE.replace("model.", "no."),
        ("no.safetensors", "a folder, and no model file"),
        folder_at("no.safetensors"),
    ),
    Case("truncated model", BAKE, ("model.safetensors", "truncated"), truncated("model.safetensors")),
    Case("empty model", BAKE, ("model.safetensors", "not a safetensors"), text("model.safetensors", "")),
    Case(
        "foreign model",
        BAKE,
        ("model.safetensors", "without SSILK's header"),
        lambda folder: save_file({"weight": np.zeros(3)}, folder / "model.safetensors"),
    ),
    Case(
        "model is a stage",
        "bake rigged.usda --stage rigged.usda --motion clip.usda -o new.usdc",
        ("rigged.usda", "this is a USD stage", "may have been swapped"),
    ),
    Case(
        "model of another format",
        BAKE,
        ("model.safetensors", "format 99"),
        tensors("model.safetensors", lambda values, document: document.update(format=99)),
    ),
    Case(
        "model without config",
        BAKE,
        ("model.safetensors", "incomplete"),
        tensors("model.safetensors", lambda values, document: document.pop("config")),
    ),
    Case(
        "model without points",
        BAKE,
        ("model.safetensors", "scene.mesh.points"),
        tensors("model.safetensors", lambda values, document: values.pop("scene.mesh.points")),
    ),
    Case(
        "model with NaN parameters",
        BAKE,
        ("model.safetensors", "NaN"),
        tensors(
            "model.safetensors",
            lambda values, document: values["model.decoder.shapes"].fill(np.nan),
        ),
    ),
    Case(
        "model whose provenance is a list",
        BAKE,
        ("model.safetensors", "'provenance' is [1]"),
        tensors("model.safetensors", lambda values, document: document.update(provenance=[1])),
    ),
    Case(
        "model of mismatched sizes",
        BAKE,
        ("model.safetensors", "do not fit"),
        tensors("model.safetensors", lambda values, document: document["config"].update(latent=9)),
    ),
    Case(
        "model with a broken mesh",
        BAKE,
        ("model.safetensors", "outside 0 to"),
        tensors("model.safetensors", lambda values, document: values["scene.mesh.faces"].fill(4000)),
    ),
    Case(
        "model with wrong joints",
        BAKE,
        ("model.safetensors", "joints"),
        tensors("model.safetensors", lambda values, document: values.update(joints=np.full(3, 99))),
    ),
    Case(
        "model of cyclic joints",
        BAKE,
        ("model.safetensors", "own ancestor"),
        tensors("model.safetensors", lambda values, document: values["scene.skeleton.parents"].fill(1)),
    ),
    Case(
        "model on another character",
        BAKE,
        ("rigged.usda", "Hips/Spine", "trained with"),
        both(
            joints("rigged.usda", "A", "A/B", "A/B/C"),
            without("rigged.usda", SKIRT),
            lambda folder: bare_binds(folder),
        ),
    ),
    Case(
        "model on a taller character",
        BAKE,
        ("rigged.usda", "bound 1", "trained with"),
        attribute("rigged.usda", RIGGED, "bindTransforms", lambda a: with_rows((1, 3, 1), 2.5)(a)),
    ),
    Case(
        "model on a character of other axes",
        BAKE,
        ("rigged.usda", "'Hips/Spine' is bound at another rotation", "trained with", "rig --onto"),
        edited("rigged.usda", turned_bind),
    ),
]


def bare_binds(folder: Path) -> None:
    attribute("rigged.usda", RIGGED, "bindTransforms", lambda a: a[:3])(folder)
    attribute("rigged.usda", RIGGED, "restTransforms", lambda a: a[:3])(folder)


def animation(stage: Usd.Stage) -> UsdSkel.Animation:
    return UsdSkel.Animation(stage.GetPrimAtPath("/Hero/Animation"))


def other_weights(stage: Usd.Stage) -> None:
    """Give one frame other weights, within an extent that holds them."""
    animation(stage).GetBlendShapeWeightsAttr().Set([0.0] * 5, 7)
    stage.GetPrimAtPath("/Hero").GetAttribute("extent").Set([(-9, -9, -9), (9, 9, 9)], 7)


SHOTS = [
    Case("no such shot", "verify no.usda", ("no.usda", "no such shot")),
    Case("shot that is no shot", "verify clip.usda", ("clip.usda", "does not say how it was baked")),
    Case("garbage shot", VERIFY, ("shot.usda", "cannot be read"), text("shot.usda", "garbage")),
    Case("truncated shot", VERIFY, ("shot.usda", "cannot be read"), truncated("shot.usda")),
    Case(
        "shot whose model is gone",
        VERIFY,
        ("shot.usda", "model.safetensors", "--model"),
        lambda folder: (folder / "model.safetensors").unlink(),
    ),
    Case(
        "shot whose motion is gone",
        VERIFY,
        ("shot.usda", "clip.usda", "--motion"),
        lambda folder: (folder / "clip.usda").unlink(),
    ),
    Case(
        "tampered weights",
        VERIFY,
        ("shot.usda", "time code 7", "allowed"),
        edited("shot.usda", other_weights),
        3,
    ),
    Case(
        "weights above one",
        VERIFY,
        ("shot.usda", "checks fail"),
        edited("shot.usda", lambda stage: animation(stage).GetBlendShapeWeightsAttr().Set([2.0] * 5, 7)),
        3,
    ),
    Case(
        "missing sample",
        VERIFY,
        ("shot.usda", "checks fail"),
        edited(
            "shot.usda",
            lambda stage: animation(stage).GetRotationsAttr().ClearAtTime(7),
        ),
        3,
    ),
    Case(
        "tampered rest points",
        VERIFY,
        ("shot.usda", "/Hero"),
        attribute("shot.usda", SKIRT, POINTS, lambda points: points * 0),
        3,
    ),
    Case("view of nothing", "view no.usda -o new.png", ("no.usda", "no such file")),
    Case("view of a motion", "view clip.usda -o new.png", ("clip.usda", "no visible mesh")),
    Case("view of shots that differ", "view shot.usda hero.usda -o new.png", ("frames", "same length")),
]

CASES = [*STAGES, *MESHES, *MOTIONS, *OPTIONS, *FILES, *MODELS, *SHOTS]


def contents(folder: Path) -> dict[str, bytes | None]:
    """Everything beneath a folder: bytes of files, None for folders."""
    return {str(path.relative_to(folder)): None if path.is_dir() else path.read_bytes() for path in folder.rglob("*")}


def words(command: str, toy: Any) -> list[str]:
    before, _, after = command.partition("TRAINING")
    return [*shlex.split(before), *(toy.training if "TRAINING" in command else ()), *shlex.split(after)]


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name.replace(" ", "-"))
def test_one_sentence_and_nothing_left(case: Case, toy, tmp_path, monkeypatch, capsys):
    toy.copy(tmp_path)
    case.damage(tmp_path)
    monkeypatch.chdir(tmp_path)
    before = contents(tmp_path)
    capsys.readouterr()
    code = main(words(case.command, toy))
    out, err = capsys.readouterr()
    assert "Traceback" not in out + err
    check_sentence(err, *case.says)
    assert code == case.code
    assert contents(tmp_path) == before


def check_sentence(err: str, *says: str) -> None:
    """Check that the last line, and no other, is an error of one sentence that says all of `says`."""
    errors = [line for line in err.splitlines() if line.startswith("error: ")]
    assert len(errors) == 1 and err.splitlines()[-1] == errors[0], err
    assert errors[0].endswith((".", "?")) and not errors[0].endswith(".."), err
    assert all(part in errors[0] for part in says), err


DISKS = [
    (RIG, 16, "new.usda"),
    (TRAIN, 16, "new.resume.safetensors"),
    (BAKE, 16, "new.usdc"),
    (f"{INSPECT} --fix new.usda", 16, "new.usda"),
    (VIEW, 1, "new.png"),
    ("view shot.usda -o new.mp4 --size 64x64", 1, "new.mp4"),
]


@pytest.mark.parametrize(("command", "room", "file"), DISKS, ids=lambda value: str(value).partition(" ")[0])
def test_a_full_disk_leaves_nothing(command, room, file, toy, tmp_path, monkeypatch, capsys):
    """The system itself refuses to let any file grow past `room` kilobytes, as a full disk would."""
    toy.copy(tmp_path)
    (tmp_path / file).write_text("older")
    monkeypatch.chdir(tmp_path)
    before, limits = contents(tmp_path), resource.getrlimit(resource.RLIMIT_FSIZE)
    capsys.readouterr()
    resource.setrlimit(resource.RLIMIT_FSIZE, (room << 10, limits[1]))
    try:
        code = main(words(command, toy))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    check_sentence(capsys.readouterr().err, file)
    assert code == 2
    assert contents(tmp_path) == before


COMMANDS = [
    ("rig hero.usda --garment Hat -o new.usda", ("'Hat'",)),
    ("bake clip.usda --stage rigged.usda --motion clip.usda -o new.usdc", ("this is a USD stage",)),
    ("train rigged.usda", ("--motions",)),
]


@pytest.mark.parametrize(("command", "says"), COMMANDS, ids=lambda value: str(value).partition(" ")[0])
def test_the_shell_sees_the_exit_code(command, says, toy, tmp_path):
    toy.copy(tmp_path)
    before = contents(tmp_path)
    program = [sys.executable, "-m", "ssilk_core", *words(command, toy)]
    done = subprocess.run(program, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 2 and not done.stdout and "Traceback" not in done.stderr
    check_sentence(done.stderr, *says)
    assert contents(tmp_path) == before


def test_errors_are_events_for_machines(toy, monkeypatch, capsys):
    monkeypatch.chdir(toy.folder)
    for command in ("rig hero.usda --garment Hat -o new.usda --json", "rig --json"):
        capsys.readouterr()
        assert main(shlex.split(command)) == 2
        out, err = capsys.readouterr()
        *before, event = map(json.loads, out.splitlines())
        assert event["event"] == "failed" and event["error"].endswith(".") and not err
        assert all(earlier["event"] == "started" for earlier in before)


@pytest.mark.parametrize(
    "command",
    [
        "evaluate model.safetensors --stage rigged.usda --motions .",
        "trade model.safetensors --stage rigged.usda --motions . --no-refine",
        "report shot.usda -o new.html",
        "report model.safetensors --stage rigged.usda --motion clip.usda -o new.html",
    ],
    ids=["evaluate", "trade", "shot", "model"],
)
@pytest.mark.parametrize(
    ("found", "said"), [(None, "it is not installed"), ("2.5.1", "version 2.5.1 is installed")], ids=["none", "old"]
)
def test_libigl_is_asked_for_before_any_work(command, found, said, toy, monkeypatch, capsys):
    """Without it the triangles that intersect others cannot be counted, at the end of minutes."""
    monkeypatch.chdir(toy.folder)
    monkeypatch.setattr("ssilk_core.physics.intersections.pairs.can_find", lambda: False)
    monkeypatch.setattr("ssilk_core.physics.intersections.pairs.libigl_version", lambda: found)
    for work in ("ssilk_core.network.checkpoint.load_model", "ssilk_usd.shots.read.read_parts"):
        monkeypatch.setattr(work, lambda *_: pytest.fail("work began"))
    assert main(shlex.split(command)) == 2
    told = capsys.readouterr().err.strip()
    assert told.startswith(f"error: libigl: {said}; 2.6.3 or newer is needed") and "\n" not in told
    assert not Path("new.html").exists()


def test_one_frame_can_be_baked(toy, tmp_path, monkeypatch):
    toy.copy(tmp_path)
    edited("clip.usda", one_frame)(tmp_path)
    monkeypatch.chdir(tmp_path)
    assert main(shlex.split(BAKE)) == 0
    stage = Usd.Stage.Open("new.usdc")
    assert stage.GetStartTimeCode() == stage.GetEndTimeCode() == 0
    assert animation(stage).GetRotationsAttr().GetTimeSamples() == [0.0]


def test_motions_that_are_named_twice_count_once_and_are_told(toy, tmp_path, monkeypatch):
    """They would be validated on by what was trained on."""
    from ssilk_core.cli.main import parser
    from ssilk_core.cli.train import training_job

    monkeypatch.chdir(toy.copy(tmp_path))
    Path("walks").mkdir()
    for name in "abcde":
        Path(f"walks/{name}.usda").write_text(Path("clip.usda").read_text())
    Path("runs").symlink_to("walks")

    def job(motions: str, *valid: str):
        told: list[Any] = []
        words = ["train", "rigged.usda", "--motions", *motions.split(), "-o", "x.safetensors", *valid, *toy.training]
        found = training_job(parser(["train"]).parse_args(words), "cpu", told.append)
        return found, [event.text for event in told if getattr(event, "level", "") == "warning"]

    once, heard = job("walks")
    assert (len(once.motions), len(once.held_out), heard) == (4, 1, [])
    twice, heard = job("walks runs walks/a.usda")
    assert [motion.path for motion in twice.motions] == [motion.path for motion in once.motions] and len(heard) == 1
    assert "names 5 motions, some of them twice: each counts once" in heard[0]
    seen, heard = job("walks", "--valid", "runs/b.usda")
    assert (len(seen.motions), len(seen.held_out), len(heard)) == (5, 1, 1)
    assert "--valid names 1 motion that --motions has: on these a validation does not tell" in heard[0]
