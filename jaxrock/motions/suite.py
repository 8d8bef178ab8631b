"""Suites: many ground motions, of any kinds, with their peaks."""

import contextlib
import dataclasses
import operator
import warnings
from collections import Counter
from collections.abc import Hashable, Iterator, Sequence
from typing import Annotated, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxrock._arguments.annotations import arguments, list_of
from jaxrock._arguments.parameters import broadcast, leaves_of, one_of_many, shared
from jaxrock._arguments.ranges import direction
from jaxrock._arguments.repr import described
from jaxrock._core.arrays import Values, is_traced, shown, to_device
from jaxrock._core.named import AbstractNamed
from jaxrock._core.precision import frames_of_the_package
from jaxrock._core.settings import called_by_users
from jaxrock.compiler import checks
from jaxrock.motions.components import Components
from jaxrock.motions.floors import Floor
from jaxrock.motions.joined_records import Chosen, JoinedRecords
from jaxrock.motions.motion import AbstractMotion, Scaled, Shifted, WithVertical
from jaxrock.motions.peaks import peaks_of_many, peaks_of_motion
from jaxrock.motions.record import Record, record_in_g, with_room

_LEAST = 1e-12  # [g]; peaks are divisors in scaling to a level


def _known_stays_so(tree) -> contextlib.AbstractContextManager:
    """Return a context in which values computed from an untraced tree stay concrete, also within `jax.jit`."""
    # Outside tracing values are concrete anyway; the context would compile operation by operation instead of whole
    # programs.
    if is_traced(tree) or not is_traced(jnp.zeros(())):
        return contextlib.nullcontext()
    return jax.ensure_compile_time_eval()


def _is_motion(value) -> bool:
    return isinstance(value, (AbstractMotion, Components))


class Suite(AbstractNamed):
    """Ground motions of any kinds, with their peaks.

    **Arguments:**

    - `motions`: a list of motions; one whose parameters are arrays of shape (n,) is an ensemble of n. Or a list of
      `Components`, each of which is one motion for every azimuth.
    - `names`: of the motions (or of the components); None: those of records, or the kind, with numbers.
    - `azimuth`: (azimuths,) of components [rad], within 2 pi, from the first one towards the second: the vertical
      planes in which a block rocks. The motions are the first record at all azimuths, then the second, and so on.
    - `vertical`: whether the vertical component of components shakes a block, too, if there is one.

    `suite[number]` is one of them. Where the number is traced (`jax.vmap` over numbers, a suite as an axis of `sweep`),
    all scenes share the samples of all records.

    `peak_acceleration` [g] and `peak_velocity` [m/s] are (motions,). `sources` are the names of records before turning.
    `azimuth` is the angle of each motion, (motions,), or None. `turns` is the number of motions from each record.

    Within `jax.jit`, `jax.vmap` and derivatives, motions may depend on traced values.

    **Raises:** ValueError if there are no motions, or names in another number, or one twice; for a motion that does not
    move; for components without azimuths, and azimuths without components.
    """

    __repr__ = described

    groups: tuple[AbstractMotion, ...]  # ensembles; samples that all of an ensemble share are stored once
    names: tuple[str, ...] = eqx.field(static=True)
    peak_acceleration: Float[Array, " motions"]
    peak_velocity: Float[Array, " motions"]
    sources: tuple[str, ...] = eqx.field(static=True)
    azimuth: Float[np.ndarray, " motions"] | None
    turns: int = eqx.field(static=True)

    @arguments
    def __init__(
        self,
        motions: Annotated[Sequence[AbstractMotion | Components], list_of(_is_motion, "motions")],
        names: Annotated[Sequence[str] | None, list_of(str, "words")] = None,
        azimuth: Values | None = None,
        *,
        vertical: bool = True,
    ):
        if not motions:
            raise ValueError("Argument `motions` must hold at least one motion, but is empty.")
        with _known_stays_so((motions, azimuth)):
            self._set(motions, names, azimuth, vertical)

    def _set(self, motions: Sequence, names: Sequence[str] | None, azimuth: Values | None, vertical: bool) -> None:
        self.azimuth, self.turns, sources = None, 1, None
        twice = [name for name, count in Counter(names or ()).items() if count > 1]
        if twice:
            raise ValueError(f"Argument `names` must differ from motion to motion, but has {twice[0]!r} twice.")
        if azimuth is not None or any(isinstance(each, Components) for each in motions):
            records = len(motions)
            motions, names, sources, self.azimuth = _turned(motions, names, azimuth, vertical)
            self.turns = len(motions) // records
        self.groups = tuple(map(_ensemble, motions))
        own = [name for motion, group in zip(motions, self.groups) for name in _names(motion, size_of(group))]
        self.names = tuple(_numbered(own) if names is None else names)
        if len(self.names) != len(own):
            raise ValueError(f"Argument `names` must name {len(own)} motions, but has {len(self.names)} names.")
        self.sources = self.names if sources is None else sources
        peaks = zip(*map(_peaks, self.groups))
        self.peak_acceleration, self.peak_velocity = (
            jnp.concatenate(x) if is_traced(x) else to_device(np.concatenate(x)) for x in peaks
        )
        if is_traced(self.peak_acceleration):
            peaks = self.peak_acceleration, self.peak_velocity
            failed = ~jnp.all((peaks[0] > _LEAST) & (peaks[1] > 0))
            self.peak_acceleration, self.peak_velocity = checks.error_if(
                peaks, failed, "Argument `motions` must move the ground"
            )
            return
        # A motion without duration, such as a record of one sample, moves nothing.
        for name, peak, speed in zip(self.names, np.asarray(self.peak_acceleration), np.asarray(self.peak_velocity)):
            if not (peak > _LEAST and speed > 0):
                raise ValueError(f"Argument `motions` must move the ground, but {name!r} does not.")

    def __len__(self) -> int:
        return len(self.names)

    @called_by_users
    def __getitem__(self, number) -> AbstractMotion:
        """Return one of its motions. Where the number is traced, scenes of all records share their samples.

        **Raises:** IndexError for a number out of range, ValueError for one that is not whole. A traced number raises
        ValueError out of range, and for motions of several kinds, or derived from records other than by a factor.
        """
        if not is_traced(number):
            place = _place(number, len(self))
            ends = np.cumsum([size_of(group) for group in self.groups])
            group = int(np.searchsorted(ends, place, side="right"))
            return one_of_many(self.groups[group], place - int(ends[group]) + size_of(self.groups[group]))
        if jnp.ndim(number) or not jnp.issubdtype(number.dtype, jnp.integer):
            raise ValueError(f"A motion of a suite has a whole number, but this is {shown(number)}.")
        motion, failed = self._chosen(number.astype(jnp.int32)), (number < 0) | (number >= len(self))
        whole, own = eqx.partition(motion, shared(motion))  # exclude shared arrays, which would be copied per lane
        message = f"The number of a motion must be in [0, {len(self) - 1}]"
        return eqx.combine(checks.error_if(own, failed, message), whole)

    def _chosen(self, number) -> AbstractMotion:
        """Return the motion of a traced number."""
        if all(_is_record(group.motion if type(group) is Scaled else group) for group in self.groups):
            with _known_stays_so(self.groups):
                joined = JoinedRecords.of([_multiplied(motion) for motion in self.motions()])
            return Chosen(joined, number, jnp.ones((), joined.samples.dtype))
        kinds = {jax.tree.structure(group) for group in self.groups}
        if len(kinds) > 1 or any(leaf.is_shared for group in self.groups for leaf in leaves_of(group)):
            raise ValueError(
                "Motions of a suite must be records, also times factors, or numbers of one kind of pulse, to be chosen "
                "by a traced number: take `jaxrock.hazard.suite_outcomes`, or one motion after the other."
            )
        every = jax.tree.map(lambda *parts: jnp.concatenate(parts), *self.groups)
        return one_of_many(every, number)

    def __iter__(self) -> Iterator[AbstractMotion]:
        return self.motions()

    def motions(self) -> Iterator[AbstractMotion]:
        """Yield its motions one by one."""
        for group in self.groups:
            for index in range(size_of(group)):
                yield one_of_many(group, index)


def _place(number: Any, count: int) -> int:
    """Return the index of a motion, from 0, by its number, which may be counted from the end."""
    try:
        place = operator.index(number)  # also for an array of one whole number
    except TypeError:
        raise ValueError(f"A motion of a suite has a whole number, but this is {shown(number)}.") from None
    if not -count <= place < count:
        raise IndexError(f"The number of a motion is out of range: {place} of {count} motions.")
    return place % count


def _is_record(motion: AbstractMotion) -> bool:
    return type(motion) is Record and motion.samples.shape[-1] > 1


def _multiplied(motion: Any) -> Record:
    """Return a record, possibly times a factor, as a record with its own samples."""
    if isinstance(motion, Record):
        return motion
    record = motion.motion
    return record_in_g(motion.factor * record.samples, record.dt, record.name, record.origin)


def _turned(motions: Sequence, names: Sequence[str] | None, azimuth: Values | None, vertical: bool):
    """Turn components to all azimuths: return motions, their names, the names of their records, and the azimuth of
    each.
    """
    if azimuth is None or not all(isinstance(each, Components) for each in motions):
        raise ValueError("Arguments `motions` and `azimuth` must be given for components alone, all of them.")
    angles = np.asarray(direction("azimuth", azimuth), float)
    if angles.ndim != 1 or angles.size == 0:
        raise ValueError(f"Argument `azimuth` must be a list of angles, but has shape {angles.shape}.")
    own = [each.first.name or f"record {number + 1}" for number, each in enumerate(motions)]
    names = _numbered(own) if names is None else names
    if len(names) != len(motions):
        raise ValueError(f"Argument `names` must name {len(motions)} motions, but has {len(names)} names.")
    turned = [each.in_plane(angle, vertical) for each in motions for angle in angles]
    titles = [f"{name}, {np.degrees(angle):.4g} deg" for name in names for angle in angles]
    sources = tuple(name for name in names for _ in angles)
    return turned, _numbered(titles), sources, np.tile(angles, len(motions))


def _ensemble(motion: AbstractMotion) -> AbstractMotion:
    """Broadcast all numbers of a motion to the shape (n,); samples stay as they are."""
    leaves = list(leaves_of(motion))
    for leaf in leaves:
        if jnp.ndim(leaf.value) > 1 and leaf.declared.axes is not None:
            raise ValueError(
                f"Motions of a suite must hold numbers or lists of them, but `{leaf.name}` has shape "
                f"{jnp.shape(leaf.value)}."
            )
    return broadcast(motion, jnp.broadcast_shapes((1,), *(jnp.shape(x.value) for x in leaves if not x.is_shared)))


def size_of(group: AbstractMotion) -> int:
    """Return the number of motions in a group."""
    return next(leaf.value.shape[0] for leaf in leaves_of(group) if not leaf.is_shared)


def _names(motion: AbstractMotion, size: int) -> list[str]:
    inner = motion
    while not getattr(inner, "name", "") and isinstance(inner, Floor | Scaled | Shifted | WithVertical):
        inner = inner.horizontal if isinstance(inner, WithVertical) else inner.motion
    name = getattr(inner, "name", "") or type(motion).__name__
    return [name] if size == 1 else [f"{name} {k + 1}" for k in range(size)]


def repeated(suite: Suite) -> tuple[str, str] | None:
    """Return the names of two identical motions; None where there are none, or the suite is traced."""
    if is_traced(suite):
        return None
    seen: dict[Any, str] = {}
    for name, motion in zip(suite.names, suite.motions()):
        before = seen.setdefault(_content(motion), name)
        if before is not name:
            return before, name
    return None


def warn_of_repeated(suite: Suite) -> None:
    """Warn, at the user's line, of two identical motions in a suite."""
    twice = repeated(suite)
    if twice:
        warnings.warn(
            f"Motions {twice[0]!r} and {twice[1]!r} are the same: what they do counts twice.",
            stacklevel=frames_of_the_package() + 1,
        )


def _content(value: Any) -> Hashable:
    """Return the content of a motion as a key, without its name and origin (all labels are equal)."""
    if isinstance(value, (np.ndarray, jax.Array)):
        array = np.asarray(value)
        return array.shape, array.dtype.str, array.tobytes()
    if isinstance(value, eqx.Module):
        return type(value), *(_content(getattr(value, field.name)) for field in dataclasses.fields(value))
    if isinstance(value, (list, tuple)):
        return tuple(map(_content, value))
    return value if isinstance(value, Hashable) else id(value)


def _numbered(names: list[str]) -> list[str]:
    """Number the names that occur more than once: names tell which outcomes go together."""
    alike, seen, found = Counter(names), Counter[str](), []
    for name in names:
        seen[name] += 1
        found.append(f"{name} {seen[name]}" if alike[name] > 1 else name)
    return found


def _peaks(group: AbstractMotion):
    """Return the peak accelerations and velocities of a group's motions."""
    group = with_room(group)
    if size_of(group) == 1:  # a single motion uses the programs that are compiled already
        return [jnp.reshape(peak, (1,)) for peak in peaks_of_motion(one_of_many(group, 0))]
    return peaks_of_many(group, one_of_many, size_of(group))
