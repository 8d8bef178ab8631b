"""Films of responses: the block on the moving ground, its history beside it, impacts and the verdict."""

import html
import importlib.util
import shutil
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np

from jaxrock._arguments.annotations import arguments, at_least, path_of
from jaxrock._arguments.ranges import scalar, size
from jaxrock._core.arrays import Values
from jaxrock._core.atomic_files import written_atomically
from jaxrock.blocks.edge import Edge
from jaxrock.blocks.flexible import FlexibleBlock
from jaxrock.blocks.rigid import Block
from jaxrock.flexible.response import FlexibleResponse
from jaxrock.models.equation import AbstractEquation
from jaxrock.models.rigid import Housner
from jaxrock.models.rolling import RollingMoments
from jaxrock.plot.bodies import AnyBlock, Body, Shapes
from jaxrock.plot.drawings import draw, draw_ground
from jaxrock.plot.responses import acceleration_of, moments_seen, why_not
from jaxrock.plot.style import BLUE, GREY, RED, SAND
from jaxrock.responses.history import Response
from jaxrock.responses.own_block import check_own

if TYPE_CHECKING:
    from matplotlib.animation import FuncAnimation

_LONGEST = 20.0  # [s] longest duration of a film whose speed is not given
_FLASH = 0.12  # [s] time for which an impact is marked in the film


@arguments
def animate(
    response: Response | FlexibleResponse,
    block: AnyBlock | None = None,
    *,
    model: AbstractEquation = Housner(),
    speed: Values | None = None,
    fps: Annotated[int, at_least(1, 240)] = 20,
) -> "FuncAnimation":
    """Make a film of a response: the block to scale, impacts, the ground's acceleration, and at the end the verdict.

    **Arguments:**

    - `response`: result of `simulate`, of one scene.
    - `block`: the block to draw. None: the rectangle of the response's slenderness and frequency parameter, or its
      flexible block. An asymmetric block must be given.
    - `model`: a `Spring`, to draw its column. Edges on which a block rolls come from the response.
    - `speed`: seconds of the response per second of the film, positive; None: 1, or more to make the film last 20 s.
    - `fps`: pictures per second, in [1, 240].

    **Returns:** a `matplotlib.animation.FuncAnimation`. `save_animation` writes it; in a notebook
    `IPython.display.HTML(film.to_jshtml())` shows it.

    **Raises:** ValueError for arguments outside their ranges, a response of many scenes, or another block than that of
    the response.
    """
    from matplotlib.animation import FuncAnimation

    response.trajectory.check_single()
    duration = float(response.duration)
    rate = max(1.0, duration / _LONGEST) if speed is None else float(scalar("speed", size("speed", speed)))
    body = Body.of(_drawn(response, block), model, _edges(response))
    count = int(np.ceil(duration * fps / rate)) + 1
    time = np.minimum(np.arange(count) * rate / fps, duration)
    turned, bending = np.asarray(response(time)[0]), [None] * count
    rotation = body.lying(turned)
    if isinstance(response, FlexibleResponse):
        alpha, heights = float(response.scene.block.alpha), body.heights
        lean = np.sin(turned) if response.scene.block.rotations == "finite" else turned
        bending = np.asarray(response.column(time)) - np.cos(alpha) * lean[:, None] * heights
    parts = _Parts(response, body, rate, rotation)
    last = fps  # number of pictures that show the verdict, for one second

    def show(number: int) -> list:
        k = min(number, count - 1)
        return parts.show(float(time[k]), body.pose(float(rotation[k]), bending[k]), number >= count - 1)

    return FuncAnimation(parts.figure, show, frames=count + last, interval=1000 / fps, blit=False, repeat=True)


def _drawn(response: Response | FlexibleResponse, block: AnyBlock | None) -> AnyBlock:
    if isinstance(response, FlexibleResponse):
        return response.scene.block
    if isinstance(block, FlexibleBlock):
        raise ValueError("Argument `block` must be that of the response, which is rigid, but is a FlexibleBlock.")
    if block is not None:
        check_own(response.scene, block)
        return block
    if response.scene.far is not None:
        raise ValueError("Argument `block` must be given for the response of an asymmetric block: its shape is drawn.")
    return Block(response.scene.alpha, response.scene.p, 1.0)


def _edges(response: Response | FlexibleResponse) -> tuple[Edge, Edge] | None:
    """Return the edges on which a block rolls, to the right and to the left; None for other blocks."""
    if isinstance(response, FlexibleResponse) or not isinstance(response.scene.moments, RollingMoments):
        return None
    moments: Any = response.scene.both_moments
    here, there = moments
    return here.pieces.edge, there.pieces.edge


def _room(body: Body, rotation: np.ndarray) -> tuple[float, float, float]:
    """Return the left, right and upper limits of the drawing [m], which hold the body at all its rotations."""
    known = rotation[np.isfinite(rotation)]
    turns = np.quantile(known, np.linspace(0, 1, 100)) if known.size else np.zeros(1)
    places = np.concatenate([body.pose(float(turn)).outline for turn in turns])
    reach = body.size, *abs(places[:, 0])
    return -max(reach), max(reach), max(body.size, places[:, 1].max())


class _Parts:
    """The figure of a film, and its moving artists."""

    def __init__(self, response: Response | FlexibleResponse, body: Body, rate: float, rotation: np.ndarray):
        import matplotlib.pyplot as plt

        self.response, self.rate = response, rate
        self.figure, axes = plt.subplot_mosaic(
            [["scene", "rotation"], ["scene", "ground"]], figsize=(8, 4), width_ratios=(1.1, 1), layout="constrained"
        )
        scene, size = axes["scene"], body.size
        left, right, high = _room(body, rotation)
        scene.set(xlim=(1.1 * left, 1.1 * right), ylim=(-0.25 * size, 1.1 * high), aspect="equal")
        scene.set_axis_off()
        draw_ground(scene, body, None if isinstance(response, FlexibleResponse) else response.scene.only_side)
        self.outline, self.column, self.masses = draw(scene, body, body.pose(0.0))
        (self.flash,) = scene.plot([], [], "*", color=RED, markersize=16, zorder=5)
        self.verdict = textwrap.fill(why_not(response.status) or ("overturns" if response.overturned else "stands"), 42)
        self.words = scene.set_title("\n" * self.verdict.count("\n") + "\n.", fontsize=10)  # room for the verdict
        peak = float(np.max(np.asarray(self._motion.bounds)))
        self.reach = 0.8 * size / max(peak, 1e-12)
        self.arrow = scene.quiver(
            0, -0.15 * size, 0, 0, color=BLUE, angles="xy", scale_units="xy", scale=1, width=0.012
        )
        self.impacts = np.asarray(response.impact_times)
        self.cursors = self._histories(axes["rotation"], axes["ground"])
        self.figure.canvas.draw()
        self.figure.set_layout_engine("none")  # keep the layout of the first picture for all

    @property
    def _motion(self):
        scene = self.response.scene
        return scene.ground if isinstance(self.response, FlexibleResponse) else scene.motion

    def _histories(self, above, below) -> list:
        response, end = self.response, float(self.response.duration)
        time = np.linspace(0, end, 4001)
        alpha = response.scene.block.alpha if isinstance(response, FlexibleResponse) else response.scene.alpha
        above.plot(time, np.asarray(response(time)[0]) / float(alpha), color=BLUE, linewidth=0.9)
        above.plot(self.impacts, 0 * self.impacts, "|", color=RED, markersize=6)
        time = moments_seen(self._motion, 0.0, end, 4001)
        below.plot(time, acceleration_of(self._motion, time), color="black", linewidth=0.7)
        above.set_ylim(*np.clip(above.get_ylim(), -2.5, 2.5))
        for axis, label in ((above, r"$\theta/\alpha$"), (below, r"$\ddot u_g$ [g]")):
            axis.axhline(0, color=GREY, linewidth=0.5)
            axis.set(xlim=(0, end), ylabel=label)
        above.tick_params(labelbottom=False)
        below.set_xlabel("time [s]")
        return [axis.axvline(0, color=SAND, linewidth=1.4) for axis in (above, below)]

    def show(self, time: float, shapes: Shapes, over: bool) -> list:
        """Move everything to a time."""
        self.outline.set_xy(shapes.outline)
        self.column.set_data(*shapes.column.T)
        self.masses.set_data(*shapes.masses.T)
        self.arrow.set_UVC(self.reach * float(acceleration_of(self._motion, np.array([time]))[0]), 0.0)
        for cursor in self.cursors:
            cursor.set_xdata([time, time])
        count = int(np.searchsorted(self.impacts, time, side="right"))
        hit = count > 0 and time - self.impacts[count - 1] < _FLASH * self.rate and not over
        self.flash.set_data(*([[x] for x in shapes.pivot] if hit else ([], [])))
        faster = "" if self.rate == 1 else f", {self.rate:.3g} times as fast"
        said = self.verdict if over else "\n" * self.verdict.count("\n")
        self.words.set_text(f"{time:.2f} s{faster}, {count} impact{'' if count == 1 else 's'}\n{said}")
        self.words.set_color(RED if over and self.verdict != "stands" else "black")
        return [self.outline, self.column, self.masses, self.flash, self.words, self.arrow, *self.cursors]


@arguments
def save_animation(
    film: "FuncAnimation", path: Annotated[str | Path, path_of], *, dpi: Annotated[int, at_least(10, 1000)] = 80
) -> None:
    """Write a film in the format of the file's ending: GIF, self-contained HTML, or MP4.

    The duration follows from the pictures per second. Pictures of a GIF last whole hundredths of a second, and at least
    two, because viewers slow down shorter ones. Above 50 pictures per second, a GIF leaves some out. Pictures of HTML
    last whole thousandths.

    **Arguments:**

    - `film`: result of `animate`. `path`: ends with .gif, .html or .mp4; an existing file is replaced only when the
      film is complete.
    - `dpi`: dots per inch.

    **Raises:** ValueError for another ending, and for MP4 without the program ffmpeg: that of the system, or of
    `pip install "jaxrock[film]"`. OSError if the file cannot be written.
    """
    import matplotlib
    from matplotlib.animation import FFMpegWriter

    own: Any = film
    interval, path = own._interval, Path(path)  # `event_source.interval` is truncated to whole milliseconds
    kind = path.suffix.lower()
    if kind == ".gif":
        with written_atomically(path, replace=True, lasting=False) as aside:
            film.save(aside, writer=_gif_writer(interval), dpi=dpi)
    elif kind == ".html":
        vars(own).pop("_html_representation", None)  # matplotlib's cached HTML may have another dpi
        # A large `embed_limit` [MB] keeps matplotlib from leaving out pictures. A picture lasts 1000 // fps [ms].
        with matplotlib.rc_context({"savefig.dpi": dpi, "animation.embed_limit": 1e6}):
            with_size = film.to_jshtml(fps=1000 / (round(interval) + 0.5), embed_frames=True)
        title = html.escape(path.stem)
        text = f"<!DOCTYPE html><meta charset='utf-8'><title>{title}</title>{with_size}"
        with written_atomically(path, replace=True, lasting=False) as aside:
            aside.write_text(text, encoding="utf-8")
    elif kind == ".mp4":
        with matplotlib.rc_context({"animation.ffmpeg_path": _ffmpeg()}):
            more = [*matplotlib.rcParams["animation.ffmpeg_args"], "-f", "mp4"]  # independent of the ending of its name
            if not FFMpegWriter.isAvailable():
                raise ValueError(
                    "Argument `path` must end with .gif or .html, as .mp4 needs the program ffmpeg, which is not "
                    'there: install it, or `pip install "jaxrock[film]"`.'
                )
            with written_atomically(path, replace=True, lasting=False) as aside:
                film.save(aside, writer=FFMpegWriter(fps=round(1000 / interval, 6), extra_args=more), dpi=dpi)
    else:
        raise ValueError(f"Argument `path` must end with .gif, .html or .mp4, but is {str(path)!r}.")


def _gif_writer(interval: float):
    """Return a GIF writer for pictures at an interval [ms]; each lasts until the next, rounded to 10 ms."""
    from matplotlib.animation import PillowWriter

    every = int(np.ceil(20 / interval - 1e-9))

    class Writer(PillowWriter):
        def finish(self) -> None:
            frames: list[Any] = vars(self)["_frames"]
            kept = frames[::every]
            due = np.append(np.arange(len(kept)) * every, len(frames)) * interval
            lasts = np.maximum(10 * np.diff(np.round(due / 10)), 20).astype(int).tolist()
            kept[0].save(self.outfile, save_all=True, append_images=kept[1:], duration=lasts, loop=0, format="GIF")

    return Writer(fps=1000 / interval)


def _ffmpeg() -> str:
    """Return matplotlib's configured ffmpeg, or that of the package `imageio_ffmpeg` if the first is not installed."""
    import matplotlib

    usual = matplotlib.rcParams["animation.ffmpeg_path"]
    if shutil.which(usual) is None and importlib.util.find_spec("imageio_ffmpeg") is not None:
        return importlib.import_module("imageio_ffmpeg").get_ffmpeg_exe()
    return usual
