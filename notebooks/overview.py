"""The picture of the README: one block in a real earthquake, blocks of every size, and who overturns under a pulse."""

from pathlib import Path

import jax
import matplotlib
import numpy as np

jax.config.update("jax_enable_x64", True)
matplotlib.use("Agg")

import matplotlib.pyplot as plt  # noqa: E402

import jaxrock as rk  # noqa: E402


def main() -> None:
    """Draw the picture beside this script."""
    figure = plt.figure(figsize=(11, 7), layout="constrained")
    grid = figure.add_gridspec(3, 2, width_ratios=(1.25, 1))
    left = [figure.add_subplot(grid[i, 0]) for i in range(3)]
    record = rk.example_record()
    rk.plot.history(rk.simulate(rk.Block.from_dimensions(0.6, 3.0), record, duration=30.0), left)
    left[0].set_title("A block of 0.6 m x 3 m in the 1979 Imperial Valley earthquake", fontsize=10)
    for axis in left[:2]:
        axis.tick_params(labelbottom=False)
    right = figure.add_subplot(grid[:, 1])
    surface = rk.overturning_map(np.linspace(0.3, 8, 400), np.linspace(1.02, 10, 400), restitution=0.9)
    rk.plot.overturning(surface, right)
    right.set_title("160,000 blocks under one sine pulse", fontsize=10)
    figure.savefig(Path(__file__).with_name("overview.png"), dpi=110)


if __name__ == "__main__":
    main()
