"""Kernels on a CPU: machine code by LLVM, whose blocks XLA's own threads share.

A handler takes blocks one by one, and so do the tasks that it gives to XLA's thread pool, until
none is left.  It then waits for blocks that a task has begun, never for a task to begin: a pool
that is busy, or that runs tasks late, cannot stop it.  What a late task looks at is a record in the
heap that lives until the last of them has seen it.  Blocks do not depend on each other, so that
results do not depend on the number of threads.
"""

import ctypes
from collections.abc import Callable
from ctypes import c_int64
from typing import Any

from codesign_jax import reuse
from codesign_jax.compiler import ffi, handlers, vector
from codesign_jax.compiler.handlers import Handler, LlvmFunction
from codesign_jax.compiler.values import SCRATCH, Layout

_ALIGNMENT = 64  # bytes: a line of the cache
# times that a handler looks again at once, then pauses [ns]
_YIELDS = 100
_SLEEP = 50_000


class Job(ctypes.Structure):
    """A call's record; the addresses of the arrays follow it in memory."""

    _fields_ = [
        ("next", c_int64),  # block that nobody has taken yet
        ("done", c_int64),  # blocks that have been run
        ("users", c_int64),  # tasks, and the handler, that may still look at the record
        ("blocks", c_int64),
        ("kernel", ctypes.c_void_p),  # what runs a block
    ]


_DECLARATIONS = """
declare i32 @posix_memalign(ptr, i64, i64)
declare ptr @malloc(i64)
declare void @free(ptr)
declare i32 @sched_yield()
"""

ENTRY = "entry"
"""Name by which a block's code is found in its object file."""


def block_code(jaxpr: Any, layout: Layout) -> str:
    return vector.write(jaxpr, layout.blocks, layout.lanes)


def object_text(jaxpr: Any, layout: Layout) -> str:
    """Program of a kernel's object file, which tells the address of the block's code as `ENTRY`."""
    return block_code(jaxpr, layout) + f"@{ENTRY} = alias i8, ptr @block\n"


def handler_code(name: str, layout: Layout) -> str:
    return _DECLARATIONS + _work(layout) + _task() + _drop() + _handler(name, layout)


def register(
    origin: str, trace: Callable[[], Any], layout: Layout, *, keep: bool = True, level: int = 2
) -> str:
    """Compiles a kernel and makes it known to XLA; returns the name to call it by.

    One of the same origin and layout that was compiled before is not traced again; `keep`: whether
    its machine code may be kept on disk and be found there.
    """
    name = "kernel_" + reuse.digest("cpu", origin, layout, level, *handlers.identity())
    with handlers.LOCK:
        if not handlers.known(name):
            file = reuse.Kept(reuse.kernel_file(name) if keep else None)
            code = file.read()
            text = "" if code else object_text(trace(), layout)
            loaded = handlers.prepare(handler_code(name, layout), keep=keep)
            handlers.register(name, loaded, "cpu")

            def load() -> int:
                machine_code = code or file.write(handlers.compile(text, level))
                return handlers.Loaded(machine_code).function(ENTRY)

            handlers.supply(name, loaded, load)
    return name


def _work(layout: Layout) -> str:
    """Takes blocks until none is left; true if there was no memory to run them in."""
    c = LlvmFunction("define internal i1 @work(ptr %job) noinline nounwind")
    blocks = c.get("%job", Job, "blocks")
    following = c.at("%job", Job, "next")
    waiting = c.let(f"load atomic i64, ptr {following} monotonic, align 8")
    with c.when(c.let(f"icmp sge i64 {waiting}, {blocks}")):
        c.end("ret i1 false")
    offsets = {}
    total = 0
    for k in layout.of(SCRATCH):
        offsets[k] = total
        total += -(-layout.arrays[k].bytes // _ALIGNMENT) * _ALIGNMENT
    memory = "null"
    if offsets:
        place = c.local("ptr")
        lacks = c.let(f"call i32 @posix_memalign(ptr {place}, i64 {_ALIGNMENT}, i64 {total})")
        with c.when(c.let(f"icmp ne i32 {lacks}, 0")):
            c.end("ret i1 true")
        memory = c.let(f"load ptr, ptr {place}")
    first = c.byte("%job", ctypes.sizeof(Job))
    bases = [c.let(f"load ptr, ptr {c.byte(first, 8 * k)}") for k in range(len(layout.arrays))]
    kernel = c.get("%job", Job, "kernel")
    c.start("again")
    block = c.let(f"atomicrmw add ptr {following}, i64 1 monotonic")
    with c.when(c.let(f"icmp slt i64 {block}, {blocks}")):
        places = []
        for k, array in enumerate(layout.arrays):
            if k in offsets:
                places.append(c.byte(memory, offsets[k]))
            else:
                offset = c.let(f"mul i64 {block}, {0 if array.shared else array.bytes}")
                places.append(c.byte(bases[k], offset))
        c.do(f"call void {kernel}({', '.join(f'ptr {p}' for p in places)})")
        c.do(f"atomicrmw add ptr {c.at('%job', Job, 'done')}, i64 1 release")
        c.end("br label %again")
    if offsets:
        c.do(f"call void @free(ptr {memory})")
    c.end("ret i1 false")
    return c.text()


def _task() -> str:
    """What XLA's threads run; without memory it leaves the blocks to others."""
    c = LlvmFunction("define internal void @task(ptr %job) nounwind")
    c.let("call i1 @work(ptr %job)")
    c.do("call void @drop(ptr %job)")
    c.end("ret void")
    return c.text()


def _drop() -> str:
    """Takes leave of a record; the last user frees it."""
    c = LlvmFunction("define internal void @drop(ptr %job) nounwind")
    users = c.let(f"atomicrmw sub ptr {c.at('%job', Job, 'users')}, i64 1 acq_rel")
    with c.when(c.let(f"icmp eq i64 {users}, 1")):
        c.do("call void @free(ptr %job)")
    c.end("ret void")
    return c.text()


def _handler(name: str, layout: Layout) -> str:
    """Shares the blocks with XLA's threads, and waits for all that were begun."""
    h = Handler(name, layout)
    c = h.code
    blocks = h.blocks
    with c.when(c.let(f"icmp eq i64 {blocks}, 0")):
        c.end("ret ptr null")
    workers = _smaller(c, _threads(h), blocks)
    job = _job(h, workers, h.kernel())
    _schedule(h, job, workers)
    short = c.local("i1")
    begun = c.local("i64")
    c.do(f"store i1 false, ptr {short}")
    c.do(f"store i64 {blocks}, ptr {begun}")
    with c.when(c.let(f"call i1 @work(ptr {job})")):
        # Nobody begins another block; tasks that have memory finish theirs.
        taken = c.let(f"atomicrmw xchg ptr {c.at(job, Job, 'next')}, i64 {blocks} monotonic")
        c.do(f"store i64 {_smaller(c, taken, blocks)}, ptr {begun}")
        c.do(f"store i1 {c.let(f'icmp slt i64 {taken}, {blocks}')}, ptr {short}")
    _wait(c, job, c.let(f"load i64, ptr {begun}"))
    c.do(f"call void @drop(ptr {job})")
    with c.when(c.let(f"load i1, ptr {short}")):
        h.fail(ffi.RESOURCE_EXHAUSTED, h.message(f"kernel {name}: no memory for a block's scratch"))
    c.end("ret ptr null")
    return h.text()


def _smaller(c: LlvmFunction, a: str, b: str) -> str:
    return c.let(f"select i1 {c.let(f'icmp slt i64 {a}, {b}')}, i64 {a}, i64 {b}")


def _threads(h: Handler) -> str:
    """Threads of XLA's pool; one, the caller's, if there is no pool."""
    c = h.code
    number = h.code.local("i64")
    c.do(f"store i64 1, ptr {number}")
    record = c.record(ffi.NumThreads, ctx=h.ctx, num_threads=number)
    error = h.call("thread_pool_num_threads", record)
    with c.when(c.let(f"icmp ne ptr {error}, null")):
        _destroy(h, error)
        c.do(f"store i64 1, ptr {number}")
    threads = c.let(f"load i64, ptr {number}")
    # Not LLVM's maximum: a kernel that uses it declares it, and a second declaration is an error.
    positive = c.let(f"icmp sgt i64 {threads}, 1")
    return c.let(f"select i1 {positive}, i64 {threads}, i64 1")


def _destroy(h: Handler, error: str) -> None:
    record = h.code.record(ffi.ErrorDestroy, error=error)
    destroy = h.code.get(h.api, ffi.Api, "error_destroy")
    h.code.do(f"call void {destroy}(ptr {record})")


def _job(h: Handler, users: str, kernel: str) -> str:
    c = h.code
    arrays = h.layout.arrays
    size = ctypes.sizeof(Job) + 8 * len(arrays)
    job = c.let(f"call ptr @malloc(i64 {size})")
    with c.when(c.let(f"icmp eq ptr {job}, null")):
        h.fail(ffi.RESOURCE_EXHAUSTED, h.message(f"kernel {h.name}: no memory for a call's record"))
    numbers = {"next": 0, "done": 0, "users": users, "blocks": h.blocks, "kernel": kernel}
    for field, value in numbers.items():
        c.put(job, Job, field, value)
    first = c.byte(job, ctypes.sizeof(Job))
    for k in range(len(arrays)):
        c.do(f"store ptr {h.data.get(k, 'null')}, ptr {c.byte(first, 8 * k)}")
    return job


def _schedule(h: Handler, job: str, workers: str) -> None:
    """Gives XLA's threads one task less than there are workers: the caller is one of them."""
    c = h.code
    count = h.code.local("i64")
    record = c.record(ffi.Schedule, ctx=h.ctx, task="@task", data=job)
    c.do(f"store i64 1, ptr {count}")
    c.start("schedule")
    number = c.let(f"load i64, ptr {count}")
    with c.when(c.let(f"icmp slt i64 {number}, {workers}")):
        c.do(f"store i64 {c.let(f'add i64 {number}, 1')}, ptr {count}")
        error = h.call("thread_pool_schedule", record)
        with c.when(c.let(f"icmp ne ptr {error}, null")):
            _destroy(h, error)
            missing = c.let(f"sub i64 {workers}, {number}")
            c.do(f"atomicrmw sub ptr {c.at(job, Job, 'users')}, i64 {missing} monotonic")
            c.do(f"store i64 {workers}, ptr {count}")
        c.end("br label %schedule")


def _wait(c: LlvmFunction, job: str, begun: str) -> None:
    """Waits until as many blocks are done as were begun."""
    looks = c.local("i64")
    pause = c.local("[2 x i64]")
    c.do(f"store i64 0, ptr {looks}")
    c.do(f"store [2 x i64] [i64 0, i64 {_SLEEP}], ptr {pause}")
    done = c.at(job, Job, "done")
    c.start("wait")
    finished = c.let(f"load atomic i64, ptr {done} acquire, align 8")
    with c.when(c.let(f"icmp ne i64 {finished}, {begun}")):
        look = c.let(f"load i64, ptr {looks}")
        c.do(f"store i64 {c.let(f'add i64 {look}, 1')}, ptr {looks}")
        with c.when(c.let(f"icmp slt i64 {look}, {_YIELDS}")):
            c.let("call i32 @sched_yield()")
            c.end("br label %wait")
        c.let(f"call i32 @nanosleep(ptr {pause}, ptr null)")
        c.end("br label %wait")
