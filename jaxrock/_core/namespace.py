"""Names that `dir` and completion show of a namespace: public ones, without modules that the file imports."""

from types import ModuleType
from typing import Any


def shown(space: dict[str, Any], *modules: str) -> list[str]:
    """Return the names for the `__dir__` of a package.

    **Arguments:**

    - `space`: its `globals()`. `modules`: names of its modules that are public namespaces.
    """
    return sorted(name for name, value in space.items() if _is_shown(name, value) or name in modules)


def _is_shown(name: str, value: Any) -> bool:
    if name.startswith("__"):
        return True  # tools look for them
    return name[0] != "_" and not isinstance(value, ModuleType)
