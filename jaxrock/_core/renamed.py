"""Former names of attributes, as deprecated properties."""

import warnings

from jaxrock._core.precision import frames_of_the_package


def renamed(old: str, new: str) -> property:
    """Return a property that reads the attribute `new` under its old name, with a DeprecationWarning."""

    def read(result):
        warnings.warn(
            f"`{type(result).__name__}.{old}` is now `{new}`; the next release removes the old name.",
            DeprecationWarning,
            stacklevel=frames_of_the_package() + 1,
        )
        return getattr(result, new)

    return property(read, doc=f"Former name of `{new}`, deprecated.")
