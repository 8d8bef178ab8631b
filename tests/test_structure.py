"""The shape of the package: imports go downward, files and functions stay short, importing has no side effects."""

import ast
import functools
import json
import operator
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
MODULES = [name for name in FILES if name != "__init__"]

# At the bottom: `status`, and helpers (one underscore). They import each other, and all others may import them.
BOTTOM = {"status"} | {name for name in MODULES if re.match("_[^_]", name)}

# Every package, and the packages just below it: it may import those, and what lies below them.
BELOW = {
    "keeping": set(),
    "numerics": set(),
    "native": {"keeping", "numerics"},
    "transforms": {"native"},
    "blocks": {"numerics"},
    "motions": {"blocks"},
    "models": {"blocks"},
    "engines": {"models", "motions", "transforms"},
    "flexible": {"engines"},
    "responses": {"flexible"},
    "sweeps": {"transforms"},
    "studies": {"responses", "sweeps"},
    "hazard": {"studies"},
    "inverse": {"studies"},
    "closed_form": {"transforms"},
    "plot": {"hazard", "inverse", "closed_form"},
    "__init__": {"plot"},
    "command_line": {"__init__"},
    "__main__": {"command_line"},
}

MOST_FLOORS = 12
MOST_LINES_OF_A_MODULE = 400
MOST_LINES_OF_A_CLASS = 200
MOST_LINES_OF_A_FUNCTION = 60


@functools.cache
def trees() -> dict[str, ast.Module]:
    """Every file, as Python reads it."""
    return {name: ast.parse(path.read_text(encoding="utf-8")) for name, path in FILES.items()}


def room(module: str) -> str:
    """The package that a module is in."""
    return module.split(".")[0]


def imports_of(tree: ast.Module) -> set[str]:
    """Modules of the package that a file imports, wherever in it; the package itself is `__init__`."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"relative import in line {node.lineno}"
            # `from jaxrock import x`: a module x, or something that the package exports.
            names = [f"{node.module}.{a.name}" for a in node.names]
            names = [n if n.removeprefix("jaxrock.") in FILES else node.module for n in names]
        else:
            continue
        found |= {name.removeprefix("jaxrock.") for name in names if name.startswith("jaxrock.")}
        found |= {"__init__" for name in names if name == "jaxrock"}
    return found


@functools.cache
def imports() -> dict[str, set[str]]:
    """Return the modules of the package that each file imports."""
    return {name: imports_of(tree) for name, tree in trees().items()}


def reached(graph: dict[str, set[str]], start: str) -> set[str]:
    """All modules that `start` leads to, in any number of steps."""
    found, waiting = set(), [*graph[start]]
    while waiting:
        name = waiting.pop()
        if name not in found:
            found.add(name)
            waiting += graph[name]
    return found


def code_lines(function: ast.FunctionDef | ast.ClassDef, lines: list[str]) -> int:
    """Lines of a function from `def` to its end, without its docstring, comments and blank lines."""
    numbers = set(range(function.lineno, function.end_lineno + 1))
    if ast.get_docstring(function) is not None:
        numbers -= set(range(function.body[0].lineno, function.body[0].end_lineno + 1))
    return sum(bool(lines[n - 1].strip()) and not lines[n - 1].lstrip().startswith("#") for n in numbers)


def lengths(*kinds: type) -> dict[str, int]:
    """Lines of code of every definition of these kinds."""
    return {
        f"{name}.{node.name}": code_lines(node, FILES[name].read_text().splitlines())
        for name, tree in trees().items()
        for node in ast.walk(tree)
        if isinstance(node, kinds)
    }


IMPORTED = """
import json, sys, jax
settings = lambda: dict(jax.config.values.items())
before = settings()
import jaxrock
told = {"settings": settings() == before, "x64": jax.config.jax_enable_x64, "imported": list(sys.modules)}
jaxrock.plot.history
print(json.dumps(told | {"with figures": list(sys.modules)}))
"""


@functools.cache
def imported() -> dict:
    """Return reports of a fresh interpreter without JAX settings: after the import, and after a use of figures."""
    environment = {key: value for key, value in os.environ.items() if not key.startswith("JAX_")}
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", IMPORTED],
        cwd=PACKAGE.parent,
        env=environment | {"JAX_PLATFORMS": "cpu"},
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_the_table_names_every_package():
    assert not {name for name in BELOW if name in reached(BELOW, name)}
    assert {room(name) for name in FILES} - BOTTOM == set(BELOW), "give the new package its place in BELOW"


def test_imports_go_downward():
    """Modules, and what they import that does not lie below them; of those at the bottom, that is not there, too."""
    upward = {}
    for name in FILES:
        allowed = {room(name)} | reached(BELOW, room(name)) if room(name) in BELOW else set()
        upward[name] = sorted(
            other for other in imports()[name] - BOTTOM if room(other) not in allowed or name in BOTTOM
        )
    assert not {name: others for name, others in upward.items() if others}


def test_no_cycles():
    assert not [name for name in FILES if name in reached(imports(), name)]


@pytest.mark.parametrize("name", [name for name, path in FILES.items() if path.stem == "__init__"])
def test_packages_say_what_they_are_for(name):
    """In a few lines: what for, what it imports, where to start reading."""
    said = ast.get_docstring(trees()[name])
    assert said
    if name not in ("__init__", "closed_form"):
        assert "Imports" in said or "imports" in said
        assert len(said.splitlines()) <= 7


def test_few_floors():
    """The longest chain of packages, each of which imports the next."""

    def floor(package: str) -> int:
        return 1 + max((floor(below) for below in BELOW[package]), default=0)

    assert max(map(floor, BELOW)) <= MOST_FLOORS


def test_the_physics_imports_no_engine():
    physics = [name for name in FILES if room(name) in ("models", "motions", "blocks", "numerics")]
    led = {name: {room(other) for other in reached(imports(), name)} & {"engines", "responses"} for name in physics}
    assert len(led) > 50 and not {name: rooms for name, rooms in led.items() if rooms}


def test_machine_code_knows_no_blocks():
    rooms = {room(other) for name in FILES if room(name) == "native" for other in reached(imports(), name)}
    assert rooms <= {"native", "keeping", "numerics"} | BOTTOM


def test_closed_forms_import_no_engine():
    """They judge the engines: nothing of the package but roots, divided differences, each other, and what compiles and
    differentiates any function."""
    reached_rooms = {room(name) for name in reached(imports(), "closed_form")}
    assert reached_rooms <= {"closed_form", "numerics", "transforms", "native", "keeping"} | BOTTOM
    own = {name for name in FILES if room(name) == "closed_form"}
    others = {other for name in own for other in imports()[name]} - own
    assert others <= BOTTOM | {"numerics.divided_differences", "numerics.roots", "transforms.elementwise"}


@pytest.mark.parametrize("name", [name for name in FILES if name.startswith("closed_form.")])
def test_closed_forms_are_documented(name):
    nodes = [node for node in trees()[name].body if isinstance(node, (ast.FunctionDef, ast.ClassDef))]
    assert ast.get_docstring(trees()[name])
    assert not [node.name for node in nodes if not node.name.startswith("_") and not ast.get_docstring(node)]


def test_modules_are_short():
    found = {name: len(FILES[name].read_text().splitlines()) for name in MODULES}
    assert not {name: lines for name, lines in found.items() if lines > MOST_LINES_OF_A_MODULE}


def test_functions_are_short():
    found = lengths(ast.FunctionDef)
    assert len(found) > 100
    assert not {name: lines for name, lines in found.items() if lines > MOST_LINES_OF_A_FUNCTION}


def test_classes_are_short():
    found = lengths(ast.ClassDef)
    assert not {name: lines for name, lines in found.items() if lines > MOST_LINES_OF_A_CLASS}


def test_restitution_is_not_called_eta():
    """`eta` is the restitution in some papers, its square in others."""
    found = {
        f"{path.name}:{number}"
        for path in PACKAGE.rglob("*.py")
        for number, line in enumerate(path.read_text().splitlines(), 1)
        if re.search(r"\beta\b", line)
    }
    assert not found


SPACES = ("blocks", "hazard", "inverse", "models", "motions", "responses", "studies")


def exports() -> dict[str, tuple[str, str]]:
    """Public names of the package and its namespaces: the module that each comes from, and its name there."""
    return {
        (f"{space}." if space in SPACES else "") + (alias.asname or alias.name): (
            node.module.removeprefix("jaxrock").removeprefix("."), alias.name
        )
        for space in ("__init__", *SPACES)
        for node in trees()[space].body
        if isinstance(node, ast.ImportFrom) and node.module.startswith("jaxrock") and node.names[0].name != "*"
        for alias in node.names
    }  # fmt: skip


def test_what_is_public_is_there():
    """By the name that the package or its namespace exports."""
    assert not [name for name in exports() if operator.attrgetter(name)(jaxrock) is None and name[0] != "_"]


def test_what_is_public_has_a_docstring():
    """In the source, where it is defined once: at run time a dataclass without one has one made of its arguments."""
    told = {}
    for name, (module, origin) in exports().items():
        home = f"{module}.{origin}".removeprefix(".")
        definitions = [trees()[home]] if home in FILES else [
            node
            for node in trees()[module].body
            if isinstance(node, (ast.FunctionDef, ast.ClassDef)) and node.name == origin
            if "overload" not in map(ast.unparse, node.decorator_list)
        ]  # fmt: skip
        told[name] = [bool(ast.get_docstring(node)) for node in definitions]
    assert not {name: has for name, has in told.items() if has != [True]}


def functions_of(module, origin):
    """Return callables of a public name: the function, or the methods of the class."""
    for node in trees().get(module, ast.Module([], [])).body:
        if getattr(node, "name", None) == origin:
            inner = node.body if isinstance(node, ast.ClassDef) else [node]
            yield from (each for each in inner if isinstance(each, ast.FunctionDef))


def is_hidden(function):
    return function.name.startswith("_") and function.name not in ("__init__", "__call__")


def untyped(function):
    """Arguments whose type a function does not say, and `return` if it does not say what it returns."""
    given = function.args
    every = [*given.posonlyargs, *given.args, *given.kwonlyargs, *filter(None, (given.vararg, given.kwarg))]
    silent = [each.arg for each in every if each.annotation is None and each.arg not in ("self", "cls")]
    return silent if function.returns or function.name == "__init__" else [*silent, "return"]


def test_what_is_public_says_its_types():
    found = {
        f"{name}.{function.name}": untyped(function)
        for name, origin in exports().items()
        for function in functions_of(*origin)
        if not is_hidden(function)
    }
    assert len(found) > 200 and not {name: silent for name, silent in found.items() if silent}


def test_the_public_names_are_found():
    assert {"Block", "Record", "outcome", "simulate", "hazard.HazardCurve", "studies.Critical"} <= set(exports())


@pytest.mark.parametrize("space", SPACES)
def test_a_namespace_offers_no_module_and_another_thing_by_one_name(space):
    """The one would hide the other."""
    own = {name.split(".")[1] for name in exports() if name.startswith(f"{space}.")}
    modules = {name.split(".")[1] for name in FILES if name.startswith(f"{space}.")}
    assert own & modules <= {"restitution", "intensity"}


def test_an_unknown_name_raises():
    with pytest.raises(AttributeError, match="^module 'jaxrock' has no attribute 'Observations'$"):
        _ = jaxrock.Observations


def test_importing_takes_little():
    """SciPy's optimisers, filters and the rest come with what needs them."""
    assert not {"scipy", "optax", "diffrax"} & set(imported()["imported"])


ROOT = PACKAGE.parent
FOLDERS = ("jaxrock", "references", "benchmarks", "tests")


@pytest.mark.parametrize(
    ("folder", "allowed"),
    [
        ("jaxrock", {"jaxrock"}),
        ("references", {"jaxrock", "references"}),
        ("benchmarks", {"jaxrock", "references", "benchmarks"}),
        ("tests", {"jaxrock", "references"}),
    ],
)
def test_what_tests_and_benchmarks_share_lies_in_references(folder, allowed):
    """Check imports: tests import nothing of benchmarks, benchmarks nothing of tests; the package only itself."""
    if not (ROOT / folder).exists():
        pytest.skip(f"needs the folder {folder} of the repository")
    homes = {path.stem: name for name in ("benchmarks", "tests") for path in (ROOT / name).glob("*.py")}
    homes |= {path.name: "benchmarks" for path in (ROOT / "benchmarks").glob("*/")}
    homes |= {name: name for name in FOLDERS}
    for path in (ROOT / folder).rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module] if isinstance(node, ast.ImportFrom) and not node.level else []
            found = {homes.get(name.split(".")[0]) for name in names} - {None}
            assert found <= allowed, f"{path.relative_to(ROOT)} imports {names}"


def test_import_draws_nothing_and_configures_nothing():
    found = imported()
    assert found["settings"] and not found["x64"] and "matplotlib.pyplot" not in found["imported"]


def test_figures_come_when_they_are_asked_for():
    assert "jaxrock.plot" not in imported()["imported"] and "jaxrock.plot" in imported()["with figures"]
    assert not {"scipy", "optax"} & set(imported()["with figures"])


def test_unknown_names_raise():
    with pytest.raises(AttributeError, match="module 'jaxrock' has no attribute 'rock'"):
        jaxrock.rock  # noqa: B018


# Module state that changes at run time is seen by every thread; each entry says why it is safe.
SHARED = {
    "_undisturbed._pauses": "under its lock",
    "native.machine._registered": "under a lock",
    "numerics.compound._OPERATIONS": "changed at import only",
    "responses.arguments._usual": "the same value, whoever puts it there, by one call of C",
    "sweeps.devices._meetings": "counted by one call of C, and under a lock where there are many processes",
    "sweeps.grid._examples": "changed at import only",
    "keeping.changes._found": "the same value, whoever puts it there, by one call of C",
    "keeping.changes._seen": "the same value, whoever puts it there, by one call of C",
    "keeping.facts._known": "the same value, whoever puts it there, by one call of C",
    "transforms.fingerprint._known": "the same value, whoever puts it there, by one call of C",
    "transforms.user_function._known": "the same value, whoever puts it there, by one call of C",
    "transforms.user_function._origins": "under a lock",
    "transforms.recipe._alike": "under a lock",
}
CHANGES = {"add", "append", "clear", "discard", "extend", "insert", "pop", "popitem", "remove", "setdefault", "update"}


def changed_within_functions(tree: ast.Module) -> set[str]:
    """Names of a module whose values its functions change or take the next of; or which they give another value."""
    own = {
        name.id
        for node in tree.body
        if isinstance(node, (ast.Assign, ast.AnnAssign))
        for target in (node.targets if isinstance(node, ast.Assign) else [node.target])
        for name in ast.walk(target)
        if isinstance(name, ast.Name)
    }
    found = set()
    for function in (node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)):
        local = {node.id for node in ast.walk(function) if isinstance(node, ast.Name) and type(node.ctx) is ast.Store}
        for node in ast.walk(function):
            if isinstance(node, ast.Global):
                found |= set(node.names)
            part = None
            if isinstance(node, (ast.Subscript, ast.Attribute)) and not isinstance(node.ctx, ast.Load):
                part = node.value
            elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr in CHANGES:
                part = node.func.value
            elif isinstance(node, ast.Call) and getattr(node.func, "id", "") == "next" and node.args:
                part = node.args[0]
            if isinstance(part, ast.Name) and part.id in own - local:
                found.add(part.id)
    return found


def test_what_threads_share_is_known():
    """Check that other module-level state does not change.

    `functools.cache` is safe, and lazily created singletons have a lock.
    """
    found = {f"{name}.{each}" for name, tree in trees().items() for each in changed_within_functions(tree)}
    assert found == set(SHARED)


def test_text_is_written_in_one_encoding():
    """In utf-8, which readers expect, and not in that of the place where it runs."""
    for name, tree in trees().items():
        for call in (node for node in ast.walk(tree) if isinstance(node, ast.Call)):
            word = getattr(call.func, "attr", getattr(call.func, "id", ""))
            modes = [each.value for each in call.args if isinstance(each, ast.Constant)] + [""]
            if word == "write_text" or word == "open" and set(modes) & {"w", "a", "x"}:
                assert any(each.arg == "encoding" for each in call.keywords), f"{name}, line {call.lineno}"
