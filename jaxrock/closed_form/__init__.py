"""Solutions in closed form. They import no engine, so they can serve as independent checks of the engines."""

from jaxrock._core.namespace import shown as _shown
from jaxrock.closed_form import (
    pushover as pushover,
    restitution as restitution,
    sine_pulse as sine_pulse,
    single_lobe as single_lobe,
)


def __dir__() -> list[str]:
    return _shown(globals(), "pushover", "restitution", "sine_pulse", "single_lobe")
