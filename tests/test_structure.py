"""The shape of the package: imports go downward, files and functions stay short, importing has no side effects."""

import ast
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import jaxrock

PACKAGE = Path(jaxrock.__file__).parent
FILES = {
    ".".join(path.relative_to(PACKAGE).with_suffix("").parts).removesuffix(".__init__"): path
    for path in sorted(PACKAGE.rglob("*.py"))
}
TREES = {name: ast.parse(path.read_text()) for name, path in FILES.items()}
MODULES = [name for name in TREES if name != "__init__"]

# At the bottom: `status`, and helpers (one underscore). They import nothing, and all others may import them.
BOTTOM = {"status"} | {name for name in MODULES if re.match("_[^_]", name)}

# Every other module, and the modules just below it: it may import those, and what lies below them.
BELOW = dict.fromkeys(BOTTOM, set()) | {
    "polynomial": set(),
    "block": set(),
    "outline": set(),
    "asymmetric": {"block", "outline"},
    "skewed": set(),
    "models": {"block", "skewed"},
    "motion": {"models", "polynomial"},
    "pulses": {"motion"},
    "records": {"pulses"},
    "free": {"state"},
    "operations": set(),
    "emitter": {"operations"},
    "kernels": {"emitter"},
    "programs": set(),
    "native": {"kernels", "programs"},
    "lanes": {"native"},
    "late": set(),
    "derivatives": {"lanes", "late"},
    "taylor": {"motion"},
    "scene": {"asymmetric", "motion"},
    "spread": set(),
    "state": {"scene", "spread"},
    "engine": {"taylor", "state"},
    "tape": {"state"},
    "series": {"derivatives", "engine", "free", "tape"},
    "quick": {"series"},
    "guards": {"state"},
    "arcs": {"derivatives", "engine", "guards"},
    "response": {"quick", "arcs"},
    "contact": {"response"},
    "devices": set(),
    "grid": {"response"},
    "store": {"grid"},
    "traced": set(),
    "sweeps": {"devices", "store", "traced"},
    "spectra": {"sweeps", "pulses"},
    "closed_form.single_lobe": set(),
    "closed_form._sine_arcs": set(),
    "closed_form.sine_pulse": {"closed_form._sine_arcs"},
    "closed_form.restitution": set(),
    "closed_form.pushover": set(),
    "closed_form": {f"closed_form.{name}" for name in ("single_lobe", "sine_pulse", "pushover", "restitution")},
    "similarity": {"block"},
    "parameters": {"scene"},
    "sensitivity": {"spectra", "parameters"},
    "critical": {"sweeps", "parameters"},
    "modal_curves": set(),
    "flexible_block": {"block"},
    "flexible_phases": {"flexible_block", "modal_curves"},
    "flexible_scene": {"flexible_phases", "motion", "polynomial"},
    "flexible": {"flexible_scene", "derivatives"},
    "dispatch": {"response", "flexible"},
    "fragility": set(),
    "hazard": {"fragility"},
    "hazard_files": {"hazard"},
    "intensity": {"motion", "block"},
    "suites": {"spectra", "fragility", "intensity"},
    "surfaces": {"suites"},
    "least_squares": set(),
    "histories": {"response", "pulses", "parameters", "least_squares"},
    "observations": {"asymmetric"},
    "observation_files": {"observations"},
    "possible": {"observations"},
    "likelihood": {"response", "possible", "pulses"},
    "climb": set(),
    "problem": {"likelihood"},
    "profiles": {"problem", "climb"},
    "inverse": {"profiles"},
    "proposals": set(),
    "posterior": {"inverse", "proposals"},
    "feasible": {"likelihood", "critical", "spectra"},
    "invert": {"feasible", "inverse", "observation_files", "pulses"},
    "plot": {"sensitivity", "critical", "closed_form", "surfaces", "histories"},
    "__init__": {
        "plot",
        "contact",
        "records",
        "similarity",
        "hazard_files",
        "dispatch",
        "posterior",
        "observation_files",
        "feasible",
    },
    "__main__": {"__init__", "invert"},
}

MOST_LINES_OF_A_MODULE = 450
MOST_LINES_OF_A_FUNCTION = 70


def imported(tree: ast.Module) -> set[str]:
    """Modules of the package that a file imports, wherever in it; the package itself is `__init__`."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"relative import in line {node.lineno}"
            # `from jaxrock import x`: a module x, or something that the package exports.
            names = [f"{node.module}.{a.name}" for a in node.names]
            names = [n if n.removeprefix("jaxrock.") in TREES else node.module for n in names]
        else:
            continue
        found |= {name.removeprefix("jaxrock.") for name in names if name.startswith("jaxrock.")}
        found |= {"__init__" for name in names if name == "jaxrock"}
    return found


IMPORTS = {name: imported(tree) for name, tree in TREES.items()}


def reached(graph: dict[str, set[str]], start: str) -> set[str]:
    """All modules that `start` leads to, in any number of steps."""
    found, waiting = set(), [*graph[start]]
    while waiting:
        name = waiting.pop()
        if name not in found:
            found.add(name)
            waiting += graph[name]
    return found


def code_lines(function: ast.FunctionDef, lines: list[str]) -> int:
    """Lines of a function from `def` to its end, without its docstring, comments and blank lines."""
    numbers = set(range(function.lineno, function.end_lineno + 1))
    if ast.get_docstring(function) is not None:
        numbers -= set(range(function.body[0].lineno, function.body[0].end_lineno + 1))
    return sum(bool(lines[n - 1].strip()) and not lines[n - 1].lstrip().startswith("#") for n in numbers)


def functions():
    for name, tree in TREES.items():
        lines = FILES[name].read_text().splitlines()
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef):
                yield f"{name}.{node.name}", code_lines(node, lines)


def fresh(code: str) -> str:
    """What a fresh interpreter prints, with nothing set for JAX."""
    environment = {key: value for key, value in os.environ.items() if not key.startswith("JAX_")}
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code],
        cwd=PACKAGE.parent,
        env=environment | {"JAX_PLATFORMS": "cpu"},
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_the_table_names_every_module():
    assert not {name for name in BELOW if name in reached(BELOW, name)}
    assert set(TREES) == set(BELOW), "a module was added or removed: give it its place in BELOW"


@pytest.mark.parametrize("name", TREES)
def test_imports_go_downward(name):
    assert name in BELOW, "this module has no place in BELOW yet"
    upward = IMPORTS[name] - reached(BELOW, name) - (set() if name in BOTTOM else BOTTOM)
    assert not upward, f"{name} imports {sorted(upward)}, which do not lie below it"


@pytest.mark.parametrize("name", TREES)
def test_no_cycles(name):
    assert name not in reached(IMPORTS, name)


@pytest.mark.parametrize("name", ["free", "polynomial", "models", "motion", "spread"])
def test_the_physics_imports_no_engine(name):
    assert not reached(IMPORTS, name) & {"engine", "series", "arcs", "response"}


def test_closed_forms_import_no_engine():
    """They judge the engines: nothing of the package but helpers and each other."""
    assert all(name in BOTTOM or name.startswith("closed_form") for name in reached(IMPORTS, "closed_form"))


@pytest.mark.parametrize("name", [name for name in TREES if name.startswith("closed_form.")])
def test_closed_forms_are_documented(name):
    nodes = [node for node in TREES[name].body if isinstance(node, (ast.FunctionDef, ast.ClassDef))]
    assert ast.get_docstring(TREES[name])
    assert not [node.name for node in nodes if not node.name.startswith("_") and not ast.get_docstring(node)]


@pytest.mark.parametrize("name", MODULES)
def test_modules_are_short(name):
    lines = len(FILES[name].read_text().splitlines())
    assert lines <= MOST_LINES_OF_A_MODULE


def test_functions_are_short():
    found = dict(functions())
    assert len(found) > 100
    assert not {name: lines for name, lines in found.items() if lines > MOST_LINES_OF_A_FUNCTION}


def test_restitution_is_not_called_eta():
    """`eta` is the restitution in some papers, its square in others."""
    found = {
        f"{path.name}:{number}"
        for path in PACKAGE.rglob("*.py")
        for number, line in enumerate(path.read_text().splitlines(), 1)
        if re.search(r"\beta\b", line)
    }
    assert not found


def exports() -> dict[str, tuple[str, str]]:
    """Public names of the package: the module that each comes from, and its name there."""
    return {
        alias.asname or alias.name: (node.module.split(".")[-1], alias.name)
        for node in TREES["__init__"].body
        if isinstance(node, ast.ImportFrom) and node.module.startswith("jaxrock.")
        for alias in node.names
    }


@pytest.mark.parametrize("name", exports())
def test_what_is_public_has_a_docstring(name):
    # In the source: at run time a dataclass without a docstring has one made of its arguments.
    assert getattr(jaxrock, name) is not None
    module, origin = exports()[name]
    definitions = [
        node for node in TREES[module].body if isinstance(node, (ast.FunctionDef, ast.ClassDef)) and node.name == origin
    ]
    assert len(definitions) == 1, f"{name} is not defined in {module}, from which it is imported"
    assert ast.get_docstring(definitions[0])


def test_the_public_names_are_found():
    assert {"Block", "Record", "outcome", "simulate", "overturning_map", "Status"} <= set(exports())


def test_import_draws_nothing_and_configures_nothing():
    settings = "{k: v for k, v in jax.config.values.items()}"
    code = f"import sys, jax; before = {settings}; import jaxrock; after = {settings}\n"
    code += "print(before == after, jax.config.jax_enable_x64, 'matplotlib.pyplot' in sys.modules)"
    assert fresh(code) == "True False False"


def test_figures_come_when_they_are_asked_for():
    code = "import sys, jaxrock; before = 'jaxrock.plot' in sys.modules; jaxrock.plot.history; "
    assert fresh(code + "print(before, 'jaxrock.plot' in sys.modules)") == "False True"


def test_unknown_names_raise():
    with pytest.raises(AttributeError, match="module 'jaxrock' has no attribute 'rock'"):
        jaxrock.rock  # noqa: B018
