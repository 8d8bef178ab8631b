"""Equations of motion of a rigid block: a table of coefficients, or functions of the user's own.

Imports `blocks` and `numerics`. Start with `equation`, the interface of every model, then `rigid`.
"""

from jaxrock._core.namespace import shown as _shown
from jaxrock.models.coefficients import Coefficients as Coefficients
from jaxrock.models.equation import AbstractEquation as AbstractEquation
from jaxrock.models.mechanism import (
    Mechanism as Mechanism,
    RigidBody as RigidBody,
)
from jaxrock.models.restraints.damper import Damper as Damper
from jaxrock.models.restraints.restraint import (
    AbstractRestraint as AbstractRestraint,
    RestraintTerms as RestraintTerms,
)
from jaxrock.models.restraints.tendon import Tendon as Tendon
from jaxrock.models.restraints.tie import Tie as Tie
from jaxrock.models.rigid import (
    Housner as Housner,
    Linear as Linear,
)
from jaxrock.models.rolling import Rolling as Rolling
from jaxrock.models.spring import Spring as Spring
from jaxrock.models.terms import Terms as Terms
from jaxrock.models.user_equation import Equation as Equation


def __dir__() -> list[str]:
    return _shown(globals())
