"""Assembles a Pallas kernel of one warp a block into PTX, NVIDIA's portable assembly language.

Pallas' own GPU compilers take minutes for a kernel of thousands of scalars; this kernel needs
nothing of them: a value over the lanes is one register of each thread, and every operation one
instruction.  The driver's assembler allocates registers and fuses multiplications with additions.
Source of the instructions: NVIDIA, Parallel Thread Execution ISA 8.
"""

import struct
from collections.abc import Collection
from typing import Any, NamedTuple

import jax
import numpy as np

from codesign_jax.compiler.ptx_rules import LANES, RULES, Value, kind_of
from codesign_jax.compiler.walker import Walker

HEADER = ".version 7.8\n.target sm_80\n.address_size 64\n"
AHEAD = 600
"""Lines of a loop between asking for a row and reading it, about the time that memory takes."""
LAUNCH = f".maxntid {LANES}, 1, 1\n"


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


def immediate(kind: str, number: Any) -> str:
    """A number as an operand."""
    if kind == "f32":
        return "0f" + struct.pack(">f", np.float32(number)).hex().upper()
    return str(int(number))


class Assembler(Walker):
    """Writes the instructions of one kernel."""

    language = "PTX"
    rules = RULES

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

    def fma(self, a: Value, b: Value, c: Value) -> Value:
        """See `Walker`."""
        return self.compute("f32", "fma.rn.f32", a, b, c)

    def nearest(self, x: Value) -> Value:
        """See `Walker`."""
        return self.compute("f32", "cvt.rni.f32.f32", x)

    def whole(self, x: Value) -> Value:
        """See `Walker`."""
        return self.compute("s32", "cvt.rzi.s32.f32", x)

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
        offset = 0
        parts: list[tuple[str, int]] = []
        for index, stride in zip(indices, strides, strict=True):
            offset += 4 * int(stride) * int(index.number)
            if index.name is not None:
                parts.append((index.name, 4 * int(stride)))
        address = ref.address
        for name, stride in parts:
            key = ("at", address, name, stride)
            found = next((s[key] for s in self.known if key in s), None)
            if found is None:
                place, wide = self.register("u64"), self.register("u64")
                self.emit(f"mul.wide.s32 {wide}, {name}, {stride};")
                self.emit(f"add.u64 {place}, {address}, {wide};")
                self.known[-1][key] = found = Value("u64", place)
                grown = self.growth.get(address, 0) + stride * self.growth.get(name, 0)
                self.growth[place], self.born[place] = grown, len(self.lines)
            assert found.name is not None
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


def assemble(
    jaxpr: Any, shapes: list[tuple[int, ...]], name: str, shared: Collection[int] = ()
) -> str:
    """PTX of a kernel whose block b works on entry b of every array.

    Args:
      jaxpr: The kernel's jaxpr; its arguments are references to a block of each array.
      shapes: Shapes of the blocks.
      name: Name of the kernel.
      shared: Places of arrays of one block, which all blocks read.

    Raises:
      NotImplementedError: If the kernel does something that has no rule here.
    """
    asm, refs = Assembler(), []
    for k, shape in enumerate(shapes):
        address = asm.register("u64")
        asm.emit(f"ld.param.u64 {address}, [arg{k}];")
        asm.emit(f"cvta.to.global.u64 {address}, {address};")
        if k not in shared:
            offset = asm.register("u64")
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
