"""Run a function over its points in the calling thread and in threads of XLA's pool. Needs llvmlite.

The pool exists already: a new thread costs more, and Linux may leave it waiting on the core that started it. XLA does
not guarantee when, or whether, a task runs. So the caller runs unclaimed points and waits only for tasks that have
started.
"""

import ctypes
import os
from collections.abc import Callable

from llvmlite import ir

from jaxrock.compiler.xla_ffi import Done, Interface, Task

HAS_THREADS = os.name == "posix"
_WANTED, _THREADS = 1, 2  # positions in the first input (see `kernels.Frame`)
_SHARE = 64  # points per further thread
_NEXT, _BEGUN, _ENDED, _HELD = 2, 3, 4, 5  # words of the shared memory, after both tables
_CLOSED = 1 << 32  # added to `_BEGUN`, it stops late tasks; exceeds any number of threads
_POINTER, _I32, _I64 = ir.IntType(8).as_pointer(), ir.IntType(32), ir.IntType(64)


def call_in_threads(b: ir.IRBuilder, program: ir.Function, tables: list, interface, context) -> None:
    """Emit a call of `program` in this thread and, for many points, in further threads at once; for no point, no call.

    `tables` are the arrays of pointers to outputs and inputs. XLA passes `interface` and `context` to its handler, for
    calls of its own functions.
    """
    sizes = b.bitcast(b.load(tables[1]), _I32.as_pointer())
    wanted, threads = (b.sext(b.load(b.gep(sizes, [_I32(i)])), _I64) for i in (_WANTED, _THREADS))
    most, others = b.sdiv(b.sub(wanted, _I64(1)), _I64(_SHARE)), b.sub(threads, _I64(1))
    others = b.select(b.icmp_signed("<", most, others), most, others)
    if not HAS_THREADS:
        others = _I64(0)
    with b.if_then(b.icmp_signed(">", wanted, _I64(0))):
        with b.if_else(b.icmp_signed("<=", others, _I64(0))) as (alone, shared):
            with alone:
                following = b.alloca(_I64)
                b.store(_I64(0), following)
                b.call(program, [*tables, following])
            with shared:
                _Shared(b, program).run(tables, others, interface, context)


class _Shared:
    """State that threads share while they run a function, on the heap: a task may start after the call has ended."""

    def __init__(self, b: ir.IRBuilder, program: ir.Function):
        self.b, self.program = b, program
        give = ir.Function(b.module, ir.FunctionType(_POINTER, [_I64]), "malloc")
        self._take_back = ir.Function(b.module, ir.FunctionType(ir.VoidType(), [_POINTER]), "free")
        self._let_others = ir.Function(b.module, ir.FunctionType(_I32, []), "sched_yield")
        self._memory = lambda: b.call(give, [_I64(8 * (_HELD + 1))])

    def run(self, tables: list, others, interface, context) -> None:
        """Emit: schedule tasks, run the function here, too, and wait for the tasks that have started."""
        b = self.b
        memory = self._memory()
        for number, table in enumerate(tables):
            b.store(b.ptrtoint(table, _I64), self._number(b, memory, number))
        for number, value in ((_NEXT, _I64(0)), (_BEGUN, _I64(0)), (_ENDED, _I64(0)), (_HELD, b.add(others, _I64(1)))):
            b.store(value, self._number(b, memory, number))
        asked = count_up(b, others, self._asking(memory, interface, context))
        b.atomic_rmw("sub", self._number(b, memory, _HELD), b.sub(others, asked), "acq_rel")
        self._run(b, memory)
        begun = b.atomic_rmw("add", self._number(b, memory, _BEGUN), _I64(_CLOSED), "acq_rel")
        wait, look, done = (b.append_basic_block(name) for name in ("wait", "look", "done"))
        b.branch(look)
        b.position_at_end(wait)
        b.call(self._let_others, [])
        b.branch(look)
        b.position_at_end(look)
        ended = b.load_atomic(self._number(b, memory, _ENDED), "acquire", 8)
        b.cbranch(b.icmp_signed("<", ended, begun), wait, done)
        b.position_at_end(done)
        self._let_go(b, memory)

    def _asking(self, memory, interface, context) -> Callable:
        """Return `ask(number)`, which emits a request for a task and returns whether XLA accepts it."""
        b = self.b
        asked = _made(b, Task, context=context, task=b.bitcast(self._task(), _POINTER), data=memory)
        done = _made(b, Done)

        def function(name, result):
            return b.load(_part(b, interface, Interface, name, ir.FunctionType(result, [_POINTER]).as_pointer()))

        schedule, destroy = function("schedule", _POINTER), function("destroy_error", ir.VoidType())

        def ask(number):
            error = b.call(schedule, [asked])
            is_taken = b.icmp_unsigned("==", error, ir.Constant(_POINTER, None))
            with b.if_then(b.not_(is_taken)):  # XLA found no thread: the error is freed here
                b.store(error, _part(b, done, Done, "error", _POINTER))
                b.call(destroy, [done])
            return is_taken

        return ask

    def _task(self) -> ir.Function:
        """Emit the task of another thread: it runs the function unless it starts too late."""
        task = ir.Function(self.b.module, ir.FunctionType(ir.VoidType(), [_POINTER]), "task")
        task.linkage = "internal"
        b, memory = ir.IRBuilder(task.append_basic_block("entry")), task.args[0]
        before = b.atomic_rmw("add", self._number(b, memory, _BEGUN), _I64(1), "acq_rel")
        with b.if_then(b.icmp_signed("<", before, _I64(_CLOSED))):
            self._run(b, memory)
            b.atomic_rmw("add", self._number(b, memory, _ENDED), _I64(1), "acq_rel")
        self._let_go(b, memory)
        b.ret_void()
        return task

    def _run(self, b: ir.IRBuilder, memory) -> None:
        kinds = self.program.ftype.args
        tables = [b.inttoptr(b.load(self._number(b, memory, i)), kinds[i]) for i in (0, 1)]
        b.call(self.program, [*tables, self._number(b, memory, _NEXT)])

    def _let_go(self, b: ir.IRBuilder, memory) -> None:
        """Emit the release of one reference; the last one frees the memory."""
        held = b.atomic_rmw("sub", self._number(b, memory, _HELD), _I64(1), "acq_rel")
        with b.if_then(b.icmp_signed("==", held, _I64(1))):
            b.call(self._take_back, [memory])

    @staticmethod
    def _number(b: ir.IRBuilder, memory, number: int):
        return b.bitcast(b.gep(memory, [_I64(8 * number)]), _I64.as_pointer())


def _made(b: ir.IRBuilder, kind: type[ctypes.Structure], **parts):
    """Emit a structure of XLA's interface on the stack, with some of its fields set."""
    made = b.bitcast(b.alloca(_I64, -(-ctypes.sizeof(kind) // 8)), _POINTER)
    known = {"struct_size": ir.Constant(_I64, ctypes.sizeof(kind)), "extension_start": ir.Constant(_POINTER, None)}
    for name, value in (known | parts).items():
        b.store(value, _part(b, made, kind, name, value.type))
    return made


def _part(b: ir.IRBuilder, structure, kind: type[ctypes.Structure], name: str, of):
    """Emit a pointer to a field of a structure."""
    return b.bitcast(b.gep(structure, [_I64(getattr(kind, name).offset)]), of.as_pointer())


def count_up(b: ir.IRBuilder, size, act: Callable):
    """Emit a loop of `act(number)` from 0 to `size`, or until it is false; return the number where the loop ends."""
    before, head, inside, after = b.basic_block, *(b.append_basic_block(name) for name in ("next", "act", "done"))
    b.branch(head)
    b.position_at_end(head)
    number = b.phi(_I64)
    b.cbranch(b.icmp_signed("<", number, size), inside, after)
    b.position_at_end(inside)
    goes_on = act(number)
    following = b.add(number, _I64(1))
    number.add_incoming(_I64(0), before)
    number.add_incoming(following, b.basic_block)
    last = b.basic_block
    b.cbranch(goes_on, head, after)
    b.position_at_end(after)
    end = b.phi(_I64)
    end.add_incoming(number, head)
    end.add_incoming(number, last)
    return end
