"""LLVM for this machine: it compiles modules, once for all sessions, and tells XLA where the code is.

Needs llvmlite.
"""

import functools
import hashlib
import platform
import threading
from collections.abc import Callable

from llvmlite import binding
from llvmlite.ir import Module, PhiInstr

from jaxrock._foreign import is_known, register
from jaxrock.keeping import folder
from jaxrock.native.interface import add_handler
from jaxrock.native.operations import Unsupported

# LLVM's effort, 0 to 3: at what runs for microseconds, in one lane, and at all else (see `Plan`). With 0 it takes a
# third to two thirds of the time, and on x86, where this was measured (`benchmarks/effort.py`), numbers are the same to
# the bit. The code takes up to three times as long.
EFFORT = {"in a moment": 0 if platform.machine() in ("x86_64", "AMD64") else 3, "for long": 3}


class _Machine:
    """Targets of LLVM, and an engine that links what is compiled for them."""

    def __init__(self):
        binding.initialize_native_target()
        binding.initialize_native_asmprinter()
        features = binding.get_host_cpu_features()
        self.lanes = 16 if features.get("avx512f") else 8  # two registers: one computes while the other waits
        self.told = f"{binding.llvm_version_info} {binding.get_host_cpu_name()} {features.flatten()}"
        self._targets = [
            binding.Target.from_default_triple().create_target_machine(
                cpu=binding.get_host_cpu_name(), features=features.flatten(), opt=n, jit=True, codemodel="jitdefault"
            )
            for n in range(4)
        ]
        self._engine = binding.create_mcjit_compiler(binding.parse_assembly(""), self._targets[3])

    def object_of(self, text: str, effort: int) -> bytes:
        """The machine code of a module."""
        target = self._targets[effort]
        try:
            code = binding.parse_assembly(text)
            code.verify()
        except RuntimeError as error:  # what was written is no program: XLA takes over
            raise Unsupported(f"a program that LLVM refuses: {error}") from error
        # What the emitter writes has no calls to inline, no loops to turn into vectors, and nothing left in them that
        # stays the same. LLVM's usual passes take three times as long as these two, a fifth of all that it takes, and
        # what comes of them is no faster; one of them sums in an order of its own, which costs digits.
        passes = binding.create_new_function_pass_manager()
        passes.add_simplify_cfg_pass()
        passes.add_instruction_combine_pass()
        builder = binding.create_pass_builder(target, binding.create_pipeline_tuning_options())
        for function in code.functions:
            if not function.is_declaration:
                passes.run(function, builder)
        return target.emit_object(code)

    def address(self, code: bytes, name: str) -> int:
        """Where a function of some machine code is, from now on."""
        self._engine.add_object_file(binding.ObjectFileRef.from_data(code))
        self._engine.finalize_object()
        return self._engine.get_function_address(name)


_one_at_a_time = threading.RLock()
_registered = set()


def _machine() -> _Machine:
    with _one_at_a_time:  # of two machines one would be freed, with all that it has compiled
        return _made()


@functools.cache
def _made() -> _Machine:
    return _Machine()


def lanes_of() -> int:
    """Lanes of a vector, at most: of numbers in double precision two registers, in single precision one."""
    return _machine().lanes


def lanes_for(scenes: int | None, quick: bool, single: bool) -> int:
    """Lanes of a vector for so many scenes (None: one), which a quick program follows or a careful one, in `single`
    precision or double.

    Code for two registers takes LLVM twice as long as for one, and only a quick program, whose values have room in all
    registers, runs faster so. Of one scene, two lanes are compiled in no more time than one, and take half of the time
    that sixteen take."""
    if scenes is None:
        return 2
    return lanes_of() if quick or single else lanes_of() // 2


def machine() -> str:
    """What machine code is made for: LLVM, the processor and what it can do."""
    return _machine().told


def registered(program, shared: list[bool], emit: Callable, lanes: int, effort: int) -> str:
    """The name under which XLA finds the machine code of a program: made of its text, so that compiled programs that a
    cache keeps find it again."""
    if not is_known():
        raise Unsupported("XLA's interface of this version")
    module = emit(program, shared, lanes, "program")
    return kept(module, len(program.jaxpr.outvars), 1 + len(shared), effort)


def kept(module: Module, outputs: int, inputs: int, effort: int) -> str:
    """The name under which XLA finds the machine code of the function `program` of a module."""
    add_handler(module, outputs, inputs)
    text = str(module)
    _take_apart(module)
    name = "jaxrock_" + hashlib.sha256(f"{machine()}\n{effort}\n{text}".encode()).hexdigest()[:20]
    if not is_there(name):
        code = _machine().object_of(text.replace("jaxrock_handler", name), effort)
        folder.write("machine", name, code)
        _register(name, code)
    return name


def _take_apart(module: Module) -> None:
    """Free what a module is made of now: functions and their parts hold each other, and the collector, which would have
    to find that out, is seldom called."""
    for function in module.functions:
        for block in function.blocks:
            for phi in (each for each in block.instructions if isinstance(each, PhiInstr)):
                phi.incomings.clear()
            block.instructions.clear()
        function.blocks.clear()
    module.globals.clear()


def is_there(name: str) -> bool:
    """Return whether XLA finds machine code under a name; what is kept from another session it does, too."""
    with _one_at_a_time:
        if name in _registered:
            return True
        code = folder.read("machine", name)
        if code is not None:
            _register(name, code)
        return code is not None


def _register(name: str, code: bytes) -> None:
    with _one_at_a_time:
        if name in _registered:
            return
        register(name, _machine().address(code, name))
        _registered.add(name)
