"""Loads and stores of a kernel's memory in LLVM's language, for a writer of vectors.

Lanes whose indices are known to lie within one row share one instruction for it; lanes that each
compute an index of their own gather and scatter.
"""

from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import numpy as np

from codesign_jax.compiler.llvm_rules import Value

if TYPE_CHECKING:
    from codesign_jax.compiler.llvm import Writer


class Ref(NamedTuple):
    """Memory of a block.

    Attributes:
      address: Name of its address.
      shape: Its shape.
      dtype: Type of its elements: float32, float64 or int32.
    """

    address: str
    shape: tuple[int, ...]
    dtype: np.dtype

    @property
    def kind(self) -> str:
        """Kind of a value from it."""
        return "i" if self.dtype == np.int32 else "f"

    @property
    def element(self) -> str:
        """Name of its elements' type."""
        names = {"int32": "i32", "float32": "float", "float64": "double"}
        if self.dtype.name not in names:
            raise NotImplementedError(f"no memory of {self.dtype.name}")
        return names[self.dtype.name]

    @property
    def strides(self) -> list[int]:
        """Elements from an index to the next one, in each dimension."""
        return [int(s) for s in np.cumprod([1, *self.shape[:0:-1]])[::-1]]


def indices(w: "Writer", ref: Ref, equation: Any, leaves: list[Value]) -> list[Value]:
    """Index in each dimension; a whole slice is the lane.

    Raises:
      NotImplementedError: If the lanes are to read several elements each.
    """
    (indexer,) = jax.tree.unflatten(equation.params["tree"], leaves)
    found, slices, last = [], 0, len(ref.shape) - 1
    for k, (index, size) in enumerate(zip(indexer.indices, ref.shape, strict=True)):
        if isinstance(index, Value):
            found.append(index if k == last and index.text is None else w.narrow(index))
        elif isinstance(index, int | np.integer):
            found.append(Value("i", False, None, int(index)))
        else:
            assert index.size == size == w.lanes, (index, size)
            slices += 1
            found.append(Value("i", True, None, np.arange(size)))
    if slices and sum(i.wide for i in found) > 1:
        raise NotImplementedError("a slice of an array beside an index that lanes differ in")
    return found


def _own(places: list[Value]) -> bool:
    """Whether lanes have elements of their own, not known to lie within one row."""
    return any(i.wide for i in places[:-1]) or (places[-1].wide and places[-1].text is not None)


def _address(w: "Writer", ref: Ref, places: list[Value]) -> str:
    """Address of an element, of the first lane where the last index has one for each."""
    offset, address = 0, ref.address
    for index, stride in zip(places, ref.strides, strict=True):
        if index.text is None:
            offset += stride * int(np.min(index.known))
            continue
        wide = w.emit(f"sext i32 {index.text} to i64")
        step = w.emit(f"mul nsw i64 {wide}, {stride}")
        address = w.emit(f"getelementptr inbounds {ref.element}, ptr {address}, i64 {step}")
    if offset:
        address = w.emit(f"getelementptr inbounds {ref.element}, ptr {address}, i64 {offset}")
    return address


def _addresses(w: "Writer", ref: Ref, places: list[Value]) -> str:
    """Vector of addresses with its type, one for each lane; offsets have 32 bits."""
    offset = Value("i", False, None, 0)
    for index, stride in zip(places, ref.strides, strict=True):
        step = w.apply("mul", index, Value("i", False, None, stride))
        offset = w.apply("add", offset, step)
    lanes = w.typed(w.spread(offset))
    text = w.emit(f"getelementptr {ref.element}, ptr {ref.address}, {lanes}")
    return f"<{w.lanes} x ptr> {text}"


def load(w: "Writer", ref: Ref, places: list[Value]) -> Value:
    """Reads an element, or one for each lane.

    Nothing checks that an index which lanes compute lies within the array: whoever computes it has
    to clamp it.
    """
    lane, align = places[-1], ref.dtype.itemsize
    if _own(places):
        vector, mask = f"<{w.lanes} x {ref.element}>", _every_lane(w)
        name = _masked(w, "gather", ref)
        w.declared.add(
            f"declare {vector} @{name}(<{w.lanes} x ptr>, i32, <{w.lanes} x i1>, {vector})"
        )
        at = _addresses(w, ref, places)
        text = w.emit(f"call {vector} @{name}({at}, i32 {align}, {mask}, {vector} poison)")
        return _from_memory(w, ref, Value(ref.kind, True, text))
    address = _address(w, ref, places)
    if not lane.wide:
        text = w.emit(f"load {ref.element}, ptr {address}, align {align}")
        return _from_memory(w, ref, Value(ref.kind, False, text))
    pattern = np.asarray(lane.known) - np.min(lane.known)
    count = int(pattern.max()) + 1
    row = f"<{count} x {ref.element}>"
    text = w.emit(f"load {row}, ptr {address}, align {align}")
    if count != w.lanes or (pattern != np.arange(w.lanes)).any():
        text = w.shuffle(row, text, pattern)
    return _from_memory(w, ref, Value(ref.kind, True, text))


def store(w: "Writer", ref: Ref, places: list[Value], value: Value) -> None:
    """Writes an element, or one for each lane.

    Lanes that are known to have the same element store the same value.  Of lanes that turn out to
    have the same one the last lane's value stays.  As in `load`, indices are not checked.
    """
    lane, align = places[-1], ref.dtype.itemsize
    if _own(places):
        vector, pointers = f"<{w.lanes} x {ref.element}>", f"<{w.lanes} x ptr>"
        name = _masked(w, "scatter", ref)
        w.declared.add(f"declare void @{name}({vector}, {pointers}, i32, <{w.lanes} x i1>)")
        text, at = _to_memory(w, ref, w.spread(value)), _addresses(w, ref, places)
        w.lines.append(f"call void @{name}({vector} {text}, {at}, i32 {align}, {_every_lane(w)})")
        return
    address = _address(w, ref, places)
    if not lane.wide:
        value = w.narrow(value)
        assert not value.wide, "lanes store different values in one place"
        text = _to_memory(w, ref, value)
        w.lines.append(f"store {ref.element} {text}, ptr {address}, align {align}")
        return
    pattern = np.asarray(lane.known) - np.min(lane.known)
    columns, first = np.unique(pattern, return_index=True)
    assert (columns == np.arange(columns.size)).all(), "a row with holes"
    text = _to_memory(w, ref, w.spread(value))
    if columns.size != w.lanes or (pattern != np.arange(w.lanes)).any():
        text = w.shuffle(f"<{w.lanes} x {ref.element}>", text, first)
    w.lines.append(f"store <{columns.size} x {ref.element}> {text}, ptr {address}, align {align}")


def _masked(w: "Writer", name: str, ref: Ref) -> str:
    """Name of LLVM's function that gathers or scatters."""
    short = {"i32": "i32", "float": "f32", "double": "f64"}[ref.element]
    return f"llvm.masked.{name}.v{w.lanes}{short}.v{w.lanes}p0"


def _every_lane(w: "Writer") -> str:
    return f"<{w.lanes} x i1> <{', '.join(['i1 true'] * w.lanes)}>"


def _from_memory(w: "Writer", ref: Ref, value: Value) -> Value:
    """A float in the writer's size."""
    own = w.type(value.kind, value.wide)
    stored = f"<{w.lanes} x {ref.element}>" if value.wide else ref.element
    if own == stored:
        return value
    operation = "fpext" if ref.dtype.itemsize < w.itemsize else "fptrunc"
    return value._replace(text=w.emit(f"{operation} {stored} {value.text} to {own}"))


def _to_memory(w: "Writer", ref: Ref, value: Value) -> str:
    """An operand with the size of the memory's floats."""
    own = w.type(value.kind, value.wide)
    stored = f"<{w.lanes} x {ref.element}>" if value.wide else ref.element
    if own == stored:
        return w.operand(value)
    operation = "fpext" if ref.dtype.itemsize > w.itemsize else "fptrunc"
    return w.emit(f"{operation} {w.typed(value)} to {stored}")
