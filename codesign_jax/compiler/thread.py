"""A block as one warp of an NVIDIA GPU: a value over the lanes is a scalar of each thread.

A loop asks for rows of memory ahead of their use, and LLVM makes PTX of the whole, which drivers
translate.

Sources: NVIDIA, Parallel Thread Execution ISA 8; LLVM, User Guide for NVPTX.
"""

import re
from typing import Any, NamedTuple

import llvmlite.binding as binding
import numpy as np

from codesign_jax.compiler.values import LLVM_TYPES, ONCHIP, SIZES, Layout, Ref, Value, kind_of
from codesign_jax.compiler.writer import Writer

AHEAD = 300
"""Lines of a loop between asking for a row and reading it, about the time that memory takes."""


class PrefetchedRows(NamedTuple):
    """Rows that a loop reads at an address, and reads again further on in the next round."""

    line: int  # Line behind which the address is known
    offsets: list[int]  # Offsets of the rows from the address [bytes]


def rounds_ahead(lines: int, length: int) -> int:
    """How many rounds ahead of its use a loop of so many lines prefetches a row.

    As many as memory takes, but few against the loop's length: what is asked for in the last rounds
    lies behind the rows that the loop reads.
    """
    return min(-(-AHEAD // max(1, lines)), max(1, length // 5))


def adjacent(offsets: list[int], row: int, lanes: int) -> list[tuple[int, int]]:
    """Runs of adjacent rows: first offset and number, at most as many as lanes."""
    runs: list[tuple[int, int]] = []
    for offset in offsets:
        if runs and offset == runs[-1][0] + row * runs[-1][1] and runs[-1][1] < lanes:
            runs[-1] = (runs[-1][0], runs[-1][1] + 1)
        else:
            runs.append((offset, 1))
    return runs


LANES = 32
"""Threads of a warp, of which a block may have the first few."""


class ThreadWriter(Writer):
    """Writes the instructions of a thread."""

    def __init__(self, lanes: int = LANES):
        """Starts empty; the lane is in `%lane`."""
        super().__init__(lanes)
        self.lane = Value("i32", True, "%lane")
        # Mask of the warp's threads that take part, one bit each; LLVM reads i32 as signed.
        self.all = f"i32 {-1 if lanes == LANES else (1 << lanes) - 1}"
        self.growth: dict[str, int] = {}  # of integers [1] and addresses [bytes], in each round
        self.address_lines: dict[str, int] = {}  # line behind an address
        self.computed: list[dict[tuple, Any]] = [{}]  # computed already, one scope a region
        # The loops around: line at which a body begins, rounds, and its reads by address.
        self.loops: list[tuple[int, int, dict[str, PrefetchedRows]]] = []
        self.grouped_loads = (
            False  # between the loads of a group, before which the threads have met
        )
        # Where lanes exchange through memory, whether they have since they last met.
        self.stored = self.loaded = False
        self.spans: set[int] = set()  # numbers of rows that are asked for at once

    def type(self, kind: str, wide: bool) -> str:
        return LLVM_TYPES[kind]

    def lane_index(self) -> Value:
        return self.lane

    def splat(self, value: Value) -> Value:
        """The register stays."""
        if not value.wide and value.text is not None:
            self.scalar_of[value.text] = value._replace(known=0)
        return value._replace(wide=True)

    def swap_lanes(self, value: Value, source: np.ndarray) -> Value:
        """Lanes swap in pairs."""
        mask = int(source[0])
        if len(source) != self.lanes or (source != np.arange(self.lanes) ^ mask).any():
            raise NotImplementedError("a kernel's lanes swap in pairs whose indices differ by bits")
        if value.kind in ("f32", "i32"):
            return self._swap(value, mask)
        if value.kind == "b":
            whole = self._swap(self.convert("zext", value, "i32"), mask)
            return self.compute("icmp ne", whole, self.like(whole, 0), kind="b")
        bits = self.emit(f"bitcast {self.typed(value)} to i64")
        halves = []
        for shift in (0, 32):
            half = self.emit(f"trunc i64 {self.emit(f'lshr i64 {bits}, {shift}')} to i32")
            half = self._swap(Value("i32", True, half), mask)
            half = self.emit(f"zext {self.typed(half)} to i64")
            halves.append(self.emit(f"shl i64 {half}, {shift}"))
        both = self.emit(f"or i64 {halves[0]}, {halves[1]}")
        kind = self.type(value.kind, True)
        return Value(value.kind, True, self.emit(f"bitcast i64 {both} to {kind}"))

    def _swap(self, value: Value, mask: int) -> Value:
        scalar = LLVM_TYPES[value.kind]
        full = f"llvm.nvvm.shfl.sync.bfly.{value.kind}"
        self.declared.add(f"declare {scalar} @{full}(i32, {scalar}, i32, i32)")
        call = f"call {scalar} @{full}({self.all}, {self.typed(value)}, i32 {mask}, i32 31)"
        return Value(value.kind, True, self.emit(call))

    def over_lanes(self, name: str, value: Value) -> Value:
        full = f"llvm.nvvm.redux.sync.{name}"
        self.declared.add(f"declare i32 @{full}(i32, i32)")
        return Value("i32", False, self.emit(f"call i32 @{full}({self.typed(value)}, {self.all})"))

    def compute(self, operation: str, *args: Value, kind: str | None = None) -> Value:
        """No integer is computed twice, so that addresses are known again."""
        if args[0].kind != "i32":
            return super().compute(operation, *args, kind=kind)
        key = (operation, *args)
        return self._once(
            key, lambda: super(ThreadWriter, self).compute(operation, *args, kind=kind)
        )

    def _once(self, key: tuple, make: Any) -> Any:
        """What was made for a key where control has come from, or is made now."""
        for scope in self.computed:
            if key in scope:
                return scope[key]
        self.computed[-1][key] = result = make()
        return result

    # Arithmetic: in float32 what the kernel's tolerance is far above, two units in the last place

    def divide(self, a: Value, b: Value) -> Value:
        if a.kind == "f64":
            return super().divide(a, b)
        # Its error is 2 units in the last place, as that of `div.full`, which takes three more
        # instructions; but the quotient is 0 for divisors beyond 2^126 (PTX ISA).
        self.declared.add("declare float @llvm.nvvm.div.approx.f(float, float)")
        text = self.emit(f"call float @llvm.nvvm.div.approx.f({self.typed(a)}, {self.typed(b)})")
        return Value("f32", a.wide or b.wide, text)

    def square_root(self, x: Value) -> Value:
        return super().square_root(x) if x.kind == "f64" else self._approximate("sqrt", x)

    def inverse_square_root(self, x: Value) -> Value:
        if x.kind == "f64":
            return super().inverse_square_root(x)
        return self._approximate("rsqrt", x)

    def _approximate(self, name: str, x: Value) -> Value:
        full = f"llvm.nvvm.{name}.approx.f"
        self.declared.add(f"declare float @{full}(float)")
        return Value("f32", x.wide, self.emit(f"call float @{full}({self.typed(x)})"))

    # Memory

    def load(self, ref: Ref, indices: list[Value]) -> Value:
        base, offset, place = self._address(ref, indices)
        wide = any(i.wide for i in indices)
        kind = LLVM_TYPES[ref.kind]
        foreign = self._is_foreign(ref, indices)
        if foreign and not self.grouped_loads:
            self._warp_barrier()
        if ref.exchanged:
            if self.stored:
                self._warp_barrier()
            self.loaded = True
        space = f"ptr addrspace({ref.space})"
        text = self.emit(f"load {kind}, {space} {place}, align {SIZES[ref.kind]}")
        if foreign:
            self.grouped_loads = not self.last_of_group
            if self.last_of_group:
                self._warp_barrier()
        if ref.shape[-1] == self.lanes and self.growth.get(base):
            self._read_ahead(base, offset)
        return Value(ref.kind, wide, text)

    def store(self, ref: Ref, indices: list[Value], value: Value) -> None:
        _, _, place = self._address(ref, indices)
        if ref.exchanged:
            if self.loaded:
                self._warp_barrier()
            self.stored = True
        space = f"ptr addrspace({ref.space})"
        self.lines.append(f"store {self.typed(value)}, {space} {place}, align {SIZES[ref.kind]}")

    def _address(self, ref: Ref, indices: list[Value]) -> tuple[str, int, str]:
        """An element's address: a base, the offset from it in bytes, and both together."""
        strides = np.cumprod([1, *ref.shape[:0:-1]])[::-1] * SIZES[ref.kind]
        offset = 0
        base = ref.address
        for index, stride in zip(indices, strides, strict=True):
            offset += int(stride) * int(index.known)
            if not index.is_known:
                base = self._offset_address(base, index, int(stride), ref.space)
        if not offset:
            return base, 0, base
        space = f"ptr addrspace({ref.space})"
        place = self.emit(f"getelementptr inbounds i8, {space} {base}, i64 {offset}")
        return base, offset, place

    def _offset_address(self, base: str, index: Value, stride: int, space: int) -> str:
        key = (base, index.text, stride)
        return self._once(key, lambda: self._new_address(base, index, stride, space))

    def _new_address(self, base: str, index: Value, stride: int, space: int) -> str:
        assert index.text is not None
        wide = index.text
        if index.kind != "i64":
            wide = self.emit(f"sext i32 {index.text} to i64")
        step = self.emit(f"mul nsw i64 {wide}, {stride}")
        pointer = f"ptr addrspace({space}) {base}"
        place = self.emit(f"getelementptr inbounds i8, {pointer}, i64 {step}")
        self.growth[place] = self.growth.get(base, 0) + stride * self.growth.get(index.text, 0)
        self.address_lines[place] = len(self.lines)
        return place

    def branch(self, equation: Any, args: list) -> list:
        """Addresses computed in a branch are unknown after it."""
        return self._scoped(super().branch, equation, args)

    def while_loop(self, equation: Any, args: list) -> list:
        """Addresses computed in a loop are unknown after it."""
        return self._scoped(super().while_loop, equation, args)

    def loop(self, equation: Any, args: list) -> list:
        """Addresses computed in a loop are unknown after it."""
        return self._scoped(super().loop, equation, args)

    def _scoped(self, write: Any, equation: Any, args: list) -> list:
        self.computed.append({})
        results = write(equation, args)
        self.computed.pop()
        return results

    def start(self, label: str) -> None:
        """The two branches of a conditional know nothing of each other."""
        super().start(label)
        self.stored = self.loaded = True
        if len(self.computed) > 1:
            self.computed[-1] = {}

    # Asking for memory ahead

    def note_growth(self, name: str, a: Value, b: Value, result: Value) -> Value:
        """Notes how integers grow from round to round."""
        if result.text is None:
            return result
        grow = [0 if v.text is None else self.growth.get(v.text, 0) for v in (a, b)]
        if name == "mul":
            factors = [int(v.known) if v.is_known and np.ndim(v.known) == 0 else 0 for v in (b, a)]
            total = grow[0] * factors[0] + grow[1] * factors[1]
        else:
            total = grow[0] + (grow[1] if name == "add" else -grow[1])
        if total:
            self.growth[result.text] = total
        return result

    def _is_foreign(self, ref: Ref, indices: list[Value]) -> bool:
        """Whether lanes read what other lanes may have written in columns of their own."""
        *_, lane = indices
        return ref.shape[-1] == self.lanes and lane.wide and lane != self.lane

    def _warp_barrier(self) -> None:
        """Makes what threads stored before it visible to all of them after it."""
        self.declared.add("declare void @llvm.nvvm.bar.warp.sync(i32)")
        self.lines.append(f"call void @llvm.nvvm.bar.warp.sync({self.all})")
        self.stored = self.loaded = False

    def _read_ahead(self, base: str, offset: int) -> None:
        """Notes a read for the innermost loop in which its address is computed."""
        line = self.address_lines[base]
        for first, _, reads in reversed(self.loops):
            if first <= line:
                reads.setdefault(base, PrefetchedRows(line, [])).offsets.append(offset)
                return

    def begin_loop(self, counters: list[str], length: int) -> None:
        self.loops.append((len(self.lines), length, {}))
        self.growth |= {name: 1 for name in counters}

    def end_loop(self) -> None:
        """Prefetches the rows of later rounds of a loop as soon as their addresses are known.

        Without it every round waits for memory: a kernel of this size leaves room for two warps on
        a scheduler, which cannot hide it.
        """
        first, length, reads = self.loops.pop()
        rounds = rounds_ahead(len(self.lines) - first, length)
        if not rounds:
            return
        for address, (line, offsets) in sorted(reads.items(), key=lambda r: -r[1].line):
            behind = self.lines[line:]
            self.lines = self.lines[:line]
            for offset, rows in adjacent(sorted(set(offsets)), 4 * self.lanes, self.lanes):
                self._prefetch(address, offset + rounds * self.growth[address], rows)
            self.lines += behind

    def _prefetch(self, address: str, offset: int, rows: int) -> None:
        """Prefetches rows: lane k the k-th of them, all further lanes the last one."""
        if rows > 1:
            self.spans.add(rows)
            address = self.emit(f"getelementptr i8, ptr addrspace(1) {address}, i64 %span{rows}")
        place = self.emit(f"getelementptr i8, ptr addrspace(1) {address}, i64 {offset}")
        # LLVM's own prefetch has no instruction on NVPTX.
        self.lines.append(
            f'call void asm sideeffect "prefetch.global.L1 [$0];", "l"(ptr addrspace(1) {place}) #1'
        )


def write(jaxpr: Any, layout: Layout, name: str) -> str:
    """A kernel of LLVM's language whose block b works on entry b of every array."""
    lanes = layout.lanes
    blocks = layout.blocks
    if not 1 <= lanes <= LANES:
        raise NotImplementedError(f"a block of {lanes} lanes: a warp has {LANES}")
    writer = ThreadWriter(lanes)
    refs = []
    start = []
    params = []
    onchip = []
    for k, ((shape, dtype), array) in enumerate(zip(blocks, layout.arrays, strict=True)):
        kind = kind_of(dtype)
        if array.role == ONCHIP:
            onchip.append(
                f"@s{k} = internal addrspace(3) global [{array.bytes} x i8] undef, align 16"
            )
            refs.append(Ref(f"@s{k}", shape, kind, 3, array.exchanged))
            continue
        size = 0 if array.shared else SIZES[kind] * int(np.prod(shape))
        start += [
            f"%o{k} = mul i64 %block, {size}",
            f"%a{k} = getelementptr inbounds i8, ptr addrspace(1) %p{k}, i64 %o{k}",
        ]
        refs.append(Ref(f"%a{k}", shape, kind, exchanged=array.exchanged))
        params.append(f"ptr addrspace(1) noalias align 16 %p{k}")
    writer.run(jaxpr, [], refs)
    for rows in sorted(writer.spans):  # from a lane in the first row to that lane's own row
        start += [
            f"%last{rows} = call i32 @llvm.umin.i32(i32 %lane, i32 {rows - 1})",
            f"%row{rows} = mul i32 %last{rows}, {lanes}",
            f"%from{rows} = sub i32 %row{rows}, %lane",
            f"%elements{rows} = sext i32 %from{rows} to i64",
            f"%span{rows} = mul i64 %elements{rows}, 4",
        ]
    head = [
        "entry:",
        f"%lane = call range(i32 0, {lanes}) i32 @llvm.nvvm.read.ptx.sreg.tid.x()",
        "%index = call i32 @llvm.nvvm.read.ptx.sreg.ctaid.x()",
        "%block = zext i32 %index to i64",
    ]
    declared = writer.declared | {
        "declare i32 @llvm.nvvm.read.ptx.sreg.tid.x()",
        "declare i32 @llvm.nvvm.read.ptx.sreg.ctaid.x()",
        "declare i32 @llvm.umin.i32(i32, i32)",
    }
    body = "\n".join([*head, *start, *writer.lines, "ret void"])
    return (
        'target triple = "nvptx64-nvidia-cuda"\n'
        + "".join(f"{line}\n" for line in onchip)
        + f"define ptx_kernel void @{name}({', '.join(params)}) #0 {{\n{body}\n}}\n"
        + "\n".join(sorted(declared))
        + f'\nattributes #0 = {{ nounwind "nvvm.maxntid"="{lanes},1,1" }}\n'
        "attributes #1 = { nounwind memory(inaccessiblemem: readwrite) }\n"
    )


TARGET = "sm_80"
FEATURES = "+ptx78"
"""The oldest GPU and the version of PTX that the code is written for; newer ones run it too."""

_CONDITIONAL = re.compile(r"^(\s*@!?%p\d+ )bra(\s)", re.MULTILINE)


def assembly(text: str) -> str:
    """PTX of a kernel in LLVM's language.

    Passes are few on purpose: the kernel's own text has loops and little that is computed twice,
    and passes that move loads out of loops make values live longer than there are registers.
    """
    binding.initialize_all_targets()
    binding.initialize_all_asmprinters()
    target = binding.Target.from_triple("nvptx64-nvidia-cuda")
    machine = target.create_target_machine(cpu=TARGET, features=FEATURES, opt=0)
    module = binding.parse_assembly(text)
    module.data_layout = str(machine.target_data)
    module.verify()
    passes = binding.create_new_function_pass_manager()
    passes.add_new_gvn_pass()
    passes.add_aggressive_dce_pass()
    options = binding.create_pipeline_tuning_options(speed_level=1)
    builder = binding.create_pass_builder(machine, options)
    for function in module.functions:
        if not function.is_declaration:
            passes.run(function, builder)
    # Conditions are the same on all lanes, which LLVM does not know: threads need not meet again.
    return _CONDITIONAL.sub(r"\1bra.uni\2", machine.emit_assembly(module))
