"""Build LLVM IR faster than llvmlite does: write most instructions as text at once. Needs llvmlite.

Most instructions are arithmetic, comparisons, selects, and loads and stores of elements. For each, llvmlite keeps an
object with its operands, searches for an unused name, and writes the text at the end.
"""

import functools
from typing import Any

from llvmlite import ir

_SIGNS = {">": "gt", "<": "lt", "==": "eq", "!=": "ne", ">=": "ge", "<=": "le"}
_EQUAL = {"==", "!="}
_FLAG = ir.IntType(1)
_flags = functools.cache(functools.partial(ir.VectorType, _FLAG))  # by the number of lanes


class Line:
    """The result of an instruction whose text is final, as an operand of other instructions.

    `depth` is the number of enclosing loops that recompute it (see `emitter.remember`).
    """

    __slots__ = ("type", "depth", "_name", "_text")

    def __init__(self, kind: ir.Type, name: str, text: str):
        self.type, self.depth, self._name, self._text = kind, None, name, f"{name} = {text}"

    def get_reference(self) -> str:
        """Return the name, `%v` and a number, a form that no other value has."""
        return self._name

    def __str__(self) -> str:
        return self._text


def _of_two(instruction: str):
    def write(self, x, y, name: str = "", flags: tuple[str, ...] = ()):
        return self._operation(x.type, f"{instruction} {' '.join(flags)}" if flags else instruction, x, y)

    return write


class Builder(ir.IRBuilder):
    """A builder with the interface of llvmlite's, for a single function.

    Instructions that it writes at once ignore the argument `name`.
    """

    def __init__(self, basic_block: Any):
        super().__init__(basic_block)
        self._written = 0

    def _operation(self, kind: ir.Type, words: str, x, y) -> Line:
        """Write an instruction of these words with two operands of one type, and a result of type `kind`.

        **Raises:** ValueError for operands of two types.
        """
        if x.type is not y.type and x.type != y.type:
            raise ValueError(f"Operands must be of one type, but are {x.type} and {y.type}.")
        return self._add(kind, f"{words} {x.type} {x.get_reference()}, {y.get_reference()}")

    def _add(self, kind: ir.Type, text: str) -> Line:
        self._written += 1
        line = Line(kind, f"%v{self._written}", text)
        self._block.instructions.insert(self._anchor, line)
        self._anchor += 1
        return line

    fadd, fsub, fmul, fdiv = map(_of_two, ("fadd", "fsub", "fmul", "fdiv"))
    and_, or_, xor = map(_of_two, ("and", "or", "xor"))
    add, sub, mul = map(_of_two, ("add", "sub", "mul"))

    def fneg(self, x, name: str = "", flags: tuple[str, ...] = ()):
        return self._add(x.type, f"{' '.join(('fneg', *flags))} {x.type} {x.get_reference()}")

    def called(self, function: ir.Function, values) -> Line:
        """Call a function with values of its argument types."""
        kind, operands = function.ftype.return_type, ", ".join(f"{x.type} {x.get_reference()}" for x in values)
        return self._add(kind, f"call {kind} {function.get_reference()}({operands})")

    def extract_element(self, vector, index, name: str = ""):
        kind = vector.type
        return self._add(
            kind.element, f"extractelement {kind} {vector.get_reference()}, {index.type} {index.get_reference()}"
        )

    def insert_element(self, vector, value, index, name: str = ""):
        kind, operands = vector.type, (vector, value, index)
        if kind.element != value.type:
            raise ValueError(f"What is put into {kind} must be of its type, but is of {value.type}.")
        return self._add(kind, f"insertelement {', '.join(f'{x.type} {x.get_reference()}' for x in operands)}")

    def select(self, which, x, y, name: str = "", flags: tuple[str, ...] = ()):
        if x.type != y.type:
            raise ValueError(f"Cases must be of one type, but are {x.type} and {y.type}.")
        operands = ", ".join(f"{value.type} {value.get_reference()}" for value in (which, x, y))
        return self._add(x.type, f"{' '.join(('select', *flags))} {operands}")

    def gep(self, ptr, indices, inbounds: bool = False, name: str = "", source_etype=None):
        if len(indices) > 1 or inbounds or source_etype is not None:
            return super().gep(ptr, indices, inbounds, name, source_etype)
        kind, (index,) = ptr.type, indices
        place = f"{index.type} {index.get_reference()}"
        return self._add(kind, f"getelementptr {kind.pointee}, {kind} {ptr.get_reference()}, {place}")

    def load(self, ptr, name: str = "", align: int | None = None, typ=None):
        if typ is not None:
            return super().load(ptr, name, align, typ)
        kind = ptr.type
        aligned = "" if align is None else f", align {align}"
        return self._add(kind.pointee, f"load {kind.pointee}, {kind} {ptr.get_reference()}{aligned}")

    def fcmp_ordered(self, sign: str, x, y, name: str = "", flags: tuple[str, ...] = ()):
        return self._compared(("fcmp", *flags), "o" + _SIGNS[sign] if sign in _SIGNS else sign, x, y)

    def fcmp_unordered(self, sign: str, x, y, name: str = "", flags: tuple[str, ...] = ()):
        return self._compared(("fcmp", *flags), "u" + _SIGNS[sign] if sign in _SIGNS else sign, x, y)

    def icmp_signed(self, sign: str, x, y, name: str = ""):
        return self._compared(("icmp",), ("" if sign in _EQUAL else "s") + _SIGNS[sign], x, y)

    def icmp_unsigned(self, sign: str, x, y, name: str = ""):
        return self._compared(("icmp",), ("" if sign in _EQUAL else "u") + _SIGNS[sign], x, y)

    def _compared(self, words: tuple[str, ...], sign: str, x, y):
        kind = _FLAG if not isinstance(x.type, ir.VectorType) else _flags(x.type.count)
        return self._operation(kind, " ".join((*words, sign)), x, y)

    def position_before(self, instruction):
        """Position without llvmlite's search, as the instruction is the last one in all uses here."""
        instructions = instruction.parent.instructions
        if instructions[-1] is not instruction:
            return super().position_before(instruction)
        self._block, self._anchor = instruction.parent, len(instructions) - 1
