"""Count the files that a cold `outcome` enters before the physics: `python -m references.entry` prints it.

Counted in a fresh process, by the calls of Python functions:

- files of the package that are entered before `engines/scene.py`;
- crossings: pairs of files, one in the compiler and one not, of which the first calls the second.
"""

import json
import subprocess
import sys
from pathlib import Path

_COUNTED = """
import json, sys
from pathlib import Path
import jax
jax.config.update("jax_enable_x64", True)
import jaxrock as rk

package = Path(rk.__file__).parent
known, files, crossings, functions = {}, [], set(), set()


def place(code):
    if code not in known:
        path = Path(code.co_filename)
        known[code] = path.relative_to(package).as_posix() if package in path.parents else None
    return known[code]


def nearest(frame):
    while frame is not None:
        if (here := place(frame.f_code)) is not None:
            return here
        frame = frame.f_back


def watch(frame, event, _):
    if event == "call" and (here := place(frame.f_code)) is not None:
        functions.add(frame.f_code)
        if here not in files:
            files.append(here)
        above = nearest(frame.f_back)
        if above is not None and above.startswith("compiler/") != here.startswith("compiler/"):
            crossings.add((above, here))


block, record = rk.Block(0.2, 2.0), rk.example_record()
sys.setprofile(watch)
rk.outcome(block, record)
sys.setprofile(None)
print(json.dumps({"files": files, "functions": len(functions), "crossings": sorted(crossings)}))
"""


def counted() -> dict:
    """Return the files in the order in which they are entered, the number of functions, and the crossings."""
    done = subprocess.run(
        [sys.executable, "-c", _COUNTED],
        capture_output=True,
        text=True,
        check=True,
        cwd=Path(__file__).parents[1],
        env={"PATH": "", "JAX_PLATFORMS": "cpu", "JAXROCK_CACHE": "off", "PYTHONPATH": str(Path(__file__).parents[1])},
    )
    return json.loads(done.stdout)


def before_the_scene(found: dict) -> list[str]:
    """Return the files that are entered before the scene is built."""
    return found["files"][: found["files"].index("engines/scene.py")]


if __name__ == "__main__":
    found = counted()
    before = before_the_scene(found)
    print(f"{len(found['files'])} files, {found['functions']} functions, {len(found['crossings'])} crossings")
    print(f"{len(before)} files before engines/scene.py:", *before, sep="\n  ")
    print("crossings:", *(" -> ".join(pair) for pair in found["crossings"]), sep="\n  ")
