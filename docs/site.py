"""What the site adds to the pages of this folder: tables of benchmarks and notebooks, which lie beside it."""

import re
from pathlib import Path

from mkdocs.structure.files import File

ROOT = Path(__file__).parents[1]
PATTERNS = (
    "benchmarks/*.md", "benchmarks/*.png", "notebooks/*.ipynb", "notebooks/*.md", "notebooks/*.png",
    "notebooks/pictures/*.png", "*.md",
)  # fmt: skip


def on_files(files, config):
    """Take them in, at the places where the repository has them."""
    for pattern in PATTERNS:
        for path in sorted(ROOT.glob(pattern)):
            place = path.relative_to(ROOT).as_posix()
            if place != "README.md":  # the site begins with a page of its own
                files.append(File.generated(config, place, abs_src_path=str(path)))
    return files


def on_page_markdown(markdown, page, config, files):
    """Links out of this folder stay within the site, whose root it is; those to code become names."""
    if page.file.generated_by is None:  # of this folder
        markdown = re.sub(r"\]\(\.\./((?:\.\./)?(?:benchmarks|notebooks|CONTRIBUTING))", r"](\1", markdown)
    return re.sub(r"\[([^\]]+)\]\([^)]*\.(?:py|json)\)", r"\1", markdown)
