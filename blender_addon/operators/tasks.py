# SPDX-License-Identifier: GPL-3.0-or-later
"""Work outside Blender, one at a time, polled by a timer while Blender stays usable."""

from __future__ import annotations

import time

import bpy

from ssilk_core.errors import SsilkError

from ..errors import SetupError
from ..outside.work import Work
from .reporting import RefusingOperator

INTERVAL = 0.1  # seconds between two looks at a running work
current: Work | None = None
failed = ""  # why the latest work failed, for panels; empty where it did not


class OutsideOperator(RefusingOperator):
    """Base of operators whose work runs outside.

    Subclasses give `prepare`, which returns the work, and `finish`, which takes its result and returns a sentence.
    Neither is undone by itself: what changes Blender's data names the step in `undo`.
    """

    undo = ""
    level = "INFO"  # of the report at the end; "WARNING" where something besides the work is wrong
    work: Work | None = None
    timer: bpy.types.Timer | None = None

    @classmethod
    def refusal(cls, context: bpy.types.Context) -> str:
        return busy()

    def prepare(self, context: bpy.types.Context) -> Work:
        """Check everything and start the work; raise `SetupError` if it cannot."""
        raise NotImplementedError

    def finish(self, context: bpy.types.Context, work: Work) -> str:
        """Take the result; return what to tell."""
        raise NotImplementedError

    def explain(self, work: Work) -> str:
        """Return why the work failed; empty if it succeeded nevertheless."""
        return work.error

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Start, and watch by a timer; wait instead where there is no window to do so."""
        if not self._begin(context):
            return {"CANCELLED"}
        if bpy.app.background:
            while not self.work.poll():
                time.sleep(INTERVAL / 10)
            return self._end(context)
        self.timer = context.window_manager.event_timer_add(INTERVAL, window=context.window)
        context.window_manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Poll the work at each timer event."""
        if event.type != "TIMER":
            return {"PASS_THROUGH"}
        redraw(context)
        if self.work is not current:  # stopped by `stop`
            self._leave(context)
            return {"CANCELLED"}
        if not self.work.poll():
            tell(context, self.work.status)
            return {"PASS_THROUGH"}
        if self.undo and context.mode != "OBJECT" and not self.work.error:
            self.work.text = "Done; it is applied as soon as you are in Object Mode"
            return {"PASS_THROUGH"}
        return self._end(context)

    def cancel(self, context: bpy.types.Context) -> None:
        """Stop, as Blender asks when it closes the file, or a dialog before anything has begun."""
        if self.work:
            self._leave(context)

    def _begin(self, context: bpy.types.Context) -> bool:
        global current, failed
        try:
            self.work = self.prepare(context)
        except SsilkError as error:
            failed = str(error)
            self.report({"ERROR"}, failed)
            return False
        current, failed = self.work, ""
        return True

    def _end(self, context: bpy.types.Context) -> set[str]:
        """Report how the work ended, with what it made."""
        global failed
        work = self.work
        try:
            reason = work.error and self.explain(work)
            if reason:
                raise SetupError(reason)
            sentence = self.finish(context, work)
            self.report({self.level}, sentence)
        except SsilkError as error:
            failed = "" if work.cancelled else str(error)
            self.report({"WARNING" if work.cancelled else "ERROR"}, str(error))
            return {"CANCELLED"}
        finally:
            self._leave(context)
        if self.undo:
            bpy.ops.ed.undo_push(message=self.undo)
        return {"FINISHED"}

    def _leave(self, context: bpy.types.Context) -> None:
        global current
        if self.timer:
            context.window_manager.event_timer_remove(self.timer)
            tell(context, None)
            self.timer = None
        self.work.close()
        if current is self.work:
            current = None
        redraw(context, views=True)


def busy() -> str:
    """Return what is running already; empty if nothing is."""
    return f"{current.title} still runs" if current else ""


def stop() -> None:
    """Stop what runs, for good."""
    global current, failed
    failed = ""
    if current:
        current.close()
        current = None


def tell(context: bpy.types.Context, text: str | None) -> None:
    """Show text in the status bar, since the panel may be out of sight; None for what Blender shows there."""
    if context.workspace:  # there is none while a file is closed
        context.workspace.status_text_set(text)


def redraw(context: bpy.types.Context, *, views: bool = False) -> None:
    """Draw again what shows progress, and what views show besides where asked: a heavy scene takes long to draw."""
    for window in context.window_manager.windows:
        for area in window.screen.areas:
            for region in area.regions if area.type in {"VIEW_3D", "PREFERENCES"} else ():
                if views or area.type == "PREFERENCES" or region.type == "UI":
                    region.tag_redraw()


class CancelWork(RefusingOperator, bpy.types.Operator):
    """Stop what runs outside Blender"""

    bl_idname = "ssilk.cancel"
    bl_label = "Cancel"

    @classmethod
    def refusal(cls, _: bpy.types.Context) -> str:
        return "" if current else "Nothing runs"

    def execute(self, _: bpy.types.Context) -> set[str]:
        current.cancel()
        return {"FINISHED"}


class DismissFailure(RefusingOperator, bpy.types.Operator):
    """Take this message away"""

    bl_idname = "ssilk.dismiss_failure"
    bl_label = "Dismiss"

    def execute(self, context: bpy.types.Context) -> set[str]:
        global failed
        failed = ""
        redraw(context)
        return {"FINISHED"}


CLASSES = (CancelWork, DismissFailure)
