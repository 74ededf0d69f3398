# SPDX-License-Identifier: Apache-2.0
"""The fabrics that one training serves: factors of five properties of its own fabric, each within a range.

    lame_lambda, lame_mu = stretch (lambda_0, shear mu_0)     "stvk"
    stretch, shear       = stretch (k_0, shear s_0)           "baraff_witkin"
    bending, density, drag = factors of the fabric's own

Both moduli of the membrane grow with `stretch`; `shear` is how much stiffer it is against shear beside that. So any
factors that are drawn independently give a fabric. Networks see x = ln(factor) / ln(4), which is zero for the
fabric's own. Thickness and contact stay those of the training's fabric.

A range knows which factors its presets had when it was made, so that a model plays the fabrics of its training by
their names, whatever the presets become.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import inf, isclose, isfinite, log

import numpy as np

from ..errors import fail, fail_unknown
from .assets import Floats
from .fabrics import FABRICS, Fabric, fabric_named

FACTORS = ("stretch", "shear", "bending", "density", "drag")
UNIT = log(4.0)  # of the logarithm of a factor, as networks see it
USUAL = 4.0  # factor to which a range goes where none is named, and from its inverse
MOST = 1000.0  # factor that a range may name
# Of presets before they were calibrated [N m], see `FabricRange.points`.
FORMER_BENDING = {"silk": 3e-6, "cotton": 1.5e-5, "denim": 1e-4, "wool": 5e-5, "leather": 4e-4}
_MODULI = {"stvk": ("lame_lambda", "lame_mu"), "baraff_witkin": ("stretch", "shear")}
PROPERTIES = (*(name for moduli in _MODULI.values() for name in moduli), *FACTORS[2:])  # of fabrics of any model


def properties(fabric: Fabric) -> tuple[str, ...]:
    """Return the names of a fabric's properties that the factors are of, in the order of `FACTORS`."""
    return (*_MODULI[fabric.stretch_model], *FACTORS[2:])


def factors_of(own: Fabric, other: Fabric) -> Floats:
    """Return the factors (5,) by which the properties of another fabric are those of `own`, in order of `FACTORS`.

    Raises:
        SsilkError: the other has another stretch model, or no stiffness, or what `own` has none of.
    """
    where = f"fabric '{other.name}'"
    if other.stretch_model != own.stretch_model:
        allowed = f"the model was trained with '{own.stretch_model}'"
        fail(where, f"stretch model '{other.stretch_model}'", allowed, "leave it as it is")
    found = []
    for name in properties(own):
        mine, theirs = (float(getattr(fabric, name)) for fabric in (own, other))
        if mine == theirs:
            found.append(1.0)
        elif mine == 0:
            fail(where, f"{name} = {theirs:g}", f"the model's own fabric has none, and no factor of 0 is {theirs:g}")
        else:
            found.append(theirs / mine)
    if not found[0] > 0:
        fail(where, f"{properties(own)[0]} = 0", "a network knows fabrics that resist stretch", "take a positive one")
    found[1] /= found[0]
    return np.array(found)


def seen_factors(own: Fabric, other: Fabric) -> Floats:
    """Return the factors as `factors_of`, of a fabric that networks can tell.

    Raises:
        SsilkError: likewise, or it differs from the default in its contact alone, and `own` has another contact.
    """
    factors, default = factors_of(own, other), FABRICS["default"]
    alike = all(getattr(other, name) == getattr(default, name) for name in PROPERTIES)
    if alike and other.contact_model != own.contact_model:
        found = f"its contact, '{other.contact_model}', is all that it has of its own"
        allowed = f"contact is as in the training, '{own.contact_model}'"
        fail(f"fabric '{other.name}'", found, allowed, f"leave it out, or train with --fabric {other.name}")
    return factors


def fabric_with(own: Fabric, factors: Floats, name: str | None = None) -> Fabric:
    """Return a fabric whose properties are factors (5,) of those of `own`; all else is as in that."""
    stretch, shear, *others = (float(factor) for factor in factors)
    scales = dict(zip(properties(own), (stretch, stretch * shear, *others)))
    values = {key: getattr(own, key) * scale for key, scale in scales.items() if scale != 1}
    return replace(own, name=own.name if name is None else name, **values)


def inputs_of(factors: Floats) -> Floats:
    """Return factors as networks see them; those of zero as very small ones."""
    return np.log(np.maximum(factors, 1e-9)) / UNIT + 0.0


@dataclass(frozen=True)
class FabricRange:
    """Factors of a fabric from `low` to `high`, in the order of `FACTORS`; one lies between.

    Attributes:
        presets: fabrics that it was made to span, by name: training draws mixtures of these, too.
        points: their factors, five for each. None in files from before the presets were calibrated: all names of
            presets mean there what they meant then (`FORMER_BENDING`).

    Raises:
        SsilkError: there are not five of each, they are no positive finite numbers, or do not enclose one; or the
            points are not within, one for each preset.
    """

    low: tuple[float, ...]
    high: tuple[float, ...]
    presets: tuple[str, ...] = ()
    points: tuple[tuple[float, ...], ...] | None = ()

    def __post_init__(self) -> None:
        for name in ("low", "high", "presets"):
            object.__setattr__(self, name, tuple(getattr(self, name)))
        fits = len(self.low) == len(self.high) == len(FACTORS)
        if not fits or not all(0 < low <= 1 <= high < inf for low, high in zip(self.low, self.high)):
            found = f"factors from {list(self.low)} to {list(self.high)}"
            fail("range of fabrics", found, f"five finite ranges about one, of {', '.join(FACTORS)}")
        if self.points is None:
            return
        object.__setattr__(self, "points", tuple(map(tuple, self.points)))
        sizes = {len(point) for point in self.points} - {len(FACTORS)}
        if sizes or len(self.points) != len(self.presets) or any(self.beyond(np.array(at)) for at in self.points):
            found = f"points {[list(point) for point in self.points]} of the presets {list(self.presets)}"
            fail("range of fabrics", found, "each preset has five factors within the range")

    @classmethod
    def of(cls, own: Fabric, words: Sequence[str]) -> FabricRange:
        """Return what spans all that words name: presets, and a factor F that means 1/F to F; `USUAL` for no word.

        Raises:
            SsilkError: a word is neither, or a second factor.
        """
        most, presets = 1.0, []
        for word in words or [f"{USUAL:g}"]:
            if word in FABRICS:
                presets.append(word)
                continue
            try:
                factor = float(word)
            except ValueError:
                fail_unknown("--fabrics", f"'{word}', neither a preset nor a factor", word, FABRICS)
            if not (isfinite(factor) and 1 < factor <= MOST):
                allowed = f"a factor above 1, to {MOST:g}, means fabrics from 1/F to F times the model's own"
                fail("--fabrics", f"the factor {word}", allowed, "such as --fabrics 4, or name presets")
            if most > 1:
                fail("--fabrics", f"the factors {most:g} and {factor:g}", "one range has one", "give the wider one")
            most = factor
        corners = [seen_factors(own, fabric_named(name)) for name in presets]
        whole = np.stack([np.full(len(FACTORS), 1 / most), np.full(len(FACTORS), most), *corners])
        points = tuple(tuple(corner.tolist()) for corner in corners)
        return cls(tuple(whole.min(axis=0).tolist()), tuple(whole.max(axis=0).tolist()), tuple(presets), points)

    def factors_of(self, own: Fabric, name: str) -> Floats:
        """Return the factors (5,) of `own` that the name of a preset means here.

        Raises:
            SsilkError: there is no such preset, or networks that know `own` do not see it.
        """
        if self.points is not None and name in self.presets:
            return np.array(self.points[self.presets.index(name)])
        preset = fabric_named(name)
        if self.points is None:
            preset = replace(preset, bending=FORMER_BENDING.get(name, preset.bending))
        return seen_factors(own, preset)

    def other_words(self, own: Fabric, name: str) -> str:
        """Return in words which factors the name of a preset has now and not here; empty where it means the same."""
        pairs = zip(FACTORS, self.factors_of(own, name), seen_factors(own, fabric_named(name)))
        return ", ".join(f"{key} {now:.3g}, not {here:.3g}" for key, here, now in pairs if not isclose(here, now))

    @property
    def bounds(self) -> tuple[Floats, Floats]:
        """Return the least and the largest inputs of a network, shapes (5,)."""
        return inputs_of(np.array(self.low)), inputs_of(np.array(self.high))

    def seen(self, factors: Floats) -> Floats:
        """Return what a network sees of factors (5,): none beyond its range."""
        return np.clip(inputs_of(factors), *self.bounds)

    def beyond(self, factors: Floats) -> str:
        """Return in words which factors lie beyond the range; empty where none does."""
        found = [
            f"{name} {factor:.3g} (trained from {low:.3g} to {high:.3g})"
            for name, factor, low, high in zip(FACTORS, factors, self.low, self.high)
            if not low * (1 - 1e-6) <= factor <= high * (1 + 1e-6)
        ]
        return ", ".join(found)

    def words(self) -> str:
        """Return the range in words."""
        parts = zip(FACTORS, self.low, self.high)
        return ", ".join(f"{name} {low:.3g} to {high:.3g}" for name, low, high in parts)


def ends(own: Fabric, fabrics: FabricRange) -> list[Fabric]:
    """Return fabrics at the ends of a range: its presets, or where it has none, the softest and the stiffest."""
    if fabrics.presets:
        found = [(name, fabrics.factors_of(own, name)) for name in dict.fromkeys(fabrics.presets)]
        return [fabric_with(own, factors, name) for name, factors in found if (factors != 1).any()]
    stiff = np.array([name in ("stretch", "bending") for name in FACTORS])
    found = [("softest", np.where(stiff, fabrics.low, 1.0)), ("stiffest", np.where(stiff, fabrics.high, 1.0))]
    return [fabric_with(own, factors, name) for name, factors in found]
