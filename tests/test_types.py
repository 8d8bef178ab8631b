"""Types that users see: `references/typed_use.py` states them, and this test compares them with the values.

Type checkers read that file in `.ci/run`.
"""

import inspect

import jax.numpy as jnp
import pytest
from beartype.roar import BeartypeCallHintParamViolation, BeartypeCallHintReturnViolation
from jaxtyping import Array, Float

from jaxrock.inverse.calibration_grid import weighed
from references import checked_shapes, typed_use

PARTS = [
    name for name, part in vars(typed_use).items() if inspect.isfunction(part) and part.__module__ == typed_use.__name__
]
QUICK = {"own_record", "pictures"}


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[] if name in QUICK else pytest.mark.slow) for name in PARTS]
)
def test_types_are_what_checkers_are_told(name, tmp_path, monkeypatch):
    stated = []

    def held(value, kind):
        stated.append(kind)
        assert isinstance(value, kind), f"{type(value)} is not {kind}"

    monkeypatch.setattr(typed_use, "assert_type", held)
    part = getattr(typed_use, name)
    part(*[tmp_path] * len(inspect.signature(part).parameters))
    assert len(stated) == inspect.getsource(part).count("assert_type(")


def test_shapes_are_checked_of_what_is_given_and_returned():
    """See `references.checked_shapes`; a function of the package stands for all."""
    function = inspect.unwrap(weighed)
    assert function is not weighed  # while tests run
    fresh = checked_shapes.checked(function)
    assert fresh(jnp.ones((2, 3)), [jnp.ones(3)]).shape == (2,)
    with pytest.raises(BeartypeCallHintParamViolation, match="parameter shares"):
        fresh(jnp.ones(()), [])
    with pytest.raises(BeartypeCallHintReturnViolation, match="return"):
        fresh(jnp.ones((2, 3)), [])


def test_shapes_are_checked_seldom_of_what_is_called_often(monkeypatch):
    def calls(of):
        function, told = checked_shapes.checked(identity), []
        for number in range(of):
            try:
                function(None)
            except BeartypeCallHintParamViolation:
                told.append(number)
        return told

    def identity(x: Float[Array, " n"]):
        return x

    assert calls(100) == [*range(64), 64, 80, 96]
    monkeypatch.setitem(checked_shapes.SELDOM, "every", 1)
    assert calls(100) == list(range(100))
