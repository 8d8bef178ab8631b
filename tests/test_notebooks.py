"""Every notebook runs from top to bottom, with fewer points; the files are left alone."""

import ast
import functools
import inspect
import re
from pathlib import Path

import matplotlib.pyplot as plt
import pytest

import jaxrock as rk

nbclient = pytest.importorskip("nbclient")
nbformat = pytest.importorskip("nbformat")

FOLDER = Path(__file__).parents[1] / "notebooks"
in_repository = pytest.mark.skipif(not FOLDER.exists(), reason="needs the folder notebooks of the repository")
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
# What takes seconds. In kernels of their own all of them take minutes, of what `test_arcs`, `test_asymmetric_rocks`,
# `test_block_calibration`, `test_borders`, `test_closed_forms`, `test_critical`, `test_derivatives`, `test_flexible`,
# `test_found_record`, `test_hazard`, `test_histories`, `test_inverse`, `test_rolling`, `test_search`,
# `test_similarity`, `test_spectra`, `test_springs` and `test_suite_outcomes` judge; and all are asked for names and
# arguments by `test_what_notebooks_call_there_is`.
SHORT = {
    "01_a_block_in_an_earthquake",
    "02_who_overturns",
    "04_single_lobe_pulses",
    "10_hazard_curve_rejection",
    "11_fit_a_history",
    "15_calibrate_a_block",
    "errata",
}


def each(paths):
    """Decorate a test with notebooks."""
    return pytest.mark.parametrize("path", paths, ids=lambda path: path.stem)


@pytest.mark.filterwarnings("ignore")
@each([path for path in NOTEBOOKS if path.stem in SHORT])
def test_cells_of_a_notebook(path, monkeypatch):
    """In this process, with what it has compiled."""
    monkeypatch.chdir(path.parent)  # where its data are
    notebook, names = nbformat.read(path, as_version=4), {"__name__": "__main__"}
    with_fewer_points(notebook)
    with plt.rc_context():
        for cell in notebook.cells:
            if cell.cell_type == "code":
                shown(cell.source, path.name, names)
    plt.close("all")


def shown(source, where, names):
    """Run a cell; what stands in its last line is written, as a notebook does it."""
    program = ast.parse(source)
    last = ast.Expression(program.body.pop().value) if isinstance(program.body[-1], ast.Expr) else None
    exec(compile(program, where, "exec"), names)
    if last is not None:
        print(repr(eval(compile(last, where, "eval"), names)))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
@each(NOTEBOOKS)
def test_notebook(path, monkeypatch, tmp_path_factory):
    """In a kernel of its own."""
    monkeypatch.setenv("JAXROCK_CACHE", str(tmp_path_factory.getbasetemp() / "kept for notebooks"))
    notebook = nbformat.read(path, as_version=4)
    with_fewer_points(notebook)
    beside = {"metadata": {"path": str(path.parent)}}  # where its data are
    nbclient.NotebookClient(notebook, timeout=300, kernel_name="python3", resources=beside).execute()


def called(tree):
    """Return, for every call of the package in some code, the function and the names of its arguments."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and ast.unparse(node).startswith("rk."):
            yield ast.unparse(node), None
        if isinstance(node, ast.Call) and ast.unparse(node.func).startswith("rk."):
            yield ast.unparse(node.func), [keyword.arg for keyword in node.keywords if keyword.arg]


@each(NOTEBOOKS)
def test_what_notebooks_call_there_is(path):
    """Names of the package and of arguments, without running anything."""
    code = [cell.source for cell in nbformat.read(path, as_version=4).cells if cell.cell_type == "code"]
    found = 0
    for name, arguments in called(ast.parse("\n".join(re.sub(r"^[%!].*", "", text, flags=re.M) for text in code))):
        if not re.fullmatch(r"[\w.]+", name):
            continue  # of what a call returns
        there = functools.reduce(getattr, name.split(".")[1:], rk)
        if arguments:
            taken = inspect.signature(there).parameters
            if not any(each.kind is each.VAR_KEYWORD for each in taken.values()):
                assert set(arguments) <= set(taken), name
        found += 1
    assert found


FEWER = {"points": 24, "starts": 3, "repetitions": 4, "levels": 5}


def with_fewer_points(notebook):
    """The numbers that every longer notebook states once, as `points = ...`; it knows nothing of fewer."""
    for cell in notebook.cells:
        for name, number in FEWER.items() if cell.cell_type == "code" else ():
            cell.source = re.sub(rf"^{name} = \d+", f"{name} = {number}", cell.source, flags=re.MULTILINE)


@each(NOTEBOOKS)
def test_what_readers_see(path):
    """Check each notebook: a title, sizes stated once, data in files, and figures."""
    cells = nbformat.read(path, as_version=4).cells
    assert cells[0].cell_type == "markdown" and cells[0].source.startswith("# ")
    code = [cell for cell in cells if cell.cell_type == "code"]
    text = "\n".join(cell.source for cell in code)
    assert "environ" not in text
    for name in FEWER:
        assert len(re.findall(rf"^{name} = ", text, flags=re.MULTILINE)) <= 1
        assert not re.search(rf"\bif {name}\b|\b{name} [<>]|max\({name}\b", text)  # sizes for tests stand here
    for numbers in re.findall(r"\[([^\[\]]*)\]", text):
        assert len(re.findall(r"\d\.\d+", numbers)) <= 12, numbers
    assert any(cell.outputs for cell in code)
    outputs = [output for cell in code for output in cell.outputs]
    assert not [output.evalue for output in outputs if output.output_type == "error"]
    assert not re.search(r"/(tmp|home|root|work|Users)/", "".join(str(output.get("text", "")) for output in outputs))


@in_repository
def test_there_are_notebooks():
    assert NOTEBOOKS


@in_repository
def test_the_index_has_every_notebook_with_its_picture():
    """Numbered without gaps, in order of reading."""
    folder = NOTEBOOKS[0].parent
    found = re.findall(r"\[!\[\]\((\S+)\)\]\((\S+)\.ipynb\)", (folder / "README.md").read_text())
    assert [name for _, name in found] == [path.stem for path in NOTEBOOKS]
    assert all((folder / picture).stat().st_size < 50_000 for picture, _ in found)
    assert [int(name[:2]) for _, name in found[:-1]] == list(range(1, len(found)))
