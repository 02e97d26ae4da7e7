"""A block as vectors of a CPU: a value over the lanes is one vector, an operation one instruction.

XLA's own code for the CPU slices and copies small arrays for most of the time.
"""

from typing import Any

import numpy as np

from codesign_jax.compiler.values import LLVM_TYPES, SIZES, Ref, Value, kind_of
from codesign_jax.compiler.writer import Writer


class VectorWriter(Writer):
    """Writes vector instructions."""

    def type(self, kind: str, wide: bool) -> str:
        return f"<{self.lanes} x {LLVM_TYPES[kind]}>" if wide else LLVM_TYPES[kind]

    def lane_index(self) -> Value:
        return Value("i32", True, None, np.arange(self.lanes, dtype=np.int32))

    def _known(self, kind: str, wide: bool, number: Any) -> str:
        if not wide:
            return super()._known(kind, wide, number)
        each = np.broadcast_to(np.asarray(number), (self.lanes,))
        return "<" + ", ".join(f"{LLVM_TYPES[kind]} {self.number(kind, v)}" for v in each) + ">"

    def operand(self, value: Value) -> str:
        if value.is_known and value.wide:
            return self._known(value.kind, True, value.known)
        return super().operand(value)

    def splat(self, value: Value) -> Value:
        if value.wide:
            return value
        if value.is_known:
            return value._replace(wide=True)
        kind = self.type(value.kind, True)
        zeros = f"<{self.lanes} x i32> zeroinitializer"
        first = self.emit(f"insertelement {kind} poison, {self.typed(value)}, i32 0")
        text = self.emit(f"shufflevector {kind} {first}, {kind} poison, {zeros}")
        self.scalar_of[text] = value
        return Value(value.kind, True, text)

    def swap_lanes(self, value: Value, source: np.ndarray) -> Value:
        text = self._shuffle(self.type(value.kind, True), self.operand(value), source)
        return Value(value.kind, True, text)

    def _shuffle(self, kind: str, value: str, pattern: np.ndarray) -> str:
        mask = ", ".join(f"i32 {int(p)}" for p in pattern)
        return self.emit(
            f"shufflevector {kind} {value}, {kind} poison, <{len(pattern)} x i32> <{mask}>"
        )

    def over_lanes(self, name: str, value: Value) -> Value:
        full = f"llvm.vector.reduce.s{name}.v{self.lanes}i32"
        self.declared.add(f"declare i32 @{full}({self.type('i32', True)})")
        return Value("i32", False, self.emit(f"call i32 @{full}({self.typed(value)})"))

    # Memory

    def load(self, ref: Ref, indices: list[Value]) -> Value:
        """Lanes that read one row read it once."""
        *rows, lane = indices
        if any(i.wide for i in rows) or (lane.wide and not lane.is_known):
            return self._gather(ref, indices)
        address = self._address(ref, indices)
        align = SIZES[ref.kind]
        scalar = LLVM_TYPES[ref.kind]
        if not lane.wide:
            text = self.emit(f"load {scalar}, ptr {address}, align {align}")
            return Value(ref.kind, False, text)
        pattern = np.asarray(lane.known) - np.min(lane.known)
        count = int(pattern.max()) + 1
        value = self.emit(f"load <{count} x {scalar}>, ptr {address}, align {align}")
        if count != self.lanes or (pattern != np.arange(self.lanes)).any():
            value = self._shuffle(f"<{count} x {scalar}>", value, pattern)
        return Value(ref.kind, True, value)

    def store(self, ref: Ref, indices: list[Value], value: Value) -> None:
        *rows, lane = indices
        if any(i.wide for i in rows) or (lane.wide and not lane.is_known):
            self._scatter(ref, indices, self.splat(value))
            return
        address = self._address(ref, indices)
        align = SIZES[ref.kind]
        if not lane.wide:
            if value.wide:  # as below, the first of the lanes that share a place
                text = self.emit(f"extractelement {self.typed(value)}, i32 0")
                value = Value(value.kind, False, text)
            self.lines.append(f"store {self.typed(value)}, ptr {address}, align {align}")
            return
        value = self.splat(value)
        pattern = np.asarray(lane.known) - np.min(lane.known)
        places, first = np.unique(pattern, return_index=True)
        if (places != np.arange(places.size)).any():
            raise NotImplementedError("a kernel's lanes store a row with holes")
        text = self.operand(value)
        if places.size != self.lanes or (pattern != np.arange(self.lanes)).any():
            text = self._shuffle(self.type(value.kind, True), text, first)
        row = f"<{places.size} x {LLVM_TYPES[ref.kind]}>"
        self.lines.append(f"store {row} {text}, ptr {address}, align {align}")

    def _address(self, ref: Ref, indices: list[Value]) -> str:
        """Address of an element, of the first lane where an index has one for each."""
        strides = np.cumprod([1, *ref.shape[:0:-1]])[::-1]
        offset = 0
        address = ref.address
        scalar = LLVM_TYPES[ref.kind]
        for index, stride in zip(indices, strides, strict=True):
            offset += int(stride) * int(np.min(index.known))
            if not index.is_known:
                wide = index.text
                if index.kind != "i64":
                    wide = self.emit(f"sext i32 {index.text} to i64")
                step = self.emit(f"mul nsw i64 {wide}, {int(stride)}")
                address = self.emit(f"getelementptr inbounds {scalar}, ptr {address}, i64 {step}")
        if offset:
            address = self.emit(f"getelementptr inbounds {scalar}, ptr {address}, i64 {offset}")
        return address

    def _addresses(self, ref: Ref, indices: list[Value]) -> str:
        strides = np.cumprod([1, *ref.shape[:0:-1]])[::-1]
        total = "zeroinitializer"
        rows = f"<{self.lanes} x i64>"
        for index, stride in zip(indices, strides, strict=True):
            wide = self.splat(index)
            if wide.kind != "i64":
                wide = self.convert("sext", wide, "i64")
            step = self.emit(f"mul nsw {self.typed(wide)}, {self._known('i64', True, int(stride))}")
            total = self.emit(f"add nsw {rows} {total}, {step}")
        scalar = LLVM_TYPES[ref.kind]
        return self.emit(f"getelementptr inbounds {scalar}, ptr {ref.address}, {rows} {total}")

    def _masked(self, name: str, ref: Ref, operands: list[str], result: str) -> str:
        full = f"llvm.masked.{name}.{self.suffix(ref.kind, True)}.v{self.lanes}p0"
        align = f"i32 {SIZES[ref.kind]}"
        mask = self._known("b", True, 1)
        operands = [*operands, align, f"{self.type('b', True)} {mask}"]
        if name == "gather":
            operands.append(f"{self.type(ref.kind, True)} poison")
        types = [o.split(">")[0] + ">" if o[0] == "<" else o.split(" ")[0] for o in operands]
        self.declared.add(f"declare {result} @{full}({', '.join(types)})")
        return f"call {result} @{full}({', '.join(operands)})"

    def _gather(self, ref: Ref, indices: list[Value]) -> Value:
        place = f"<{self.lanes} x ptr> {self._addresses(ref, indices)}"
        call = self._masked("gather", ref, [place], self.type(ref.kind, True))
        return Value(ref.kind, True, self.emit(call))

    def _scatter(self, ref: Ref, indices: list[Value], value: Value) -> None:
        typed = self.typed(value)
        place = f"<{self.lanes} x ptr> {self._addresses(ref, indices)}"
        self.lines.append(self._masked("scatter", ref, [typed, place], "void"))


def write(jaxpr: Any, blocks: list[tuple[tuple[int, ...], Any]], lanes: int) -> str:
    """A function `block` of LLVM's language that runs a kernel on one block."""
    writer = VectorWriter(lanes)
    refs = [Ref(f"%a{k}", shape, kind_of(dtype)) for k, (shape, dtype) in enumerate(blocks)]
    writer.run(jaxpr, [], refs)
    params = ", ".join(f"ptr noalias %a{k}" for k in range(len(blocks)))
    body = "\n".join(writer.lines)
    declarations = "\n".join(sorted(writer.declared))
    return (
        f"define internal void @block({params}) nounwind {{\nentry:\n{body}\nret void\n}}\n"
        f"{declarations}\n"
    )
