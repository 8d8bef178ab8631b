"""What became of a computation: every result carries one of these."""

import equinox as eqx


class Status(eqx.Enumeration):
    """Outcome of a computation, as data: it goes through jit and vmap, and compares with ==.

    `Status[result.status]` is the message. Numbers beside a status other than `successful` are not results.
    """

    successful = "The response was computed."
    step_budget_exhausted = (
        "The step budget was used up before the motion ended, usually by impacts that do not die out "
        "(restitution at or near 1). Raise `max_steps` of the engine."
    )
    undecided = (
        "Too close to call: a near balance, a grazing impact or long chaotic rocking makes the response so sensitive "
        "that errors of this computation decide it. A tighter tolerance may decide; near the last digit nothing can."
    )
    solver_failed = (
        "The differential equation solver gave up: its nonlinear solver failed or its steps became too small."
    )
    not_finite = "The state or the motion stopped being a finite number. Check the inputs."
