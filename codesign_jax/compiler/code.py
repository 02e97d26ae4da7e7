"""Instructions of a function in LLVM's language, for code that is no kernel: XLA's handlers.

Source: LLVM Language Reference Manual.
"""

import contextlib
import ctypes
from collections.abc import Iterator

from codesign_jax.compiler import ffi

_TYPES = {1: "i8", 4: "i32", 8: "i64"}


def type_of(structure: type[ctypes.Structure], field: str) -> str:
    """LLVM's type of a field."""
    kind = dict(structure._fields_)[field]  # type: ignore[arg-type]
    return "ptr" if kind is ctypes.c_void_p else _TYPES[ctypes.sizeof(kind)]


def constant(name: str, text: str) -> str:
    """A constant string that ends in a zero byte."""
    raw = text.encode() + b"\0"
    quoted = "".join(f"\\{byte:02X}" for byte in raw)
    return f'@{name} = private constant [{len(raw)} x i8] c"{quoted}"\n'


class Code:
    """A function that is being written."""

    def __init__(self, head: str):
        """Starts with a function's head, such as "define void @f(ptr %x)"."""
        self.head, self.lines, self.first = head, [], []
        self.count, self.ended = 0, False

    def name(self, prefix: str = "t") -> str:
        """A new name."""
        self.count += 1
        return f"{prefix}{self.count}"

    def let(self, text: str) -> str:
        """Adds an instruction; returns the name of its result."""
        name = "%" + self.name()
        self.lines.append(f"{name} = {text}")
        return name

    def do(self, text: str) -> None:
        """Adds an instruction without a result."""
        self.lines.append(text)

    def end(self, text: str) -> None:
        """Ends a basic block."""
        self.lines.append(text)
        self.ended = True

    def start(self, label: str) -> None:
        """Begins a basic block, to which the one before goes on unless it has ended."""
        if not self.ended:
            self.lines.append(f"br label %{label}")
        self.lines.append(f"{label}:")
        self.ended = False

    @contextlib.contextmanager
    def when(self, condition: str) -> Iterator[None]:
        """What is added in this context runs if a condition holds."""
        yes, after = self.name("yes"), self.name("after")
        self.end(f"br i1 {condition}, label %{yes}, label %{after}")
        self.start(yes)
        yield
        self.start(after)

    def local(self, kind: str, count: int = 1) -> str:
        """Memory of the function's frame, made once whatever loops surround it."""
        name = "%" + self.name("m")
        self.first.append(f"{name} = alloca {kind}, i64 {count}, align 8")
        return name

    def byte(self, base: str, offset: int | str) -> str:
        """The address some bytes on."""
        return self.let(f"getelementptr i8, ptr {base}, i64 {offset}")

    def at(self, base: str, structure: type[ctypes.Structure], field: str) -> str:
        """Address of a structure's field."""
        return self.byte(base, getattr(structure, field).offset)

    def get(self, base: str, structure: type[ctypes.Structure], field: str) -> str:
        """Reads a structure's field."""
        return self.let(f"load {type_of(structure, field)}, ptr {self.at(base, structure, field)}")

    def put(self, base: str, structure: type[ctypes.Structure], field: str, value: object) -> None:
        """Writes a structure's field."""
        kind = type_of(structure, field)
        self.do(f"store {kind} {value}, ptr {self.at(base, structure, field)}")

    def record(self, structure: type[ctypes.Structure], **values: object) -> str:
        """A structure of XLA's interface in the function's frame; what is not given is 0."""
        place = self.local(f"[{ctypes.sizeof(structure)} x i8]")
        self.do(f"store [{ctypes.sizeof(structure)} x i8] zeroinitializer, ptr {place}")
        for field, value in {"struct_size": ffi.size(structure), **values}.items():
            self.put(place, structure, field, value)
        return place

    def text(self) -> str:
        """The function."""
        return "\n".join([self.head + " {", "entry:", *self.first, *self.lines, "}", ""])
