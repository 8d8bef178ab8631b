"""Scenes of `references.structures` as blocks, motions and models of jaxrock."""

import jax.numpy as jnp
import numpy as np

import jaxrock as rk


def motion(told):
    """Return the motion of a scene."""
    kind, amplitude, period = told["kind"], told.get("amplitude"), told.get("period")
    if kind == "record":
        return rk.Record(np.array(told["samples"]), told["dt"])
    if kind == "half sine":
        return rk.HalfSinePulse(amplitude, period / 2)
    if kind == "ricker":
        return rk.RickerPulse(amplitude, period, center=told["center"])
    if kind == "harmonic":
        return rk.HarmonicMotion(amplitude, period, told["cycles"])
    return {"sine": rk.SinePulse, "cosine": rk.CosinePulse}[kind](amplitude, period)


def motions(scene):
    """Return the motion of a scene, with its vertical component, if it has one."""
    horizontal = motion(scene["motion"])
    return horizontal if scene.get("vertical") is None else horizontal.with_vertical(motion(scene["vertical"]))


def restraint(told):
    """Return a restraint."""
    kind, own = told["kind"], {name: value for name, value in told.items() if name != "kind"}
    if kind == "damper" and "rotational" in own:
        return rk.models.Damper(own["rotational"])
    if kind == "damper" and "centre" in own:
        return rk.models.Damper(own["centre"], centre=True)
    if kind == "damper":
        return rk.models.Damper(own["horizontal"], height=own["height"])
    if kind == "tendon":
        return rk.models.Tendon(own.get("stiffness", 0.0), own.get("prestress"))
    return rk.models.Tie(**own)


def model(scene):
    """Return Housner's model with the restraints of a scene."""
    found = rk.Housner()
    for told in scene["structure"].get("restraints", ()):
        found = found + restraint(told)
    return found


def radius(scene):
    """Return half the diagonal of the block, or of one column [m]."""
    return 0.75 * 9.81 / scene["p"] ** 2


def block(scene):
    """Return the block of a scene, its wall of one side, its frame, or its column with a mass."""
    structure, size = scene["structure"], 2 * radius(scene)
    sizes = size * np.sin(scene["alpha"]), size * np.cos(scene["alpha"])
    if structure["kind"] == "frame":
        return rk.Block.from_frame(*sizes, beam=structure["beam_ratio"])
    if structure["kind"] == "pinned":
        return rk.Block.from_masses(*sizes, top=structure["mass_ratio"])
    opens = None if structure["sides"] == 2 else "right" if structure["side"] > 0 else "left"
    return rk.Block(scene["alpha"], scene["p"], scene["restitution"], opens=opens)


def scene(told):
    """Return block, motion and model of a scene."""
    if told["structure"]["kind"] in ("inerter", "oscillator", "strip"):
        found = mechanism(told)
        return found.block(), motions(told), found
    return block(told), motions(told), model(told)


def mechanism(told):
    """Return the mechanism of a scene, of masses over that of the block, whose moment of inertia is that of a
    rectangle."""
    structure, size, alpha = told["structure"], radius(told), told["alpha"]
    half, height = size * np.sin(alpha), size * np.cos(alpha)

    def place(x):
        return -size * jnp.sin(alpha - x), size * jnp.cos(alpha - x)

    def own(x):
        return rk.models.RigidBody(1.0, *place(x), rotation=x, inertia=size**2 / 3)

    def with_inerter(x):
        return [own(x), rk.models.RigidBody(0.0, 0.0, 0.0, place(x)[0], structure["inertance_ratio"])]

    def with_oscillator(x):
        return [own(x), rk.models.RigidBody(structure["mass_ratio"], 2 * place(x)[0], 0.0)]  # moves horizontally

    def spring(x, velocity):
        omega = structure["frequency_ratio"] * told["p"]
        stretch, arm = 2 * (size * np.sin(alpha) + place(x)[0]), 2 * place(x)[1]
        damping = 2 * structure["damping"] * omega * arm * velocity
        return structure["mass_ratio"] * (omega**2 * stretch + damping) * arm

    def strip(x):
        ratio, load = structure["height_ratio"], structure["load_ratio"]
        upper, (aside, up) = ratio * height, place(x)
        length = np.hypot(half, upper)
        run = half * jnp.cos(x) - height * jnp.sin(x)
        back = jnp.arccos(run / length) - np.arccos(half / length)  # the far top corner stays above the foot
        rest = half * jnp.sin(back) + upper * jnp.cos(back)
        above = rk.models.RigidBody(ratio, aside, 2 * up + rest, rotation=-back, inertia=ratio * length**2 / 3)
        return [own(x), above, rk.models.RigidBody(load, 0.0, 2 * up + 2 * rest)]

    kind = structure["kind"]
    if kind == "oscillator":
        return rk.models.Mechanism(with_oscillator, spring)
    return rk.models.Mechanism(strip if kind == "strip" else with_inerter)
