# SPDX-License-Identifier: GPL-3.0-or-later
"""Export a glTF binary in a Blender of its own, so that the artist's stays usable and may stop it; then compare.

Run by Blender, or by a Python with the bpy module. After `--` come the copy of the file, whether its scripts run in
the artist's Blender ("trusted" or "untrusted"), the names of garment and armature, the .glb to write, what that
Blender showed (.npy), and the folders of the modules that it has.
"""

import importlib
import json
import os
import shutil
import signal
import sys
from pathlib import Path

import bpy


def say(event, **fields):
    """Print an event as one line of JSON."""
    print(json.dumps({"event": event, **fields}), flush=True)


def count_frames(total):
    """Tell of each frame that is shown: the exporter shows all of them, and so does the comparison."""
    shown = []

    def on_frame(*_):
        shown.append(1)
        say("progress", done=min(len(shown), total), total=total)

    bpy.app.handlers.frame_change_post.append(on_frame)


def heed_interrupts():
    """End at once when asked to: Blender itself waits for a second interrupt."""
    for name in ("SIGINT", "SIGBREAK"):
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), lambda *_: os._exit(130))


def end(code):
    """End at once: Blender 4.5 as a module may wait for ever for a thread of its own while it exits."""
    shutil.rmtree(bpy.app.tempdir, ignore_errors=True)
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def main(blend, trust, garment, armature, path, seen, *folders):
    """Open the file, export, and compare what is in the .glb with what Blender shows, here and there."""
    heed_interrupts()
    sys.path[:0] = folders
    own = Path(__file__).resolve().parents[1]
    sys.path.insert(0, str(own.parent))
    gltf = importlib.import_module(f"{own.name}.playback.gltf")
    errors = importlib.import_module("ssilk_core.errors")
    bpy.ops.wm.open_mainfile(filepath=blend, load_ui=False, use_scripts=trust == "trusted")
    scene = bpy.context.scene
    count_frames(2 * (scene.frame_end - scene.frame_start + 1))
    try:
        things = bpy.data.objects[garment], bpy.data.objects[armature]
        loss, frame = gltf.exported(*things, Path(path))
        apart, where = gltf.apart(*things, Path(seen))
    except errors.SsilkError as error:
        say("failed", error=str(error))
        end(2)
    say("result", task="export", detail={"loss": loss, "frame": frame, "apart": apart, "where": where})
    end(0)


if __name__ == "__main__":
    main(*sys.argv[sys.argv.index("--") + 1 :])
