"""Critical amplitudes and durations: all ends of the intervals in which a block overturns.

Overturning is not monotonic in amplitude. Below the amplitude that overturns a block without impact, others overturn it
after one, three or five impacts. These intervals are ever narrower, and the safe gaps between them may be narrower
still. A bisection of the verdict finds one end by chance.

Here the margin, its slope and the number of impacts at sampled points tell where an end may hide between two of them.
Only there is the sampling refined. `ends` finds all ends; `lowest_ends` finds a given number of the lowest, stops there
and can be traced by JAX.
"""

from typing import Annotated

import numpy as np

from jaxrock._arguments.annotations import arguments, at_least, known, pair
from jaxrock._arguments.parameters import in_real_numbers
from jaxrock._arguments.ranges import not_negative, ratio, scalar
from jaxrock._core.arrays import if_traced
from jaxrock.blocks.asymmetric import AsymmetricBlock
from jaxrock.blocks.rigid import Block
from jaxrock.engines.stepper import AbstractEngine
from jaxrock.models.equation import AbstractEquation
from jaxrock.models.rigid import Housner
from jaxrock.motions.motion import AbstractMotion
from jaxrock.responses.current_model import current_model
from jaxrock.studies.critical_ends import Critical
from jaxrock.studies.critical_search import CriticalScenes, critical_ends
from jaxrock.studies.search_axis import Amplitude, Duration, check_sizeless

_FIRST = 256  # intervals of the first sampling


@arguments
def critical_amplitudes(
    block: Block | AsymmetricBlock,
    motion: AbstractMotion,
    model: AbstractEquation = Housner(),
    *,
    intensity: Annotated[tuple[float, float], pair] = (1.0, 10.0),
    derivatives: bool | None = None,
    max_ends: Annotated[int | None, at_least(1, 256)] = None,
    narrowest: Annotated[float | None, known(not_negative)] = None,
    engine: AbstractEngine | None = None,
    progress: bool | None = None,
) -> Critical:
    """Find all amplitudes of a motion at which a block begins or ceases to overturn.

    **Arguments:**

    - `block`, `motion`: one scene, or many: parameters of shape (scenes,). The amplitude of the motion plays no part.
    - `model`, `engine`: as in `outcome`.
    - `intensity`: search range: least and largest amplitude over the uplift threshold [-]. Below 1 nothing moves.
    - `derivatives`: whether to compute `derivative`; without, it is NaN. None: only for concrete arguments; for traced
      ones JAX differentiates `value` by the traced arguments.
    - `max_ends`: number of ends to find, from the lowest on, 1 to 256; results are padded to that number. None: all
      ends. Under records and over wide ranges this takes minutes, even if no more ends are found (the progress bar
      grows with the intervals still to be searched). Traced arguments need a number.
    - `narrowest`: least relative width [-] of overturning intervals and safe gaps, 0 or more; thinner ones are merged
      into what surrounds them, as by `Critical.without_thin`. It must not be traced. None: none are merged. Of the
      lowest `max_ends` ends fewer are left then.
    - `progress`: as in `rocking_spectrum`.

    **Returns:** a `Critical`. An overturning interval may be missed if it is much narrower than the sampling and leaves
    no trace in the margins beside it. A safe gap between different numbers of impacts is not missed.
    With traced arguments (within `jax.jit`, `jax.vmap`, `jax.grad`) it is a plain function of arrays.

    **Raises:** ValueError for arguments outside their ranges.

    **Source:** Voyagaki et al. (2012), 3.11 (the balance); derivatives by the implicit function of the margin.
    """
    low, high = _rising("intensity", intensity)
    block, motion = in_real_numbers(block, motion)
    model = current_model(model, block, motion)
    scenes = CriticalScenes.of(block, motion, model)
    # Overturning intervals crowd towards the threshold, so the sampling is dense at the least amplitudes.
    grid = np.concatenate([[low], low + (high - low) * np.geomspace(1e-4, 1.0, _FIRST)])
    grid = np.log(grid) + if_traced(scenes.least)[:, None]
    kind = Amplitude(model, engine)
    return critical_ends(
        scenes, grid, kind, derivatives=derivatives, most=max_ends, narrowest=narrowest, progress=progress
    )


@arguments
def critical_durations(
    block: Block | AsymmetricBlock,
    motion: AbstractMotion,
    model: AbstractEquation = Housner(),
    *,
    factor: Annotated[tuple[float, float], pair] = (0.05, 20.0),
    derivatives: bool | None = None,
    max_ends: Annotated[int | None, at_least(1, 256)] = None,
    narrowest: Annotated[float | None, known(not_negative)] = None,
    engine: AbstractEngine | None = None,
    progress: bool | None = None,
) -> Critical:
    """Find all durations of a motion of given amplitude at which a block begins or ceases to overturn.

    **Arguments:**

    - `block`, `motion`, `model`, `derivatives`, `max_ends`, `narrowest`, `engine`, `progress`: as in
      `critical_amplitudes`.
    - `factor`: search range: least and largest duration over that of `motion` [-]; all times are stretched alike.

    **Returns:** a `Critical`; `value` is the duration of the whole motion [s].
    With traced arguments (within `jax.jit`, `jax.vmap`, `jax.grad`) it is a plain function of arrays.

    **Raises:** ValueError for arguments outside their ranges, and for laws of restitution and models of your own that
    depend on the speed of impacts, or on p.
    """
    low, high = _rising("factor", factor)
    block, motion = in_real_numbers(block, motion)
    model = current_model(model, block, motion)
    check_sizeless(block, model)
    scenes = CriticalScenes.of(block, motion, model)
    grid = np.linspace(np.log(low), np.log(high), _FIRST + 1)
    grid = np.broadcast_to(grid, (scenes.threshold.size, grid.size))
    kind = Duration(model, engine)
    return critical_ends(
        scenes, grid, kind, derivatives=derivatives, most=max_ends, narrowest=narrowest, progress=progress
    )


def _rising(name: str, ends: tuple[float, float]) -> tuple[float, float]:
    low, high = (float(scalar(name, ratio(name, end))) for end in ends)
    if low >= high:
        raise ValueError(f"Argument `{name}` must be rising, but is {ends}.")
    return low, high
