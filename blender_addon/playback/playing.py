# SPDX-License-Identifier: GPL-3.0-or-later
"""The garments that are played live, and the handlers that update them on frame changes, loading and rendering.

Nothing is written while Blender renders in another thread and its interface is not locked: both would write at once.
"""

from __future__ import annotations

import bpy
from bpy.app.handlers import persistent

from ssilk_core.errors import SsilkError

from ..outside.jobs import MODEL, read_state
from ..scene import overlay
from .live import Live
from .models import job_of, model_of

PATIENCE = 0.3  # seconds after an edit before the motion is read again
BETWEEN = 0.01  # seconds between two slices of reading, for the artist
_played: dict[int, Live] = {}
_reasons: dict[int, str] = {}
_outdated: set[int] = set()  # those whose keys were edited since their motion was read
_rendering = False


def live(garment: bpy.types.Object) -> Live | None:
    """Return what plays a garment; None where nothing does."""
    return _played.get(garment.session_uid)


def reason(garment: bpy.types.Object) -> str:
    """Return why a garment is no longer played; empty if nothing went wrong."""
    return _reasons.get(garment.session_uid, "")


def play(garment: bpy.types.Object) -> None:
    """Play a garment from now on. In object mode.

    Raises:
        SetupError: it cannot be played.
    """
    _reasons.pop(garment.session_uid, None)
    _outdated.discard(garment.session_uid)
    _played[garment.session_uid] = Live(garment, model_of(garment))
    garment.ssilk.live = True
    _read_soon(0.0)


def stop(garment: bpy.types.Object) -> None:
    """Play a garment no longer; it stays as it is."""
    _played.pop(garment.session_uid, None)
    garment.ssilk.live = False


def refresh(garment: bpy.types.Object) -> None:
    """Read the motion of a garment before it is played again."""
    _outdated.discard(garment.session_uid)
    _played[garment.session_uid].refresh()
    _read_soon(0.0)


def take_up_models() -> None:
    """Switch to the newest models of trainings that are played."""
    for uid, played in list(_played.items()):
        if played.renewed and played.done is None and _attempt(uid, played.ready):
            _attempt(uid, played.take_up)
            _read_soon(0.0)


def play_what_is_awaited() -> None:
    """Play the garments that wait for the first model of their training; in object mode."""
    if bpy.context.mode != "OBJECT":
        return
    for garment in bpy.data.objects:
        if not garment.ssilk.awaited or garment.name not in bpy.context.scene.objects:
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


def _forget() -> None:
    for known in (_played, _reasons, _outdated):
        known.clear()


def _handlers() -> list[tuple[list, object]]:
    calls = bpy.app.handlers
    return [
        (calls.frame_change_post, _frame_changed),
        (calls.depsgraph_update_post, _edited),
        (calls.load_post, _loaded),
        (calls.render_init, _render_began),
        (calls.render_complete, _render_ended),
        (calls.render_cancel, _render_ended),
    ]


def _read_soon(seconds: float) -> None:
    """Read motions a little at a time; all at once where Blender has no window to keep alive."""
    if bpy.app.background:
        while _read() is not None:
            pass
    elif not bpy.app.timers.is_registered(_read):
        bpy.app.timers.register(_read, first_interval=seconds)


def _read() -> float | None:
    """Read a little of one motion; return when to be called again."""
    for uid, played in list(_played.items()):
        if uid in _outdated:
            _outdated.discard(uid)
            _attempt(uid, played.refresh)
        if played.done is not None:
            more = _attempt(uid, played.read)
            if not more:
                _show_all(bpy.context.scene, bpy.context.evaluated_depsgraph_get())
            return BETWEEN
    return None


def _attempt(uid: int, call, *arguments: object) -> object:  # type: ignore[no-untyped-def]
    """Return what a call gives; a garment for which it fails is played no longer, and the panel says why."""
    try:
        return call(*arguments)
    except SsilkError as error:
        _played.pop(uid, None)
        _reasons[uid] = str(error)
        return None


def _show_all(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    if _rendering and not (scene.render.use_lock_interface or bpy.app.background):
        return
    for uid, played in list(_played.items()):
        _attempt(uid, played.show, scene, depsgraph)


@persistent
def _frame_changed(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    _show_all(scene, depsgraph)


@persistent
def _edited(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    """Read the motion again when keys were edited; what else may move the armature is for the artist to say."""
    if not _played or not any(isinstance(update.id, bpy.types.Action) for update in depsgraph.updates):
        return
    for uid, played in list(_played.items()):
        if _attempt(uid, played.is_in, scene):
            played.stale = True
            _outdated.add(uid)
    if not bpy.app.background:
        _read_soon(PATIENCE)


@persistent
def _loaded(_: str) -> None:
    """Go on playing what was played when the file was saved."""
    _forget()
    for garment in bpy.data.objects:
        if garment.ssilk.live:
            _attempt(garment.session_uid, play, garment)


@persistent
def _render_began(*_: object) -> None:
    global _rendering
    _rendering = True


@persistent
def _render_ended(*_: object) -> None:
    global _rendering
    _rendering = False
