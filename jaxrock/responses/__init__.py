"""Responses of one scene: `outcome`, `simulate`, and the forces between block and ground.

Imports `engines` and `flexible`. Start with `outcome`.
"""

from jaxrock._core.namespace import shown as _shown
from jaxrock.flexible.response import (
    FlexibleResponse as FlexibleResponse,
    outcome_flexible as outcome_flexible,
    simulate_flexible as simulate_flexible,
)
from jaxrock.flexible.stepper import FlexibleOutcome as FlexibleOutcome
from jaxrock.responses.contact import (
    Contact as Contact,
    contact_forces as contact_forces,
)
from jaxrock.responses.history import Response as Response
from jaxrock.responses.outcome import Outcome as Outcome


def __dir__() -> list[str]:
    return _shown(globals())
