"""Solutions that need no integration. They import no engine, so they can judge them."""

from jaxrock._surface import shown as _shown
from jaxrock.closed_form import (
    pushover as pushover,
    restitution as restitution,
    sine_pulse as sine_pulse,
    single_lobe as single_lobe,
)


def __dir__() -> list[str]:
    return _shown(globals(), "pushover", "restitution", "sine_pulse", "single_lobe")
