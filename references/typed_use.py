"""Typical use, for type checkers: `mypy --strict` and pyright find no fault here, and every type is as stated.

`.ci/run` has mypy read it; `tests/test_types.py` runs it, so that what checkers are told is so.
"""

from pathlib import Path
from typing import assert_type

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes

import jaxrock as rk


def one_scene() -> None:
    """A block in an earthquake: README.md, docs/index.md."""
    block = rk.Block.from_dimensions(width=0.6, height=3.0)
    record = rk.example_record()
    assert_type(block, rk.Block)
    assert_type(record, rk.Record)
    response = rk.simulate(block, record)
    assert_type(response, rk.responses.Response)
    assert_type(response.max_rotation, jax.Array)
    assert_type(response.impact_times, jax.Array)
    rotation, velocity = response(np.linspace(0.0, 1.0, 5))
    assert_type(rotation, jax.Array)
    peak = float(response.max_rotation / block.alpha)
    print(f"peak {peak:.3f} alpha, overturned: {bool(response.overturned)}", velocity.shape)
    found = rk.outcome(block, 1.4 * record, rk.Linear(), engine=rk.Series(order=8))
    assert_type(found, rk.responses.Outcome)
    assert_type(found.overturned, jax.Array)
    assert_type(found.status, rk.Status)
    if found.status == rk.Status.successful:
        print(found.margin.item(), rk.Status[found.status])
    contact = rk.responses.contact_forces(response, block)
    assert_type(contact.sticks(0.5), jax.Array)


def many_scenes() -> None:
    """Transformations: `jax.vmap`, `jax.grad`, a sweep; docs/how_to/sweeps.md."""
    block, record = rk.Block(0.2, 2.0), rk.SinePulse(0.4, 0.6)

    def under(scale: jax.Array) -> rk.responses.Outcome:
        return rk.outcome(block, scale * record)

    scales = jnp.linspace(0.6, 2.0, 3)
    many = jax.vmap(under)(scales)
    assert_type(many, rk.responses.Outcome)
    fallen = np.asarray(scales)[np.asarray(many.overturned)]
    slope = jax.grad(lambda alpha: rk.outcome(rk.Block(alpha, 2.0), record).margin)(0.2)
    print(fallen.size, float(slope))
    grid = rk.sweep(
        lambda alpha, p: rk.outcome(rk.Block(alpha, p), record),
        alpha=np.linspace(0.1, 0.3, 2),
        p=[1.5, 2.0],
        progress=False,
    )
    assert_type(grid, rk.studies.Grid)
    print(grid.shape, grid.values.margin.shape)
    spectrum = rk.rocking_spectrum(0.2, record, [2.0, 3.0], progress=False)
    assert_type(spectrum.rotation_ratio, jax.Array)
    suite = rk.motions.Suite([record, 0.5 * record])
    lower, upper = rk.rocking_spectrum(0.2, suite, [2.0, 3.0], progress=False).percentiles([16, 50, 84])
    assert_type(lower, jax.Array)
    assert_type(upper, jax.Array)
    surface = rk.overturning_map([1.0, 2.0], [1.5, 3.0], pulse=rk.CosinePulse, progress=False)
    assert_type(surface.state, jax.Array)
    ends = rk.critical_amplitudes(block, record, intensity=(1.0, 6.0), progress=False)
    print(ends.value[: int(ends.count)])
    told = rk.studies.sensitivity(block, record)
    print(told.names, told.max_rotation.elasticity)


def own_record(folder: Path) -> None:
    """Samples from anywhere, files, components: docs/how_to/record.md."""
    time = np.arange(0, 2, 0.01)
    record = rk.Record(0.3 * np.sin(5 * time), dt=0.01, name="made")
    rk.motions.write_at2(record, folder / "mine.AT2")
    again = rk.read_record(folder / "mine.AT2")
    assert_type(again.origin, rk.motions.Origin)
    later = (1.5 * again).shifted(1.0) + -again
    motion = again.with_vertical(0.5 * record)
    assert_type(motion, rk.motions.WithVertical)
    clean = rk.processing.filtered(rk.processing.baseline_corrected(record, degree=1), low=0.5, high=20.0)
    assert_type(clean, rk.Record)
    print(float(later.end), float(rk.intensity.arias(clean)), float(rk.intensity.peak_acceleration(clean)))
    print(rk.outcome(rk.Block.from_dimensions(width=0.3, height=1.5), motion))


class Brittle(rk.restitution.AbstractRestitution):
    """Fast impacts lose more: docs/how_to/own_physics.md."""

    firm: jax.Array
    speed: jax.Array

    def ratio(self, corners: rk.restitution.Corners, speed: jax.Array) -> jax.Array:
        """Return the ratio of the speeds after and before an impact."""
        return self.firm / (1 + speed / self.speed)


class Ramp(rk.motions.AbstractMotion):
    """A straight line."""

    height: jax.Array = rk.parameter("g")
    duration: jax.Array = rk.parameter("s", "positive")

    @property
    def knots(self) -> jax.Array:
        """Its ends."""
        return jnp.stack([jnp.zeros_like(self.duration), self.duration])

    @property
    def scales(self) -> jax.Array:
        """A straight line has none."""
        return jnp.full_like(self.duration, jnp.inf)[None]

    @property
    def bounds(self) -> jax.Array:
        """Its end."""
        return jnp.abs(self.height)[None]

    def series(self, piece: jax.Array, local: jax.Array, unit: jax.Array, order: int) -> list[jax.Array]:
        """Value and slope."""
        slope = self.height / self.duration
        return [slope * local, slope * unit][: order + 1]


class Damper(eqx.Module):
    """Viscous moment over m g R."""

    size: jax.Array

    def __call__(self, opening: jax.Array, velocity: jax.Array, block: rk.Block) -> jax.Array:
        return self.size * velocity


def own_physics() -> None:
    """A law, a motion and a model of one's own."""
    brittle = rk.Block(0.2, 2.0, restitution=Brittle(jnp.asarray(0.95), jnp.asarray(4.0)))
    ramp = Ramp(jnp.asarray(0.5), jnp.asarray(0.7))
    print(rk.outcome(brittle, ramp).margin)
    model = rk.models.Equation(
        restoring=lambda opening, block: jnp.sin(block.alpha - opening),
        arm=lambda opening, block: jnp.cos(block.alpha - opening),
        dissipation=Damper(jnp.asarray(0.2)),
    )
    engine = rk.Diffrax(solver=diffrax.Tsit5(), rtol=1e-8, atol=1e-10)
    print(rk.outcome(rk.Block(0.2, 2.0), rk.SinePulse(0.4, 0.6), model, engine=engine).max_rotation)


def rocks() -> None:
    """Two sides, and a flexible column: docs/how_to/rock.md, docs/concepts/flexible.md."""
    rock = rk.blocks.AsymmetricBlock.from_corners(
        corner1=(0.32, -0.61), corner2=(-0.25, -0.58), centre=(0.0, 0.0), gyration_radius=0.45
    )
    print(bool(rk.outcome(rock, -1 * rk.SinePulse(0.5, 0.6)).overturned))
    column = rk.blocks.FlexibleBlock(0.5, 2.0, 30e9, 2500.0, 0.02, masses=3)
    assert_type(rk.outcome(column, rk.SinePulse(0.3, 0.6)), rk.responses.FlexibleOutcome)
    wild = rk.Block(jnp.asarray(-0.2), 2.0, throw=False)
    print(rk.outcome(wild, rk.SinePulse(0.4, 0.6), throw=False).status == rk.Status.not_finite)


def from_rocks() -> None:
    """Estimate shaking from rocks: docs/inverse.md, docs/concepts/fragility.md."""
    seen = rk.inverse.Observations(alpha=[0.2, 0.3], p=[2.0, 2.5], seen=["toppled", "survived"])
    unknowns = {"amplitude": rk.inverse.Unknown(0.1, 1.5), "period": rk.inverse.Unknown(0.2, 1.5)}
    target = rk.inverse.log_density(seen, rk.SinePulse, unknowns)
    print(target(target.starts(4)).shape)
    suite = rk.motions.Suite([rk.SinePulse(0.5, 0.6), rk.CosinePulse(0.5, 0.6)])
    fragility = rk.hazard.LogNormalFragility(0.4, 0.3)
    print(suite.names, fragility(np.array([0.2, 0.4])))


def pictures() -> None:
    """Figures are matplotlib's."""
    block, pulse = rk.Block(0.2, 2.0), rk.SinePulse(0.4, 0.6)
    axes = rk.plot.history(rk.simulate(block, pulse))
    assert_type(axes[0], Axes)
    assert_type(rk.plot.scene(block, pulse), Axes)
