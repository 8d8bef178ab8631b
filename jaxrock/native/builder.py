"""A builder of LLVM's language that writes most instructions as text at once. Needs llvmlite.

Most of a program is arithmetic, comparisons and choices. llvmlite keeps each instruction as an object with its
operands, looks for a name that no other has, and writes it in the end.
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


def _of_two(instruction: str):
    def write(self, x, y, name: str = "", flags: tuple[str, ...] = ()):
        return self.line(x.type, (instruction, *flags), x, y)

    return write


class Builder(ir.IRBuilder):
    """One of llvmlite's, which knows the same instructions; of a single function. Names that are asked for are not
    given to what it writes at once."""

    def __init__(self, block: ir.Block):
        super().__init__(block)
        self._written = 0

    def line(self, kind: ir.Type, words: tuple[str, ...], *operands) -> Line:
        """An instruction of these words and operands, all of one type, whose result is of a `kind`.

        **Raises:** ValueError for operands of several types.
        """
        first = operands[0].type
        if any(x.type != first for x in operands[1:]):
            raise ValueError(f"Operands must be of one type, but are {[str(x.type) for x in operands]}.")
        return self._add(kind, f"{' '.join(words)} {first} {', '.join(x.get_reference() for x in operands)}")

    def _add(self, kind: ir.Type, text: str) -> Line:
        self._written += 1
        line = Line(kind, f"%v{self._written}", text)
        self._block.instructions.insert(self._anchor, line)
        self._anchor += 1
        return line

    fadd, fsub, fmul, fdiv = map(_of_two, ("fadd", "fsub", "fmul", "fdiv"))
    and_, or_, xor = map(_of_two, ("and", "or", "xor"))

    def fneg(self, x, name: str = "", flags: tuple[str, ...] = ()):
        return self.line(x.type, ("fneg", *flags), x)

    def select(self, which, x, y, name: str = "", flags: tuple[str, ...] = ()):
        if x.type != y.type:
            raise ValueError(f"Cases must be of one type, but are {x.type} and {y.type}.")
        operands = ", ".join(f"{value.type} {value.get_reference()}" for value in (which, x, y))
        return self._add(x.type, f"{' '.join(('select', *flags))} {operands}")

    def fcmp_ordered(self, sign: str, x, y, name: str = "", flags: tuple[str, ...] = ()):
        return self._compared("o", sign, x, y, flags)

    def fcmp_unordered(self, sign: str, x, y, name: str = "", flags: tuple[str, ...] = ()):
        return self._compared("u", sign, x, y, flags)

    def _compared(self, order: str, sign: str, x, y, flags: tuple[str, ...]):
        kind = ir.IntType(1)
        if isinstance(x.type, ir.VectorType):
            kind = ir.VectorType(kind, x.type.count)
        return self.line(kind, ("fcmp", *flags, order + _SIGNS[sign] if sign in _SIGNS else sign), x, y)

    def position_before(self, instruction):
        """Where that is the last of its block, as it is wherever this is asked for, it need not be looked for."""
        instructions = instruction.parent.instructions
        if instructions[-1] is not instruction:
            return super().position_before(instruction)
        self._block, self._anchor = instruction.parent, len(instructions) - 1
