"""All tests run in double precision, on two devices, so that surfaces are shared out.

Shapes in annotations are checked where a module states any, of the first calls of every function, and seldom after
them (`references.checked_shapes`). With JAXROCK_CHECK_ALL=1 all calls are checked, in all modules.

XLA compiles as after `keep_compiled`, and then as quickly as it can, since nearly every program runs once: that takes
half of the time or less. LLVM does so with machine code of our own, whose numbers are the same to the bit
(`test_native.py`, `test_at_any_effort`). With `XLA_FLAGS=` both compile as they do for users; LLVM does so in processes
that tests start, too.
"""

import atexit
import ctypes
import gc
import importlib
import importlib.util
import json
import os
import shutil
import tempfile
import threading
from pathlib import Path

import pytest
from _pytest.runner import pytest_runtest_protocol as protocol

_CHECK_ALL = os.environ.get("JAXROCK_CHECK_ALL") == "1"


def checked_modules():
    """Modules of the package (not imported yet) whose annotations are checked."""
    package = Path(importlib.util.find_spec("jaxrock").origin).parent
    for path in sorted(package.rglob("*.py")):
        shapes = "from jaxtyping import" in path.read_text()
        if _CHECK_ALL or shapes:
            yield ".".join(["jaxrock", *path.relative_to(package).with_suffix("").parts])


# What one process has compiled all find again, after it was forgotten, too. What one has half written another may read:
# JAX says so, which is no error here (see `filterwarnings`), and compiles it. The first one clears the place away.
_PLACE = "JAXROCK_TESTS_COMPILED"
if _PLACE not in os.environ:
    os.environ[_PLACE] = tempfile.mkdtemp(prefix="jaxrock-tests-")
    atexit.register(shutil.rmtree, os.environ[_PLACE], ignore_errors=True)
os.environ["JAXROCK_CACHE"] = "off"  # tests compile anew what they test
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # of workers: more threads than one wait at full speed


def pytest_addoption(parser):
    """Add the option of an environment that has all packages."""
    parser.addoption("--no-skips", action="store_true", help="a skipped test fails, whatever is missing")


def pytest_configure(config):
    """Get ready to run tests; what only deals them out to others needs nothing of that."""
    skips = importlib.import_module("references.skipped_tests")
    config.pluginmanager.register(skips.SkippedTests(allowed=not config.option.no_skips))
    if config.getoption("tx", None) and config.getoption("dist") != "no" and not config.option.collectonly:
        return
    shapes = importlib.import_module("references.checked_shapes")
    if _CHECK_ALL:
        shapes.SELDOM["every"] = 1
    shapes.check_shapes(list(checked_modules()))
    # Programs of a hundred thousand operations are traced, and little of what that makes is garbage: look less often.
    gc.set_threshold(1_000_000, 10, 10)
    quickly = "XLA_FLAGS" not in os.environ
    if quickly:
        importlib.import_module("jaxrock.keeping.compiled").compile_quickly()
        fewer = ("simplify-while-loops", "while-loop-invariant-code-motion", "while-loop-constant-sinking")
        flags = (
            "--xla_backend_optimization_level=0",
            "--xla_cpu_parallel_codegen_split_count=1",  # parts that are compiled side by side take longer in all
            f"--xla_disable_hlo_passes={','.join(fewer)}",
        )
        os.environ["XLA_FLAGS"] = " ".join([os.environ.get("XLA_FLAGS", ""), *flags]).strip()
    jax = importlib.import_module("jax")
    if quickly and jax.__version_info__ < (0, 12):
        _share_contexts(importlib.import_module("jax._src.interpreters.mlir"))
    if quickly and importlib.util.find_spec("llvmlite"):
        importlib.import_module("jaxrock.native.machine").EFFORT["for long"] = 0
    jax.config.update("jax_compilation_cache_dir", os.environ[_PLACE])
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_num_cpu_devices", 2)
    importlib.import_module("matplotlib").use("Agg")


_PROGRAMS = 64  # of a context, which they make greater: it stays as long as one of them


def _share_contexts(mlir):
    """JAX before 0.12 makes a context of MLIR for each program, most of its memory, and holds it as long as that. Here
    programs of a thread share some: one more for each program that is being made while another is, since what JAX makes
    then would come to stand in that other."""
    made, current, mine = mlir.make_ir_context, mlir.ir.Context, threading.local()

    def shared():
        contexts = mine.__dict__.setdefault("contexts", [])  # with the programs that may still be made in each
        around = current.current
        level = 0 if around is None else 1 + max((n for n, (c, _) in enumerate(contexts) if c is around), default=-1)
        if around is not None and not level:
            return made()
        context, left = contexts[level] if level < len(contexts) else (None, 0)
        if not left:
            context, left = made(), _PROGRAMS
        contexts[level : level + 1] = [(context, left - 1)]
        return context

    mlir.make_ir_context = shared


# Bytes that a worker holds before it forgets compiled programs, if it has grown by so many since it last did: after the
# last test of a file, and within one, where the next test may need what was compiled for this.
_AFTER_A_FILE, _WITHIN, _LEAST_GROWTH = 1.3e9, 1.4e9, 2e8
_MOST_MAPS = 30_000
_TESTS = 50  # after so many it is looked how many maps there are, for to read them takes as long as a small test
_held, _left = [0.0], [_TESTS]  # bytes after they were last forgotten; tests until maps are looked at
_OF_C = ctypes.CDLL(None) if os.name == "posix" else None


def _memory() -> float:
    """Bytes that this process holds; zero where that cannot be told."""
    told = Path("/proc/self/statm")
    return int(told.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") if told.exists() else 0.0


def _has_many_maps() -> bool:
    _left[0] -= 1
    maps = Path("/proc/self/maps")
    if _left[0] or not maps.exists():
        return False
    _left[0] = _TESTS
    return maps.read_bytes().count(b"\n") > _MOST_MAPS


@pytest.hookimpl(trylast=True)
def pytest_runtest_teardown(item, nextitem):
    """Forget compiled programs before they are too many: each takes memory, and maps pages, and past 65,530 maps XLA
    crashes on Linux."""
    goes_on = nextitem is not None and nextitem.path == item.path
    most = max(_WITHIN if goes_on else _AFTER_A_FILE, _held[0] + _LEAST_GROWTH)
    if not _has_many_maps() and _memory() <= most:
        return
    importlib.import_module("jaxrock.transforms.recipe").forget_programs()
    importlib.import_module("jax").clear_caches()
    gc.collect()  # it is told to look seldom, and much waits for it
    gc.freeze()  # what is left stays for long
    if hasattr(_OF_C, "malloc_trim"):  # what is free is given back only so
        _OF_C.malloc_trim(0)
    _held[0] = _memory()


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_protocol(item, nextitem):
    """As pytest does it, with room for the frames of all that a test calls. Plugins that run tests in another way
    (again, if they fail) are not asked."""
    return importlib.import_module("jaxrock._undisturbed").with_room(protocol, item, nextitem)


def pytest_collection_finish():
    """What all modules have made by now stays: the collector need not look at it again."""
    gc.collect()
    gc.freeze()


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish():
    """At the end pytest looks for garbage five times, and Python twice: once is enough, for what is left stays."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session")
def references():
    """Reference values from 200-bit integrations (see the file's `about`)."""
    return json.loads((Path(__file__).parents[1] / "references" / "papers.json").read_text())
