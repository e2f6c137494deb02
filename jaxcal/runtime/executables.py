"""Programs, compiled once and kept: in this process and in the user's cache folder.

Most of the time to a first answer is tracing and compiling. Both are skipped if any process has
compiled the program of the same plan and shapes before: :func:`run` then loads machine code and
does not call the function at all.

A program is kept under a key that names everything it depends on: the function's name, the static
plan, the shapes and dtypes of all arrays, the compiler's flags, and this installation
(:func:`installation`): jaxlib's binary, the processor's features, the versions of what is traced
through, and the sources of jaxcal. :mod:`jaxcal.runtime.program_cache` says who may write the
files. None of JAX's settings is changed.

Trees of arrays are described as JSON (:func:`describe`), so that neither pickles nor a trace are
needed to put a result together. Programs that call functions outside XLA (LAPACK, callbacks) are
compiled for this process only: the addresses mean nothing to another process.

A few programs serve any number of images: callers pad their arrays to the size of
:func:`padded_images` for one problem or of a :func:`bucket` for a batch, and cut the result. Padded
images are masked, and no answer depends on them.
"""

from __future__ import annotations

import hashlib
import importlib
import json
import logging
import os
import platform
import secrets
import sys
import time
from collections import OrderedDict
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, fields, is_dataclass
from functools import cache
from importlib import metadata
from pathlib import Path
from threading import Lock
from typing import Any

import jax
import numpy as np
from jaxlib import xla_client

from jaxcal import CalibrationError
from jaxcal.runtime import compiler, forks, program_cache
from jaxcal.runtime.arrays import assembled
from jaxcal.runtime.interrupts import no_interrupt_lost

LOADED = 32
"""Most programs kept in this process; the least recently used is dropped."""

SMALLEST_BUCKET = 8
"""Images or problems of the smallest bucket of a batch."""

FEWEST_PADDED = 64
"""One problem has at least so many images when it is solved. Padding from 12 to 64 costs a few ms,
compiling another program costs seconds."""

TRACED_THROUGH = ("jax", "jaxlib", "equinox", "optimistix", "numpy")
"""Packages whose versions change what is compiled."""

NOT_TRACED = ("cli", "report", "io")
"""Folders of jaxcal that no compiled program comes from."""

CPU_FACTS = (
    "vendor_id",
    "cpu family",
    "model",
    "model name",
    "stepping",
    "flags",
    "Features",
    "CPU implementer",
    "CPU architecture",
    "CPU variant",
    "CPU part",
    "isa",
)
"""Lines of /proc/cpuinfo that say what a processor can do."""

JAX_SETTINGS = (
    "jax_enable_x64",
    "jax_default_matmul_precision",
    "jax_default_prng_impl",
    "jax_threefry_partitionable",
)
"""Settings of the caller that change what is traced."""

Description = Any
"""The description of a tree, which JSON can hold."""

Convert = Callable[[list[jax.Array]], list[Any]]
"""From a program's result, once it is computed, to the arrays that the caller gets."""

_log = logging.getLogger(__name__)


class NotDescribableError(TypeError):
    """A tree holds something that JSON cannot describe, such as a function."""


@dataclass(frozen=True)
class _Program:
    """A program that runs here.

    Attributes:
        executable: jaxlib's.
        device: where it runs.
        result: description of what it returns.
        from_disk: it was loaded, not compiled.
    """

    executable: Any
    device: Any
    result: Description
    from_disk: bool

    def __call__(self, leaves: list[Any], convert: Convert) -> Any:
        with jax.ensure_compile_time_eval():  # inside a caller's jit it would trace
            arrays = jax.device_put(leaves, self.device)
        pieces = self.executable.execute_sharded(arrays).disassemble_into_single_device_arrays()
        return rebuild(
            self.result, convert(jax.block_until_ready([shards[0] for shards in pieces]))
        )


def padded_images(count: int) -> int:
    """The number that the images of one problem are padded to: 64, 128, 256, 512, ..."""
    return max(FEWEST_PADDED, 1 << (count - 1).bit_length())


def bucket(count: int) -> int:
    """The size that the problems of a batch, or their images, are padded to: 8, 12, 16, 24, 32, ...

    Finer than that of one problem, since masked images cost a batch more time.
    """
    size = SMALLEST_BUCKET
    while size < count:
        # Powers of two, and 1.5 times each of them.
        size = size * 3 // 2 if size & (size - 1) == 0 else size * 4 // 3
    return size


def in_numpy(arrays: list[jax.Array]) -> list[np.ndarray]:
    """A result as numpy arrays: each operation on JAX's would compile a program of its own."""
    return [np.asarray(array) for array in arrays]


_loaded: OrderedDict[str, _Program] = OrderedDict()
_being_made: dict[str, Lock] = {}
_lock = Lock()


def run(
    function: str | Callable[..., Any],
    arguments: tuple[Any, ...],
    plan: Any,
    *,
    flags: compiler.Flags,
    label: dict[str, Any],
    convert: Convert = in_numpy,
) -> Any:
    """Call ``function(*arguments, plan)``, compiled; by the kept program if there is one.

    Args:
        function: a pure function of a module, or ``module:name``, which is imported and called
            only where no program is kept.
        arguments: trees of concrete arrays: modules and dataclasses of jaxcal, tuples, None.
        plan: everything static about it.
        flags: of the compiler; those that it does not know are left out.
        label: what the program is, for ``jaxcal cache show``.
        convert: what to make of the result's arrays; by default numpy's.

    Raises:
        NotDescribableError: arguments or plan hold what cannot be described.
        CalibrationError: this process was forked from one in which JAX had started.
    """
    refuse_after_fork()
    leaves: list[Any] = []
    described = describe(arguments, leaves)
    name = function
    if not isinstance(function, str):
        name = f"{function.__module__}:{function.__qualname__}"
    device = _device(leaves)
    key = json.dumps(
        {
            "function": name,
            "plan": describe(plan),
            "arguments": described,
            "leaves": [[leaf.dtype.name, list(leaf.shape)] for leaf in leaves],
            "device": [device.platform, device.id],
            "flags": flags,
            "settings": [str(getattr(jax.config, name, None)) for name in JAX_SETTINGS],
            "installation": installation(),
        },
        sort_keys=True,
    )
    with _lock:
        turn = _being_made.setdefault(key, Lock())

    def compiled() -> _Program:
        return _compile(
            lambda flat: _imported(function)(*rebuild(described, flat), plan),
            leaves,
            device,
            flags,
            key,
            label,
        )

    with turn:  # threads that need the same program wait for one of them
        program = _recall(key) or _load(key, device) or compiled()
        _remember(key, program)
    try:
        return program(leaves, convert)
    except jax.errors.JaxRuntimeError as error:
        if not program.from_disk:
            raise
        _log.debug("a compiled program in the cache does not run: %s", error)
    with turn:
        program = compiled()
        _remember(key, program)
    return program(leaves, convert)


def refuse_after_fork() -> None:
    """Refuse to compute where it would wait without end for threads that a fork left behind.

    Raises:
        CalibrationError: this process was forked from one in which JAX had started.
    """
    if forks.threads_left_behind:
        raise CalibrationError(
            "jaxcal cannot compute in a process that was forked from one in which JAX had started: "
            "JAX's threads are not in it. Start processes by 'spawn', as by "
            "multiprocessing.get_context('spawn')"
        )


def _imported(function: str | Callable[..., Any]) -> Callable[..., Any]:
    if not isinstance(function, str):
        return function
    module, name = function.split(":")
    return getattr(importlib.import_module(module), name)


def forget() -> None:
    """Drop the programs that this process holds; those on the disk stay."""
    with _lock:
        _loaded.clear()
        _being_made.clear()


def _recall(key: str) -> _Program | None:
    with _lock:
        return _loaded.get(key)


def _remember(key: str, program: _Program) -> None:
    with _lock:
        _loaded[key] = program
        _loaded.move_to_end(key)
        while len(_loaded) > LOADED:
            old, _ = _loaded.popitem(last=False)
            _being_made.pop(old, None)


def _load(key: str, device: Any) -> _Program | None:
    kept = program_cache.read(key)
    if kept is None:
        return None
    header, content = kept
    try:
        devices = xla_client.DeviceList((device,))
        executable = device.client.deserialize_executable(content, executable_devices=devices)
        return _Program(executable, device, header["result"], from_disk=True)
    # jaxlib may raise anything: a program that does not load is compiled again.
    except Exception as error:
        _log.debug("a compiled program in the cache is not used: %s", error)
        return None


@no_interrupt_lost()
def _compile(
    function: Callable[[list[Any]], Any],
    leaves: list[Any],
    device: Any,
    flags: compiler.Flags,
    key: str,
    label: dict[str, Any],
) -> _Program:
    _log.info("compiling, once; later runs are done in a second or two")
    began = time.perf_counter()
    results: list[Description] = []

    def flat(*flat_leaves: Any) -> list[Any]:
        found: list[Any] = []
        results.append(describe(function(list(flat_leaves)), found))
        return found

    # A unique name keeps JAX's compilation cache from returning an executable that it has loaded:
    # such an executable lacks its machine code when it is serialised again.
    flat.__name__ = f"kept_{secrets.token_hex(8)}"
    place = jax.sharding.SingleDeviceSharding(device)
    shapes = [jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=place) for leaf in leaves]
    known = compiler.known(device.platform, flags)
    lowered = jax.jit(flat, keep_unused=True).lower(*shapes)
    executable = lowered.compile(compiler_options=known).runtime_executable()
    _remove_from_jaxs_cache(flat.__name__)
    program = _Program(executable, device, results[0], from_disk=False)
    if "custom_call" in lowered.as_text():
        return program
    header = {
        "label": label,
        "result": program.result,
        "seconds": round(time.perf_counter() - began, 3),
    }
    try:
        # Before the first run, in which sorting makes comparators that cannot be serialised.
        content = device.client.serialize_executable(executable)
    except Exception as error:  # not every compiler's programs can be
        _log.debug("a compiled program is not kept: %s", error)
        return program
    program_cache.write(key, header, content)
    return program


def _remove_from_jaxs_cache(name: str) -> None:
    """Remove what JAX has kept under a unique name: nobody finds it again, and it would pile up."""
    folder: Any = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
    with suppress(OSError):
        for path in Path(folder).glob(f"jit_{name}-*") if folder else ():
            path.unlink()


def _device(leaves: list[Any]) -> Any:
    """The device that an array is committed to, else a processor, else JAX's default."""
    for leaf in leaves:
        if isinstance(leaf, jax.Array) and leaf.committed:
            return next(iter(leaf.devices()))
    return processor() or jax.local_devices()[0]


def processor() -> Any | None:
    """JAX's default device if that is a processor, else the first one; None if JAX has none."""
    default: Any = jax.config.jax_default_device  # pyright: ignore[reportAttributeAccessIssue]
    with suppress(RuntimeError):  # JAX_PLATFORMS may name others only
        if not isinstance(default, jax.Device):
            default = jax.local_devices(backend=default)[0]
        return default if default.platform == "cpu" else jax.local_devices(backend="cpu")[0]
    return None


def describe(tree: Any, leaves: list[Any] | None = None) -> Description:
    """Describe a tree by what JSON can hold.

    Args:
        tree: of dataclasses of jaxcal (modules too), tuples, lists, None, numbers, texts, arrays.
        leaves: a list, to which arrays and numpy's numbers are appended: their values are not in
            the description. Without a list numpy's numbers are described by their values.

    Raises:
        NotDescribableError: it holds anything else, or arrays without a list for them.
    """
    if leaves is not None and isinstance(tree, (np.ndarray, np.generic, jax.Array)):
        leaves.append(tree)
        return {"leaf": len(leaves) - 1}
    if isinstance(tree, np.generic):
        tree = tree.item()
    if tree is None or isinstance(tree, (bool, int, float, str)):
        return tree
    if isinstance(tree, (tuple, list)):
        kind = "tuple" if isinstance(tree, tuple) else "list"
        return {kind: [describe(part, leaves) for part in tree]}
    kind = type(tree)
    if is_dataclass(tree) and kind.__module__.split(".")[0] == "jaxcal":
        return {
            "class": f"{kind.__module__}:{kind.__qualname__}",
            "fields": {
                field.name: describe(getattr(tree, field.name), leaves) for field in fields(tree)
            },
        }
    raise NotDescribableError(f"{kind.__module__}.{kind.__qualname__} cannot be described")


def is_describable(plan: Any) -> bool:
    """Whether :func:`describe` accepts a plan, whose values count."""
    try:
        describe(plan)
    except NotDescribableError:
        return False
    return True


def rebuild(description: Description, leaves: list[Any]) -> Any:
    """The tree that :func:`describe` described, with other arrays."""
    if isinstance(description, dict):
        if "leaf" in description:
            return leaves[description["leaf"]]
        for name, kind in (("tuple", tuple), ("list", list)):
            if name in description:
                return kind(rebuild(part, leaves) for part in description[name])
        module, name = description["class"].split(":")
        if module.split(".")[0] != "jaxcal":
            raise NotDescribableError(f"{module} is not part of jaxcal")
        found: Any = importlib.import_module(module)
        for part in name.split("."):
            found = getattr(found, part)
        parts = description["fields"].items()
        return assembled(found, {field: rebuild(part, leaves) for field, part in parts})
    return description


@cache
def installation() -> str:
    """A digest of everything outside a plan that a compiled program depends on.

    It takes a few milliseconds. A digest of jaxlib's binary, 350 MB, would take 0.6 s. So the list
    of digests that was installed with it is used, and the binaries' sizes and times of change,
    which show if one was replaced by hand.
    """
    facts: list[Any] = [sys.implementation.name, sys.version_info[:3], platform.machine()]
    facts += [os.environ.get("XLA_FLAGS", ""), _processor()]
    facts += [[name, metadata.version(name)] for name in TRACED_THROUGH]
    facts.append(_digest(metadata.distribution("jaxlib").read_text("RECORD") or ""))
    binaries = Path(importlib.import_module("jaxlib").__path__[0])
    for path in sorted(binaries.iterdir()):
        if path.suffix in (".so", ".dll", ".pyd", ".dylib"):
            status = path.stat()
            facts.append([path.name, status.st_size, status.st_mtime_ns])
    facts.append(_sources())
    return _digest(json.dumps(facts))


def _sources() -> str:
    """A digest of the sources of compiled programs: to change one of them means to recompile."""
    home = Path(__file__).parents[1]
    found = hashlib.sha256()
    for path in sorted(home.rglob("*.py")):
        inside = path.relative_to(home)
        if inside.parts[0] not in NOT_TRACED:
            content = path.read_bytes()
            found.update(f"{inside.as_posix()} {len(content)}\n".encode() + content)
    return found.hexdigest()


def _processor() -> str:
    """What the processor can do, as far as the system says it."""
    try:
        with open("/proc/cpuinfo", "rb", buffering=0) as file:
            first = file.read(8192).decode(errors="replace").split("\n\n")[0]
    except OSError:
        return "; ".join((platform.processor(), platform.platform(), _mac_processor()))
    lines = [line for line in first.splitlines() if line.split(":")[0].strip() in CPU_FACTS]
    return "\n".join(lines)


def _mac_processor() -> str:
    if sys.platform != "darwin":
        return ""
    import ctypes

    found = ctypes.create_string_buffer(256)
    size = ctypes.c_size_t(len(found))
    library = ctypes.CDLL(None)
    library.sysctlbyname(b"machdep.cpu.brand_string", found, ctypes.byref(size), None, 0)
    return found.value.decode(errors="replace")


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()
