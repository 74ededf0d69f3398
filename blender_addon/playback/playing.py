# SPDX-License-Identifier: GPL-3.0-or-later
"""The garments that are played live, and the handlers that update them on frame changes, loading and rendering.

A render reads the keys that stand for what is played. The motion is therefore read again before its first frame, in
the main thread, and nothing is written from then on until it ends: Blender may render in another thread.
"""

from __future__ import annotations

import threading
import time

import bpy
from bpy.app.handlers import persistent

from ssilk_core.errors import SsilkError

from ..motions.keys import is_baked
from ..outside.jobs import MODEL, read_state
from ..scene import overlay
from .dressed import remove_live_keys
from .live import Live
from .models import job_of, model_of

PATIENCE = 0.3  # seconds after an edit before the motion is read again
BETWEEN = 0.01  # seconds between two slices of reading, for the artist
SOLVING = 0.1  # seconds between two looks at what was solved
_played: dict[int, Live] = {}
_reasons: dict[int, str] = {}
_warnings: dict[int, str] = {}  # about frames of the latest render
_outdated: set[int] = set()  # those whose keys were edited since their motion was read
_rendering = False


def live(garment: bpy.types.Object) -> Live | None:
    """Return what plays a garment; None where nothing does."""
    return _played.get(garment.session_uid)


def reason(garment: bpy.types.Object) -> str:
    """Return why a garment is no longer played; empty if nothing went wrong."""
    return _reasons.get(garment.session_uid, "")


def warning(garment: bpy.types.Object) -> str:
    """Return what was wrong with the latest render of a garment that is played; empty if nothing was."""
    return _warnings.get(garment.session_uid, "")


def play(garment: bpy.types.Object) -> None:
    """Play a garment from now on. In object mode.

    Raises:
        SetupError: it cannot be played.
    """
    _let_go(garment.session_uid)
    _reasons.pop(garment.session_uid, None)
    _outdated.discard(garment.session_uid)
    _played[garment.session_uid] = Live(garment, model_of(garment))
    garment.ssilk.live = True
    _read_soon(0.0)


def stop(garment: bpy.types.Object) -> None:
    """Play a garment no longer; it stays as it is."""
    _let_go(garment.session_uid)
    remove_live_keys(garment)
    garment.ssilk.live = False


def play_otherwise(garment: bpy.types.Object) -> None:
    """Play a garment at the level of quality that was chosen for it, where it is played."""
    played = live(garment)
    if played and played.solver.level != garment.ssilk.live_quality:
        _attempt(garment.session_uid, played.choose, garment.ssilk.live_quality)
        _read_soon(0.0)


def change_fabric(garment: bpy.types.Object) -> None:
    """Play a garment in the fabric that was chosen for it, where it is played."""
    played = live(garment)
    if played and played.done is None and _attempt(garment.session_uid, lambda: played.in_other_fabric):
        _attempt(garment.session_uid, played.change_fabric)
        _read_soon(0.0)


def refresh(garment: bpy.types.Object) -> None:
    """Read the motion of a garment before it is played again."""
    _outdated.discard(garment.session_uid)
    _played[garment.session_uid].refresh()
    _read_soon(0.0)


def take_up_models() -> None:
    """Switch to the newest models of trainings that are played."""
    for uid, played in list(_played.items()):
        if played.renewed and played.done is None and _attempt(uid, played.dressed.ready):
            _attempt(uid, played.take_up)
            _read_soon(0.0)


def play_what_is_awaited() -> None:
    """Play the garments that wait for the first model of their training; in object mode."""
    if bpy.context.mode != "OBJECT":
        return
    for garment in bpy.data.objects:
        if garment.library or not garment.ssilk.awaited or garment.name not in bpy.context.scene.objects:
            continue
        job = job_of(garment)
        state = job and read_state(job)
        if job and (job / MODEL).is_file():
            garment.ssilk.awaited = False
            _attempt(garment.session_uid, play, garment)
            overlay.hide()  # classes would lie over what the artist has waited for
        elif not (state and state.alive):  # it ended before there was a model, and the panel says why
            garment.ssilk.awaited = False


def start_listening() -> None:
    """Register the handlers."""
    for handlers, function in _handlers():
        handlers.append(function)


def stop_listening() -> None:
    """Remove handlers and timer, and stop playing."""
    _forget()
    for handlers, function in _handlers():
        if function in handlers:
            handlers.remove(function)
    if bpy.app.timers.is_registered(_read):
        bpy.app.timers.unregister(_read)


def _let_go(uid: int) -> Live | None:
    """Play a garment no longer; return what played it."""
    played = _played.pop(uid, None)
    if played:
        played.solver.close()
    return played


def _forget() -> None:
    for uid in list(_played):
        _let_go(uid)
    for known in (_played, _reasons, _warnings, _outdated):
        known.clear()


def _handlers() -> list[tuple[list, object]]:
    calls = bpy.app.handlers
    return [
        (calls.frame_change_post, _frame_changed),
        (calls.depsgraph_update_post, _edited),
        (calls.load_post, _loaded),
        (calls.undo_post, _undone),
        (calls.redo_post, _undone),
        (calls.render_init, _render_began),
        (calls.render_complete, _render_ended),
        (calls.render_cancel, _render_ended),
    ]


def _read_soon(seconds: float) -> None:
    """Read motions a little at a time; all at once where Blender has no window to keep alive."""
    if bpy.app.background:
        _read_all()
    elif not bpy.app.timers.is_registered(_read):
        bpy.app.timers.register(_read, first_interval=seconds)


def _read_all() -> None:
    """Read all motions, and wait for what is solved."""
    while (pause := _read()) is not None:
        time.sleep(pause if pause == SOLVING else 0.0)


def _read() -> float | None:
    """Read a little of one motion, or take in what was solved; return when to be called again."""
    if _rendering:
        return PATIENCE
    for uid, played in list(_played.items()):
        if uid in _outdated:
            _outdated.discard(uid)
            _attempt(uid, played.refresh)
        if played.done is not None:
            more = _attempt(uid, played.read)
            if not more:
                depsgraph = bpy.context.evaluated_depsgraph_get()
                _show_all(bpy.context.scene, depsgraph)
                if _attempt(uid, played.meets_otherwise, bpy.context.scene, depsgraph):  # edited while it was read
                    _outdate(uid, played)
            return BETWEEN
    waits = [_solve(uid, played) for uid, played in list(_played.items())]
    return SOLVING if any(waits) else None


def _solve(uid: int, played: Live) -> bool:
    """Take in what was solved for a garment, and show it; return whether more will come."""
    before, scene = played.solved, bpy.context.scene
    waits = bool(_attempt(uid, played.solve))
    if not waits or before <= scene.frame_current - played.first < played.solved:
        _show_all(scene, bpy.context.evaluated_depsgraph_get())
    _redraw_panels()
    return waits


def _redraw_panels() -> None:
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            for region in area.regions if area.type == "VIEW_3D" else ():
                if region.type == "UI":
                    region.tag_redraw()


def _attempt(uid: int, call, *arguments: object) -> object:  # type: ignore[no-untyped-def]
    """Return what a call gives; a garment for which it fails is played no longer, and the panel says why."""
    try:
        return call(*arguments)
    except SsilkError as error:
        played = _let_go(uid)
        _reasons[uid] = str(error)
        if played and played.rolled and not _rendering:  # else a file's own keys stay, as where it lacks its model
            for garment in (thing for thing in bpy.data.objects if thing.session_uid == uid):
                remove_live_keys(garment)
        return None


def _show_all(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    for uid, played in list(_played.items()):
        waits, known = played.done is None, played.solver.noticed
        _attempt(uid, played.show, scene, depsgraph)
        lost_shapes = waits and played.done is not None  # and is dressed again
        if lost_shapes or (played.solver.noticed and not known and not bpy.app.background):
            _read_soon(PATIENCE)


@persistent
def _frame_changed(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    if not _rendering:
        _look_at_times(scene)
        _show_all(scene, depsgraph)
    elif depsgraph.mode == "RENDER":
        _compare(scene, depsgraph)


def _compare(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    """Say where a rendered frame shows another motion than the one that the garment follows."""
    for uid, played in list(_played.items()):
        if _attempt(uid, played.disagrees, scene, depsgraph):
            garment, armature = played.dressed.objects()
            told = (
                f"Frame {scene.frame_current} was rendered with another pose of '{armature.name}' than "
                f"'{garment.name}' follows; bake it over the frames that you render."
            )
            print(f"SSILK: {told}")
            _warnings[uid] = told


@persistent
def _edited(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    """Read the motion again when keys were edited; what else may move the armature is for the artist to say."""
    if not _played or _rendering:
        return
    _look_at_times(scene)
    if any(isinstance(update.id, bpy.types.Action) and not is_baked(update.id) for update in depsgraph.updates):
        _read_again(scene)
    moved = [
        update.id.original
        for update in depsgraph.updates
        if isinstance(update.id, bpy.types.Object) and (update.is_updated_transform or update.is_updated_geometry)
    ]
    for uid, played in list(_played.items()) if moved else ():
        if _attempt(uid, played.meets_otherwise, scene, depsgraph, moved):
            _outdate(uid, played)


def _look_at_times(scene: bpy.types.Scene) -> None:
    """Read motions again where the scene's frames or its rate are others by now."""
    if scene == bpy.context.scene and any(played.done is None and played.behind for played in _played.values()):
        _read_again(scene)


def _read_again(scene: bpy.types.Scene) -> None:
    for uid, played in list(_played.items()):
        if _attempt(uid, played.dressed.is_in, scene):
            _outdate(uid, played)


def _outdate(uid: int, played: Live) -> None:
    """Read a garment's motion again, soon."""
    played.stale = True
    _outdated.add(uid)
    if not bpy.app.background:
        _read_soon(PATIENCE)


@persistent
def _undone(*_: object) -> None:
    """Play no longer what was not played by then, and dress again what lost its shapes or keys."""
    for uid, played in list(_played.items()):
        found = _attempt(uid, played.dressed.objects)
        if not found:
            continue
        if not found[0].ssilk.live:
            _let_go(uid)
        elif played.done is not None or _attempt(uid, played.missing):
            _attempt(uid, played.dress_again)
        elif played.solver.level != found[0].ssilk.live_quality:
            _attempt(uid, played.choose, found[0].ssilk.live_quality)
        elif played.in_other_fabric:
            _attempt(uid, played.change_fabric)
        elif played.solved:
            _attempt(uid, played.key_again)
    _read_soon(PATIENCE)


@persistent
def _loaded(_: str) -> None:
    """Go on playing what was played when the file was saved; of linked garments the keys play."""
    _forget()
    for garment in bpy.data.objects:
        if garment.ssilk.live and not garment.library:
            _attempt(garment.session_uid, play, garment)


@persistent
def _render_began(scene: bpy.types.Scene, *_: object) -> None:
    """Read again what the armatures do, before the first frame: constraints and drivers tell of no edits."""
    global _rendering
    for uid, played in list(_played.items()):
        _warnings.pop(uid, None)
        if _attempt(uid, played.dressed.is_in, scene):
            _outdated.add(uid)
    if threading.current_thread() is threading.main_thread():
        _read_all()
    else:  # the main thread reads, by its timer, while the render waits here
        if not bpy.app.timers.is_registered(_read):
            bpy.app.timers.register(_read)
        while any(uid in _outdated or played.busy for uid, played in list(_played.items())):
            time.sleep(BETWEEN)
    _rendering = True
    for uid, played in _played.items():
        if played.unkeyed:
            print(f"SSILK: The render lacks what is played live. {played.unkeyed}")
        if played.wrong:
            name = played.dressed.objects()[0].name
            _warnings[uid] = f"The render shows the network's motion of '{name}': {played.wrong}"
            print(f"SSILK: {_warnings[uid]}")


@persistent
def _render_ended(*_: object) -> None:
    global _rendering
    _rendering = False
