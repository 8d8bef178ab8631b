"""Code in the documentation runs, and its links lead somewhere."""

import ast
import importlib
import importlib.util
import logging
import re
import tomllib
import types
from pathlib import Path

import matplotlib.pyplot as plt
import pytest

import jaxrock as rk

ROOT = Path(__file__).parents[1]
PACKAGE = Path(rk.__file__).parent
has_machine_code = importlib.util.find_spec("llvmlite") is not None
PAGES = sorted(path.relative_to(ROOT).as_posix() for path in [*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md")])
# Recipes are tried by tests/test_log_density.py, many processes by tests/test_distributed.py, examples below.
ELSEWHERE = {"docs/inverse.md", "docs/how_to/cluster.md", "docs/examples.md"}
LINK = re.compile(r"\]\(([^)\s]+)\)")


def snippets(page):
    """The lines of Python of a page, at the places where they stand."""
    lines, inside = [], False
    for line in (ROOT / page).read_text().splitlines():
        fence = line.startswith("```")
        inside = line.strip() == "```python" if fence else inside
        lines.append(line if inside and not fence else "")
    return "\n".join(lines)


QUICK = {"README.md", "docs/index.md", "docs/concepts/flow_guard_reset.md", "docs/concepts/margin_error_status.md"}


def pages_with_snippets():
    for page in PAGES:
        if page not in ELSEWHERE and snippets(page).strip():
            yield pytest.param(page, marks=[] if page in QUICK else pytest.mark.slow)


@pytest.mark.parametrize("page", list(pages_with_snippets()))
def test_every_snippet_of_a_page_runs(page, tmp_path, monkeypatch, caplog):
    """Run every snippet; pages in `QUICK` must leave nothing to XLA, which would take many times as long."""
    monkeypatch.chdir(tmp_path)
    with caplog.at_level(logging.DEBUG, "jaxrock"):
        exec(compile(snippets(page), page, "exec"), {"__name__": "__main__"})
    plt.close("all")
    assert page not in QUICK or not has_machine_code or "left to XLA" not in caplog.text


@pytest.mark.slow
@pytest.mark.parametrize("other", ["heyoka", "openseespy.opensees"])
def test_what_is_said_of_others_runs_where_they_are(other):
    """Their code on the page of comparisons, after the first of jaxrock's."""
    try:
        importlib.import_module(other)
    except (ImportError, RuntimeError) as error:  # OpenSees needs libraries of the system
        pytest.skip(f"needs {other.partition('.')[0]}: {error}")
    page = (ROOT / "docs/comparison.md").read_text()
    ours = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    (theirs,) = (code for code in re.findall(r"```py\n(.*?)```", page, re.DOTALL) if f"import {other} " in code)
    exec(compile(ours[0] + theirs, other, "exec"), {"__name__": "__main__"})


def test_the_readme_of_an_index_points_to_nothing_that_is_not_there():
    """An index shows it without the files beside it; the package is built with these replacements."""
    hook = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["metadata"]["hooks"]
    shown = whole = (ROOT / "README.md").read_text()
    for each in hook["fancy-pypi-readme"]["substitutions"]:
        shown = re.sub(each["pattern"], each["replacement"], shown)
    assert set(LINK.findall(whole)) and not [link for link in LINK.findall(shown) if "://" not in link]
    for table in ("What there is", "How fast, how right"):
        assert f"## {table}\n\n" in shown


def anchors(text):
    """Names of the headings of a page, as readers of Markdown make them."""
    told = re.findall(r"^#+ (.+)$", re.sub(r"```.*?```", "", text, flags=re.DOTALL), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).strip().replace(" ", "-") for title in told}


@pytest.mark.skipif(not (ROOT / "notebooks").exists(), reason="needs the folder notebooks of the repository")
@pytest.mark.parametrize("page", PAGES)
def test_every_link_of_a_page_leads_somewhere(page):
    text = (ROOT / page).read_text()
    for link in LINK.findall(re.sub(r"```.*?```|`[^`\n]*`", "", text, flags=re.DOTALL)):
        if link.startswith("http"):
            continue
        path, _, anchor = link.partition("#")
        target = ((ROOT / page).parent / path).resolve() if path else ROOT / page
        assert target.exists(), link
        assert not anchor or anchor in anchors(target.read_text()), link


MOST_WORDS = 90
DEVELOPERS = [page for page in PAGES if page.startswith("docs/developer/")]
ITEM = re.compile(r"\s*(?:[-*+]|\d+\.)\s")
NAME_OF_A_MODULE = re.compile(r"`(?:jaxrock\.)?([a-z_]\w*(?:\.\w+)*)`")
PATH_OF_A_FILE = re.compile(r"`([\w.]+(?:/[\w.]+)*/?)`")


def paragraphs(text):
    """Return paragraphs and items of lists of a page, without tables, headings and code."""
    found = [""]
    for line in re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE).splitlines():
        if not line.strip() or line.lstrip().startswith(("|", "#")):
            found.append("")
        elif ITEM.match(line):
            found.append(line)
        else:
            found[-1] += f" {line}"
    return [each for each in found if each.strip()]


@pytest.mark.parametrize("page", [page for page in PAGES if page.startswith("docs/") or page == "CONTRIBUTING.md"])
def test_paragraphs_are_short(page):
    found = paragraphs((ROOT / page).read_text())
    assert not [each for each in found if len(each.split()) > MOST_WORDS]


def test_long_paragraphs_are_found():
    """An item of a list counts by itself; a table and code do not count."""
    many = "word " * MOST_WORDS
    assert max(len(each.split()) for each in paragraphs(f"{many}\nword\n")) == MOST_WORDS + 1
    short = f"{many}\n\n- {many[5:]}\n- word\n\n| {many} | {many} |\n\n```sh\n{many}\n\n{many}\n```\n"
    assert max(len(each.split()) for each in paragraphs(short)) == MOST_WORDS


def is_there(name):
    """Return whether a module of the package, or an attribute of one, has this name."""
    path, rest = PACKAGE, name.split(".")
    while rest and ((path / rest[0]).is_dir() or (path / f"{rest[0]}.py").exists()):
        path /= rest.pop(0)
    module = ".".join(path.relative_to(PACKAGE.parent).parts)
    if not rest or (module.startswith("jaxrock.compiler.llvm") and not has_machine_code):
        return True
    thing = importlib.import_module(module)
    for part in rest:
        if part in getattr(thing, "__annotations__", {}):  # a field without a default
            return True
        if not hasattr(thing, part):
            return False
        thing = getattr(thing, part)
    return True


def modules_named_in(text):
    """Names in backticks or in diagrams that begin with a package of jaxrock, or with one of its modules."""
    own = {path.stem for path in PACKAGE.iterdir()}
    diagrams = re.findall(r"```text\n(.*?)```", text, re.DOTALL)
    names = {*NAME_OF_A_MODULE.findall(text), *re.findall(r"[\w.]+", "\n".join(diagrams))}
    return {name for name in names if "." in name and name.split(".")[0] in own}


def files_named_in(text):
    """Paths in backticks, of the repository, of the package, or of the tests by the name of a file alone."""
    return {path for path in PATH_OF_A_FILE.findall(text) if "/" in path or re.fullmatch(r"test_\w+\.py", path)}


@pytest.mark.skipif(not (ROOT / "notebooks").exists(), reason="needs the folder notebooks of the repository")
@pytest.mark.parametrize("page", ["CONTRIBUTING.md", *DEVELOPERS])
def test_modules_and_files_of_a_page_are_there(page):
    text = (ROOT / page).read_text()
    assert not [name for name in modules_named_in(text) if not is_there(name)]
    places = ROOT, PACKAGE, ROOT / "tests"
    assert not [path for path in files_named_in(text) if not any((place / path).exists() for place in places)]


def test_modules_that_are_gone_are_found():
    assert len(DEVELOPERS) > 10 and len(modules_named_in((ROOT / "docs/developer/compiler.md").read_text())) > 30
    text = "`engines.gone`, `jaxrock.engines.rest`, `jax.jit`, `in_lanes`\n\n```text\n compiler.cache -> jax.jit\n```\n"
    assert modules_named_in(text) == {"engines.gone", "engines.rest", "compiler.cache"}
    for name in ("engines.rest", "engines.rest.wait", "engines.taylor.policy.POLICY.order", "compiler.lane_function"):
        assert is_there(name), name
    for name in ("engines.gone", "engines.rest.gone", "compiler.gone", "compiler.lane_function.gone"):
        assert not is_there(name), name


def namespaces():
    """Every public module by the shortest name that users write."""
    found = {"rk": rk}
    for path, space in (left := list(found.items())):
        for name, value in shown(space):
            if isinstance(value, types.ModuleType) and not any(value is known for known in found.values()):
                found[f"{path}.{name}"] = value
                left.append((f"{path}.{name}", value))
    return found


def shown(space):
    return [(name, getattr(space, name)) for name in dir(space) if name[0] != "_"]


def public_things():
    """Return every public object that is no module, and all names under which users find it."""
    found = {}
    for path, space in namespaces().items():
        for name, value in shown(space):
            if not isinstance(value, types.ModuleType):
                found.setdefault(id(value), (value, []))[1].append(f"{path}.{name}")
    assert len(found) > 200
    return found.values()


def test_completion_shows_what_is_public_and_no_more():
    """Not what files import for themselves, nor the packages of which the public ones are made."""
    assert {path.split(".")[1] for path in namespaces() if path != "rk"} == {
        "blocks", "closed_form", "hazard", "intensity", "inverse", "models", "motions", "plot", "processing",
        "responses", "restitution", "similarity", "studies",
    }  # fmt: skip
    for thing, (path, *_) in public_things():
        if not isinstance(thing, (dict, tuple)):
            assert thing.__module__.startswith("jaxrock."), path
            assert (thing.__doc__ or "").strip(), path
    assert "law_of" in vars(rk.restitution) and "law_of" not in dir(rk.restitution)


# Modules whose functions the table of names does not list one by one.
WHOLE = {"closed_form", "intensity", "processing", "similarity"}


@pytest.mark.parametrize("page", ["names.md", "api.md"])
def test_every_public_name_has_its_place(page):
    """By itself, or with its whole module."""
    text = (ROOT / "docs" / page).read_text()
    entries = set(re.findall(r"^::: (\S+)$", text, re.MULTILINE))

    def written(thing, path):
        space, _, name = path.removeprefix("rk.").rpartition(".")
        module = namespaces().get(f"rk.{space}", rk).__name__
        if page == "api.md":
            return place(thing) in entries or module in entries
        short = rf"`{space}\..*`\.{name}`" if space else "(?!)"  # in the row of another of its module
        by_itself = re.search(rf"\b{re.escape(path.removeprefix('rk.'))}\b|{short}", text)
        return by_itself or (space.split(".")[0] in WHOLE and f"`{space}`" in text)

    assert not [paths for thing, paths in public_things() if not any(written(thing, path) for path in paths)]


def place(thing):
    """Where something is defined; nothing for a constant."""
    return f"{getattr(thing, '__module__', '')}.{getattr(thing, '__qualname__', '')}"


EXAMPLES = "docs/examples.md"
# Parts that compile little: all together some 30 s. The others are slow.
FEW_PROGRAMS = {
    "One scene", "Many scenes", "`rk.models`", "`rk.motions`", "Files, components", "What lies in other places",
    "`rk.processing`, `rk.intensity`", "`rk.similarity`", "Static strength, free rocking", "`rk.hazard`",
    "Hazard, and rocks that still stand",
}  # fmt: skip


def parts_of_examples():
    """Code by heading, at the lines where it stands; what all begin with has none."""
    lines, found, heading = (ROOT / EXAMPLES).read_text().splitlines(), {}, ""
    for number, (line, code) in enumerate(zip(lines, snippets(EXAMPLES).splitlines())):
        heading = line.removeprefix("## ") if line.startswith("## ") and not code else heading
        found.setdefault(heading, [""] * len(lines))[number] = code
    return {heading: "\n".join(code) for heading, code in found.items()}


PARTS = parts_of_examples()


@pytest.mark.parametrize(
    "heading", [pytest.param(h, marks=[] if h in FEW_PROGRAMS else pytest.mark.slow) for h in PARTS if h]
)
def test_every_part_of_the_examples_runs_by_itself_and_gives_the_types_it_says(heading, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    scope = {"__name__": "__main__"}
    for code in (PARTS[""], PARTS[heading]):
        exec(compile(code, EXAMPLES, "exec"), scope)
    for name, kind in scope.get("__annotations__", {}).items():
        assert name not in scope or isinstance(scope[name], kind), name
    plt.close("all")


def named_in(code):
    """Return the names of the package in some code, also by a short name of a namespace."""
    tree, known = ast.parse(code), {"rk": rk}

    def value(node):
        if isinstance(node, ast.Name):
            return known.get(node.id)
        space = value(node.value) if isinstance(node, ast.Attribute) else None
        return getattr(space, node.attr, None) if isinstance(space, types.ModuleType) else None

    for node in ast.walk(tree):
        if isinstance(node, ast.Assign):
            target, given = node.targets[0], node.value
            pairs = zip(target.elts, given.elts) if isinstance(given, ast.Tuple) else [(target, given)]
            known |= {str(t.id): value(v) for t, v in pairs if isinstance(value(v), types.ModuleType)}
    return {id(value(node)) for node in ast.walk(tree) if isinstance(node, ast.Attribute)}


def test_every_public_name_has_an_example():
    assert set(PARTS) > FEW_PROGRAMS
    named = set().union(*map(named_in, PARTS.values()))
    assert not [paths for thing, paths in public_things() if id(thing) not in named]


def test_who_cites_names_this_version():
    assert f"\nversion: {rk.__version__}\n" in (ROOT / "CITATION.cff").read_text()
