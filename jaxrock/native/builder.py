"""A builder of LLVM's language that writes most instructions as text at once. Needs llvmlite.

Nine in ten instructions of a program are arithmetic, comparisons and choices. llvmlite keeps each as an object with its
operands, looks for a name that no other has, and writes it in the end, which takes three times as long.
"""

from llvmlite import ir

_SIGNS = {">": "gt", "<": "lt", "==": "eq", "!=": "ne", ">=": "ge", "<=": "le"}


class Line:
    """The result of an instruction that is written already, as other instructions take it."""

    __slots__ = ("type", "_name", "_text")

    def __init__(self, kind: ir.Type, name: str, text: str):
        self.type, self._name, self._text = kind, name, f"{name} = {text}"

    def get_reference(self) -> str:
        """Its name: `%v` and a number, as nothing else is called."""
        return self._name

    def __str__(self) -> str:
        return self._text


def _of_two(name: str):
    def write(self, x, y, flags: tuple[str, ...] = ()):
        told = " ".join((name, *flags))
        return self.line(x.type, f"{told} {x.type} {x.get_reference()}, {y.get_reference()}")

    return write


class Builder(ir.IRBuilder):
    """One of llvmlite's, which knows the same instructions; of a single function."""

    def __init__(self, block: ir.Block):
        super().__init__(block)
        self._written = 0

    def line(self, kind: ir.Type, text: str) -> Line:
        """An instruction, by its text."""
        self._written += 1
        line = Line(kind, f"%v{self._written}", text)
        self._block.instructions.insert(self._anchor, line)
        self._anchor += 1
        return line

    fadd, fsub, fmul, fdiv = map(_of_two, ("fadd", "fsub", "fmul", "fdiv"))
    and_, or_, xor = map(_of_two, ("and", "or", "xor"))

    def not_(self, x):
        return self.xor(x, ir.Constant(x.type, [-1] * x.type.count if isinstance(x.type, ir.VectorType) else -1))

    def fneg(self, x):
        return self.line(x.type, f"fneg {x.type} {x.get_reference()}")

    def select(self, which, x, y):
        operands = ", ".join(f"{value.type} {value.get_reference()}" for value in (which, x, y))
        return self.line(x.type, f"select {operands}")

    def fcmp_ordered(self, sign: str, x, y):
        return self._compared("fcmp", "o" + _SIGNS[sign] if sign in _SIGNS else sign, x, y)

    def fcmp_unordered(self, sign: str, x, y):
        return self._compared("fcmp", "u" + _SIGNS[sign] if sign in _SIGNS else sign, x, y)

    def _compared(self, name: str, sign: str, x, y):
        kind = ir.IntType(1)
        if isinstance(x.type, ir.VectorType):
            kind = ir.VectorType(kind, x.type.count)
        return self.line(kind, f"{name} {sign} {x.type} {x.get_reference()}, {y.get_reference()}")

    def position_before(self, instruction):
        """Where that is the last of its block, as it is wherever this is asked for, it need not be looked for."""
        instructions = instruction.parent.instructions
        if instructions[-1] is not instruction:
            return super().position_before(instruction)
        self._block, self._anchor = instruction.parent, len(instructions) - 1
