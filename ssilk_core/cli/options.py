# SPDX-License-Identifier: Apache-2.0
"""Options that several verbs share, and how a scene is loaded from them."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from math import nan
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..delivery.bake import BakeRequest, naming
from ..delivery.bake.request import (
    ALL_ELEMENTS,
    LATENT_ELEMENTS,
    MAX_HANDLES,
    MAX_HOLD,
    MAX_PRE_ROLL,
    MAX_REFINE,
    MAX_SAMPLES_PER_FRAME,
    REFINED_OUTPUTS,
)
from ..delivery.bake.task import named_by_bodies
from ..delivery.bake.world import GUSTS
from ..delivery.targets import TARGETS
from ..errors import fail
from ..events import Message, Reporter, format_count
from ..files import is_same_file, need_not_input, need_writable, split_body, split_location
from ..network.settings import apply_overrides, setting_names
from ..quality.levels import QUALITIES
from ..scene.assets.reshaped import reshaped
from ..scene.fabric_range import FACTORS
from ..scene.fabrics import FABRICS, Fabric, fabric_named, fabric_of_surface, stiffness_words, surface_message
from ..scene.kinematics import MAX_FPS, MIN_FPS
from ..scene.posed_alike import shaped_as_in_stage
from ..scene.shape_weights import bodies_within, body_name, body_of, parse_shapes, shapes_text

if TYPE_CHECKING:
    from ..authoring.setup.rig import RigOptions
    from ..scene.assets import Character, Garment, Mesh, Motion, ProxyRig, Scene, SurfaceMaterial
    from ..training.wardrobe.listing import WardrobeEntry


LIST, MODEL = ".toml", ".safetensors"  # suffixes of a list of garments, and of a trained one
STAGE = "USD file with the character (SkelRoot, Skeleton, body meshes)"
BODIES = "USD file with the character, or FILE:SHAPE=WEIGHT,... (repeatable: one for each body of a family)"


def add_scene(verb: argparse.ArgumentParser) -> None:
    """Add the options that name the character and the garment."""
    verb.add_argument("stage", type=Path, help=STAGE)
    add_garment(verb)


def add_garment(verb: argparse.ArgumentParser) -> None:
    """Add the options that name what is taken of a stage."""
    verb.add_argument(
        "--garment", metavar="FILE[:/PRIM]|PRIM", help="garment: a file of its own, or a mesh of the stage"
    )
    verb.add_argument("--root", metavar="PRIM", help="SkelRoot of the character, where the stage has several")
    verb.add_argument(
        "--body",
        metavar="PRIM",
        action="append",
        default=[],
        help="body mesh (repeatable; default: all under the SkelRoot)",
    )


class _Property(argparse.Action):
    """Keeps each NAME=VALUE of an option; refuses a second value of one name."""

    def __call__(self, parser: object, namespace: object, values: object, option_string: str | None = None) -> None:
        """Keep one more."""
        kept, name = getattr(namespace, self.dest), str(values).partition("=")[0]
        if other := next((each for each in kept if each.partition("=")[0] == name), None):
            raise argparse.ArgumentError(self, f"'{other}' and '{values}' are two values of '{name}'; give one")
        setattr(namespace, self.dest, [*kept, values])


def add_fabric(verb: argparse.ArgumentParser) -> None:
    """Add the options of the fabric."""
    verb.add_argument(
        "--fabric",
        choices=FABRICS,
        help="material (default: that of the garment's physics material, or 'default'); 'paper' has the paper's "
        "contact",
    )
    verb.add_argument(
        "--material",
        action=_Property,
        default=[],
        metavar="NAME=VALUE",
        help=f"change a property of the fabric (repeatable): {', '.join(setting_names(Fabric))}",
    )


def add_known_fabric(verb: argparse.ArgumentParser) -> None:
    """Add the options of the fabric that a trained garment is of."""
    verb.add_argument(
        "--fabric",
        choices=FABRICS,
        help="preset that the garment is of, where its model was trained with --fabrics (default: the fabric of its "
        "training)",
    )
    verb.add_argument(
        "--material",
        action=_Property,
        default=[],
        metavar="NAME=VALUE",
        help="change a property of that fabric (repeatable): density=0.3 in its unit, or bending=2x for twice that "
        f"of the training's fabric; factors are {', '.join(FACTORS)}. A bake with --feedback or --quality hero takes "
        "friction=0.4 of any model",
    )


def asked_known_fabric(options: argparse.Namespace) -> dict[str, Any]:
    """Return what the options of `add_known_fabric` say by their names, without those that say nothing."""
    asked = {"fabric": options.fabric, "material": options.material}
    return {name: value for name, value in asked.items() if value}


def add_world(verb: argparse.ArgumentParser, of: str) -> None:
    """Add what surrounds the character; `of` says in which work cloth meets it."""
    about = (
        f"Cloth meets it {of}. A shot's prims with UsdPhysics.CollisionAPI, and its PhysicsScene's gravity and "
        "ssilk:wind, count without these options. Vectors are in the axes of the shot's stage."
    )
    world = verb.add_argument_group("what surrounds the character", about)
    world.add_argument("--collider", action="append", default=[], metavar="PRIM",
                       help="a mesh or solid that cloth meets, or a prim above some, by path or name "
                            "(repeatable)")  # fmt: skip
    world.add_argument("--wind", metavar="X,Y,Z", help="velocity of the air in the world [m/s] (default: the air "
                       "moves along with the character's root)")  # fmt: skip
    world.add_argument("--gusts", metavar=GUSTS, help="RMS speed of the wind's turbulence [m/s], size of its largest "
                       "eddies [m] (default 2) and seed (default 0)")  # fmt: skip
    world.add_argument("--gravity", metavar="X,Y,Z", help="acceleration [m/s2] (default: 9.81 down)")


def asked_fabric(options: argparse.Namespace) -> Fabric:
    """Return the fabric that the options alone ask for; raise `SsilkError` for an unknown property or a bad value."""
    return apply_overrides(fabric_named(options.fabric or "default"), options.material, "--material")


def fabric(options: argparse.Namespace, garment: Garment, report: Reporter) -> Fabric:
    """Return the fabric of a garment: what the options name, else its stage's, else the default.

    Properties that the options set go before those of its stage.

    Raises:
        SsilkError: an unknown property, a bad value, or a fabric without stitches for islands that these alone hold.
    """
    from ..authoring.setup.hosts import need_stitch

    if options.fabric or garment.surface is None:
        found = asked_fabric(options)
    else:
        found = apply_overrides(stated_fabric(garment.surface, report), options.material, "--material")
    if garment.classes is not None:
        need_stitch(garment.mesh, garment.classes, found)
    if garment.mesh.stiffness is not None:
        report(Message(f"{garment.mesh.path}: {stiffness_words(garment.mesh)}"))
    return found


def stated_fabric(surface: SurfaceMaterial, report: Reporter) -> Fabric:
    """Return the fabric of a stage's physics material, and tell it."""
    stated = fabric_of_surface(surface)
    report(Message(f"{surface.path}: {surface_message(surface, stated)}"))
    return stated


@dataclass(frozen=True)
class NumberRange:
    """The type of an option that takes a finite number from `low` to `high`."""

    low: float
    high: float
    kind: type[int] | type[float] = float

    def __call__(self, text: str) -> float:
        """Return the number that a text spells; raise `ArgumentTypeError` where it is none of these."""
        try:
            value = self.kind(text)
        except ValueError:
            value = nan
        if not self.low <= value <= self.high:
            whole = "whole " if self.kind is int else ""
            raise argparse.ArgumentTypeError(
                f"'{text[:40]}' is not a {whole}number from {self.low:g} to {self.high:g}"
            )
        return value


RATE = NumberRange(MIN_FPS, MAX_FPS)  # frames in a second


def add_bake(verb: argparse.ArgumentParser) -> None:
    """Add the options that say what is baked, over what, and for whom."""
    verb.add_argument("model", nargs="+", metavar="MODEL|LIST[:/ROOT]",
                      help="models written by 'ssilk train', or the list that 'ssilk wardrobe' left beside its "
                           "models, which stands for all of these; ROOT is the SkelRoot that wears it, where the "
                           "stage has several")  # fmt: skip
    verb.add_argument(
        "--stage",
        type=Path,
        action="append",
        required=True,
        help=BODIES,
    )
    motions = verb.add_mutually_exclusive_group(required=True)
    motions.add_argument(
        "--motion",
        nargs="+",
        metavar="SHOT[:/PRIM]",
        help="USD files with motions; PRIM is the SkelAnimation, where there are several",
    )
    motions.add_argument("--shots", type=Path, metavar="LIST",
                         help='JSON file of named shots, {"s010": "s010/anim.usdc", ...}; paths are relative to '
                              "it")  # fmt: skip
    about = "; ".join(f"{name}: {target.about}" for name, target in TARGETS.items())
    verb.add_argument("--target", choices=TARGETS, default="usd", help=f"who receives it (default usd). {about}")
    verb.add_argument("--fps", type=RATE, help="frames per second of the shot (default: the motion's)")
    add_range(verb, "frames to bake", "the range of the motion's stage, or all")
    verb.add_argument("--handles", type=NumberRange(0, MAX_HANDLES, int), default=0, metavar="N",
                      help="frames before and after the range that are baked as well, where there are samples "
                           "(default 0)")  # fmt: skip
    verb.add_argument("--samples-per-frame", type=NumberRange(1, MAX_SAMPLES_PER_FRAME, int), default=1, metavar="N",
                      help="samples in each frame, for motion blur (default 1)")  # fmt: skip
    verb.add_argument(
        "--pre-roll",
        type=NumberRange(0, MAX_PRE_ROLL),
        default=0.0,
        metavar="SECONDS",
        help="run-up to the first pose and after each cut, so that the garment has settled (default 0)",
    )
    verb.add_argument("--start-cloth", metavar="FILE[:/PRIM][@CODE]",
                      help="shot or point cache that this one goes on from: its last frame, or that at a time code, "
                           "is the first one here, and its cloth is there (default: it is at rest)")  # fmt: skip
    verb.add_argument("--hold", type=NumberRange(1, MAX_HOLD, int), metavar="N",
                      help="frames for which each pose of the garment is held, 2 for animation on twos (default: "
                           "ssilk:hold of the garment in the shot, or 1)")  # fmt: skip
    verb.add_argument("--loop", action="store_true",
                      help="the motion is a cycle: play it until the garment repeats, and write one round whose last "
                           "frame flows into its first (default: ssilk:loop of the garment in the shot)")  # fmt: skip
    add_known_fabric(verb)
    add_world(verb, "with --refine and --quality hero; the network alone feels wind and gravity, and sees colliders "
                    "where it was trained with some")  # fmt: skip
    _add_names(verb)
    _add_output(verb)


def add_range(verb: argparse.ArgumentParser, what: str, default: str) -> None:
    """Add --range, which `parse_range` reads; `what` it names, and in words what is taken without it."""
    verb.add_argument(
        "--range",
        metavar="FIRST-LAST",
        help=f"{what}, as time codes of the motion, such as 1001-1100, or 'all' that have samples (default: "
        f"{default}); --range=-3-5 where FIRST is negative",
    )


def _add_names(verb: argparse.ArgumentParser) -> None:
    """Add the options that say how garments and shots are named in a folder, and what assets say of themselves."""
    about = f"Names are those in a folder of layers. In a pattern, {naming.FIELDS}."
    names = verb.add_argument_group("names and versions", about)
    names.add_argument("--shot-name", metavar="PATTERN",
                       help="such as s010 for one motion, or '{parent2}_{stem}' (default: the file's, and the prim's "
                            "where one is named)")  # fmt: skip
    names.add_argument("--garment-name", metavar="PATTERN",
                       help="such as cape, or '{parent}' (default: the model's, with ROOT in front)")  # fmt: skip
    names.add_argument("--body-name", metavar="PATTERN",
                       help="such as heavy, or '{parent}': what names of shots and garments begin with, one for each "
                            "stage (default: the stage's where several are given, else none)")  # fmt: skip
    names.add_argument("--level-of", metavar="GARMENT",
                       help="these are levels of quality of a garment of the shot: variants of its prim")  # fmt: skip
    names.add_argument("--asset-version", metavar="PATTERN",
                       help="of the garment, in the assetInfo of what is written, such as v012, or '{parent}' "
                            "(default: what the asset has, else a hash of the model)")  # fmt: skip
    names.add_argument("--asset-identifier", metavar="PATTERN",
                       help="likewise, such as 'studio:/cloth/{stem}' (default: what the asset has, else its own "
                            "layer; none in a file)")  # fmt: skip
    names.add_argument("--replace", action="store_true",
                       help="bake even where a name was used for another input, or an asset has another "
                            "version")  # fmt: skip


def _add_output(verb: argparse.ArgumentParser) -> None:
    """Add the options that say what becomes of the garment, and what is written with it."""
    verb.add_argument("--lbs", action="store_true", help="bake linear blend skinning instead of the network")
    verb.add_argument("--points", action="store_true", help="write point caches as well (folders)")
    verb.add_argument(
        "--refine",
        type=NumberRange(0, MAX_REFINE, int),
        default=0,
        metavar="N",
        help="iterations of the simulator's solver in each frame, from the network's state (default 0)",
    )
    verb.add_argument(
        "--feedback",
        action="store_true",
        help="refined frames look back on refined ones: the garment follows the solver, not the network",
    )
    verb.add_argument(
        "--latent-iterations",
        type=NumberRange(0, MAX_REFINE, int),
        default=0,
        metavar="N",
        help="iterations of a solver in the model's latents in each frame, instead of the network's step (default 0)",
    )
    verb.add_argument(
        "--latent-elements",
        choices=LATENT_ELEMENTS,
        default=ALL_ELEMENTS,
        help="that solver sums the energy over the whole garment (default), or over few of its elements: some "
        "four times as fast, less exact in wild motion",
    )
    verb.add_argument(
        "--refined-output",
        choices=REFINED_OUTPUTS,
        default=REFINED_OUTPUTS[0],
        help="refined garments as joints and blendshapes of the shot's own (default), or as time-sampled points",
    )
    verb.add_argument(
        "--certify",
        action="store_true",
        help="move frames as little as it takes until, in the written file, no triangle of the garment intersects "
        "another and no covered skin shows; say which have no free position",
    )
    verb.add_argument("--no-body", action="store_true", help="leave the body meshes out")
    verb.add_argument(
        "--hide-covered",
        action="store_true",
        help="hide the body's faces that the garment covers in every frame, where skin shows through: a last resort",
    )
    verb.add_argument("--no-verify", action="store_true", help="do not re-skin the written files")
    verb.add_argument("--device", default="cpu", help="where the network runs (default cpu)")


def add_level(verb: argparse.ArgumentParser, size: str, *, plays: bool = False) -> None:
    """Add --quality and --budget; `size` says of what a budget in bytes is, `plays` that levels limit the rate."""
    rates = {
        level.name: f", at most {level.fps:g} frames a second" for level in QUALITIES.values() if plays and level.fps
    }
    levels = "; ".join(f"{level.name}: {level.about}{rates.get(level.name, '')}" for level in QUALITIES.values())
    verb.add_argument("--quality", choices=QUALITIES, help=f"level of quality ({levels})")
    verb.add_argument("--budget", metavar="AMOUNT", help=f"keep the most within 0.3ms for each frame, or {size}")


def requests_of(options: argparse.Namespace) -> list[BakeRequest]:
    """Return a request for each model on each body over each motion, as the options of `add_bake` say."""
    shots: list[tuple[str | None, naming.ListedShot]]
    if options.shots:
        if options.shot_name:
            fail("--shot-name", "a pattern and a list of shots", "the list names them", "leave one of them out")
        shots = list(naming.read_shots(options.shots).items())
    else:
        listed = map(naming.ListedShot, options.motion)
        shots = [(_name(options.shot_name, shot.motion, "--shot-name"), shot) for shot in listed]
    worn = [
        (model, split_location(model), _name(options.garment_name, model, "--garment-name"))
        for model in _models(options.model)
    ]
    requests = [
        BakeRequest(
            model=model,
            stage=str(stage),
            motion=shot.motion,
            root=root,
            fps=options.fps,
            range=shot.range or options.range,
            handles=options.handles,
            samples_per_frame=options.samples_per_frame,
            pre_roll=options.pre_roll,
            target=options.target,
            lbs=options.lbs,
            refine=options.refine,
            feedback=options.feedback,
            latent_iterations=options.latent_iterations,
            latent_elements=options.latent_elements,
            refined_output=options.refined_output,
            certify=options.certify,
            hide_covered=options.hide_covered,
            hold=options.hold or 0,
            loop=options.loop,
            start_cloth=options.start_cloth,
            colliders=tuple(options.collider),
            wind=options.wind,
            gusts=options.gusts,
            gravity=options.gravity,
            fabric=options.fabric,
            material=tuple(options.material),
            device=options.device,
            garment=garment,
            shot=name,
            level_of=options.level_of,
            asset_version=_name(options.asset_version, whole, "--asset-version"),
            asset_identifier=_name(options.asset_identifier, whole, "--asset-identifier"),
        )
        for whole, (model, root), garment in worn
        for stage in options.stage
        for name, shot in shots
    ]
    if not options.body_name and len(options.stage) == 1:
        return requests
    bodies = {
        str(stage): naming.pattern_name(options.body_name or "{stem}", str(stage), "--body-name")
        for stage in options.stage
    }
    return named_by_bodies(requests, bodies)


def _models(named: Iterable[str]) -> list[str]:
    """Return models, "MODEL[:/ROOT]" each, with those of a list in its place, inner ones first.

    Raises:
        SsilkError: a list cannot be read, or a model that it stands for is not beside it.
    """
    found = list[str]()
    for each in named:
        path, root = split_location(each)
        if not path.endswith(LIST):
            found.append(each)
            continue
        from ..training.wardrobe.listing import read_list

        for entry in read_list(Path(path)):
            model = Path(path).with_name(f"{entry.name}{MODEL}")
            if not model.is_file():
                missing, allowed = f"there is no {model}", "the models of a list lie beside it"
                todo = "train it with 'ssilk wardrobe', and name the list in the folder of its models"
                fail(f"{path}: table '{entry.name}'", missing, allowed, todo)
            found.append(f"{model}:{root}" if root else str(model))
    return found


def _name(pattern: str | None, location: str, option: str) -> str | None:
    return naming.pattern_name(pattern, location, option) if pattern else None


def layer_options(options: argparse.Namespace) -> dict[str, bool]:
    """Return what `plan_layers` takes beside requests, as the options of `add_bake` say."""
    return {
        "include_body": not options.no_body,
        "points": options.points,
        "verify": not options.no_verify,
        "replace_names": options.replace,
    }


def is_folder(output: Path) -> bool:
    """Return whether an output is a folder, there already or by its name."""
    return output.is_dir() or not output.suffix


def wardrobe(options: argparse.Namespace) -> tuple[Path, str | None]:
    """Return the file that holds the garment, and the prim that was asked for."""
    from ssilk_usd.opening.stage import USD_SUFFIXES

    file, prim = split_location(options.garment) if options.garment else ("", None)
    return (Path(file), prim) if Path(file).suffix in USD_SUFFIXES else (options.stage, options.garment)


def check_output(output: Path, *inputs: Path | str | None) -> None:
    """Check that `output` can be written and is none of the `inputs`.

    Raises:
        SsilkError: it cannot, or it is.
    """
    need_writable(output)
    need_not_input(output, *inputs)


def read(options: argparse.Namespace, report: Reporter) -> tuple[Character, Garment, ProxyRig | None]:
    """Read the character, the garment and its authored rig, as the options of `add_scene` say."""
    from ssilk_usd.reading.scene import read_scene

    file, shapes = split_body(str(options.stage))
    if not Path(file).exists():
        fail(str(options.stage), "there is no such file", "a USD stage with a character is needed")
    if shapes and wardrobe(options)[0] == options.stage:
        found = "the stage's own garment, on a body that weights of its shapes make"
        fail(str(options.stage), found, "the garment lies as on the body of the stage itself",
             f"'ssilk rig {file} --onto {shapes}' puts it on that one")  # fmt: skip
    return read_scene(options.stage, root=options.root, bodies=options.body, garment=options.garment, report=report)


def need_onto(options: argparse.Namespace) -> None:
    """Raise `SsilkError` for --joints without --onto."""
    if options.joints and not options.onto:
        allowed = "a map says which joints of --onto stand for those of the garment's character"
        fail(f"--joints {options.joints}", "no --onto", allowed, "name a character with --onto")


def read_onto(options: argparse.Namespace, report: Reporter) -> Character:
    """Read the character of --onto, "STAGE[:/ROOT]", which has another skeleton: --root and --body name others."""
    from ssilk_usd.reading.character import read_character

    file, root = onto(options)
    if not Path(split_body(file)[0]).exists():
        fail(file, "there is no such file", "a USD stage with a character is needed")
    return read_character(file, root=root, report=report)


def onto(options: argparse.Namespace) -> tuple[str, str | None]:
    """Return where the character of --onto is, which may be weights of the stage's shapes, and its root."""
    file, root = split_location(str(options.onto))
    return body_of(file, str(options.stage)), root


def read_member(options: argparse.Namespace, location: str, report: Reporter, root: str | None = None) -> Character:
    """Read another body of the character; a body of its own stage has its garment too, which is none of the body."""
    from ssilk_usd.reading.character import read_character

    file, prim = wardrobe(options)
    stage = split_body(str(options.stage))[0]
    own = is_same_file(split_body(location)[0], stage) and is_same_file(file, stage)
    root, garment = root or options.root, prim if own else None
    return read_character(location, root=root, bodies=options.body, garment=garment, report=report)


def bodies_in_list(entry: WardrobeEntry, entries: Sequence[WardrobeEntry], folder: Path) -> list[str]:
    """Return the paths of the bodies that a garment of a list meets, where its stage has others of the list as well.

    Garments that a stage does not mark as such count as bodies, and would be met twice: as bodies that move with the
    skeleton, and as the garments that they are. Nothing where none would.

    Args:
        folder: that of the list, to which its paths are relative.

    Raises:
        SsilkError: the stage has no character.
    """
    from ssilk_usd.reading.character import bodies_beside

    from ..training.wardrobe.listing import garment_file

    table = entry.located(folder)
    stage, own = Path(table["stage"]), garment_file(table)[1]
    if not Path(split_body(str(stage))[0]).is_file():
        return []  # which is told where it is read
    others = [garment_file(each.located(folder)) for each in entries if each is not entry]
    beside = [prim for file, prim in others if prim and Path(file).resolve() == stage.resolve()]
    return bodies_beside(str(stage), beside, own if garment_file(table)[0] == str(stage) else None) if beside else []


def members(options: argparse.Namespace, report: Reporter) -> list[str]:
    """Return where the bodies of --family are, as `open_stage` takes them.

    Without a word, --family means bodies within the ranges of all shapes that the stage marks as body parameters:
    each shape alone, and combinations of all. It says which these are.

    Raises:
        SsilkError: it marks none, or a body is named twice.
    """
    if options.family is None:
        return []
    if options.family:
        named = [_as_compared(body_of(str(member), str(options.stage))) for member in options.family]
        if twice := next((each for each in named if named.count(each) > 1), None):
            fail(f"--family {twice}", "a body that is named twice", "each is named once", "leave one out")
        return named
    from ssilk_usd.opening.shaped import body_parameters
    from ssilk_usd.opening.stage import open_stage

    file, known = split_body(str(options.stage))[0], body_parameters(open_stage(options.stage))
    marked = {name: each for name, each in known.items() if each.is_marked}
    if not marked:
        there = f"its blendshapes are {', '.join(known)}" if known else "its bodies have no blendshapes"
        fail(file, "it marks no body parameters with ssilk:weightRange", there,
             "name the bodies, such as --family tall=1 heavy=1")  # fmt: skip
    alone, combined = bodies_within({name: (each.low, each.high) for name, each in marked.items()})
    told = f"{len(alone)} with one shape at an end of its range"
    told += f", and {len(combined)} with every shape at an end" if combined else ""
    report(Message(f"--family takes {format_count(len(alone + combined), 'bodies')} beside the stage's own: {told}"))
    return [f"{file}:{shapes}" for shapes in (*alone, *combined)]


def _as_compared(body: str) -> str:
    """Return where a body is with its weights of shapes as they are compared."""
    file, shapes = split_body(body)
    return f"{Path(file)}:{shapes_text(parse_shapes(body, shapes))}" if shapes else str(Path(body))


def tell_shapes(
    options: argparse.Namespace, motions: Iterable[Motion], report: Reporter, *, trained: Character | None = None
) -> None:
    """Warn of motions that show the character's meshes otherwise than its stage; options as `load_scene`.

    Args:
        trained: the character in a training, which has one shape whatever the motions' blendshapes are.
    """
    from ssilk_usd.reading.shown import tell_shown_otherwise

    motions = list(motions)
    chosen = {"root": options.root, "garment": options.garment, "bodies": options.body}
    tell_shown_otherwise(options.stage, [motion.path for motion in motions], report, **chosen)
    if trained is None:
        return
    for motion in motions:
        found = reshaped(trained, with_shapes(options, motion, motion.path, trained))
        if found:
            text = f"{motion.path}: {'; '.join(map(str, found))}"
            report(Message(f"{text}; training sees the shape of the character's stage alone", "warning"))


def with_shapes(options: argparse.Namespace, motion: Motion, source: str | Path, character: Character) -> Motion:
    """Return a motion with the blendshapes of the character that its file weighs; options as `load_scene`."""
    from ssilk_usd.reading.body_shapes import with_body_shapes

    chosen = {"root": options.root, "garment": options.garment}
    return shaped_as_in_stage(
        character, lambda own: with_body_shapes(options.stage, str(source), motion, own, **chosen)
    )


def load_scene(
    options: argparse.Namespace,
    report: Reporter,
    *,
    rigging: RigOptions | None = None,
) -> Scene:
    """Read a scene and make the weights, classes and rig that it lacks, as `rigging` says."""
    from ..authoring.setup.prepare import prepare_scene

    character, garment, rig = read(options, report)
    return prepare_scene(character, garment, rig, rig_options=rigging, report=report)


def laid(options: argparse.Namespace, garment: Mesh) -> Callable[[], Mesh] | None:
    """Return what reads a garment where riders of its stage lie on it; None where that is on the body that it is on.

    A body that weights of the stage's shapes make has the garment from elsewhere, and riders from the stage.
    """
    from ssilk_usd.reading.scene import read_scene

    file, shapes = split_body(str(options.stage))
    name = (split_location(garment.path)[1] or garment.path).rpartition("/")[2]
    return (lambda: read_scene(file, root=options.root, garment=name)[1].mesh) if shapes else None


def bodies(stages: Sequence[Path]) -> dict[str, Path]:
    """Return the stages of bodies by their names, their stems or shapes; that of one alone by none.

    Raises:
        SsilkError: two have one name.
    """
    if len(stages) == 1:
        return {"": stages[0]}
    found: dict[str, Path] = {}
    for stage in stages:
        name = body_name(str(stage))
        if name in found:
            fail(str(stage), f"a second body '{name}'", "names of stages tell bodies apart", "rename one")
        found[name] = stage
    return found
