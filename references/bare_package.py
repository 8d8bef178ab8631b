"""A plugin of pytest that makes `jaxrock` a bare package, in which only the compiler and what lies below it are found.

`python -m pytest --noconftest -p references.bare_package tests/compiler` shows that the compiler needs no physics.
"""

import importlib.util
import sys
import types
from importlib.abc import MetaPathFinder

ALLOWED = ("_core", "compiler", "numerics")


class _Blocked(MetaPathFinder):
    """Raises for every other package of `jaxrock`."""

    def find_spec(self, name, path=None, target=None):
        parts = name.split(".")
        if parts[0] == "jaxrock" and len(parts) > 1 and parts[1] not in ALLOWED:
            raise ImportError(f"{name} is blocked")
        return None


def _bare() -> types.ModuleType:
    found = importlib.util.find_spec("jaxrock")
    assert found is not None
    package = types.ModuleType("jaxrock")
    package.__path__ = list(found.submodule_search_locations or [])
    return package


assert "jaxrock" not in sys.modules
sys.modules["jaxrock"] = _bare()
sys.meta_path.insert(0, _Blocked())
