"""Assembles a Pallas kernel of one warp a block into PTX, NVIDIA's portable assembly language.

Pallas' own GPU compilers take minutes for a kernel of thousands of scalars; this kernel needs
nothing of them: a value over the lanes is one register of each thread, and every operation one
instruction.  The driver's assembler allocates registers and fuses multiplications with additions.
Source of the instructions: NVIDIA, Parallel Thread Execution ISA 8.
"""

import struct
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from codesign_jax.engines.structured.fused.walk import (
    COMPARE,
    COSINE,
    SINE,
    Walker,
    quarter_turn_parts,
    swapped_lanes,
)

HEADER = ".version 7.8\n.target sm_80\n.address_size 64\n"
LANES = 32
AHEAD = 600
"""Lines of a loop between asking for a row and reading it, about the time that memory takes."""
LAUNCH = f".maxntid {LANES}, 1, 1\n"


class Value(NamedTuple):
    """A register or number of each thread.

    Attributes:
      kind: "f32", "s32" or "pred".
      name: Register, or None for a number.
      number: The number, or what is to be added to the register (s32).
    """

    kind: str
    name: str | None
    number: Any = 0


class Ref(NamedTuple):
    """Memory of a block: register with its address, and its shape."""

    address: str
    shape: tuple[int, ...]


class Ahead(NamedTuple):
    """Rows that a loop reads at an address, and reads again further on in the next round.

    Attributes:
      line: Line after which the address is known.
      offsets: Offsets of the rows from the address [bytes].
    """

    line: int
    offsets: list[int]


def kind_of(aval: Any) -> str:
    """Type of registers for an array."""
    if aval.dtype == np.bool_:
        return "pred"
    return "s32" if np.issubdtype(aval.dtype, np.integer) else "f32"


def immediate(kind: str, number: Any) -> str:
    """A number as an operand."""
    if kind == "f32":
        return "0f" + struct.pack(">f", np.float32(number)).hex().upper()
    return str(int(number))


class Assembler(Walker):
    """Writes the instructions of one kernel."""

    language = "PTX"

    def __init__(self) -> None:
        """Starts empty."""
        self.lines: list[str] = []
        self.counts: dict[str, int] = {}
        self.known: list[dict[tuple, Value]] = [{}]  # one scope a region: computed already
        self.spans: set[int] = set()  # numbers of rows that are asked for at once
        self.growth: dict[str, int] = {}  # of registers, in each round of the loop they are in
        self.born: dict[str, int] = {}  # line after an address
        self.ahead: list[dict[str, Ahead]] = []  # one a loop: its reads, by address register

    def register(self, kind: str) -> str:
        """A new register."""
        prefix = {"f32": "f", "s32": "r", "pred": "p", "u64": "d"}[kind]
        self.counts[prefix] = self.counts.get(prefix, -1) + 1
        return f"%{prefix}{self.counts[prefix]}"

    def label(self) -> str:
        """A new label."""
        self.counts["L"] = self.counts.get("L", -1) + 1
        return f"L{self.counts['L']}"

    def emit(self, line: str) -> None:
        """Adds an instruction."""
        self.lines.append(line)

    def operand(self, value: Value) -> str:
        """Operand of an instruction."""
        if value.name is None:
            if value.kind == "pred":
                name = self.register("pred")
                self.emit(f"setp.{'eq' if value.number else 'ne'}.s32 {name}, 0, 0;")
                return name
            return immediate(value.kind, value.number)
        if value.kind == "s32" and value.number:
            return self.compute("s32", "add.s32", value._replace(number=0), value.number).name  # type: ignore[return-value]
        return value.name

    def compute(self, kind: str, operation: str, *args: Any) -> Value:
        """The result of an instruction; the same one is not written twice."""
        values = [a if isinstance(a, Value) else Value("s32", None, a) for a in args]
        key = (operation, *values)
        for scope in self.known:
            if key in scope:
                return scope[key]
        operands = [self.operand(v) for v in values]
        result = Value(kind, self.register(kind))
        self.emit(f"{operation} {', '.join([result.name, *operands])};")  # type: ignore[list-item]
        self.known[-1][key] = result
        return result

    def move(self, target: str, value: Value) -> None:
        """Copies into a register."""
        if value.kind == "pred":
            self.emit(f"mov.pred {target}, {self.operand(value)};")
        else:
            self.emit(f"mov.b32 {target}, {self.operand(value)};")

    # Memory

    def pointer(self, ref: Ref, indices: list[Value]) -> str:
        """Operand [register + offset] of an element, its index in each dimension given."""
        strides = np.cumprod([1, *ref.shape[:0:-1]])[::-1]
        offset, parts = 0, []
        for index, stride in zip(indices, strides, strict=True):
            offset += 4 * int(stride) * int(index.number)
            if index.name is not None:
                parts.append((index.name, 4 * int(stride)))
        address = ref.address
        for name, stride in parts:
            key = ("at", address, name, stride)
            found = next((s[key] for s in self.known if key in s), None)
            if found is None:
                found = Value("u64", self.register("u64"))
                wide = self.register("u64")
                self.emit(f"mul.wide.s32 {wide}, {name}, {stride};")
                self.emit(f"add.u64 {found.name}, {address}, {wide};")
                self.known[-1][key] = found
                grown = self.growth.get(address, 0) + stride * self.growth.get(name, 0)
                self.growth[found.name] = grown
                self.born[found.name] = len(self.lines)
            address = found.name
        return f"[{address}+{offset}]" if offset >= 0 else f"[{address}{offset}]"

    def indices(self, ref: Ref, equation: Any, leaves: list[Value]) -> list[Value]:
        """Index in each dimension; a whole slice is the lane."""
        (indexer,) = jax.tree.unflatten(equation.params["tree"], leaves)
        found = []
        for index, size in zip(indexer.indices, ref.shape, strict=True):
            if isinstance(index, Value):
                found.append(index)
            elif isinstance(index, int | np.integer):
                found.append(Value("s32", None, int(index)))
            else:  # a slice
                assert index.size == size == LANES, (index, size)
                found.append(Value("s32", "%lane"))
        return found

    # Control

    def region(self, jaxpr: Any, consts: Any, args: list) -> list:
        """Instructions of a region that may be skipped or repeated."""
        self.known.append({})
        results = self.run(jaxpr, consts, args)
        self.known.pop()
        return results

    def carry(self, values: list[Value]) -> list[Value]:
        """Registers that a loop changes, with their first values."""
        registers = []
        for value in values:
            name = self.register(value.kind)
            self.move(name, value)
            registers.append(Value(value.kind, name))
        return registers

    def update(self, registers: list[Value], values: list[Value]) -> None:
        """Assigns all at once: a new value may be another register's old one."""
        olds = {r.name for r in registers}
        new = []
        for register, value in zip(registers, values, strict=True):
            if value.name in olds and value.name != register.name:
                copy = self.register(value.kind)
                self.move(copy, value)
                value = Value(value.kind, copy)
            new.append(value)
        for register, value in zip(registers, new, strict=True):
            if register != value:
                self.move(register.name, value)  # type: ignore[arg-type]

    def loop(self, equation: Any, args: list) -> list:
        """A scan without inputs and outputs: a loop of fixed length."""
        p = equation.params
        split = len(args) - len(equation.outvars)  # every result is carried
        consts, start = args[:split], args[split:]
        assert not p["reverse"]
        registers = self.carry(start)
        count = self.carry([Value("s32", None, 0)])[0]
        label = self.label()
        self.emit(f"{label}:")
        inner = p["jaxpr"]
        self.ahead.append({})
        first = len(self.lines)
        self.growth |= {registers[k].name: 1 for k in counters(inner.jaxpr, split)}  # type: ignore[misc]
        new = self.region(inner.jaxpr, inner.consts, [*consts, *registers])
        self.prefetch(self.ahead.pop(), first)
        self.update(registers, new)
        self.emit(f"add.s32 {count.name}, {count.name}, 1;")
        going = self.register("pred")
        self.emit(f"setp.lt.s32 {going}, {count.name}, {p['length']};")
        self.emit(f"@{going} bra.uni {label};")
        return registers

    def prefetch(self, reads: dict[str, Ahead], first: int) -> None:
        """Asks for the rows of later rounds of a loop as soon as their addresses are known.

        Without it every round waits for memory: a kernel of this size leaves room for two warps on
        a scheduler, which cannot hide it.

        Args:
          reads: What the loop reads.
          first: Line where its body begins.
        """
        rounds = -(-AHEAD // (len(self.lines) - first))
        for address, (line, offsets) in sorted(reads.items(), key=lambda r: -r[1].line):
            before, self.lines = self.lines, []
            for offset, rows in adjacent(sorted(set(offsets)), 4 * LANES):
                place = self.spread(address, rows)
                self.emit(f"prefetch.global.L1 [{place}+{offset + rounds * self.growth[address]}];")
            before[line:line] = self.lines
            self.lines = before

    def spread(self, address: str, rows: int) -> str:
        """Address of a row for each lane, from a lane's place in the first one of them."""
        if rows == 1:
            return address
        self.spans.add(rows)
        place = self.register("u64")
        self.emit(f"add.u64 {place}, {address}, %span{rows};")
        return place

    def while_loop(self, equation: Any, args: list) -> list:
        """A while loop; its condition is the same on all lanes."""
        p = equation.params
        a, b = p["cond_nconsts"], p["body_nconsts"]
        cond_consts, body_consts, start = args[:a], args[a : a + b], args[a + b :]
        registers = self.carry(start)
        top, end = self.label(), self.label()
        self.emit(f"{top}:")
        cond, body = p["cond_jaxpr"], p["body_jaxpr"]
        (going,) = self.region(cond.jaxpr, cond.consts, [*cond_consts, *registers])
        self.emit(f"@!{self.operand(going)} bra.uni {end};")
        new = self.region(body.jaxpr, body.consts, [*body_consts, *registers])
        self.update(registers, new)
        self.emit(f"bra.uni {top};")
        self.emit(f"{end}:")
        return registers

    def branch(self, equation: Any, args: list) -> list:
        """A conditional of two branches; its predicate is the same on all lanes."""
        index, operands = args[0], args[1:]
        no, yes = equation.params["branches"]
        which = index
        if index.kind != "pred":
            which = self.compute("pred", "setp.ne.s32", index, 0)
        results = [Value(kind_of(v.aval), self.register(kind_of(v.aval))) for v in equation.outvars]
        other, end = self.label(), self.label()
        self.emit(f"@!{self.operand(which)} bra.uni {other};")
        for branch, label in ((yes, other), (no, end)):
            values = self.region(branch.jaxpr, branch.consts, operands)
            for result, value in zip(results, values, strict=True):
                self.move(result.name, value)  # type: ignore[arg-type]
            if branch is yes:
                self.emit(f"bra.uni {end};")
            self.emit(f"{label}:")
        return results

    # What a walk asks for

    def constant(self, array: np.ndarray) -> Value:
        """See `Walker`."""
        return Value(kind_of(array), None, array[()])

    def same(self, equation: Any, value: Value) -> Value:
        """See `Walker`; a register has no shape."""
        return value

    def get(self, equation: Any, ref: Ref, leaves: list[Value]) -> Value:
        """See `Walker`."""
        at = self.pointer(ref, self.indices(ref, equation, leaves))
        result = Value("f32", self.register("f32"))
        self.emit(f"ld.global.f32 {result.name}, {at};")
        if ref.shape[-1] == LANES:
            self.read_ahead(at)
        return result

    def read_ahead(self, at: str) -> None:
        """Notes a read that the next round of a loop repeats further on."""
        address, _, offset = at[1:-1].partition("+")
        if self.ahead and self.growth.get(address) and offset:
            here = self.ahead[-1].setdefault(address, Ahead(self.born[address], []))
            here.offsets.append(int(offset))

    def swap(self, equation: Any, ref: Ref, value: Value, leaves: list[Value]) -> None:
        """See `Walker`."""
        at = self.pointer(ref, self.indices(ref, equation, leaves))
        self.emit(f"st.global.f32 {at}, {self.operand(value)};")


def _same_kind(name: str) -> Callable:
    def rule(asm: Assembler, equation: Any, *args: Value) -> Value:
        kind = args[0].kind
        return asm.compute(kind, f"{name}.{kind}", *args)

    return rule


def _add(asm: Assembler, equation: Any, a: Value, b: Value) -> Value:
    if a.kind == "s32" and (a.name is None or b.name is None):
        return Value("s32", a.name or b.name, int(a.number) + int(b.number))
    return asm.compute(a.kind, f"add.{a.kind}", a, b)


def _sub(asm: Assembler, equation: Any, a: Value, b: Value) -> Value:
    if a.kind == "s32" and b.name is None:
        return a._replace(number=int(a.number) - int(b.number))
    result = asm.compute(a.kind, f"sub.{a.kind}", a, b)
    if a.name is None and b.name in asm.growth:
        asm.growth[result.name] = -asm.growth[b.name]  # type: ignore[index]
    return result


def _mul(asm: Assembler, equation: Any, a: Value, b: Value) -> Value:
    if a.kind == "s32":
        if a.name is None and b.name is None:
            return Value("s32", None, int(a.number) * int(b.number))
        for x, y in ((a, b), (b, a)):
            if y.name is None and y.number == 1:
                return x
        result = asm.compute("s32", "mul.lo.s32", a, b)
        for x, y in ((a, b), (b, a)):
            if x.name in asm.growth and y.name is None:
                asm.growth[result.name] = asm.growth[x.name] * int(y.number)  # type: ignore[index]
        return result
    return asm.compute("f32", "mul.f32", a, b)


def _div(asm: Assembler, equation: Any, a: Value, b: Value) -> Value:
    return asm.compute(a.kind, "div.full.f32" if a.kind == "f32" else "div.s32", a, b)


def _compare(name: str) -> Callable:
    def rule(asm: Assembler, equation: Any, a: Value, b: Value) -> Value:
        if a.kind == "pred":
            different = asm.compute("pred", "xor.pred", a, b)
            return different if name == "ne" else asm.compute("pred", "not.pred", different)
        # A comparison with what is not a number is false, but "not equal" is true.
        test = "neu" if name == "ne" and a.kind == "f32" else name
        if a.name is None and b.name is not None:
            a, b = b, a
            test = {"lt": "gt", "gt": "lt", "le": "ge", "ge": "le"}.get(test, test)
        return asm.compute("pred", f"setp.{test}.{a.kind}", a, b)

    return rule


def _logic(name: str) -> Callable:
    def rule(asm: Assembler, equation: Any, *args: Value) -> Value:
        if args[0].kind != "pred":
            return asm.compute("s32", f"{name}.b32", *args)
        return asm.compute("pred", f"{name}.pred", *args)

    return rule


def _select(asm: Assembler, equation: Any, which: Value, no: Value, yes: Value) -> Value:
    if no.kind == "pred":
        first = asm.compute("pred", "and.pred", which, yes)
        negated = asm.compute("pred", "not.pred", which)
        second = asm.compute("pred", "and.pred", negated, no)
        return asm.compute("pred", "or.pred", first, second)
    return asm.compute(no.kind, f"selp.{no.kind}", yes, no, which)


def _convert(asm: Assembler, equation: Any, x: Value) -> Value:
    kind = kind_of(equation.outvars[0].aval)
    if kind == x.kind:
        return x
    if x.name is None:
        return Value(kind, None, x.number)
    if x.kind == "pred":
        return asm.compute(kind, f"selp.{kind}", Value(kind, None, 1), Value(kind, None, 0), x)
    if kind == "pred":
        return asm.compute("pred", f"setp.ne.{x.kind}", x, Value(x.kind, None, 0))
    return asm.compute(kind, "cvt.rn.f32.s32" if kind == "f32" else "cvt.rzi.s32.f32", x)


def _power(asm: Assembler, equation: Any, x: Value) -> Value:
    result = x
    for _ in range(abs(equation.params["y"]) - 1):
        result = asm.compute("f32", "mul.f32", result, x)
    if equation.params["y"] < 0:
        result = asm.compute("f32", "div.full.f32", Value("f32", None, 1.0), result)
    return result


def _number(value: float) -> Value:
    return Value("f32", None, value)


def _turn(asm: Assembler, x: Value) -> tuple[Value, Value]:
    """Quarter turns of an angle and what is left, within pi / 4 (Cody and Waite's reduction)."""
    scaled = asm.compute("f32", "mul.f32", x, _number(2 / np.pi))
    turns = asm.compute("f32", "cvt.rni.f32.f32", scaled)
    rest = x
    for part in quarter_turn_parts():
        rest = asm.compute("f32", "fma.rn.f32", turns, _number(-part), rest)
    return asm.compute("s32", "cvt.rzi.s32.f32", turns), rest


def _polynomial(asm: Assembler, x: Value, coefficients: tuple[float, ...]) -> Value:
    result = _number(coefficients[0])
    for c in coefficients[1:]:
        result = asm.compute("f32", "fma.rn.f32", result, x, _number(c))
    return result


def _sine(shift: int) -> Callable:
    """Sine, or with a shift of one quarter turn cosine, by Taylor's polynomials to 1e-8."""

    def rule(asm: Assembler, equation: Any, x: Value) -> Value:
        turns, r = _turn(asm, x)
        square = asm.compute("f32", "mul.f32", r, r)
        odd = _polynomial(asm, square, SINE)
        sine = asm.compute("f32", "mul.f32", odd, r)
        cosine = _polynomial(asm, square, COSINE)
        quarter = asm.compute("s32", "add.s32", turns, shift)
        low = asm.compute("s32", "and.b32", quarter, 1)
        swapped = asm.compute("pred", "setp.ne.s32", low, 0)
        value = asm.compute("f32", "selp.f32", cosine, sine, swapped)
        high = asm.compute("s32", "and.b32", quarter, 2)
        flipped = asm.compute("pred", "setp.ne.s32", high, 0)
        negative = asm.compute("f32", "neg.f32", value)
        return asm.compute("f32", "selp.f32", negative, value, flipped)

    return rule


def _sign(asm: Assembler, equation: Any, x: Value) -> Value:
    below = asm.compute("pred", "setp.lt.f32", x, _number(0))
    above = asm.compute("pred", "setp.gt.f32", x, _number(0))
    up = asm.compute("f32", "selp.f32", _number(1), _number(0), above)
    return asm.compute("f32", "selp.f32", _number(-1), up, below)


def _lane(asm: Assembler, equation: Any, *args: Value) -> Value:
    return Value("s32", "%lane")


def _reverse(asm: Assembler, equation: Any, x: Value) -> Value:
    lanes = swapped_lanes(equation.invars[0].aval.shape, equation.params["dimensions"])
    mask = int(lanes[0])
    assert (lanes == np.arange(LANES) ^ mask).all(), "lanes that do not swap in pairs"
    if x.name is None:
        return x
    result = Value(x.kind, asm.register(x.kind))
    asm.emit(f"shfl.sync.bfly.b32 {result.name}, {x.name}, {mask}, 31, 0xffffffff;")
    return result


def _over_lanes(asm: Assembler, equation: Any, x: Value) -> Value:
    # Never remembered: a loop's condition is computed anew.
    result = Value("s32", asm.register("s32"))
    asm.emit(f"redux.sync.max.s32 {result.name}, {asm.operand(x)}, 0xffffffff;")
    return result


Assembler.rules = {
    "add": _add,
    "add_any": _add,
    "sub": _sub,
    "mul": _mul,
    "div": _div,
    "neg": _same_kind("neg"),
    "abs": _same_kind("abs"),
    "max": _same_kind("max"),
    "min": _same_kind("min"),
    "rem": _same_kind("rem"),
    "sqrt": lambda asm, e, x: asm.compute("f32", "sqrt.approx.f32", x),
    "rsqrt": lambda asm, e, x: asm.compute("f32", "rsqrt.approx.f32", x),
    "square": lambda asm, e, x: asm.compute("f32", "mul.f32", x, x),
    "integer_pow": _power,
    "sin": _sine(0),
    "cos": _sine(1),
    "sign": _sign,
    **{name: _compare(name) for name in COMPARE},
    "and": _logic("and"),
    "or": _logic("or"),
    "xor": _logic("xor"),
    "not": _logic("not"),
    "select_n": _select,
    "convert_element_type": _convert,
    "iota": _lane,
    "rev": _reverse,
    "reduce_max": _over_lanes,
}


def counters(jaxpr: Any, consts: int) -> list[int]:
    """Which of a loop's carried values grow by one in every round."""
    found = []
    carried = jaxpr.invars[consts:]
    for k, (before, after) in enumerate(zip(carried, jaxpr.outvars, strict=True)):
        for e in jaxpr.eqns:
            if e.primitive.name == "add" and e.outvars[0] is after and e.invars[0] is before:
                found.append(k)
    return found


def adjacent(offsets: list[int], row: int) -> list[tuple[int, int]]:
    """Rows that follow each other: first offset and number, at most as many as lanes."""
    found: list[tuple[int, int]] = []
    for offset in offsets:
        if found and offset == found[-1][0] + row * found[-1][1] and found[-1][1] < LANES:
            found[-1] = (found[-1][0], found[-1][1] + 1)
        else:
            found.append((offset, 1))
    return found


def assemble(jaxpr: Any, shapes: list[tuple[int, ...]], name: str) -> str:
    """PTX of a kernel whose block b works on entry b of every array.

    Args:
      jaxpr: The kernel's jaxpr; its arguments are references to a block of each array.
      shapes: Shapes of the blocks.
      name: Name of the kernel.

    Raises:
      NotImplementedError: If the kernel does something that has no rule here.
    """
    asm, refs = Assembler(), []
    for k, shape in enumerate(shapes):
        address, offset = asm.register("u64"), asm.register("u64")
        asm.emit(f"ld.param.u64 {address}, [arg{k}];")
        asm.emit(f"cvta.to.global.u64 {address}, {address};")
        asm.emit(f"mul.wide.u32 {offset}, %block, {4 * int(np.prod(shape))};")
        asm.emit(f"add.u64 {address}, {address}, {offset};")
        refs.append(Ref(address, shape))
    asm.run(jaxpr, [], refs)
    kinds = {"f": ".f32", "r": ".s32", "p": ".pred", "d": ".u64"}
    registers = "".join(
        f".reg {kinds[k]} %{k}<{n + 1}>;\n" for k, n in asm.counts.items() if k in kinds
    )
    params = ", ".join(f".param .u64 arg{k}" for k in range(len(shapes)))
    start = ["mov.u32 %block, %ctaid.x;", "mov.u32 %lane, %tid.x;"]
    for rows in sorted(asm.spans):  # from a lane in the first row to that lane's own row
        n, step = f"%n{rows}", f"%span{rows}"
        start += [
            f".reg .s32 {n}; .reg .s64 {step};",
            f"min.s32 {n}, %lane, {rows - 1};",
            f"mul.lo.s32 {n}, {n}, {LANES};",
            f"sub.s32 {n}, {n}, %lane;",
            f"mul.wide.s32 {step}, {n}, 4;",
        ]
    body = "\n".join([*start, *asm.lines])
    return (
        f"{HEADER}.visible .entry {name}({params})\n{LAUNCH}{{\n"
        f".reg .u32 %block;\n.reg .s32 %lane;\n"
        f"{registers}{body}\nret;\n}}\n"
    )
