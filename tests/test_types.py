"""What type checkers are told is so. They read `references/typed_use.py` in `.ci/run`; here it runs, and every type
that it states is held against the value."""

import inspect

import jax.numpy as jnp
import pytest
from beartype.roar import BeartypeCallHintParamViolation, BeartypeCallHintReturnViolation

from jaxrock.inverse.calibration_grid import weighed
from references import typed_use

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
    """See `references.checked_shapes`; two functions of the package stand for all."""
    assert weighed(jnp.ones((2, 3)), [jnp.ones(3)]).shape == (2,)
    with pytest.raises(BeartypeCallHintParamViolation, match="parameter shares"):
        weighed(jnp.ones(()), [])
    with pytest.raises(BeartypeCallHintReturnViolation, match="return"):
        weighed(jnp.ones((2, 3)), [])
