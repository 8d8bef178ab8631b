"""Critical excitation: the least-changed record that topples blocks, spares them, or brings them to a margin.

There are as many unknowns as samples, and margins are neither convex nor continuous in them. The result is the smallest
of the changes to which several starts lead, each about a local minimum. Each start is a direction of change: louder or
softer, the path of an optimiser of optax, and against the slopes of margins under nearby records.
"""

from collections.abc import Sequence
from typing import Annotated, Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike

from jaxrock._arguments.annotations import arguments, at_least, gradient_transformation, known, pair
from jaxrock._arguments.parameters import broadcast, leaves_of
from jaxrock._arguments.ranges import finite, not_negative, one_of, positive, scalar
from jaxrock._arguments.tables import AbstractTable, Column
from jaxrock._core.arrays import Values, shown, to_device
from jaxrock._core.precision import say_if_single
from jaxrock._core.progress import Progress
from jaxrock._core.types import Floats
from jaxrock.blocks.asymmetric import AsymmetricBlock
from jaxrock.blocks.rigid import Block
from jaxrock.engines.stepper import AbstractEngine
from jaxrock.inverse.design_point import Found, Search, Site, allowed_changes, least_change, rms
from jaxrock.inverse.kept_spectrum import TOLERANCE, KeptSpectrum
from jaxrock.models.equation import AbstractEquation
from jaxrock.models.rigid import Housner
from jaxrock.motions.record import Record, record_in_g
from jaxrock.responses.current_model import current_model
from jaxrock.status import Enumeration, item

Target = str | ArrayLike | Sequence[str | float]
_ROUNDS = 6  # rounds of the search; each constrains the spectral peaks that grew in the preceding round
_APPROACH = 40  # largest number of steps of the optimiser
_NEARBY = 0.15  # root mean square of the perturbation that makes a nearby record, over that of the record
_UNRELATED, _TURNED = 6, 0.7  # first starts; root mean square of the perturbation of the best direction in later starts
_SIDES = {"topple": 1.0, "spare": -1.0}  # 1: the margin shall be at the target or below; -1: at it or above
_USELESS = 1e6  # [1/g] slope of a margin above which the sixth digit of the record decides


class RecordStatus(Enumeration):
    """Result code of a search for a record; `RecordStatus[found.status]` is the message."""

    successful = item(
        "The margins are as wanted. This record is the nearest of those that the starts led to (see `changes`); other "
        "starts may find a nearer one."
    )
    unchanged = item("The margins are as wanted under the record as it is.")
    useless_slopes = item(
        "The margins are as wanted, but they change by more than 1e6 for a change of 1 g. After such long rocking "
        "slopes lead nowhere, and digits of the record below any measurement decide. Nearer records are likely."
    )
    spectrum_changed = item(
        "The margins are as wanted, but the response spectrum at the periods that are to be kept changes by more than "
        "5 %: see `spectrum`. No change was found that keeps it; fewer periods or a wider `band` may help."
    )
    not_reached = item(
        "No change was found that makes margins as wanted: none on straight lines from the start, nor on the way of "
        "the optimiser. More `starts`, a wider `band`, or fewer blocks may help."
    )


class FoundRecord(AbstractTable):
    """A record that brings blocks to margins.

    - `record`: the `Record`; `start`: the one that was changed.
    - `change`: root mean square of the change [g]; infinite if nothing was found, and the record is the start.
    - `scaling`: root mean square of the change that scaling the start alone needs to reach the margins [g]. Factors are
      tried in steps of half a per cent; infinite if none suffices.
    - `margin`: (blocks,) margins under the record.
    - `slope`: largest change of a margin for a change of root mean square 1 g [1/g], at the last linearisation of the
      search. (At the verge itself a block may stay in balance, where slopes grow as exp(p t).)
    - `changes`: (starts,) root mean squares of the changes that each start found [g], of which `change` is the least;
      infinite where a start failed. Different values are different local minima.
    - `path`: (steps,) root mean squares along the search from the best start [g].
    - `spectrum`: largest relative change of the response spectrum at the kept periods; NaN where there are none.
    - `status`: a `RecordStatus`.
    """

    record: Record
    start: Record
    change: Floats
    scaling: Floats
    margin: Floats
    slope: Floats
    changes: Floats
    path: Floats
    spectrum: Floats
    status: RecordStatus

    @property
    def _columns(self):
        before, after = self.start.samples, self.record.samples
        return {
            "time": Column(("time",), self.start.knots, "s"),
            "start": Column(("time",), before, "g"),
            "record": Column(("time",), after, "g"),
            "added": Column(("time",), after - before, "g"),
            "change": Column((), self.change, "g"),
            "scaling": Column((), self.scaling, "g"),
            "status": Column((), self.status),
        }


def _usual():
    """Return the default optimiser: momentum, whose first steps are two hundredths of the record."""
    import optax

    return optax.chain(optax.clip_by_global_norm(1.0), optax.sgd(0.02, momentum=0.9))


@arguments
def find_record(
    block: Block | AsymmetricBlock,
    start: Record,
    target: Target = "topple",
    *,
    optimizer: Annotated[Any, gradient_transformation] = None,
    penalty: Annotated[float, known(not_negative)] = 1.0,
    band: Annotated[tuple[float, float] | None, pair] = None,
    baseline: bool = True,
    spectrum: Values | None = None,
    starts: Annotated[int, at_least(1, 10**4)] = 10,
    steps: Annotated[int, at_least(1, 10**6)] = 60,
    seed: Annotated[int, at_least(0)] = 0,
    model: AbstractEquation = Housner(),
    engine: AbstractEngine | None = None,
    progress: bool | None = None,
) -> FoundRecord:
    """Look for the record nearest to a given one that topples a block, spares it, or brings it to a margin.

    **Arguments:**

    - `block`: a `Block` or `AsymmetricBlock`, of scalars or of (blocks,) arrays. One record must satisfy all blocks.
    - `start`: the `Record` to change.
    - `target`: "topple", "spare", or a margin; one for all blocks, or a list. A block above the margin approaches it
      from above, any other from below.
    - `optimizer`: an `optax.GradientTransformation` that finds a first change by slopes of margins, in root mean
      squares of the record. None: momentum with clipped slopes. `penalty`: weight of the squared change beside the
      margins in that search, 0 or more.
    - `band`: frequencies between which the record may change [Hz]; None: all frequencies.
    - `baseline`: whether velocity and displacement of the ground at the end of the record stay as they are.
    - `spectrum`: (periods,) [s] of oscillators of 5 % damping whose peak responses stay within 5 %, each period 10
      time steps of the record or more; None: no such limit.
    - `starts`: number of directions in which the search starts, at least 1. First louder or softer, the optimiser,
      slopes here, and three slopes under nearby records. Later ones alternate between the neighbourhood of the best and
      nearby records, drawn by `seed`. `steps`: largest number of steps for each start.
    - `model`, `engine`, `progress`: as in `estimate_motion`.

    **Returns:** a `FoundRecord`: the nearest record found; no search of this kind proves it the nearest of all.

    **Raises:** ValueError for arguments outside their ranges, and for a record that does not shake.

    **Source:** Hasofer & Lind (1974), Rackwitz & Fiessler (1978), the nearest point of a limit surface; Drenick (1970),
    critical excitation.
    """
    say_if_single()
    samples = np.asarray(start.samples)
    if samples.ndim != 1:
        raise ValueError(f"Argument `start` must be one record, but has samples of shape {samples.shape}.")
    size = float(rms(samples))
    if not size > 0:
        raise ValueError("Argument `start` must shake, but all its samples are zero.")
    site = _site(block, start, target, model, engine)
    space, kept = (samples.size, float(start.dt), _checked_band(band), baseline), _kept(spectrum, start)
    search = Search(site, size, allowed_changes(*space, None if kept is None else kept.rows))
    if search.reached(np.zeros((1, samples.size)))[0]:
        return _result(search, start, Found(np.zeros(samples.size), 0.0), [0.0], 0.0, kept)
    scaling = min(_length(search.in_direction(direction, fine=True)) for direction in (samples, -samples))
    best, lengths = None, []
    for _ in range(_ROUNDS):
        bar = Progress(starts * steps, "record", progress)
        directions = _Directions(search, samples, optimizer, penalty, np.random.default_rng(seed))
        reached, nearest = _nearest(search, directions, starts, steps, bar)
        if best is not None and nearest is None:
            break  # return the change of the preceding round; its status says that the spectrum changes
        lengths, best = reached, nearest
        more = None if kept is None or best is None else kept.kept_at(samples + best.change)
        if more is None:
            break
        kept, search = more, search._replace(allowed=allowed_changes(*space, more.rows))
    return _result(search, start, best, lengths, scaling, kept)


def _nearest(search: Search, directions: "_Directions", starts: int, steps: int, bar: Progress):
    """Search from all starts; return the length of the change that each found, and the shortest change."""
    found = []
    for number in range(starts):
        best = min(found, key=_length, default=None)
        reached = search.in_direction(directions(number, best), fine=number == 0)
        found.append(reached and search.nearer(reached, steps, lambda: bar.add(1)))
        bar.add((number + 1) * steps - bar.done)
    lengths = [_length(each) for each in found]
    return lengths, found[int(np.argmin(lengths))]


def _kept(spectrum: Values | None, start: Record) -> KeptSpectrum | None:
    if spectrum is None:
        return None
    dt = float(start.dt)
    period = np.asarray(positive("spectrum", spectrum), float)
    if period.ndim != 1 or period.size == 0 or not (period >= 10 * dt).all() or not np.isfinite(period).all():
        wanted = f"be a list of periods, each of {10 * dt:g} s (ten steps of the record) or more"
        raise ValueError(f"Argument `spectrum` must {wanted}, but is {shown(spectrum)}.")
    return KeptSpectrum.of(period, np.asarray(start.samples, float), dt)


def _length(found: Found | None) -> float:
    return np.inf if found is None else found.length


def _checked_band(band: tuple[float, float] | None) -> tuple[float, float] | None:
    if band is None:
        return None
    low, high = (float(scalar(f"band[{i}]", not_negative(f"band[{i}]", x))) for i, x in enumerate(band))
    if not low < high:
        raise ValueError(f"Argument `band` must rise, but is {shown(band)}.")
    return low, high


def _site(block, start: Record, target, model: AbstractEquation, engine: AbstractEngine | None) -> Site:
    """Return the blocks, with the target margin of each and the side of the target on which it shall end."""
    shape = np.broadcast_shapes(*(jnp.shape(leaf.value) for leaf in leaves_of(block) if leaf.declared.axes == 0))
    if len(shape) > 1:
        raise ValueError(f"Argument `block` must be one block or a list of them, but has shape {shape}.")
    count = shape[0] if shape else 1
    blocks = broadcast(block, (count,))
    targets = [target] * count if isinstance(target, str) or np.ndim(target) == 0 else list(target)
    if len(targets) != count:
        raise ValueError(f"Argument `target` must be one for each of {count} blocks, but has {len(targets)}.")
    for each in targets:
        if isinstance(each, str):
            one_of("target", each, tuple(_SIDES))
    wanted = np.array([0.0 if isinstance(x, str) else float(scalar("target", finite("target", x))) for x in targets])
    model = current_model(model, blocks, start)
    site = Site(blocks, start.samples, start.dt, to_device(np.ones(count)), to_device(wanted), model, engine)
    margin = site.margins(np.zeros((1, start.samples.size)))[0][0]
    from_above = margin > wanted
    sides = [_SIDES[x] if isinstance(x, str) else 1.0 if above else -1.0 for x, above in zip(targets, from_above)]
    return eqx.tree_at(lambda it: it.side, site, to_device(np.array(sides)))


class _Directions(NamedTuple):
    """Directions of change, by the number of the start."""

    search: Search
    samples: np.ndarray
    optimizer: Any
    penalty: float
    random: np.random.Generator

    def __call__(self, number: int, nearest: Found | None) -> np.ndarray:
        """Return the direction of a start: louder or softer, the optimiser, slopes here, slopes under nearby records.

        Later starts alternate between nearby records and perturbations of the best direction, near which a nearer
        record is likelier than elsewhere.
        """
        if number == 0:
            louder, softer = (
                self.search.in_direction(self.search.allowed(x), fine=True) for x in (self.samples, -self.samples)
            )
            best = min(louder, softer, key=_length)
            return self.samples * 0.0 if best is None else best.direction
        if number == 1:
            return self._by_optimizer()
        if number >= _UNRELATED and number % 2 == 0 and nearest is not None:
            noise = self._noise()
            return self.search.allowed(nearest.direction + _TURNED * noise / max(rms(noise), 1e-300))
        nearby = self.search.allowed(self._noise()) if number > 2 else np.zeros_like(self.samples)
        excess, slopes = self.search.slopes(nearby)
        straight = least_change(slopes, -excess)
        return nearby * 0.0 if straight is None else straight

    def _noise(self) -> np.ndarray:
        """Return noise with the amplitude spectrum of the record and random phases."""
        spectrum = np.fft.rfft(self.samples)
        turned = spectrum * np.exp(2j * np.pi * self.random.uniform(size=spectrum.size))
        noise = np.fft.irfft(turned, self.samples.size)
        return _NEARBY * self.search.size * noise / max(rms(noise), 1e-300)

    def _by_optimizer(self) -> np.ndarray:
        """Return the change at which the optimiser first satisfies the targets, or else its last; in scaled units."""
        import optax

        optimizer = optax.with_extra_args_support(self.optimizer or _usual())
        unit = self.search.size * np.sqrt(self.samples.size)
        place = jnp.zeros(self.samples.size)
        state = optimizer.init(place)
        for _ in range(_APPROACH):
            excess, slopes = self.search.slopes(np.asarray(place) * unit)
            if (excess <= 0).all():
                break
            value = np.sum(np.maximum(excess, 0.0)) + self.penalty * np.sum(place**2)
            slope = jnp.asarray(unit * np.sum(slopes[excess > 0], axis=0)) + 2 * self.penalty * place
            changes, state = optimizer.update(slope, state, place, value=value, grad=slope)
            place = jnp.asarray(self.search.allowed(np.asarray(place + changes)))
        return np.asarray(place)


def _result(
    search: Search, start: Record, found: Found | None, lengths: list[float], scaling: float, kept: KeptSpectrum | None
) -> FoundRecord:
    change = np.zeros(start.samples.shape) if found is None else found.change
    margin = search.site.margins(change[None])[0][0]
    slope = np.nan if found is None else found.slope
    spectrum = np.nan if kept is None else kept.change(np.asarray(start.samples) + change)
    status = RecordStatus.successful
    if found is None:
        status = RecordStatus.not_reached
    elif found.length == 0:
        status = RecordStatus.unchanged
    elif slope > _USELESS:
        status = RecordStatus.useless_slopes
    elif spectrum > TOLERANCE:
        status = RecordStatus.spectrum_changed
    numbers = {
        "change": _length(found), "scaling": scaling, "margin": margin, "slope": slope, "changes": lengths,
        "path": found.lengths if found else (), "spectrum": spectrum,
    }  # fmt: skip
    name = f"{start.name}, changed".removeprefix(", ")
    return FoundRecord(
        record=start if found is None else record_in_g(start.samples + change, start.dt, name),
        start=start,
        status=status,
        **to_device({name: np.asarray(x) for name, x in numbers.items()}),
    )
