"""Shapes in annotations of the package, checked while tests run: of functions of modules, of methods, of fields.

The hook of jaxtyping wraps every function, and those within functions anew whenever these are called, which
programs that are traced do thousands of times. Here only what names shapes is wrapped, once, when its module is
imported; what is within functions is not checked. Of a function the first calls are checked and, since a check takes
longer than many a function while it is traced, few of the thousands after them (`SELDOM`).
"""

import ast
import functools
import importlib.abc
import importlib.machinery
import itertools
import sys
import typing
from collections.abc import Collection

from beartype import beartype
from jaxtyping import AbstractArray, jaxtyped

_NAMES = jaxtyped("context")  # within it what is named in shapes is the same wherever it stands
SELDOM = {"after": 64, "every": 16}  # calls of a function, of which later only one in so many is checked


def checked(named):
    """A function, or a class with fields, and a check of the shapes that its annotations name."""
    if not any(map(_is_of_shapes, getattr(named, "__annotations__", {}).values())):
        return named
    if isinstance(named, type):
        return jaxtyped(named, typechecker=beartype)
    function, calls = beartype(named), itertools.count()

    # What `jaxtyped` makes of a function checks its arguments twice.
    @functools.wraps(named)
    def called(*args, **kwargs):
        number = next(calls)
        if number >= SELDOM["after"] and number % SELDOM["every"]:
            return named(*args, **kwargs)
        with _NAMES:
            return function(*args, **kwargs)

    return called


def _is_of_shapes(annotation) -> bool:
    if isinstance(annotation, type) and issubclass(annotation, AbstractArray):
        return True
    return any(map(_is_of_shapes, typing.get_args(annotation)))


class _Decorating(ast.NodeTransformer):
    """Decorates functions of a module last, so that they keep their annotations, and classes first, when they have got
    their fields; not what is within functions."""

    def _decorator(self, node) -> ast.expr:
        told = f"__import__({__name__!r}, fromlist=['checked']).checked"
        return ast.copy_location(ast.parse(told, mode="eval").body, node)

    def visit_FunctionDef(self, node):
        node.decorator_list.append(self._decorator(node))
        return node

    def visit_ClassDef(self, node):
        self.generic_visit(node)
        node.decorator_list.insert(0, self._decorator(node))
        return node


class _Loader(importlib.machinery.SourceFileLoader):
    def get_code(self, fullname):  # what is compiled here is not what the module's cache is for
        return self.source_to_code(self.get_data(self.path), self.path)

    def source_to_code(self, data, path):
        return super().source_to_code(_Decorating().visit(ast.parse(data)), path)


class _Finder(importlib.abc.MetaPathFinder):
    def __init__(self, modules: Collection[str]):
        self._modules = modules

    def find_spec(self, fullname, path=None, target=None):
        spec = importlib.machinery.PathFinder.find_spec(fullname, path) if fullname in self._modules else None
        if spec is not None:
            spec.loader = _Loader(spec.loader.name, spec.loader.path)
        return spec


def check_shapes(modules: Collection[str]) -> None:
    """Check those of modules that are not imported yet."""
    sys.meta_path.insert(0, _Finder(frozenset(modules)))
