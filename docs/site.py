"""What the site adds to the pages of this folder: tables of benchmarks and notebooks, which lie beside it, and to every
name of the API its example."""

import ast
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
    if page.file.src_uri == "api.md":
        return _with_examples(markdown)
    if page.file.generated_by is None:  # of this folder
        markdown = re.sub(r"\]\(\.\./((?:\.\./)*(?:benchmarks|notebooks|CONTRIBUTING))", r"](\1", markdown)
    else:  # beside this folder
        markdown = re.sub(r"\]\(((?:\.\./)*)docs/", r"](\1", markdown)
    return re.sub(r"\[([^\]]+)\]\([^)]*\.(?:py|json)\)", r"\1", markdown)


def _with_examples(markdown):
    """The API, below every name the first statement of the examples that has it."""
    statements = []
    for code in re.findall(r"```python\n(.*?)```", (ROOT / "docs/examples.md").read_text(), re.DOTALL):
        statements += [ast.get_source_segment(code, node) for node in ast.parse(code).body]

    def example(entry):
        if (ROOT / entry[1].replace(".", "/")).with_suffix(".py").exists():
            return entry[0]  # all of a module
        space = r"plot\." if entry[1].startswith("jaxrock.plot.") else r"(?!plot\.)(?:\w+\.)?"
        named = re.compile(rf"\brk\.{space}{entry[1].split('.')[-1]}\b")
        found = next(each for each in statements if named.search(each))
        return f"{entry[0]}\nFor example:\n\n```python\n{found}\n```\n"

    return re.sub(r"^::: (\S+)\n(?:    .*\n)+", example, markdown, flags=re.MULTILINE)
