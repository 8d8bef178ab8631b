"""What the documentation says runs, and its links lead somewhere."""

import re
import types
from pathlib import Path

import matplotlib.pyplot as plt
import pytest

import jaxrock as rk

ROOT = Path(__file__).parents[1]
PAGES = sorted(path.relative_to(ROOT).as_posix() for path in [*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md")])
# Recipes are tried by tests/test_log_density.py, and many processes by tests/test_distributed.py.
ELSEWHERE = {"docs/inverse.md", "docs/how_to/cluster.md"}


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
def test_every_snippet_of_a_page_runs(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    exec(compile(snippets(page), page, "exec"), {"__name__": "__main__"})
    plt.close("all")


def anchors(text):
    """Names of the headings of a page, as readers of Markdown make them."""
    told = re.findall(r"^#+ (.+)$", re.sub(r"```.*?```", "", text, flags=re.DOTALL), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).strip().replace(" ", "-") for title in told}


@pytest.mark.skipif(not (ROOT / "notebooks").exists(), reason="source distributions leave the notebooks out")
@pytest.mark.parametrize("page", PAGES)
def test_every_link_of_a_page_leads_somewhere(page):
    text = (ROOT / page).read_text()
    for link in re.findall(r"\]\(([^)\s]+)\)", re.sub(r"```.*?```|`[^`\n]*`", "", text, flags=re.DOTALL)):
        if link.startswith("http"):
            continue
        path, _, anchor = link.partition("#")
        target = ((ROOT / page).parent / path).resolve() if path else ROOT / page
        assert target.exists(), link
        assert not anchor or anchor in anchors(target.read_text()), link


SPACES = ("blocks", "hazard", "inverse", "models", "motions", "responses", "studies")


def is_public(space, name):
    return name[0] != "_" and not isinstance(getattr(space, name), types.ModuleType)


def test_every_public_name_has_its_place():
    text = "".join((ROOT / "docs" / page).read_text() for page in ("names.md", "api.md"))
    homes = {f"{home}.": getattr(rk, home) for home in SPACES} | {"": rk}  # the top last: its names need no home
    public = {name: home for home, space in homes.items() for name in dir(space) if is_public(space, name)}
    assert len(public) > 100
    assert not [home + name for name, home in public.items() if not re.search(rf"\b{re.escape(home)}{name}\b", text)]


def test_who_cites_names_this_version():
    assert f"\nversion: {rk.__version__}\n" in (ROOT / "CITATION.cff").read_text()
