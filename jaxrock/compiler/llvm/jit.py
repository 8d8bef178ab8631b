"""Compile LLVM modules for this machine, cache the code across sessions, and register it with XLA. Needs llvmlite."""

import functools
import hashlib
import platform
import threading
from collections.abc import Callable

from llvmlite import binding
from llvmlite.ir import Module, PhiInstr

from jaxrock.compiler.cache import store
from jaxrock.compiler.llvm.ffi_handler import add_handler
from jaxrock.compiler.llvm.operations import Unsupported
from jaxrock.compiler.xla_ffi import is_known, register

# LLVM's optimization level, 0 to 3: for code that runs for microseconds, on one point, and for all else (see
# `CompiledProgram`). Level 0 compiles in a third to two thirds of the time, and its code takes up to three times as
# long. On x86, where `benchmarks/effort.py` measures it, both give equal bits.
EFFORT = {"in a moment": 0 if platform.machine() in ("x86_64", "AMD64") else 3, "for long": 3}


class _Machine:
    """LLVM's targets for this processor, one per optimization level, and an engine that links their code."""

    def __init__(self):
        binding.initialize_native_target()
        binding.initialize_native_asmprinter()
        features = binding.get_host_cpu_features()
        self.lanes = 16 if features.get("avx512f") else 8  # two registers, so that one computes while the other waits
        self.told = f"{binding.llvm_version_info} {binding.get_host_cpu_name()} {features.flatten()}"
        self._targets = [
            binding.Target.from_default_triple().create_target_machine(
                cpu=binding.get_host_cpu_name(), features=features.flatten(), opt=n, jit=True, codemodel="jitdefault"
            )
            for n in range(4)
        ]
        self._engine = binding.create_mcjit_compiler(binding.parse_assembly(""), self._targets[3])

    def object_of(self, text: str, effort: int) -> bytes:
        """Compile the text of a module to an object file."""
        target = self._targets[effort]
        try:
            code = binding.parse_assembly(text)
            code.verify()
        except RuntimeError as error:  # the emitted text is invalid: the caller falls back to XLA
            raise Unsupported(f"a program that LLVM refuses: {error}") from error
        # The emitted code has no calls to inline, no loops to vectorize, and no loop-invariant instructions. LLVM's
        # standard passes take three times as long as these two, a fifth of the whole compilation, and give no faster
        # code. One of them reorders sums, which costs digits.
        passes = binding.create_new_function_pass_manager()
        passes.add_simplify_cfg_pass()
        passes.add_instruction_combine_pass()
        builder = binding.create_pass_builder(target, binding.create_pipeline_tuning_options())
        for function in code.functions:
            if not function.is_declaration:
                passes.run(function, builder)
        return target.emit_object(code)

    def address(self, code: bytes, name: str) -> int:
        """Link an object file and return the address of a function in it."""
        self._engine.add_object_file(binding.ObjectFileRef.from_data(code))
        self._engine.finalize_object()
        return self._engine.get_function_address(name)


_one_at_a_time = threading.RLock()
_registered = set()


def _machine() -> _Machine:
    with _one_at_a_time:  # a second machine would be freed, with the code that it has linked
        return _made()


@functools.cache
def _made() -> _Machine:
    return _Machine()


def lanes_of() -> int:
    """Return the largest number of lanes: two registers in double precision, one in single precision."""
    return _machine().lanes


def lanes_for(points: int | None, quick: bool, single: bool) -> int:
    """Return the number of lanes for so many points (None: one) in the fast or the accurate pass.

    LLVM compiles twice as long for two registers as for one. Only the fast pass, whose values fit into the registers,
    runs faster with two. For one point, two lanes take no longer to compile than one, and half as long as sixteen.
    """
    if points is None:
        return 2
    return lanes_of() if quick or single else lanes_of() // 2


def machine() -> str:
    """Describe the target of the machine code: the version of LLVM, the processor and its features."""
    return _machine().told


def registered(program, shared: list[bool], emit: Callable, lanes: int, effort: int) -> str:
    """Emit and compile a jaxpr, and return the name under which XLA finds its machine code.

    The name is a digest of the emitted text, so that executables from a cache find the code again.
    """
    if not is_known():
        raise Unsupported("XLA's interface of this version")
    module = emit(program, shared, lanes, "program")
    return kept(module, len(program.jaxpr.outvars), 1 + len(shared), effort)


def kept(module: Module, outputs: int, inputs: int, effort: int) -> str:
    """Compile the function `program` of a module unless its code is cached; return the name that XLA finds it by."""
    add_handler(module, outputs, inputs)
    text = str(module)
    _take_apart(module)
    name = "jaxrock_" + hashlib.sha256(f"{machine()}\n{effort}\n{text}".encode()).hexdigest()[:20]
    if not is_there(name):
        code = _machine().object_of(text.replace("jaxrock_handler", name), effort)
        store.write("machine", name, code)
        _register(name, code)
    return name


def _take_apart(module: Module) -> None:
    """Free the parts of a module now: they form reference cycles, which the seldom called collector would keep."""
    for function in module.functions:
        for part in function.blocks:
            for phi in (each for each in part.instructions if isinstance(each, PhiInstr)):
                phi.incomings.clear()
            part.instructions.clear()
        function.blocks.clear()
    module.globals.clear()


def is_there(name: str) -> bool:
    """Return whether XLA finds machine code under a name; register the code if an earlier session has stored it."""
    with _one_at_a_time:
        if name in _registered:
            return True
        code = store.read("machine", name)
        if code is not None:
            _register(name, code)
        return code is not None


def _register(name: str, code: bytes) -> None:
    with _one_at_a_time:
        if name in _registered:
            return
        register(name, _machine().address(code, name))
        _registered.add(name)
