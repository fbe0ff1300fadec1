"""Calls from compiled programs into Python on the host, by a name that stays the same from process to process.

JAX's own callbacks are baked into a program as an address, so no program with one can be kept in the persistent
compilation cache. Here a function is a handler of XLA's foreign function interface. Its C structures (those of
`xla/ffi/api/c_api.h`, extended only at their ends) are read by ctypes, as words: nothing needs to be compiled.
"""

import ctypes
import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

HostFn = Callable[[np.ndarray, np.ndarray], None]
"""Reads its first argument, writes its second; both are float32 and XLA's own memory."""

# Places of words in XLA_FFI_CallFrame, XLA_FFI_Api, XLA_FFI_Extension_Base, XLA_FFI_Metadata and XLA_FFI_Buffer.
_EXTENSION, _API, _ARGUMENTS, _RESULTS = 1, 2, 9, 14
_VERSION, _CREATE_ERROR = 4, 6
_EXTENSION_TYPE, _EXTENDED, _METADATA_VERSION = 1, 3, 3
_DATA, _RANK, _DIMS = 3, 4, 5
_METADATA, _INTERNAL = 1, 13  # codes of an extension and of an error

_Handler = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)


class HostCall:
    """A function on the host that compiled programs on the CPU call by its name; keep it for as long as they live.

    Args:
      name: not used before in this process. Programs in the persistent cache look for it, so it must tell what
        the function does.
      function: what to call, maybe from several threads at once. It must not call JAX, which can deadlock.
    """

    def __init__(self, name: str, function: HostFn):
        self.name = name
        self._function = function
        self._handler = _Handler(self._handle)
        jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(self._handler), platform="cpu")

    def __call__(self, argument: Float[Array, "*batch n"], size: int) -> Float[Array, "*batch {size}"]:
        """Call the function within a program; axes added by `vmap` lead in both arrays."""
        shape = jax.ShapeDtypeStruct((*argument.shape[:-1], size), jnp.float32)
        return jax.ffi.ffi_call(self.name, shape, vmap_method="broadcast_all")(argument)

    def _handle(self, address: int) -> int | None:
        frame = _words(address, _RESULTS + 1)
        if frame[_EXTENSION]:
            extension = _words(frame[_EXTENSION], _EXTENDED + 1)
            if extension[_EXTENSION_TYPE] & 0xFFFFFFFF == _METADATA:  # asked once, at registration
                version = _words(frame[_API], _VERSION + 2)[_VERSION]
                _words(extension[_EXTENDED], _METADATA_VERSION + 1)[_METADATA_VERSION] = version
                return None
        try:
            self._function(_array(frame[_ARGUMENTS]), _array(frame[_RESULTS]))
        except Exception as error:  # raised here it would only be printed
            return _as_error(frame[_API], f"{type(error).__name__}: {error}")
        return None


def _words(address: int, count: int) -> "ctypes.Array[ctypes.c_int64]":
    return (ctypes.c_int64 * count).from_address(address)


def _array(buffers: int) -> np.ndarray:
    """Return the first of the buffers as an array, not copied."""
    buffer = _words(_words(buffers, 1)[0], _DIMS + 1)
    shape = tuple(_words(buffer[_DIMS], buffer[_RANK]))
    return np.ndarray(shape, np.float32, (ctypes.c_char * (4 * math.prod(shape))).from_address(buffer[_DATA]))


def _as_error(api: int, message: str) -> int:
    """Have XLA make an error with that message."""
    text = ctypes.c_char_p(message.encode())
    told = (ctypes.c_int64 * 4)(32, 0, ctypes.cast(text, ctypes.c_void_p).value or 0, _INTERNAL)
    return _Handler(_words(api, _CREATE_ERROR + 1)[_CREATE_ERROR])(ctypes.addressof(told)) or 0
