# SPDX-License-Identifier: Apache-2.0
"""What is baked."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from math import inf

from ...errors import fail, fail_unknown
from ...quality.reduction import ModelSize
from ...scene.kinematics import MAX_FPS, MAX_HOLD, MIN_FPS
from ...scene.plain import from_plain
from ..targets import TARGETS, Target
from .fabrics import need_fabric
from .world import parse_world

AT = "@"  # before the time code of a frame
OF_WORDS = ("colliders", "material")  # fields that metadata stores as one text
INPUTS = ("model", "stage", "motion")  # the files that a shot is baked from
REFINED_OUTPUTS = ("joints", "points")
ALL_ELEMENTS, FEW_ELEMENTS = "all", "few"
LATENT_ELEMENTS = (ALL_ELEMENTS, FEW_ELEMENTS)
MAX_SAMPLES_PER_FRAME = 64
MAX_PRE_ROLL = 600.0  # [s]
MAX_REFINE = 10_000
ALLOWED_FPS = f"a positive rate from {MIN_FPS:g} to {MAX_FPS} is needed"
MAX_HANDLES = 10_000
LONGEST_TEXT = 1000  # characters of an entry of assetInfo
_NUMBER = r"-?[0-9]{1,9}(?:\.[0-9]{1,9})?"


@dataclass(frozen=True, kw_only=True)
class BakeRequest:
    """One garment over one motion: all that decides how the garment moves.

    Fields are named as the options of 'ssilk bake', which names `root` in MODEL:/ROOT, and `garment` and `shot` by
    patterns or in a list. A shot stores its request, so that it can be verified later.

    Attributes:
        model: file written by 'ssilk train'.
        stage: USD file with the character.
        motion: USD file with the motion; "file:/Prim/Path" names a SkelAnimation where there are several.
        root: SkelRoot of the character, where the stage has several.
        fps: frames per second of the shot [1/s]; None for the motion's.
        samples_per_frame: samples in each frame, for motion blur.
        range: "FIRST-LAST" in time codes of the motion's stage, or "all" samples; None for the range of the stage.
        handles: frames before and after the range that are baked as well, where the motion has samples.
        pre_roll: run-up to the first pose and after each cut [s].
        target: who receives the shot, a name in `ssilk_core.delivery.targets.TARGETS`.
        lbs: bake linear blend skinning instead of the network.
        refine: iterations of the simulator's solver in each frame, from the network's state; 0 for none.
        feedback: refined frames look back on refined frames, one after the other; else inertia holds each where the
            network has it.
        latent_iterations: iterations per frame of the solver in the model's latents, which takes the place of the
            network's own steps (`network.latent_solver`); 0 for these.
        latent_elements: "all" sums that solver's energy over the whole garment, "few" over a sample of its elements.
        refined_output: "joints" writes refined frames as joints and as many blendshapes as they need (see
            `decomposition`), "points" as points.
        certify: move frames in which cloth passes through cloth, or covered skin shows, until none does
            (`delivery.bake.certificate`).
        hide_covered: hide the body's faces that the garment covers in every frame (see `skin.hidden_faces`).
        colliders, wind, gusts, gravity: what surrounds the character, in place of what its shot says: prims, and
            numbers as text (`delivery.bake.world`). Networks see colliders where they were trained with some.
        fabric, material: that the garment is of, where its model was trained for a range of fabrics: a preset, and
            properties as text (`delivery.bake.fabrics`); the model's own by default. Friction may be given to any
            model that is refined with feedback.
        hold: frames for which each pose of the garment is held, as in animation on twos; 0 for what the stage says.
        start_cloth: shot or cache with the cloth that the first frame begins with, "FILE[:/PRIM][@CODE]", at its last
            frame or at a time code (`delivery.bake.start`); None to begin at rest.
        loop: whether the motion is a cycle whose last frame is to flow into its first; False for what the stage says.
        keep: what is kept of the model, cut to be best for this motion; None for all.
        device: where the network runs.
        garment, shot: names in a folder of layers; None for those of the model and the motion.
        level_of: name of a garment of the shot that this is a level of quality of; None for a garment of its own.
        asset_version: of the garment, in the `assetInfo` of what is written; None for a hash of the model.
        asset_identifier: likewise; None for the asset's own layer, and for none in a file.

    Raises:
        SsilkError: an unknown target, refined output or fabric, or a number out of range.
    """

    model: str
    stage: str
    motion: str
    root: str | None = None
    fps: float | None = None
    samples_per_frame: int = 1
    range: str | None = None
    handles: int = 0
    pre_roll: float = 0.0
    target: str = "usd"
    lbs: bool = False
    refine: int = 0
    feedback: bool = False
    latent_iterations: int = 0
    latent_elements: str = ALL_ELEMENTS
    refined_output: str = "joints"
    certify: bool = False
    hide_covered: bool = False
    colliders: tuple[str, ...] = ()
    wind: str | None = None
    gusts: str | None = None
    gravity: str | None = None
    fabric: str | None = None
    material: tuple[str, ...] = ()
    hold: int = 0
    start_cloth: str | None = None
    loop: bool = False
    keep: ModelSize | None = None
    device: str = "cpu"
    garment: str | None = None
    shot: str | None = None
    level_of: str | None = None
    asset_version: str | None = None
    asset_identifier: str | None = None

    def __post_init__(self) -> None:
        for name in INPUTS:  # a pathlib.Path is as good, but USD's metadata stores text
            object.__setattr__(self, name, os.fspath(getattr(self, name)))
        if self.target not in TARGETS:
            fail_unknown("--target", f"'{self.target}'", self.target, TARGETS)
        if not 1 <= self.samples_per_frame <= MAX_SAMPLES_PER_FRAME:
            found = f"{self.samples_per_frame} samples in each frame"
            fail("--samples-per-frame", found, f"1 to {MAX_SAMPLES_PER_FRAME} are allowed")
        if not 0 <= self.handles <= MAX_HANDLES:
            fail("--handles", f"{self.handles} frames", f"0 to {MAX_HANDLES} are allowed")
        if self.range is not None:
            parse_range(self.range)
        if not 0 <= self.pre_roll <= MAX_PRE_ROLL:
            fail("--pre-roll", f"{self.pre_roll:g} seconds", f"0 to {MAX_PRE_ROLL:g} are allowed")
        if not 0 <= self.hold <= MAX_HOLD or int(self.hold) != self.hold:
            fail("--hold", f"{self.hold:g} frames", f"1 to {MAX_HOLD} are allowed")
        if self.fps is not None and not MIN_FPS <= self.fps <= MAX_FPS:
            fail("--fps", f"{self.fps:g} frames per second", ALLOWED_FPS)
        if not 0 <= self.refine <= MAX_REFINE or int(self.refine) != self.refine:
            fail("--refine", f"{self.refine:g} iterations", f"1 to {MAX_REFINE} are allowed, or 0 for none")
        if not 0 <= self.latent_iterations <= MAX_REFINE or int(self.latent_iterations) != self.latent_iterations:
            found = f"{self.latent_iterations:g} iterations"
            fail("--latent-iterations", found, f"1 to {MAX_REFINE} are allowed, or 0 for none")
        if self.hold > 1 and self.refine:
            found = f"poses that are held for {self.hold} frames, and --refine"
            fail("--hold", found, "the solver moves each frame", "leave one of them out")
        if self.lbs and self.latent_iterations:
            found = "linear blend skinning has no latents"
            fail("--latent-iterations", found, "only the network has them", "leave one of them out")
        need_fabric(self.fabric, self.material, rubs=True)  # a level of quality may yet bring feedback
        if self.lbs and (self.fabric or self.material):
            found = "linear blend skinning has no fabric"
            fail("--lbs", found, "only the network and the solver have one", "leave --fabric and --material out")
        if self.latent_elements not in LATENT_ELEMENTS:
            fail_unknown("--latent-elements", f"'{self.latent_elements}'", self.latent_elements, LATENT_ELEMENTS)
        if self.feedback and not self.refine:
            found, allowed = "no --refine", "it says what refined frames look back on"
            fail("--feedback", found, allowed, "add --refine N, or leave it out: --quality hero has both")
        if self.refined_output not in REFINED_OUTPUTS:
            fail_unknown("--refined-output", f"'{self.refined_output}'", self.refined_output, REFINED_OUTPUTS)
        if self.certify and self.writes_points:
            found, allowed = "refined points", "what a certificate moves is put on joints and blendshapes"
            fail("--certify", found, allowed, "leave --refined-output out")
        parse_world(self.wind, self.gusts, self.gravity)
        for name, text in (("--asset-version", self.asset_version), ("--asset-identifier", self.asset_identifier)):
            if text is not None and not (text.isprintable() and 0 < len(text) <= LONGEST_TEXT):
                fail(name, f"{text[:40]!r}", f"1 to {LONGEST_TEXT} printable characters are allowed")
        if self.lbs and self.keep:
            fail("--lbs", "linear blend skinning with a size to keep", "only the network has one", "leave keep out")

    @property
    def time_range(self) -> tuple[float, float] | None:
        """First and last time code of the range, infinite for all samples; None for that of the stage."""
        return None if self.range is None else parse_range(self.range)

    @property
    def inputs(self) -> dict[str, str]:
        """The files that it is baked from, by their fields."""
        return {name: getattr(self, name) for name in INPUTS}

    @property
    def meets_beneath(self) -> bool:
        """Whether it is refined or certified, and so over garments beneath as their files have them."""
        return self.certify or self.refine != 0

    @property
    def made(self) -> str:
        """How it is made over garments beneath, in a word."""
        return "certified" if self.certify else "refined"

    @property
    def writes_points(self) -> bool:
        """Whether the garment is refined and written as points instead of joints."""
        return self.refine != 0 and self.refined_output == "points"

    @property
    def samples_elements(self) -> bool:
        """Whether the solver in latents sums its energy over a sample of the garment's elements."""
        return self.latent_elements == FEW_ELEMENTS

    @property
    def receiver(self) -> Target:
        """Who receives the shot."""
        return TARGETS[self.target]

    @property
    def needs_gpu(self) -> bool:
        """Whether it runs on hosts with a GPU alone: its device is one. "auto" runs anywhere."""
        return self.device.startswith("cuda")

    def relocated(self, locate: Callable[[str], str]) -> BakeRequest:
        """Return the request with its input files elsewhere: `locate` gives the new path of each."""
        model, stage, motion = (locate(getattr(self, name)) for name in INPUTS)
        start = self.start_cloth
        if start is not None:
            place, code = split_start(start)
            start = locate(place) + ("" if code is None else f"{AT}{code:.9g}")
        return replace(self, model=model, stage=stage, motion=motion, start_cloth=start)

    def to_metadata(self) -> dict[str, object]:
        """Return what differs from the defaults, as a shot stores it."""
        changed = {name: value for name, value in vars(self).items() if value != getattr(BakeRequest, name, None)}
        for name in OF_WORDS:
            changed |= {name: " ".join(words)} if (words := getattr(self, name)) else {}
        return {**changed, "keep": str(self.keep)} if self.keep else changed

    @classmethod
    def from_metadata(cls, document: object) -> BakeRequest:
        """Return the request that `to_metadata` stored.

        Raises:
            TypeError, ValueError: it is none, or of a version with other fields.
            SsilkError: a value out of range.
        """
        if isinstance(document, Mapping) and isinstance(document.get("keep"), str):
            document = {**document, "keep": vars(ModelSize.of(document["keep"]))}
        for name in OF_WORDS:
            if isinstance(document, Mapping) and isinstance(document.get(name), str):
                document = {**document, name: tuple(document[name].split())}
        return from_plain(cls, document)


def split_start(text: str) -> tuple[str, float | None]:
    """Return the file, with the prim that it names, and the time code of "FILE[:/PRIM][@CODE]"; None for the last."""
    place, at, code = text.rpartition(AT)
    if at and place:
        try:
            return place, float(code)
        except ValueError:
            pass  # a file of this name
    return text, None


def parse_range(text: str) -> tuple[float, float]:
    """Return the first and last time code of "FIRST-LAST"; infinite ones for "all".

    Raises:
        SsilkError: it is neither, or ends before it begins.
    """
    if text == "all":
        return -inf, inf
    found = re.fullmatch(rf"({_NUMBER})-({_NUMBER})", text)
    if not found:
        allowed = "first and last time code are needed, such as 1001-1100, or 'all'"
        fail("--range", f"'{text}'", allowed)
    first, last = float(found[1]), float(found[2])
    if first > last:
        fail(f"--range {text}", "it ends before it begins", "FIRST-LAST is needed, such as 1001-1100")
    return first, last


def need_body(request: BakeRequest, include_body: bool) -> None:
    """Raise `SsilkError` where faces of a body are to be hidden that is not written."""
    if request.hide_covered and not include_body:
        fail("--hide-covered", "no body in the shot", "its faces are what is hidden", "leave --no-body out")
