"""The page of equations and figures: every number of the papers once, and no row that points nowhere."""

import ast
import functools
import importlib
import inspect
import re
from pathlib import Path

import pytest

import jaxrock

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "equations.md"
PAPERS = ("Voyagaki", "Dimitrakopoulos", "Diamantopoulos")


def numbered(chapter: int | str, last: int, first: int = 1) -> list[str]:
    return [f"{chapter}{i}" for i in range(first, last + 1)]


def lettered(numbers: list[str], letters: dict[str, str]) -> set[str]:
    return {number + letter for number in numbers for letter in letters.get(number, ("",))}


TWO_PARTS = {f"3.{i}": "ab" for i in (8, 9, 10, 11, 15, 17)}
PRINTED = {  # what the papers number: equations, figures
    "Voyagaki": (
        lettered(numbered("2.", 7) + numbered("3.", 18), {"3.2": "abcd", **TWO_PARTS}),
        {"2.1", "2.2", *numbered("3.", 6)},
    ),
    "Dimitrakopoulos": (
        {*numbered("2.", 4), *numbered("3.", 31), *numbered("4.", 16), *numbered("5.", 3), "6.1", *numbered("A", 4)},
        {*numbered("", 13), "S1", "table 1"},
    ),
    "Diamantopoulos": (set(numbered("", 23)), set(numbered("", 23))),
}


@functools.cache
def rows():
    """Paper, kind ("equation" or "figure"), and the cells of every row."""
    found, paper, kind = [], "", ""
    for line in PAGE.read_text().splitlines():
        if line.startswith("## "):
            paper = next(name for name in PAPERS if name in line)
        cells = [cell.strip() for cell in line.strip().strip("|").split(" | ")]
        if line.startswith("| ") and cells[1] == "function":
            kind = cells[0]
        elif line.startswith("| "):
            found.append((paper, kind, cells))
    return found


@pytest.mark.parametrize("paper", PAPERS)
@pytest.mark.parametrize("kind", ["equation", "figure"])
def test_every_number_has_one_row(paper, kind):
    stated = [x for name, of, cells in rows() if (name, of) == (paper, kind) for x in cells[0].split(", ")]
    assert len(stated) == len(set(stated))
    assert set(stated) == PRINTED[paper][kind == "figure"]


def test_the_papers_are_counted():
    assert [sum(len(PRINTED[name][i]) for name in PAPERS) for i in (0, 1)] == [116, 44 + 2]


def is_full(row):
    """A dash is for sketches, and for notebooks of figures that are not drawn."""
    _, kind, (numbers, function, notebook, test, judge) = row
    assert judge and judge != "-"
    if "sketch" in judge:
        assert kind == "figure" and (function, notebook, test) == ("-", "-", "-")
    else:
        assert function.startswith("`") and test.startswith("`")
        assert notebook.startswith("[") != ("not drawn" in judge)
    if kind == "figure" and not numbers.startswith("table"):
        assert "sketch" in judge or "drawn" in judge


def has_its_functions(row):
    for path in re.findall("`([^`]+)`", row[2][1]):
        owner = jaxrock
        for part in path.split("."):
            assert not part.startswith("_")
            name = f"{owner.__name__}.{part}" if inspect.ismodule(owner) else ""
            if not hasattr(owner, part):
                importlib.import_module(name)
            owner = getattr(owner, part)
        assert callable(owner) or path.endswith("QUANTITIES")


def has_its_notebooks(row):
    """And those of figures say that they draw them."""
    _, kind, (numbers, _, notebook, _, _) = row
    links = re.findall(r"\]\(([^)]+)\)", notebook)
    for link in links:
        assert (PAGE.parent / link).resolve().exists() and link.endswith(".ipynb")
    if kind == "figure" and links and not numbers.startswith("table"):
        text = " ".join((PAGE.parent / link).read_text().lower() for link in links)
        assert all(number in drawn(text) for number in numbers.split(", "))


def drawn(text: str) -> set[str]:
    """The numbers that follow the word figure or figures, with ranges."""
    found = set()
    for words in re.findall(r"figures? ((?:s?\d+(?:\.\d+)?(?:, | and | to |-)?)+)", text):
        for low, to, high in re.findall(r"(s?\d+(?:\.\d+)?)(?:( to |-)(\d+(?:\.\d+)?))?", words):
            found.add(low.upper())
            if to:
                chapter = low.rpartition(".")[0]
                last = range(int(low.rpartition(".")[2]), int(high.rpartition(".")[2]) + 1)
                found |= {f"{chapter}.{i}" if chapter else str(i) for i in last}
    return found


@functools.cache
def functions_of(name: str) -> set[str]:
    tree = ast.parse((ROOT / "tests" / f"{name}.py").read_text())
    return {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}


def has_its_tests(row):
    for found in re.findall("`([^`]+)`", row[2][3]):
        module, function = found.split("::")
        assert function.startswith("test_") and function in functions_of(module)


@pytest.mark.parametrize("check", [is_full, has_its_functions, has_its_notebooks, has_its_tests])
def test_every_row(check):
    wrong = {}
    for paper, kind, cells in rows():
        try:
            check((paper, kind, cells))
        except AssertionError as error:
            wrong[f"{paper} {kind} {cells[0]}"] = str(error)
    assert len(rows()) > 100 and not wrong
