"""The picture of the README: blocks of one shape on one shaking floor, beside the map of who overturns."""

from pathlib import Path

import jax
import matplotlib
import numpy as np

jax.config.update("jax_enable_x64", True)
matplotlib.use("Agg")

import matplotlib.pyplot as plt  # noqa: E402
from matplotlib.animation import FuncAnimation, PillowWriter  # noqa: E402
from matplotlib.patches import Polygon  # noqa: E402

import jaxrock as rk  # noqa: E402

SLENDERNESS, PERIOD, INTENSITY = 0.25, 0.8, 5.0  # [rad], [s], amplitude over g tan(slenderness)
RATIOS = (3.0, 3.88, 5.2, 7.2)  # of the pulse's frequency to the frequency parameters: the larger, the larger the block
RATE, LENGTH, HELD = 12, 4.6, 12  # frames a second, seconds, frames at the end
STANDS, FALLS, FALLS_LATER = "#cfa75b", "#205a8c", "#b5352b"  # as in the map


def corners(size: float, place: float, rotation: float) -> np.ndarray:
    """Of a block that has turned about one of its lower two (4, 2) [m]."""
    b, h = size * np.sin(SLENDERNESS), size * np.cos(SLENDERNESS)
    points = np.array([[-b, 0], [b, 0], [b, 2 * h], [-b, 2 * h]])
    pivot = np.array([b if rotation > 0 else -b, 0.0])
    cosine, sine = np.cos(rotation), np.sin(rotation)
    return (points - pivot) @ np.array([[cosine, -sine], [sine, cosine]]) + pivot + [place, 0.0]


def color_of(response: rk.responses.Response) -> str:
    """That of its region in the map."""
    if not response.overturned:
        return STANDS
    return FALLS_LATER if response.impact_count > 0 else FALLS


def main() -> None:
    """Draw the picture beside this script."""
    frequency, amplitude = 2 * np.pi / PERIOD, INTENSITY * np.tan(SLENDERNESS)
    pulse = rk.SinePulse(amplitude, PERIOD)
    blocks = [rk.Block(SLENDERNESS, frequency / ratio, 0.9) for ratio in RATIOS]
    responses = [rk.simulate(block, pulse, duration=LENGTH) for block in blocks]
    sizes = [float(block.half_diagonal) for block in blocks]
    places = np.cumsum([0.0, *(1.3 * (a + b) for a, b in zip(sizes, sizes[1:]))])
    # The floor, by integrating the pulse twice; after it the floor goes on, and the camera with it.
    times = np.arange(0, LENGTH, 1 / RATE)
    within = np.minimum(times, PERIOD)
    floor = 9.81 * amplitude / frequency * (within - np.sin(frequency * within) / frequency)
    floor = floor - floor[-1] * within / PERIOD  # seen from half-way

    figure, (scene, surface) = plt.subplots(1, 2, figsize=(9.5, 4.2), layout="constrained", width_ratios=(1.35, 1))
    left, right = places[0] - 2.6 * sizes[0], places[-1] + sizes[-1]
    scene.set(xlim=(left - 0.5, right + 0.5), ylim=(-0.8, 2.3 * sizes[-1]), aspect="equal")
    scene.axis("off")
    scene.set_title("Blocks of one shape under one sine pulse", fontsize=10)
    ground = scene.add_patch(Polygon([[0, 0]], facecolor="#d9d4c7", edgecolor="#857f72"))
    colors = [color_of(response) for response in responses]
    bodies = [scene.add_patch(Polygon([[0, 0]], facecolor=color, edgecolor="black", lw=0.8)) for color in colors]
    clock = scene.text(0.01, 0.94, "", transform=scene.transAxes, fontsize=9)

    found = rk.overturning_map(np.linspace(0.3, 8, 320), np.linspace(1.02, 8, 320), alpha=SLENDERNESS, restitution=0.9)
    rk.plot.overturning(found, surface)
    for ratio, color in zip(RATIOS, colors):
        surface.plot(ratio, INTENSITY, "o", color=color, markeredgecolor="white", ms=9)
    surface.set_title("Who overturns: 102,400 blocks", fontsize=10)

    def show(number: int):
        step = min(number, times.size - 1)
        shift = floor[step]
        ground.set_xy([[left + shift, -0.5], [right + shift, -0.5], [right + shift, 0], [left + shift, 0]])
        for body, response, size, place in zip(bodies, responses, sizes, places):
            rotation = np.clip(float(response(times[step])[0]), -np.pi / 2, np.pi / 2)
            body.set_xy(corners(size, place + shift, rotation))
        clock.set_text(f"{times[step]:.1f} s")
        return ground, *bodies, clock

    film = FuncAnimation(figure, show, times.size + HELD)
    film.save(Path(__file__).with_name("overview.gif"), PillowWriter(RATE), dpi=70)
    plt.close(figure)


if __name__ == "__main__":
    main()
