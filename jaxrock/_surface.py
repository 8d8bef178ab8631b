"""What `dir` and completion show of a namespace: what users may use, without what the file imports for itself."""

from types import ModuleType
from typing import Any


def shown(space: dict[str, Any], *modules: str) -> list[str]:
    """Names for the `__dir__` of a package.

    **Arguments:**

    - `space`: its `globals()`. `modules`: those of its modules that are namespaces of their own.
    """
    return sorted(name for name, value in space.items() if _is_shown(name, value) or name in modules)


def _is_shown(name: str, value: Any) -> bool:
    if name.startswith("__"):
        return True  # tools look for them
    return name[0] != "_" and not isinstance(value, ModuleType)
