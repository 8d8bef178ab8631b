"""What a sweep costs: `python benchmarks/scale.py` writes `scale.md`; `docs/how_to/cluster.md` estimates by it.

Is the cost proportional to the number of responses? Is the memory bounded? What do compiling, a store and a second
device do? Sine pulses on blocks of one slenderness, nonlinear, over frequency and intensity (`rk.sweep` of
`rk.outcome`), and the built-in record on blocks of many sizes; every measurement in a process of its own.
`--largest 1e5` is a quick run, of a few minutes; 1e7 (default) takes half an hour on two cores.
"""

import argparse
import json
import math
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

HERE = Path(__file__).resolve().parent
SIDE = 256  # of the map that one and all devices compute


def grid(points, store=None, **options):
    """A sweep of about so many sine pulses; how many they are."""
    import numpy as np

    import jaxrock as rk

    side = round(math.sqrt(points))
    block = rk.Block(0.2, 1.0)
    threshold = math.tan(0.2)

    def one(frequency_ratio, intensity):
        return rk.outcome(block, rk.SinePulse(intensity * threshold, 2 * np.pi / frequency_ratio))

    axes = {"frequency_ratio": np.linspace(0.3, 8, side), "intensity": np.linspace(1.02, 10, side)}
    return rk.sweep(one, store=store, progress=False, **axes, **options), side**2


def timed(function, repeats=1):
    """Least time of some calls [s], and what the last returned."""
    times = []
    for _ in range(repeats):
        begun = time.perf_counter()
        found = function()
        times.append(time.perf_counter() - begun)
    return min(times), found


def peak_memory():
    """Of this process so far [MiB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1024**2 if sys.platform == "darwin" else 1024)


# What the processes do: each returns numbers


def ladder(largest):
    """Ever larger sweeps."""
    import jax

    grid(1e3)  # compiled here
    before, rows = peak_memory(), []
    for power in range(3, round(math.log10(largest)) + 1):
        seconds, (found, points) = timed(lambda power=power: grid(10**power), 3 if power < 6 else 1)
        held = sum(x.nbytes for x in jax.tree.leaves(found.values)) / 2**20
        rows.append([points, seconds, held, peak_memory() - before])
        del found
    return rows


def one_map():
    """First call, best of later ones, and the device."""
    import jax

    first, _ = timed(lambda: grid(SIDE**2))
    later, (_, points) = timed(lambda: grid(SIDE**2), 7)
    return [first, later, points, jax.local_device_count(), jax.local_devices()[0].device_kind]


def stored(points, folder):
    """Without a store, with one, and read again."""
    grid(1e3)
    plain, _ = timed(lambda: grid(points), 2)  # compiled in the first
    path = Path(folder) / "a.zarr"
    written, (_, count) = timed(lambda: grid(points, store=path))
    again, (found, _) = timed(lambda: grid(points, store=path))
    assert found.resumed == count
    files = [file for file in path.rglob("*") if file.is_file()]
    return [count, plain, written, again, sum(file.stat().st_size for file in files), len(files)]


def records(count):
    """Blocks of many sizes under the built-in record."""
    import numpy as np

    import jaxrock as rk

    record = rk.example_record()
    p = np.linspace(0.8, 6.0, count)

    def run():
        return rk.sweep(lambda p: rk.outcome(rk.Block(0.2, p), record), p=p, progress=False)

    run()
    return [count, timed(run)[0]]


def gradients():
    """A map of peaks, and with three derivatives each."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    import jaxrock as rk

    def peak(alpha, intensity, ratio):
        motion = rk.SinePulse(intensity * math.tan(0.2), 2 * jnp.pi / ratio)
        return rk.outcome(rk.Block(alpha, 1.0, 0.9), motion).max_rotation

    def value(ratio, intensity):
        return {"peak": peak(0.2, intensity, ratio)}

    def both(ratio, intensity):
        value, slopes = jax.value_and_grad(peak, argnums=(0, 1, 2))(jnp.asarray(0.2), intensity, ratio)
        return {"peak": value} | dict(zip(("of_alpha", "of_intensity", "of_ratio"), slopes))

    axes = {"ratio": np.linspace(0.3, 8, SIDE), "intensity": np.linspace(1.05, 10, SIDE)}

    def swept(function):
        return timed(lambda: rk.sweep(function, progress=False, **axes), 7)[0]

    return [swept(value), swept(both)]


TASKS = {task.__name__: task for task in (ladder, one_map, stored, records, gradients)}


def child(task, arguments, devices, cache=None):
    """Run a task in a fresh process; its numbers."""
    environment = os.environ | ({"JAX_COMPILATION_CACHE_DIR": str(cache)} if cache else {})
    if cache:
        environment["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
    words = [sys.executable, __file__, "--task", json.dumps([task, arguments, devices])]
    done = subprocess.run(words, env=environment, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(done.stderr)
    return json.loads(done.stdout.splitlines()[-1])


def perform(task, arguments, devices):
    sys.path.insert(0, str(HERE.parent))
    import jax

    jax.config.update("jax_enable_x64", True)
    import jaxrock as rk

    rk.studies.use_cpu_devices(devices)
    print(json.dumps(TASKS[task](*arguments)))


def nice(seconds):
    """A time in the unit that suits it."""
    for unit, size in (("years", 31557600), ("days", 86400), ("h", 3600), ("min", 60), ("s", 1)):
        if seconds >= size:
            return f"{seconds / size:.2g} {unit}"
    return f"{1000 * seconds:.2g} ms"


def report(largest):
    """All measurements as Markdown."""
    with tempfile.TemporaryDirectory() as cache, tempfile.TemporaryDirectory() as folder:
        single = child("one_map", [], 1)
        both = child("one_map", [], None, cache)
        cached = child("one_map", [], None, cache)
        rows = child("ladder", [largest], None)
        store = child("stored", [min(largest, 1e6), folder], None)
        record = child("records", [1024 if largest >= 1e6 else 256], None)
        value, slopes = child("gradients", [], None)
    devices, kind = both[3:]
    lines = [
        "# What a sweep costs",
        "",
        f"Written by `python benchmarks/scale.py --largest {largest:g}`; float64, {devices} devices ({kind}); "
        "nonlinear blocks under sine pulses unless said otherwise.",
        "",
        "| responses | time | a response | results | memory beyond the compiled program |",
        "| --- | --- | --- | --- | --- |",
    ]
    for points, seconds, held, peak in rows:
        lines.append(
            f"| {points:,} | {nice(seconds)} | {1e6 * seconds / points:.2f} µs | {held:.1f} MiB | {peak:.0f} MiB |"
        )
    lines += [
        "",
        "Before its first response a sweep takes a millisecond, or three where its function is traced again. "
        "Memory: the results and about 100 MiB, whatever the number of responses.",
        "",
        f"| {SIDE} x {SIDE} points | first call | later calls | a response |",
        "| --- | --- | --- | --- |",
    ]
    named = ("1 device", single), (f"{devices} devices", both), (f"{devices} devices, compiled before (cache)", cached)
    for name, (first, later, points, *_) in named:
        lines.append(f"| {name} | {first:.1f} s | {1000 * later:.0f} ms | {1e6 * later / points:.2f} µs |")
    count, plain, written, again, size, files = store
    speed = 1 / (both[1] / both[2] * devices)
    lines += [
        "",
        f"{devices} devices are {single[1] / both[1]:.2f} times as fast as one.",
        "",
        f"A store of {count:,} responses: {nice(written)} instead of {nice(plain)}, {size / count:.0f} bytes a "
        f"response, {files} files; read again in {nice(again)}.",
        "",
        f"{record[0]:,} blocks under the record of 5,690 samples: {1000 * record[1] / record[0]:.2f} ms a response.",
        "",
        f"Peaks of {SIDE} x {SIDE} pulses: {nice(value)}; with their derivatives by slenderness, intensity and "
        f"frequency ratio {nice(slopes)}, {slopes / value:.1f} times as long.",
        "",
        "From these numbers, without compiling:",
        "",
        "| devices like these | pulses, 1e9 | pulses, 1e12 | records, 1e6 | records, 1e9 |",
        "| --- | --- | --- | --- | --- |",
    ]
    slow = record[0] / (record[1] * devices)
    for many in (devices, 64, 1024, 16384):
        times = [n / (rate * many) for n, rate in ((1e9, speed), (1e12, speed), (1e6, slow), (1e9, slow))]
        lines.append(f"| {many:,} | {' | '.join(map(nice, times))} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--largest", type=float, default=1e7, help="most responses of one sweep")
    parser.add_argument("--out", type=Path, default=HERE / "scale.md")
    parser.add_argument("--task", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.task:
        perform(*json.loads(given.task))
    else:
        given.out.write_text(report(given.largest))
        print(given.out.read_text())
