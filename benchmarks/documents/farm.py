# SPDX-License-Identifier: Apache-2.0
"""The tables of docs/farm.md: killed workers, a disturbed cluster, and what a shared disk is asked."""

from __future__ import annotations

from typing import Any

from ssilk_core.delivery.farm.openjd import CHUNK

from .forms import fixed, result, table

CORES = 2  # of the machine that shared_disk.json is from


def cluster() -> str:
    """Bakes in bulk, whose workers are killed; cores; memory."""
    found, soak = result("farm")["cluster"], result("farm_soak")["soak"]
    names = {
        "shots": "shots", "workers killed": "workers killed", "shots lost": "shots lost",
        "shots baked twice": "shots ended twice", "files half written": "half-written files",
        "shots compared with an undisturbed bake": "shots compared",
        "of these, shots that differ": "shots that differ from an undisturbed bake",
    }  # fmt: skip
    rows: list[list[object]] = [[words, found[name]] for words, name in names.items()]
    for count, cores in {1: "1 core", 2: "2 cores", 4: "4 cores"}.items():
        rate = result("farm_cores")["cores"][f"shots per second, cores: {count}"]
        rows.append([f"shots of 60 frames a second on {cores}", fixed(rate, 1)])
    for bakes in ("1,000", "3,000", "10,000"):
        memory = soak[f"memory after {bakes} bakes [MiB]"]
        rows.append([f"memory after {bakes} bakes in one process [MiB]", fixed(memory)])
    for words in ("start Python and its modules", "load the model and its character"):
        rows.append([f"seconds to {words}", fixed(result("farm")["start"][f"seconds to {words}"], 2)])
    return table(("measured", ""), rows)


def fuzzed() -> str:
    """Damaged files that readers refused or read."""
    rows = [
        [f"`{name}`", f"{at['refused']:,}", f"{at['read']:,}", fixed(at["longest [s]"])]
        for name, at in result("fuzz_stages")["readers"].items()
    ]
    return table(("damaged file", "refused", "read", "longest [s]"), rows)


def disturbed() -> str:
    """A cluster whose workers, drivers and raylets are killed."""
    return table(("measured, on a busy machine", ""), list(result("disturbed_farm").items()))


def _disk() -> tuple[dict[str, Any], float, float, float]:
    """Return what shared_disk.py found, and the operations of a chunk, of a task and of the last step for a task."""
    found = result("shared_disk")
    one, two = (found["runs"][f"bake, workers: {count}"]["operations in the folder"] for count in (1, 2))
    last = found["runs"]["check"]["operations in the folder"] / found["shots"]
    return found, two - one, (2 * one - two) / found["shots"], last


def disk() -> str:
    """File operations of each part of a job."""
    found, chunk, task, last = _disk()
    again = found["runs"]["bake again"]["operations in the folder"] / found["shots"]
    rows = [
        ["operations of a chunk", fixed(chunk)],
        ["operations of each of its tasks", fixed(task)],
        ["operations of a task that is done already", fixed(again)],
        ["operations of the last step, for each task", fixed(last)],
    ]
    return table(("counted in the folders of the show", ""), rows)


def disk_workers() -> str:
    """Time of a job on a slow disk, calculated and measured."""
    found = _disk()[0]
    delay, rows = found["delay of a file operation [s]"], []
    for count in (1, 2, 4):
        run = found["runs"][f"bake, workers: {count}"]
        waited = delay * run["operations of the busiest worker"]
        computed = run["seconds of computing, start included"] / min(count, CORES)
        rows.append([count, run["operations in the folder"], fixed(waited), fixed(waited + computed),
                     fixed(run["seconds"])])  # fmt: skip
    return table(("workers", "operations", "waiting [s]", "calculated [s]", "measured [s]"), rows, 0)


def large_job() -> str:
    """What a job of 50,000 tasks asks of one disk, extrapolated."""
    found, chunk, task, last = _disk()
    job, sizes = found["large job"], found["bytes"]
    tasks, chunks = job["tasks"], job["tasks"] / CHUNK
    operations = chunks * chunk + tasks * task
    shared = sizes["model"] + sizes["stage"] + sizes["asset"] + job["bytes"]
    rows = [
        ["operations of all bakes, millions", fixed(operations, 1, 1e6)],
        ["of these by each of 1,000 workers", fixed(operations, 0, 1000)],
        ["minutes that each worker waits, at 1 ms", fixed(operations / 1000 * 1e-3 / 60, 1)],
        ["minutes that each worker waits, at 10 ms", fixed(operations / 1000 * 1e-2 / 60, 1)],
        ["read by a chunk: model, stage, asset and job [MB]", fixed(shared, 0, 1e6)],
        ["read by all chunks, where no host keeps any of it [GB]", fixed(chunks * shared, 0, 1e9)],
        ["the file of the job [MB]", fixed(job["bytes"], 0, 1e6)],
        ["reading it for one chunk [s]", fixed(job["seconds to read ten"], 2)],
        ["operations of the last step, millions", fixed(tasks * last, 1, 1e6)],
        ["minutes that the last step waits, at 1 ms, at most", fixed(tasks * last * 1e-3 / 60)],
    ]
    return table(("", ""), rows)
