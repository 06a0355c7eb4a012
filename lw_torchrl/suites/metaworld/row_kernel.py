"""The Numba kernel that simulates many rows in one call, with MuJoCo's own functions and no Python between the rows.

MuJoCo's functions are called through their addresses in the library that MuJoCo's Python bindings have loaded, so the
results are bit-identical to those of the bindings. Importing this module raises an error if Numba or one of the
functions is missing, if Numba finds no writable cache folder, and on other systems than Linux.
"""

import ctypes
import sys
import time
from typing import Any

import llvmlite.binding
import mujoco
import numpy as np
from llvmlite import ir
from numba import carray, cfunc, from_dtype, njit, types
from numba.core import cgutils
from numba.extending import intrinsic
from numpy.typing import NDArray

from lw_torchrl.suites.metaworld import observation
from lw_torchrl.suites.metaworld.compiled_rows import ROW
from lw_torchrl.suites.metaworld.environments import WARNED_ALREADY, Places

if sys.platform != "linux":
    raise ImportError("the compiled simulation is supported only on Linux")

# The bindings' library depends on MuJoCo's, so its symbols include the copy of MuJoCo that the bindings use.
_mujoco = ctypes.CDLL(mujoco._functions.__file__)
_system = ctypes.CDLL(None)
_pointer = types.voidptr
_int32, _int64 = types.int32, types.int64


def _function(library: ctypes.CDLL, name: str, result: Any, *arguments: Any) -> Any:
    """Return a function of a C library for use in compiled code. Raise an AttributeError if the function is missing,
    because Numba would crash the process later."""
    llvmlite.binding.add_symbol(name, ctypes.cast(getattr(library, name), ctypes.c_void_p).value)
    return types.ExternalFunction(name, result(*arguments))


mj_step, mj_forward, mj_kinematics, mj_make_constraint, mj_reference_constraint, mj_euler = (
    _function(_mujoco, f"mj_{name}", types.void, _pointer, _pointer)
    for name in ("step", "forward", "kinematics", "makeConstraint", "referenceConstraint", "Euler")
)
mj_forward_skip = _function(_mujoco, "mj_forwardSkip", types.void, _pointer, _pointer, _int32, _int32)
get_error_handler = _function(_mujoco, "_mjPRIVATE__get_tls_error_fn", _pointer)
set_error_handler = _function(_mujoco, "_mjPRIVATE__set_tls_error_fn", types.void, _pointer)
clock_gettime = _function(_system, "clock_gettime", _int32, _int32, _pointer)
get_of_thread = _function(_system, "pthread_getspecific", _pointer, types.uint32)
set_of_thread = _function(_system, "pthread_setspecific", _int32, types.uint32, _pointer)
sched_yield = _function(_system, "sched_yield", _int32)
longjmp = _function(_system, "longjmp", types.void, _pointer, _int32)
_function(_system, "_setjmp", _int32, _pointer)

_size_of_block = _system.malloc_usable_size
_size_of_block.argtypes, _size_of_block.restype = [ctypes.c_void_p], ctypes.c_size_t
_VELOCITIES_DONE = int(mujoco.mjtStage.mjSTAGE_VEL)
_MATRIX, _QUATERNION = observation.MATRIX.start, observation.QUATERNION.start
_CLOCK = int(time.CLOCK_MONOTONIC)

# The key of a thread's jump buffer. Compiled code finds the key by name, because cached code runs in several processes.
_key = ctypes.c_uint32()
if _system.pthread_key_create(ctypes.byref(_key), None):
    raise ImportError("the process has no free key for data of its threads (pthread_key_create)")
llvmlite.binding.add_symbol("lw_torchrl_jump_key", ctypes.addressof(_key))


@intrinsic
def jump_key(typing: Any) -> Any:
    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        name, module = "lw_torchrl_jump_key", builder.module
        return builder.load(module.globals.get(name) or ir.GlobalVariable(module, ir.IntType(32), name))

    return types.uint32(), emit


@intrinsic
def pointer(typing: Any, address: Any) -> Any:
    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.inttoptr(arguments[0], cgutils.voidptr_t)

    return _pointer(_int64), emit


@intrinsic
def add_atomically(typing: Any, address: Any, number: Any) -> Any:
    """Add to an int64 atomically (other threads may do the same), and return the old value."""

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        place = builder.inttoptr(arguments[0], ir.IntType(64).as_pointer())
        return builder.atomic_rmw("add", place, arguments[1], "seq_cst")

    return _int64(_int64, _int64), emit


@intrinsic
def setjmp(typing: Any, buffer: Any) -> Any:
    """Return 0, and return again with 1 when ``longjmp`` is called."""

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        kind = ir.FunctionType(ir.IntType(32), [cgutils.voidptr_t])
        function = cgutils.get_or_insert_function(builder.module, kind, "_setjmp")
        function.attributes.add("returns_twice")
        return builder.call(function, arguments)

    return _int32(_pointer), emit


@cfunc(types.void(_pointer), cache=True)
def leave_mujoco(message: Any) -> None:
    """Handle a MuJoCo error by returning to the ``setjmp`` of this thread; MuJoCo's own handler ends the process."""
    longjmp(get_of_thread(jump_key()), 1)


# error_model="numpy" divides by zero without raising an error.
quaternion_of_matrix = njit(observation.quaternion_of_matrix, cache=True, error_model="numpy")


@njit(cache=True)
def _seconds(scratch: Any) -> float:
    clock_gettime(_CLOCK, pointer(scratch.ctypes.data))
    return scratch[0] + 1e-9 * scratch[1]


@njit(cache=True)
def _simulate_row(row: Any, inputs: Any, outputs: Any) -> None:
    model, data = pointer(row.model), pointer(row.data)
    for k in range(row.inputs):
        carray(pointer(row.inputs_at[k]), (1,), np.float64)[0] = inputs[k]
    substeps = row.substeps
    if row.looked:  # see SimulatedRow._substep_after_look
        mj_kinematics(model, data)
        mj_make_constraint(model, data)
        mj_reference_constraint(model, data)
        mj_forward_skip(model, data, _VELOCITIES_DONE, 1)
        mj_euler(model, data)
        substeps -= 1
    for _ in range(substeps):
        mj_step(model, data)
    for k in range(row.zeros):
        carray(pointer(row.zeros_at[k]), (1,), np.float64)[0] = 0.0
    if row.looks:
        mj_forward(model, data)
    for k in range(row.outputs):
        outputs[k] = carray(pointer(row.outputs_at[k]), (1,), np.float64)[0]
    if row.has_matrix:
        matrix = outputs[_MATRIX : _MATRIX + 9]
        quaternion = quaternion_of_matrix(
            (matrix[0], matrix[1], matrix[2], matrix[3], matrix[4], matrix[5], matrix[6], matrix[7], matrix[8])
        )
        for k in range(4):
            outputs[_QUATERNION + k] = quaternion[k]


@njit(cache=True)
def _try_row(row: Any, inputs: Any, outputs: Any, jump: Any) -> bool:
    """Simulate a row; return False if MuJoCo raised an error or counted a warning about an unstable simulation."""
    if setjmp(pointer(jump.ctypes.data)):
        return False
    _simulate_row(row, inputs, outputs)
    stable = True
    for k in range(row.warnings):
        stable &= carray(pointer(row.warnings_at[k]), (1,), np.int32)[0] == WARNED_ALREADY
    return stable


_table, _integers, _numbers = types.Array(from_dtype(ROW), 1, "C"), types.int64[::1], types.float64[:, ::1]
_SIGNATURE = types.void(
    *(_int64, _table, _integers, _integers, _integers, _numbers, _numbers, types.boolean[::1], types.boolean)
)


@njit(_SIGNATURE, cache=True, nogil=True)
def simulate(
    handler: Any, table: Any, rows: Any, order: Any, counts: Any, inputs: Any, outputs: Any, stable: Any, waits: Any
) -> None:
    """Simulate the rows that no other thread has taken, and, if ``waits``, wait for the other rows. All threads of a
    step call this function at once, with the same arrays.

    ``handler`` is the address of :func:`leave_mujoco`; ``table`` is a table of :data:`ROW`; ``rows`` (n,) int64 are the
    rows to simulate, and ``order`` (n,) int64 is the order in which to simulate them. ``counts`` (2,) int64 are the
    numbers of rows that threads have taken and finished. Reads ``inputs`` (n, K) float64; writes ``outputs`` (n, W)
    float64 and ``stable`` (n,) bool.
    """
    jump, scratch = np.empty(128, np.int64), np.empty(2, np.int64)
    set_of_thread(jump_key(), pointer(jump.ctypes.data))
    other_handler = get_error_handler()
    set_error_handler(pointer(handler))
    taken, done = counts.ctypes.data, counts.ctypes.data + 8
    start = _seconds(scratch)
    while True:
        number = add_atomically(taken, 1)
        if number >= len(order):
            break
        k = order[number]
        row = table[rows[k]]
        stable[k] = _try_row(row, inputs[k], outputs[k], jump)
        row.looked = row.looks_ahead
        end = _seconds(scratch)
        row.seconds, start = end - start, end
        add_atomically(done, 1)
    # Do not sleep: the last rows take less than a millisecond, and a sleeping thread wakes up late.
    while waits and add_atomically(done, 0) < len(order):
        sched_yield()
    set_error_handler(other_handler)


def model_with_places(model: Any, places: Places) -> NDArray[np.int64]:
    """Copy the C struct of an MjModel, but with these positions of bodies and sites; return it as an array.

    All other arrays of the model are shared, so each row can have a model with its own positions. The model must
    outlive the copy.
    """
    # MuJoCo does not report the size of the struct, but the struct fills a block of memory.
    size = _size_of_block(model._address)
    struct = np.frombuffer((ctypes.c_char * size).from_address(model._address), np.int64, size // 8).copy()
    for array, own in zip((model.body_pos, model.site_pos), places, strict=True):
        (field,) = np.flatnonzero(struct == array.ctypes.data)
        struct[field] = own.ctypes.data
    return struct
