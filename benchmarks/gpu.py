"""Maps, records and gradients on an accelerator: time, and error beside the same on the CPU. Writes `gpu.md`.

    python benchmarks/gpu.py              # on the default device, which should be a GPU
    python benchmarks/gpu.py --small      # small sizes, no file: does it run at all?

Responses a second are those of the second call. The error is the largest difference of max_rotation to the CPU in
double precision, over alpha, of scenes on whose verdict both agree; the share of other verdicts stands beside it.
"""

import argparse
import pathlib
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parent.parent))
jax.config.update("jax_enable_x64", True)

import jaxrock as rk  # noqa: E402


def peak_map(ratio, intensity):
    """A map of the sine pulse: (peak over alpha)."""
    alpha = jnp.asarray(0.2, ratio.dtype)
    block = rk.Block(alpha, jnp.ones_like(alpha))
    found = rk.outcome(block, rk.SinePulse(intensity * jnp.tan(alpha), 2 * jnp.pi / ratio))
    return found.max_rotation / alpha


def under_record(record):
    """Blocks under one record."""

    def peak(alpha, p):
        return rk.outcome(rk.Block(alpha, p), record).max_rotation / alpha

    return peak


def problems(small: bool, dtype) -> dict:
    """Functions of one scene, and their arguments."""
    side, blocks, slopes = (20, 50, 50) if small else (1000, 10_000, 100_000)
    ratio, intensity = jnp.meshgrid(jnp.linspace(0.4, 8, side), jnp.linspace(1.05, 9, side))
    rng = np.random.default_rng(0)
    alpha, p = rng.uniform(0.08, 0.35, blocks), rng.uniform(1.0, 4.0, blocks)
    record = jax.tree.map(lambda x: jnp.asarray(x, dtype), rk.example_record())
    few = rng.uniform(1.0, 8.0, slopes), rng.uniform(1.1, 3.0, slopes)
    found = {
        f"map, {side} x {side}": (peak_map, (ratio.ravel(), intensity.ravel())),
        f"{blocks:,} blocks under a record of {record.samples.size:,} samples": (under_record(record), (alpha, p)),
        f"{slopes:,} gradients by two numbers": (jax.value_and_grad(peak_map, (0, 1)), few),
    }
    return {name: (f, [jnp.asarray(x, dtype) for x in given]) for name, (f, given) in found.items()}


def timed(function, given, device) -> tuple[float, float, np.ndarray]:
    """First answer [s], second [s], and the peaks."""
    given = jax.device_put(given, device)
    with jax.default_device(device):
        compiled, taken = jax.jit(jax.vmap(function)), []
        for _ in range(2):
            start = time.perf_counter()
            found = jax.block_until_ready(compiled(*given))
            taken.append(time.perf_counter() - start)
    return *taken, np.asarray(found[0] if isinstance(found, tuple) else found)


def rows(small: bool):
    """A row for each problem and precision."""
    device, judge = jax.devices()[0], jax.local_devices(backend="cpu")[0]
    for name, (function, given) in problems(small, np.float64).items():
        *_, exact = timed(function, given, judge)
        for dtype in (np.float64, np.float32):
            first, second, found = timed(*problems(small, dtype)[name], device)
            same = np.isinf(found) == np.isinf(exact)
            both = same & np.isfinite(exact)
            error = np.abs(found[both] - exact[both]).max()
            rate, other = exact.size / second, 1 - same.mean()
            cells = f"{first:.1f}", f"{second:.3f}", f"{rate:,.0f}", f"{error:.1e}", f"{other:.2%}"
            yield name, dtype.__name__, *cells


def main():
    """Print the table, and write it."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--small", action="store_true")
    small = parser.parse_args().small
    head = "problem", "numbers", "first [s]", "second [s]", "responses/s", "largest error", "other verdicts"
    lines = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    lines += ["| " + " | ".join(row) + " |" for row in rows(small)]
    text = f"# On {jax.devices()[0].device_kind}\n\njax {jax.__version__}\n\n" + "\n".join(lines) + "\n"
    print(text)
    if not small:
        (pathlib.Path(__file__).parent / "gpu.md").write_text(text)


if __name__ == "__main__":
    main()
