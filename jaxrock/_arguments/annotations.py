"""Argument checks of public functions, by their annotations, before the function runs.

    @arguments
    def outcome(block: Block, motion: AbstractMotion, *, samples: Annotated[int, at_least(2)] = 100):

A class demands an instance; `int`, `bool` and `str` demand such a value; `Callable` demands a function. In `Annotated`,
each item after the type is a check, such as a `Range`, and the function gets the value that it returns. Numbers and
arrays without such a check (`ArrayLike`, shapes) are checked by the function itself, which knows more about them.
"""

import collections.abc
import functools
import inspect
import math
import os
import types
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, TypeVar, Union, cast, get_args, get_origin

import numpy as np

from jaxrock._arguments.ranges import Range, one_of, truth, whole
from jaxrock._core.arrays import shown
from jaxrock._core.settings import called_by_users

Taking = TypeVar("Taking", bound=Callable)
Check = Callable[[str, Any], Any]  # takes a name and a value; returns the value, or raises ValueError


def arguments(function: Taking) -> Taking:
    """Decorate a public function: its arguments are checked against their annotations before it runs.

    It runs under the package's settings of JAX (`_core.settings`), on arrays of enabled types.

    **Raises:** ValueError, when it is called, for an argument outside its range: "Argument `x` must ...".
    """
    parameters = inspect.signature(function).parameters.values()
    checks = {each.name: check_of(each.annotation) for each in parameters}
    checks = {name: check for name, check in checks.items() if check is not None}
    several = {each.name for each in parameters if each.kind in (each.VAR_POSITIONAL, each.VAR_KEYWORD)}
    checks = {name: check for name, check in checks.items() if name not in several}
    places = [(each.name, checks.get(each.name)) for each in parameters if each.kind <= each.POSITIONAL_OR_KEYWORD]
    by_place = {each.name for each in parameters if each.kind is each.POSITIONAL_ONLY}  # `**kwargs` may repeat it
    checks = {name: check for name, check in checks.items() if name not in by_place}

    @called_by_users
    @functools.wraps(function)
    def checked(*args: Any, **kwargs: Any) -> Any:
        args = [value if check is None else check(name, value) for (name, check), value in zip(places, args)] + list(
            args[len(places) :]
        )  # too many arguments: Python raises TypeError
        kwargs = {name: checks[name](name, value) if name in checks else value for name, value in kwargs.items()}
        return function(*args, **kwargs)

    return cast(Taking, checked)


def check_fields(owner: Any) -> None:
    """Check the fields of a module without its own `__init__` against their annotations: for its `__check_init__`."""
    kind: Any = type(owner)
    for name, check in _of_fields(kind).items():
        check(name, getattr(owner, name))


@functools.cache
def _of_fields(kind: Any) -> dict[str, Check]:
    hints = {name: hint for each in reversed(kind.__mro__) for name, hint in inspect.get_annotations(each).items()}
    checks = {name: check_of(hint) for name, hint in hints.items()}
    return {name: check for name, check in checks.items() if check is not None}


def check_of(hint: Any) -> Check | None:
    """Return the check for an annotation; None where it demands nothing that is checked here."""
    if get_origin(hint) is Annotated:
        return _of_annotated(*get_args(hint))
    if get_origin(hint) in (Union, types.UnionType):
        return _of_union(get_args(hint))
    if hint is int:
        return lambda name, value: whole(name, value)
    if hint is bool:
        return truth
    if hint is str:
        return lambda name, value: _kind(name, value, (str,), "be a word")
    if hint is collections.abc.Callable or get_origin(hint) is collections.abc.Callable:
        return _callable
    if (get_origin(hint) or hint) in (dict, collections.abc.Mapping):
        return lambda name, value: _kind(name, value, (collections.abc.Mapping,), "be a dictionary")
    if _is_own(hint):
        return lambda name, value: _kind(name, value, (hint,), f"be {_called(hint)}")
    return None


def _of_annotated(hint: Any, *more: Any) -> Check:
    checks = [each for each in more if callable(each)]
    missing = type(None) in get_args(hint)

    def check(name: str, value: Any) -> Any:
        if value is None and missing:
            return None
        return functools.reduce(lambda value, each: each(name, value), checks, value)

    return check


def _of_union(members: tuple) -> Check | None:
    """Return the check for a union of classes, or of one type and None; other unions have none."""
    rest = tuple(each for each in members if each is not type(None))
    missing = len(rest) < len(members)
    if all(map(_is_own, rest)):
        words = [_called(each) for each in rest]
        words = " or ".join(filter(None, (", ".join(words[:-1]), words[-1])))

        inner: Check | None = functools.partial(_of_kinds, rest, f"be {words}")
    else:
        inner = check_of(rest[0]) if len(rest) == 1 else None
    if inner is None or not missing:
        return inner
    return lambda name, value: None if value is None else inner(name, value)


def _of_kinds(kinds: tuple[type, ...], allowed: str, name: str, value: Any) -> Any:
    return _kind(name, value, kinds, allowed)


def _is_own(hint: Any) -> bool:
    """Return whether a hint is a class of this package or of Diffrax, not of Python, NumPy or jaxtyping."""
    return isinstance(hint, type) and hint.__module__.split(".")[0] in ("jaxrock", "diffrax")


# By the class that is demanded and the class that is given: how to convert the value.
_NEAR = {("Record", "Scaled"): " (`jaxrock.processing.scaled(record, factor)` is a Record)"}
_IN_WORDS = {"AbstractEquation": "an equation of motion, such as Housner()"}


def _called(kind: type) -> str:
    """Return a class in words, such as "a Block"; for an abstract class, such as "a motion"."""
    name = kind.__name__
    if name in _IN_WORDS:
        return _IN_WORDS[name]
    word = name.removeprefix("Abstract")
    word = word if word == name else word.lower()
    return f"{'an' if word[0] in 'AEIOUaeiou' else 'a'} {word}"


def _kind(name: str, value: Any, kinds: tuple[type, ...], allowed: str) -> Any:
    if isinstance(value, kinds):
        return value
    near = (way for kind in kinds for way in [_NEAR.get((kind.__name__, type(value).__name__))] if way)
    raise ValueError(f"Argument `{name}` must {allowed}, but is {shown(value)}{next(near, '')}.")


def _callable(name: str, value: Any) -> Callable:
    if callable(value):
        return value
    raise ValueError(f"Argument `{name}` must be a function, but is {shown(value)}.")


# Checks for `Annotated`.


def at_least(least: int, most: int | None = None) -> Check:
    """Return a check for integers from `least` to `most`; None: without an upper limit."""
    return lambda name, value: whole(name, value, least, most)


def known(allowed: Range) -> Check:
    """Return a check for a setting: one number in a range, no array, and not traced."""

    def check(name: str, value: Any) -> float:
        number = isinstance(value, (int, float, np.integer, np.floating))
        if not number or isinstance(value, (bool, np.bool_, np.timedelta64)):
            raise ValueError(f"Argument `{name}` must be a number, but is {shown(value)}.")
        try:
            found = float(value)  # a JAX array would be traced by some transformations
        except OverflowError:
            found = math.inf
        if not allowed.holds(found):
            raise ValueError(f"Argument `{name}` must {allowed.allowed}, but is {found}.")
        return found

    return check


def word_of(*words: str) -> Check:
    """Return a check for one of some words."""
    return lambda name, value: one_of(name, value, words)


def path_of(name: str, value: Any) -> Path:
    """Return the path of a file, with `~` expanded to a user's folder; or raise ValueError."""
    if not isinstance(value, (str, os.PathLike)) or "\0" in os.fsdecode(value) or not _can_be_named(value):
        raise ValueError(f"Argument `{name}` must be the path of a file, but is {shown(value)}.")
    return Path(os.path.expanduser(os.fsdecode(value)))  # `~` of an unknown user stays


def _can_be_named(value: Any) -> bool:
    try:
        os.fsencode(value)
    except UnicodeEncodeError:
        return False
    return True


def pair(name: str, value: Any) -> tuple:
    """Return a pair of values as a tuple, or raise ValueError."""
    if isinstance(value, (str, bytes, dict, set, frozenset)) or _length(value) != 2:
        raise ValueError(f"Argument `{name}` must be a pair, but is {shown(value)}.")
    return tuple(value)


def _length(value: Any) -> int | None:
    try:
        return len(value)
    except TypeError:  # a number, an array without axes
        return None


def list_of(kind: type | Callable, words: str) -> Check:
    """Return a check for a list of items of a kind.

    **Arguments:**

    - `kind`: a class, or a function of an item that returns whether it is allowed. `words`: the items, for messages.
    """

    def check(name: str, value: Any) -> list:
        if isinstance(value, (str, bytes, dict)) or not isinstance(value, collections.abc.Iterable):
            raise ValueError(f"Argument `{name}` must be a list of {words}, but is {shown(value)}.")
        try:
            values = list(value)
        except TypeError:  # an array without axes
            raise ValueError(f"Argument `{name}` must be a list of {words}, but is {shown(value)}.") from None
        for each in values:
            if not (isinstance(each, kind) if isinstance(kind, type) else kind(each)):
                raise ValueError(f"Argument `{name}` must be a list of {words}, but holds {shown(each)}.")
        return values

    return check


def gradient_transformation(name: str, value: Any) -> Any:
    """Return an optimiser of optax, or None; raise ValueError for anything else."""
    if value is not None and not (hasattr(value, "init") and hasattr(value, "update")):
        raise ValueError(f"Argument `{name}` must be an optax.GradientTransformation, but is {shown(value)}.")
    return value
