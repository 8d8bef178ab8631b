"""Fixtures of all tests, which run in double precision and on two devices, so that surfaces are shared out.

Shapes in annotations are checked where a module states any, on the first calls of every function and seldom after
them (`references.checked_shapes`). With JAXROCK_CHECK_ALL=1 all calls are checked, in all modules.

XLA compiles as after `keep_compiled`, and then with the least effort, since nearly every program runs once: this takes
half of the time or less. LLVM does so for the package's own machine code, whose results are identical to the bit
(`test_native.py`, `test_at_any_effort`). With `XLA_FLAGS=` both compile as they do for users. LLVM also does so in
processes that tests start.
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

# The judge of chaotic scenes is a program in C. Where no compiler is, its own tests have nothing to run.
collect_ignore = [] if shutil.which("cc") else ["test_real_records.py"]
_CHECK_ALL = os.environ.get("JAXROCK_CHECK_ALL") == "1"


def checked_modules():
    """Modules of the package (not imported yet) whose annotations are checked."""
    package = Path(importlib.util.find_spec("jaxrock").origin).parent
    for path in sorted(package.rglob("*.py")):
        text = path.read_text()
        shapes = "from jaxtyping import" in text or "from jaxrock._core.types import" in text
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
    """Configure a process that runs tests; a controller that only distributes them needs no configuration."""
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
        importlib.import_module("jaxrock.compiler.cache.enable").compile_quickly()
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
        importlib.import_module("jaxrock.compiler.llvm.jit").EFFORT["for long"] = 0
    jax.config.update("jax_compilation_cache_dir", os.environ[_PLACE])
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_num_cpu_devices", 2)
    importlib.import_module("matplotlib").use("Agg")


_PROGRAMS = 64  # of a context, which they make greater: it stays as long as one of them


def _share_contexts(mlir):
    """Let the programs of a thread share MLIR contexts, which hold most of the memory of compiled programs.

    JAX before 0.12 makes a context for each program and holds it as long as the program. A program that is made while
    another is being made gets a context of its own, since JAX's objects would otherwise end up in the other's context.
    """
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


# Bytes that a worker may hold before it forgets compiled programs, and growth since it last did so: after the last test
# of a file, and within a file, where the next test may need programs compiled for this one.
_AFTER_A_FILE, _WITHIN, _LEAST_GROWTH = 1.3e9, 1.4e9, 2e8
_MOST_MAPS = 30_000
_TESTS = 50  # after so many it is looked how many maps there are, for to read them takes as long as a small test
_held, _left = [0.0], [_TESTS]  # bytes after they were last forgotten; tests until maps are looked at
_OF_C = ctypes.CDLL(None) if os.name == "posix" else None


def _memory() -> float:
    """Return the bytes that this process holds; zero where the system does not tell."""
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
    """Forget compiled programs before they are too many: each takes memory and maps pages.

    Beyond 65,530 maps XLA crashes on Linux.
    """
    goes_on = nextitem is not None and nextitem.path == item.path
    most = max(_WITHIN if goes_on else _AFTER_A_FILE, _held[0] + _LEAST_GROWTH)
    if not _has_many_maps() and _memory() <= most:
        return
    importlib.import_module("jaxrock.compiler.primitive.lane_function").forget_programs()
    importlib.import_module("jax").clear_caches()
    gc.collect()  # it is told to look seldom, and much waits for it
    gc.freeze()  # what is left stays for long
    if hasattr(_OF_C, "malloc_trim"):  # what is free is given back only so
        _OF_C.malloc_trim(0)
    _held[0] = _memory()


def pytest_collection_finish():
    """Exclude the objects that all modules have made from garbage collection: they stay."""
    gc.collect()
    gc.freeze()


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish():
    """Reduce the garbage collections at exit (pytest runs five, Python two) to one: the remaining objects stay."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session")
def references():
    """Reference values from 200-bit integrations (see the file's `about`)."""
    return json.loads((Path(__file__).parents[1] / "references" / "papers.json").read_text())
