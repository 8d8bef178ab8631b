"""Emit a loop with divergent lanes: each case of its step runs for a vector of points that wait for it.

The step ends with conditions on `divergent`, whose first case is the cheap and frequent one. Many more points than a
vector has lanes are in progress, in slots on the stack. Groups of neighbouring slots take turns to advance by the first
case.

A point that needs another case joins the list of that case. When a list fills a vector, its points are gathered from
their slots, advance together, and are scattered back. Needs llvmlite.
"""

from typing import Any

from jax.extend.core import Literal
from llvmlite import ir

from jaxrock.compiler.jaxpr.partition import part_of
from jaxrock.compiler.llvm.emitter import Emitter, flat, like, remember
from jaxrock.compiler.llvm.kernels import Frame, Refilled

_I8, _I32, _I64 = ir.IntType(8), ir.IntType(32), ir.IntType(64)

_AS_NUMBER = {"convert_element_type": 0, "clamp": 1}  # {flag-to-index operation: position of its operand}
_GROUPS = 12  # of slots; of 4, 8 and 12 the fastest for a thousand integrations under sampled forcing
_ENOUGH = 0.75  # share of a group's unfinished lanes in the first case; below it the next group has its turn


def _condition(program) -> tuple[list, Any] | None:
    """Return the equations before the last condition of a step, and that condition; None if it is not divergent."""
    equations = program.jaxpr.eqns
    if not equations or equations[-1].primitive.name != "cond":
        return None
    makers = {v: equation for equation in equations for v in equation.outvars}

    def maker(atom):
        return None if isinstance(atom, Literal) else makers.get(atom)

    flag = maker(equations[-1].invars[0])
    while flag is not None and flag.primitive.name in _AS_NUMBER:
        flag = maker(flag.invars[_AS_NUMBER[flag.primitive.name]])
    return None if flag is None or flag.primitive.name != "divergent" else (equations[:-1], equations[-1])


def is_divergent_loop(equation) -> bool:
    """Return whether an equation is a loop whose step ends with a divergent condition."""
    return equation.primitive.name == "while" and _condition(equation.params["body_jaxpr"]) is not None


def _cases(program) -> int:
    """Count the cases of a step."""
    found = _condition(program)
    return 1 if found is None else sum(map(_cases, found[1].params["branches"]))


def emit_divergent(program, shared: list[bool], lanes: int, name: str) -> ir.Module:
    """Emit a loop whose step ends with divergent conditions, as `emit_loop` does for other loops."""
    return _Parted(Frame.of(program.jaxpr, lanes, name), program, shared).module()


class _Step:
    """The body of a loop, case by case."""

    def __init__(self, emitter: Emitter, program):
        self.e, self.b, self.program = emitter, emitter.b, program

    def masks(self, inputs: list, mask) -> list:
        """Emit one mask per case; the first case is that of flags that are all true."""
        return self._masks(self.program, inputs, mask)

    def done(self, inputs: list, mask, number: int) -> list:
        """Emit one case of a step, for lanes that are all in it, and return the new state."""
        return self._done(self.program, inputs, mask, number)

    def _before(self, program, inputs: list, mask) -> tuple[dict, list, Any, Any]:
        """Emit a step up to its last condition; return the values, and the condition's operands, flag and equation."""
        found = _condition(program)
        assert found is not None  # the callers handle a single case
        before, condition = found
        used = dict.fromkeys(v for v in [*condition.invars, *program.jaxpr.outvars] if not hasattr(v, "val"))
        own = [v for v in used if v not in condition.outvars]
        part = part_of(program, before, own)
        values = dict(zip(program.jaxpr.invars, inputs))
        values.update(zip(own, self.e.run(part.program, [values[v] for v in part.inputs], mask)))

        def read(atom):
            return self.e.known(atom.val, atom.aval.dtype) if hasattr(atom, "val") else values[atom]

        flag, *operands = map(read, condition.invars)
        if flag.type.element != ir.IntType(1):
            flag = self.b.icmp_signed("!=", flag, self.e.constant_of(0, flag.type))
        return values, operands, flag, condition

    def _masks(self, program, inputs: list, mask) -> list:
        if _condition(program) is None:
            return [mask]
        _, operands, flag, condition = self._before(program, inputs, mask)
        no, yes = condition.params["branches"]
        others = self.b.and_(mask, self.b.not_(flag))
        return self._masks(yes, operands, self.b.and_(mask, flag)) + self._masks(no, operands, others)

    def _done(self, program, inputs: list, mask, number: int) -> list:
        if _condition(program) is None:
            return self.e.run(program, inputs, mask)
        values, operands, _, condition = self._before(program, inputs, mask)
        no, yes = condition.params["branches"]
        skipped = _cases(yes)
        branch, number = (yes, number) if number < skipped else (no, number - skipped)
        values.update(zip(condition.outvars, self._done(branch, operands, mask, number)))
        outputs = program.jaxpr.outvars
        return [self.e.known(v.val, v.aval.dtype) if hasattr(v, "val") else values[v] for v in outputs]


class _Parted(Refilled):
    """A loop with more points in progress than a vector has lanes."""

    def __init__(self, frame: Frame, program, shared: list[bool]):
        # One more group of slots takes the results of lanes without a point.
        super().__init__(frame, program, shared, slots=(_GROUPS + 1) * frame.e.lanes)
        b, lanes = self.b, self.e.lanes
        program = self.equation.params["body_jaxpr"]
        self.step = _Step(self.e, program)
        self.last = _I64(_GROUPS * lanes)
        self.waiting = self._room(_I8)  # flags: the slot is in a list
        self.lists = [self._room(_I64) for _ in range(1, _cases(program))]
        self.counts = [b.alloca(_I64) for _ in self.lists]
        self.group, self.idle = b.alloca(_I64), b.alloca(_I64)
        # As many groups as this thread's share of the points fills.
        threads = b.sext(b.load(b.gep(frame.sizes, [_I32(2)])), _I64)
        share = b.sdiv(frame.count, b.select(b.icmp_signed(">", threads, _I64(0)), threads, _I64(1)))
        full = b.add(b.sdiv(share, _I64(lanes)), _I64(1))
        self.groups, self.top = b.alloca(_I64), b.alloca(_I64)  # groups in use; the last slot with a point
        groups = b.select(b.icmp_signed("<", full, _I64(_GROUPS)), full, _I64(_GROUPS))
        b.store(groups, self.groups)
        b.store(b.sub(b.mul(groups, _I64(lanes)), _I64(1)), self.top)

    def _operands(self, consts: list, state: list) -> tuple[list, list]:
        """Return the operands of the loop's condition and of its body."""
        count = self.equation.params["cond_nconsts"]
        return consts[:count] + state, consts[count:] + state

    def module(self) -> ir.Module:
        """Emit the function and return its module."""
        b, e = self.b, self.e
        self._each_lane(self._clear, count=_I64(self.slots))
        for count in [*self.counts, self.group, self.idle]:
            b.store(_I64(0), count)
        e.before.append(b.basic_block)
        visit, choose, end = (b.append_basic_block(name) for name in ("visit", "choose", "end"))
        b.branch(visit)
        b.position_at_end(visit)
        self._visit()
        b.branch(choose)
        b.position_at_end(choose)
        self._choose(visit, choose, end)
        b.position_at_end(end)
        b.ret_void()
        return self.f.module

    def _clear(self, lane) -> None:
        super()._clear(lane)
        self.b.store(_I8(0), self.b.gep(self.waiting, [lane]))
        self.b.store(_I8(0), self.b.gep(self.active, [lane]))

    def _closed_up(self, lane) -> None:
        """Emit: when no new points remain, an empty slot takes the point of the last one, so that fewer groups run."""
        b = self.b
        flags = self.active, self.ready, self.waiting

        def is_set(room, slot):
            return b.icmp_signed("!=", b.load(b.gep(room, [slot])), _I8(0))

        with b.if_then(b.not_(is_set(self.active, lane))):
            before, head, after = b.basic_block, b.append_basic_block("last"), b.append_basic_block("found")
            top = b.load(self.top)
            b.branch(head)
            b.position_at_end(head)
            last = b.phi(_I64)
            lower = b.sub(last, _I64(1))
            last.add_incoming(top, before)
            last.add_incoming(lower, head)
            b.cbranch(b.and_(b.icmp_signed(">", last, lane), b.not_(is_set(self.active, last))), head, after)
            b.position_at_end(after)
            b.store(last, self.top)
            free = b.and_(b.icmp_signed(">", last, lane), b.not_(is_set(self.waiting, last)))
            with b.if_then(free):
                rooms = [room for *_, room in self.own + self.changing]
                for room in [*rooms, self.point, *flags]:
                    b.store(b.load(b.gep(room, [last])), b.gep(room, [lane]))
                b.store(_I8(0), b.gep(self.active, [last]))
                b.store(_I8(0), b.gep(self.ready, [last]))

    def _visit(self) -> None:
        """Emit a group's turn: take new points, advance by the first case, list the lanes in other cases."""
        b, e, f = self.b, self.e, self.f
        group = b.load(self.group)
        first = b.mul(group, _I64(e.lanes))
        self._each_of(f.load(self.ready, first), self._exchange, first)
        with b.if_then(b.icmp_signed(">=", b.load_atomic(f.next, "monotonic", 8), f.count)):
            self._each_lane(self._closed_up, first)
            b.store(b.add(b.sdiv(b.load(self.top), _I64(e.lanes)), _I64(1)), self.groups)
        # Only after slots are closed up: a turn of a group that is no longer in use would count as idle.
        following = b.add(group, _I64(1))
        b.store(b.select(b.icmp_signed("<", following, b.load(self.groups)), following, _I64(0)), self.group)

        def take(room):
            value = f.load(room, first)
            remember([value], 1)
            return value

        active, waiting, consts = take(self.active), take(self.waiting), self._consts(take)
        active = b.and_(active, b.not_(waiting))
        changed, going, masks, turns = self._glide(consts, self._state(take), active)
        for value, (_, _, room) in zip(changed, self.changing, strict=True):
            if value is not None:
                f.store(value, room, first)
        ready = b.and_(active, b.not_(going))
        f.store(ready, self.ready, first)
        f.store(b.or_(waiting, self._listed(masks[1:], first)), self.waiting, first)
        moved = b.or_(b.icmp_signed(">", turns, _I64(0)), e.any(ready))
        b.store(b.select(moved, _I64(0), b.add(b.load(self.idle), _I64(1))), self.idle)

    def _glide(self, consts: list, carry: list, active) -> tuple:
        """Emit a loop of the first case, as long as most unfinished lanes are in it.

        Return the state (None where the case keeps a value), the mask of unfinished lanes, the masks of the cases, and
        the number of iterations.
        """
        b, e = self.b, self.e
        before, firsts = b.basic_block, flat(carry)
        head, inside, after = (b.append_basic_block(name) for name in ("head", "glide", "after"))
        b.branch(head)
        b.position_at_end(head)
        phis, turns = [b.phi(x.type) for x in firsts], b.phi(_I64)
        state = like(carry, phis)
        e.before.append(before)
        remember(phis, len(e.before))
        of_condition, of_body = self._operands(consts, state)
        (going,) = e.run(self.equation.params["cond_jaxpr"], of_condition, active)
        going = b.and_(going, active)
        masks = self.step.masks(of_body, going)
        here, all_ = self._number(masks[0]), self._number(going)
        enough = b.icmp_unsigned(">=", b.mul(here, _I32(100)), b.mul(all_, _I32(round(100 * _ENOUGH))))
        goes = b.or_(enough, b.icmp_signed("==", turns, _I64(0)))
        b.cbranch(b.and_(goes, b.icmp_unsigned(">", here, _I32(0))), inside, after)
        b.position_at_end(inside)
        changed = flat(self.step.done(of_body, masks[0], 0))
        kept = [phi if new is phi else b.select(masks[0], new, phi) for new, phi in zip(changed, phis)]
        for phi, first, later in zip([*phis, turns], [*firsts, _I64(0)], [*kept, b.add(turns, _I64(1))]):
            phi.add_incoming(first, before)
            phi.add_incoming(later, b.basic_block)
        b.branch(head)
        b.position_at_end(after)
        e.before.pop()
        found = [None if new is phi else phi for new, phi in zip(changed, phis)]
        return found, going, masks, turns

    def _number(self, mask):
        """Emit the number of lanes that are set in a mask."""
        bits = ir.IntType(self.e.lanes)
        module = self.b.module
        name = f"llvm.ctpop.i{self.e.lanes}"
        count = module.globals.get(name) or ir.Function(module, ir.FunctionType(bits, [bits]), name)
        return self.b.zext(self.b.call(count, [self.b.bitcast(mask, bits)]), _I32)

    def _listed(self, masks: list, first):
        """Emit: append the lanes of each case to its list; return the mask of all these lanes."""
        b = self.b
        for mask, places, count in zip(masks, self.lists, self.counts, strict=True):

            def put(slot, places=places, count=count):
                number = b.load(count)
                b.store(slot, b.gep(places, [number]))
                b.store(b.add(number, _I64(1)), count)

            self._each_of(mask, put, first)
        total = masks[0]
        for mask in masks[1:]:
            total = b.or_(total, mask)
        return total

    def _choose(self, visit, choose, end) -> None:
        """Emit the choice of the next work: a case whose list fills a vector, or else the next group.

        When all groups are idle, a case runs for any number of waiting points; with none, the loop ends.
        """
        b, e = self.b, self.e
        stuck = b.icmp_signed(">=", b.load(self.idle), b.load(self.groups))
        for number, count in enumerate(self.counts, 1):
            waiting = b.load(count)
            least = b.select(stuck, _I64(1), _I64(e.lanes))
            inside, other = b.append_basic_block(f"case_{number}"), b.append_basic_block("other")
            b.cbranch(b.icmp_signed(">=", waiting, least), inside, other)
            b.position_at_end(inside)
            self._together(number)
            b.store(_I64(0), self.idle)
            b.branch(choose)
            b.position_at_end(other)
        b.cbranch(stuck, end, visit)

    def _together(self, number: int) -> None:
        """Emit one step for points of many groups that wait for the same case."""
        b, e, f = self.b, self.e, self.f
        places, count = self.lists[number - 1], self.counts[number - 1]
        listed, lanes = b.load(count), _I64(e.lanes)
        few = b.icmp_signed("<", listed, lanes)
        left = b.select(few, _I64(0), b.sub(listed, lanes))
        b.store(left, count)
        kind = ir.VectorType(_I64, e.lanes)
        mask = b.icmp_signed("<", ir.Constant(kind, [_I64(i) for i in range(e.lanes)]), e.splat(listed))
        # Lanes beyond the end of the list repeat its first point, and their results go to an unused slot.
        slots = b.select(mask, b.load(f.vector(places, _I64(0)), align=8), e.splat(b.load(places)))
        # The rest of the list moves to its front; no list is longer than two vectors.
        b.store(b.load(f.vector(places, lanes), align=8), f.vector(places, _I64(0)), align=8)
        targets = b.select(mask, slots, e.splat(self.last))
        froms, tos = ([e.lane(x, i) for i in range(e.lanes)] for x in (slots, targets))

        def take(room):
            value = f.as_flag(room, e.gather([b.load(b.gep(room, [slot])) for slot in froms]))
            remember([value], 1)
            return value

        consts, carry = self._consts(take), self._state(take)
        results = flat(self.step.done(self._operands(consts, carry)[1], mask, number))
        for old, value, (_, _, room) in zip(flat(carry), results, self.changing, strict=True):
            if value is not old:
                self._put(value, room, tos)
        for slot in tos:
            b.store(_I8(0), b.gep(self.waiting, [slot]))

    def _put(self, value, room, slots: list) -> None:
        """Emit stores of the numbers of all lanes in their slots."""
        b = self.b
        if room.type.pointee == _I8:
            value = b.zext(value, ir.VectorType(_I8, self.e.lanes))
        for i, slot in enumerate(slots):
            b.store(self.e.lane(value, i), b.gep(room, [slot]))
