"""Calls from compiled programs into Python on the host, by a name that stays the same from process to process.

JAX's own callbacks are an address in the program, so that no program with one can stay in the persistent compilation
cache. Here a function is a handler of XLA's foreign function interface. ctypes reads its C structures (those of
`xla/ffi/api/c_api.h`, extended only at their ends) as words, without compilation. A handler states the version of these
structures, and XLA refuses a version that it no longer serves.
"""

import atexit
import ctypes
import functools
import math
import sys
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

HostFn = Callable[..., None]
"""A function that reads its arguments but the last, and writes that one; all are float32 and XLA's own memory."""
API_VERSION = (0, 1)  # Of XLA's interface with the places below: major and minor. 0.3 still has them; XLA serves both.

# Places of words in XLA_FFI_CallFrame, XLA_FFI_Api, XLA_FFI_Extension_Base, XLA_FFI_Metadata and XLA_FFI_Buffer.
_EXTENSION, _API, _NUM_ARGUMENTS, _ARGUMENTS, _RESULTS = 1, 2, 7, 9, 14
_CREATE_ERROR = 6
_EXTENSION_TYPE, _EXTENDED, _METADATA_VERSION = 1, 3, 3
_DATA, _RANK, _DIMS = 3, 4, 5
_METADATA, _INTERNAL = 1, 13  # codes of an extension and of an error
_REFUSAL = "a negative number, or another shape"
_Handler = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)


class HostCall:
    """A function on the host that compiled programs on the CPU call by its name; it must live as long as they do.

    Args:
      name: unique in this process. Programs in the persistent cache refer to it, so it must identify all that the
        function does.
      function: several threads may call it at once. It must not call JAX, which can deadlock.

    Raises:
      RuntimeError: XLA no longer serves `API_VERSION`.
    """

    def __init__(self, name: str, function: HostFn):
        self.name = name
        self._function = function
        self._handler = _Handler(self._handle)
        jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(self._handler), platform="cpu")

    def __call__(self, *arguments: Float[Array, "..."], size: int) -> Float[Array, "*batch {size}"]:
        """Call the function within a program; axes added by `vmap` lead in all arrays, which are not copied."""
        shape = jax.ShapeDtypeStruct((*arguments[0].shape[:-1], size), jnp.float32)
        return jax.ffi.ffi_call(self.name, shape, vmap_method="broadcast_all")(*arguments)

    def _handle(self, address: int) -> int | None:
        frame = _words(address, _RESULTS + 1)
        if frame[_EXTENSION]:
            extension = _words(frame[_EXTENSION], _EXTENDED + 1)
            if extension[_EXTENSION_TYPE] & 0xFFFFFFFF == _METADATA:  # once, at registration
                major, minor = API_VERSION
                _words(extension[_EXTENDED], _METADATA_VERSION + 1)[_METADATA_VERSION] = major | minor << 32
                return None
        try:
            arguments = _words(frame[_ARGUMENTS], frame[_NUM_ARGUMENTS])
            self._function(*map(_array, arguments), _array(*_words(frame[_RESULTS], 1)))
        except Exception as error:  # raised here it would only be printed
            return _as_error(frame[_API], f"{type(error).__name__}: {error}")
        return None


class HostFunction(HostCall):
    """A host call for programs on any device, by `jax.pure_callback` on accelerators or if XLA refuses ours.

    On a CPU that callback takes ten times as long to pass arrays as a host call, which works in XLA's own memory.
    """

    def __init__(self, name: str, function: HostFn):
        self._function = function
        if host_calls_work():
            super().__init__(name, function)

    def __call__(self, *arguments: Float[Array, "..."], size: int) -> Float[Array, "*batch {size}"]:
        shape = jax.ShapeDtypeStruct((size,), jnp.float32)
        copied = functools.partial(self._copied, size)
        elsewhere = functools.partial(jax.pure_callback, copied, shape, vmap_method="broadcast_all")
        here = functools.partial(super().__call__, size=size) if host_calls_work() else elsewhere
        return jax.lax.platform_dependent(*arguments, cpu=here, default=elsewhere)

    def _copied(self, size: int, *arguments: Array) -> np.ndarray:
        result = np.empty((*arguments[0].shape[:-1], size), np.float32)
        self._function(*map(np.asarray, arguments), result)
        return result


@atexit.register
def wait_for_programs() -> None:
    """Wait until every array is there: a program that calls into Python while that shuts down crashes or hangs."""
    for array in jax.live_arrays():
        try:
            array.block_until_ready()
        except RuntimeError:  # deleted, or its program has failed
            continue


@functools.cache
def host_calls_work() -> bool:
    """Return whether XLA calls the host as this module expects, by one call with a certain answer and one that must
    fail; print a line on standard error if it does not."""
    try:
        cpu, *_ = jax.local_devices(backend="cpu")
    except RuntimeError:  # without a CPU device no program asks for host calls
        return False
    argument, one = np.arange(6, dtype=np.float32).reshape(2, 3), np.ones((2, 1), np.float32)
    try:
        with jax.ensure_compile_time_eval(), jax.default_device(cpu):
            call = jax.jit(functools.partial(HostCall("taic_jax_probe", _answer), size=2))
            if np.array_equal(call(argument, one), [[1, 3], [7, 9]]) and _fails(call, argument, -one):
                return True
        reason = "a call of known answer went wrong"
    except (RuntimeError, ValueError) as error:
        reason = str(error).splitlines()[0]
    print(
        f"taic_jax: warning: this version of XLA does not call the physics directly ({reason}); "
        "it goes through jax.pure_callback, which is slower, and programs with physics are compiled at every start",
        file=sys.stderr,
    )
    return False


def _answer(argument: np.ndarray, one: np.ndarray, result: np.ndarray) -> None:
    """Return twice the first two of three columns, plus one; refuse a negative one."""
    if (argument.shape, one.shape) != ((2, 3), (2, 1)) or one.min() < 0:
        raise ValueError(_REFUSAL)
    result[...] = 2 * argument[:, :2] + one


def _fails(call: Callable[..., jax.Array], *arguments: np.ndarray) -> bool:
    try:
        jax.block_until_ready(call(*arguments))
    except Exception as error:  # its type differs between versions of JAX
        return _REFUSAL in str(error)
    return False


def _words(address: int, count: int) -> "ctypes.Array[ctypes.c_int64]":
    return (ctypes.c_int64 * count).from_address(address)


def _array(address: int) -> np.ndarray:
    """Return a buffer as an array, not copied."""
    buffer = _words(address, _DIMS + 1)
    shape = tuple(_words(buffer[_DIMS], buffer[_RANK]))
    return np.ndarray(shape, np.float32, (ctypes.c_char * (4 * math.prod(shape))).from_address(buffer[_DATA]))


def _as_error(api: int, message: str) -> int:
    """Return an error of XLA's with that message."""
    text = ctypes.c_char_p(message.encode())
    arguments = (ctypes.c_int64 * 4)(32, 0, ctypes.cast(text, ctypes.c_void_p).value or 0, _INTERNAL)
    return _Handler(_words(api, _CREATE_ERROR + 1)[_CREATE_ERROR])(ctypes.addressof(arguments)) or 0
