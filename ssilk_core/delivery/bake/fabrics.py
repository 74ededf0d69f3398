# SPDX-License-Identifier: Apache-2.0
"""A model in the fabric that is asked for, where it was trained for a range of fabrics."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ...errors import fail, fail_unknown
from ...events import Event, Message
from ...network.checkpoint import ONE_FABRIC, ModelFile
from ...network.settings import apply_overrides
from ...scene.assets import Floats
from ...scene.fabric_range import FACTORS, PROPERTIES, FabricRange, fabric_with, factors_of, properties
from ...scene.fabrics import Fabric, fabric_named

OPTION = "--material"
TIMES = "x"  # at the end of a value that is a factor
RUBS = "friction="  # how a property begins that networks never see, and refinement may know
FEEDBACK_RUBS = (  # what is allowed, and what to do
    "refinement knows it where each frame goes on from the last",
    "bake with --refine N --feedback or --quality hero, or take 'ssilk simulate'",
)


def in_fabric(
    file: ModelFile, where: str, fabric: str | None, material: Sequence[str], rubs: bool = False
) -> tuple[ModelFile, tuple[Event, ...]]:
    """Return a model in the fabric that options ask for, and what there is to tell of that.

    Args:
        where: the model's path, for messages.
        fabric: name of a preset; None for the model's own fabric.
        material: "NAME=VALUE" properties of it, or "NAME=FACTORx" of what the model's own fabric has.
        rubs: what follows the network knows friction, which any model may then be given.

    Raises:
        SsilkError: the model knows one fabric alone, its networks do not see a property that is asked for, or
            nothing knows the friction that is; or a preset differs from the model's own fabric in contact alone.
    """
    rough, others = _friction_apart(material, rubs)
    if rough:
        found, in_words = in_fabric(file, where, fabric, others)
        found = replace(found, fabric=apply_overrides(found.fabric, rough, OPTION))
        text = f"{where}: friction {found.fabric.friction:g} in refinement; the network plays without it"
        return found, (*in_words, Message(text))
    if not fabric and not material:
        return file, ()
    if file.fabrics is None:
        asked = " ".join([*([f"--fabric {fabric}"] if fabric else []), *(f"--material {each}" for each in material)])
        fail(where, f"{asked} for a model of one fabric", *ONE_FABRIC)
    own, known = file.fabric, file.fabrics.range
    wanted = _asked(own, known, fabric, material)
    factors = factors_of(own, wanted)
    values = ", ".join(f"{name} {factor:.3g}" for name, factor in zip(FACTORS, factors))
    told: list[Event] = [Message(f"{where}: fabric '{wanted.name}', as factors of the model's own: {values}")]
    if fabric and (other := known.other_words(own, fabric)):
        text = f"'{fabric}' is the fabric that its training called so; the preset has other factors now: {other}"
        told.append(Message(f"{where}: {text}; --material NAME=FACTORx sets them"))
    if beyond := known.beyond(factors):
        text = f"{beyond} is beyond the fabrics of its training: the network sees the nearest of these"
        told.append(Message(f"{where}: {text}; --refine N or --quality hero solve for it", "warning"))
    return file.on_fabric(wanted), tuple(told)


def need_fabric(fabric: str | None, material: Sequence[str], rubs: bool = False) -> None:
    """Raise `SsilkError` where options, which are those of `in_fabric`, ask for what no model could play."""
    preset, (rough, others) = fabric_named(fabric or "default"), _friction_apart(material, rubs)
    _need_factors(_factors(np.ones(len(FACTORS)), others))
    apply_overrides(preset, [*_absolute(PROPERTIES, others), *rough], OPTION)


def _friction_apart(material: Sequence[str], rubs: bool) -> tuple[list[str], list[str]]:
    """Return the words of --material that are friction, and the others; raise `SsilkError` where nothing knows it."""
    rough = [each for each in material if each.startswith(RUBS)]
    if rough and not rubs:
        fail(f"{OPTION} {rough[0]}", "networks know no friction", *FEEDBACK_RUBS)
    return rough, [each for each in material if each not in rough]


def _asked(own: Fabric, known: FabricRange, fabric: str | None, material: Sequence[str]) -> Fabric:
    """Return the fabric that options ask for, with all that networks do not see as the model's own has it."""
    preset = known.factors_of(own, fabric) if fabric else np.ones(len(FACTORS))
    factors = _factors(preset, material)
    _need_factors(factors)
    return apply_overrides(fabric_with(own, factors, fabric), _absolute(properties(own), material), OPTION)


def _factors(preset: Floats, material: Sequence[str]) -> Floats:
    """Return the factors (5,) of a preset, or those that the words of --material have in their place."""
    factors = preset.copy()
    for each in material:
        (name, _, text), where = each.partition("="), f"{OPTION} {each}"
        if not text.endswith(TIMES):
            continue
        if name not in FACTORS:
            fail_unknown(where, "networks see no factor of it", name, FACTORS)
        try:
            factors[FACTORS.index(name)] = float(text.removesuffix(TIMES))
        except ValueError:
            fail(where, f"'{text}'", "a factor is a number before the x, such as bending=2x")
    return factors


def _need_factors(factors: Floats) -> None:
    if not (np.isfinite(factors).all() and (factors >= 0).all() and factors[0] > 0 and factors[3] > 0):
        found = ", ".join(f"{name} {factor:g}" for name, factor in zip(FACTORS, factors))
        allowed = "they are finite and not negative, those of stretch and density positive"
        fail(OPTION, f"factors {found}", allowed)


def _absolute(known: Sequence[str], material: Sequence[str]) -> list[str]:
    """Return the words of --material that are values in units; raise `SsilkError` where one is of no known name."""
    found = [each for each in material if not each.partition("=")[2].endswith(TIMES)]
    for each in found:
        if (name := each.partition("=")[0]) not in known:
            fail_unknown(f"{OPTION} {each}", "networks do not see it", name, known)
    return found
