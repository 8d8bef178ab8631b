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

# Every package, and the packages just below it: it may import those, and what lies below them.
BELOW = {
    "_core": set(),
    "compiler": {"_core"},
    "numerics": {"compiler"},
    "status": {"compiler"},
    "_arguments": {"status"},
    "blocks": {"numerics", "_arguments"},
    "motions": {"blocks"},
    "models": {"blocks"},
    "engines": {"models", "motions"},
    "flexible": {"engines"},
    "responses": {"flexible"},
    "sweeps": {"_arguments"},
    "studies": {"responses", "sweeps"},
    "hazard": {"studies"},
    "inverse": {"studies"},
    "closed_form": {"numerics", "_arguments"},
    "plot": {"hazard", "inverse", "closed_form"},
    "__init__": {"plot"},
    "command_line": {"__init__"},
    "__main__": {"command_line"},
}

# The door of the compiler: all else of it, but for `hints`, is its own.
MOST_NAMES_OF_THE_DOOR = 10
MOST_FLOORS = 15
MOST_LINES_OF_A_MODULE = 400
MOST_LINES_OF_A_CLASS = 200
MOST_LINES_OF_A_FUNCTION = 60
# Six are users' names on both sides, such as `Housner`; nine lie in the compiler, `_core` and `_arguments`.
MOST_NAMES_DEFINED_TWICE = 15


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
    """Lines of a function or class from its first to its last, without docstrings, comments and blank lines."""
    numbers = set(range(function.lineno, function.end_lineno + 1))
    for node in ast.walk(function):
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)) and ast.get_docstring(node) is not None:
            numbers -= set(range(node.body[0].lineno, node.body[0].end_lineno + 1))
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
    assert {room(name) for name in FILES} == set(BELOW), "give the new package its place in BELOW"


def test_imports_go_downward():
    """Modules, and what they import that does not lie below them."""
    upward = {}
    for name in FILES:
        allowed = {room(name)} | reached(BELOW, room(name))
        upward[name] = sorted(other for other in imports()[name] if room(other) not in allowed)
    assert not {name: others for name, others in upward.items() if others}


def names_of(module: str) -> set[str]:
    """Names that a package imports for others."""
    return {
        alias.asname or alias.name
        for node in trees()[module].body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }


def test_the_door_of_the_compiler_is_narrow():
    assert 5 < len(names_of("compiler")) <= MOST_NAMES_OF_THE_DOOR


def past_the_door(tree: ast.Module) -> list[str]:
    """Return imports, and names of modules in text, that go past the door of the compiler."""
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names if alias.name.startswith("jaxrock.compiler")]
        elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith("jaxrock.compiler"):
            module = node.module.removeprefix("jaxrock.")
            allowed = names_of(module) if module in ("compiler", "compiler.hints") else set()
            found += [f"{module}.{alias.name}" for alias in node.names if alias.name not in allowed]
        elif isinstance(node, ast.Constant) and re.fullmatch(r"jaxrock\.compiler\.[\w.]+", str(node.value)):
            found.append(node.value)
    return found


def test_nothing_is_imported_past_the_door_of_the_compiler():
    found = {name: past_the_door(tree) for name, tree in trees().items() if room(name) != "compiler"}
    assert not {name: names for name, names in found.items() if names}


def test_imports_past_the_door_are_found():
    for line in (
        "import jaxrock.compiler.llvm",
        "from jaxrock.compiler.cache import store",
        "from jaxrock.compiler import llvm",
        "from jaxrock.compiler.hints.select import select",
        "importlib.import_module('jaxrock.compiler.cache')",
    ):
        assert past_the_door(ast.parse(line)), line
    assert not past_the_door(
        ast.parse("from jaxrock.compiler import cache, hints\nfrom jaxrock.compiler.hints import select")
    )


def test_the_compiler_knows_no_mechanics():
    """It compiles any scalar function."""
    words = re.compile(r"\b(scenes?|block|motions?)\b", re.IGNORECASE)
    files = [path for path in (PACKAGE / "compiler").rglob("*") if path.suffix in (".py", ".md")]
    found = {
        f"{path.name}:{number}": line.strip()
        for path in files
        for number, line in enumerate(path.read_text().splitlines(), 1)
        if words.search(line)
    }
    assert len(files) > 40 and not found


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


def test_the_compiler_passes_its_tests_without_physics():
    """Run them in a process in which only the compiler, mathematics and helpers are found."""
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "--noconftest", "-p", "references.bare_package",
         "-p", "no:cacheprovider", "tests/compiler"],
        cwd=ROOT, capture_output=True, text=True, timeout=600,
        env=os.environ | {"JAX_ENABLE_X64": "1", "JAX_PLATFORMS": "cpu", "JAXROCK_CACHE": "off"},
    )  # fmt: skip
    assert done.returncode == 0, done.stdout[-3000:]
    assert int(re.search(r"(\d+) passed", done.stdout)[1]) > 200


def test_closed_forms_import_no_engine():
    """They judge the engines: nothing of the package but roots, divided differences, each other, and what compiles and
    differentiates any function."""
    below = {"_core", "compiler", "status", "_arguments"}
    reached_rooms = {room(name) for name in reached(imports(), "closed_form")}
    assert reached_rooms <= {"closed_form", "numerics"} | below
    own = {name for name in FILES if room(name) == "closed_form"}
    others = {other for name in own for other in imports()[name] if room(other) not in below} - own
    assert others <= {"numerics.divided_differences", "numerics.roots"}
    used = {n for name in own for n in door_names_of(name)}
    assert used <= {"elementwise", "checks"}


def door_names_of(module: str) -> set[str]:
    """Names of the compiler's door that a module uses."""
    return {
        alias.name
        for node in ast.walk(trees()[module])
        if isinstance(node, ast.ImportFrom) and node.module == "jaxrock.compiler"
        for alias in node.names
    }


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


def public_definitions(tree: ast.Module) -> set[str]:
    """Return the public names that a module defines: imports define none, nor do aliases such as `x = other.x`."""
    found, waiting = set(), [*tree.body]
    while waiting:
        node = waiting.pop()
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            found.add(node.name)
            continue
        if isinstance(node, (ast.Assign, ast.AnnAssign)):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names = [each for target in targets for each in ast.walk(target) if isinstance(each, ast.Name)]
            found |= {each.id for each in names if type(each.ctx) is ast.Store} - {getattr(node.value, "attr", None)}
        waiting += [each for each in ast.iter_child_nodes(node) if isinstance(each, (ast.stmt, ast.excepthandler))]
    return {name for name in found if not name.startswith("_")}


def defined_twice(modules: dict[str, ast.Module]) -> dict[str, list[str]]:
    """Return the public names that more than one module defines, and those modules."""
    homes: dict[str, list[str]] = {}
    for module, tree in modules.items():
        for name in public_definitions(tree):
            homes.setdefault(name, []).append(module)
    return {name: found for name, found in homes.items() if len(found) > 1}


def test_public_names_are_defined_once():
    """A name says one thing, wherever it is read."""
    found = defined_twice(trees())
    assert len(found) <= MOST_NAMES_DEFINED_TWICE, found


def test_names_that_are_defined_twice_are_found():
    first = ast.parse(
        "try:\n    KINDS, ROOM = 1, 2\nexcept ImportError:\n    pass\ndef arc(): Column = 1\nclass End: pass"
    )
    other = ast.parse("KINDS: int = 3\nif KINDS:\n    def arc(): pass\n_ROOM = End = 2\nfrom jaxrock import Column")
    alias = ast.parse("from a import arc as arc\nKINDS = a.KINDS\nclass Other:\n    def End(self): pass\nEnd[0] = 1")
    assert defined_twice({"first": first, "other": other, "alias": alias}) == {
        name: ["first", "other"] for name in ("KINDS", "arc", "End")
    }


VAGUE = re.compile(r'"""(What|Whether|Of|Whose|Those|The same)\b')


def test_docstrings_begin_with_the_thing_or_a_verb():
    found = [
        f"{path.relative_to(ROOT)}:{number}"
        for folder in ("jaxrock", "tests")
        for path in (ROOT / folder).rglob("*.py")
        for number, line in enumerate(path.read_text().splitlines(), 1)
        if VAGUE.search(line)
    ]
    assert not found and VAGUE.search('"""' + "Whether it is.")


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
    "compiler.cache.changes._WITHOUT_PROGRAMS": "changed at import only",
    "compiler.checks._STATUSES": "changed at import only",
    "compiler.llvm.operations.OPERATIONS": "the same value, whoever puts it there, by one call of C",
    "compiler.primitive.macro.IMPLEMENTATIONS": "changed at import only",
    "compiler.tracing._pauses": "under its lock",
    "compiler.llvm.jit._registered": "under a lock",
    "compiler.primitive.macro._OPERATIONS": "changed at import only",
    "responses.arguments._usual": "the same value, whoever puts it there, by one call of C",
    "sweeps.devices._meetings": "counted by one call of C, and under a lock where there are many processes",
    "sweeps.grid._examples": "changed at import only",
    "compiler.cache.changes._found": "the same value, whoever puts it there, by one call of C",
    "compiler.cache.changes._seen": "the same value, whoever puts it there, by one call of C",
    "compiler.cache.key._known": "the same value, whoever puts it there, by one call of C",
    "compiler.jaxpr.fingerprint._known": "the same value, whoever puts it there, by one call of C",
    "compiler.jaxpr.traced_function._known": "the same value, whoever puts it there, by one call of C",
    "compiler.jaxpr.traced_function._origins": "under a lock",
    "compiler.primitive.lane_function._alike": "under a lock",
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
